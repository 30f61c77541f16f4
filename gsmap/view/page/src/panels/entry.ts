// The way into the map and out of it; until the 3D view has something to show, the floor plan.
import { css, html, nothing } from "lit";
import { customElement, state } from "lit/decorators.js";
import * as actions from "../actions";
import type { FloorPlan } from "../contract";
import * as derive from "../derive";
import { page } from "../state";
import { day } from "../words";
import { CanvasPanel } from "./base";
import { shared } from "./css";
import { icon } from "./icons";
import "./plan";

@customElement("gs-entry")
export class Entry extends CanvasPanel {
  static override styles = [
    shared,
    css`
      :host {
        position: absolute;
        inset: 0;
        display: grid;
        pointer-events: none;
      }
      .way {
        align-self: end;
        justify-self: start;
        margin: 12px;
        pointer-events: auto;
        box-shadow: 0 2px 10px var(--shade);
      }
      figure {
        margin: 0;
        padding: 16px 60px 16px 16px;
        min-height: 0;
        display: grid;
        grid-template-rows: auto minmax(0, 1fr) auto;
        gap: 10px;
        background: var(--ground);
        pointer-events: auto;
      }
      figcaption {
        text-align: center;
        color: var(--muted);
        text-wrap: pretty;
      }
      @media (max-width: 759px) {
        figure {
          padding: 12px;
        }
      }
    `,
  ];

  @state() private isAbove = false;
  @state() private isDrawn = false;
  @state() private hasStood = false;

  protected readonly drawn = (): void => {
    const known = page.stage?.state;
    this.isAbove = known?.isAbove ?? false;
    this.isDrawn = known?.isShown ?? false;
    this.hasStood = known?.hasStood ?? false;
  };

  protected override render() {
    const { map, component, stageError } = this.state;
    const shown = map && derive.componentOf(map, component);
    if (!shown) return nothing;
    const pending = shown.overview?.pending ?? 0;
    const isComing = !this.isDrawn || (pending > 0 && !this.hasStood);
    const known = isComing ? actions.planOf(this.state) : null;
    if (known?.status === "ready") return this.plan(known.value, stageError);
    if (!this.isDrawn) return nothing;
    if (!shown.overview?.has_ceiling) return nothing;
    return this.isAbove
      ? html`<button class="main way" title="Walk in (i)" @click=${() => void actions.walkIn()}>
          ${icon("walk")} Walk in
        </button>`
      : html`<button class="way" title="See it from above (f)" @click=${actions.fit}>
          ${icon("house")} From above
        </button>`;
  }

  private plan(plan: FloorPlan, error: string | null) {
    const [width, height] = plan.size_m;
    const { until } = this.state;
    return html`<figure>
      <h2>Floor plan <span class="muted small">${width.toFixed(0)} × ${height.toFixed(0)} m</span></h2>
      <gs-plan .plan=${plan}></gs-plan>
      <figcaption role="status" class="small">
        ${until ? `Outlines of captures until ${day(until)}; the picture shows every capture.` : nothing}
        ${
          error
            ? html`The 3D view needs WebGL 2, which does not work here: look whether the browser's hardware acceleration
              is on. Lists, reviews and pictures work without it. (${error})`
            : "The 3D view is being prepared."
        }
        ${this.isDrawn ? html`<button @click=${actions.stay}>Show what is there of it</button>` : nothing}
      </figcaption>
    </figure>`;
  }
}
