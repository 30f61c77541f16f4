// The way into the map and out of it; until the 3D view has something to show, the floor plan.
import { css, html, nothing, svg } from "lit";
import { customElement, state } from "lit/decorators.js";
import * as actions from "../actions";
import type { FloorPlan } from "../contract";
import * as derive from "../derive";
import { page } from "../state";
import { CanvasPanel } from "./base";
import { shared } from "./css";
import { icon } from "./icons";

const WIDTH = 1000; // of the drawing's own units

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
        padding: 48px 64px 24px;
        min-height: 0;
        display: grid;
        grid-template-rows: minmax(0, 1fr) auto;
        gap: 10px;
        background: var(--ground);
        pointer-events: auto;
      }
      figure svg {
        width: 100%;
        height: 100%;
      }
      figcaption {
        text-align: center;
        color: var(--muted);
      }
      .outline {
        fill: none;
        stroke: var(--accent);
        stroke-width: 2.5;
        opacity: 0.7;
      }
      text {
        font:
          600 26px system-ui,
          sans-serif;
        fill: var(--text);
        stroke: var(--ground);
        stroke-width: 6px;
        paint-order: stroke;
        text-anchor: middle;
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

  private plan({ picture, size_m: [width, height], scenes }: FloorPlan, error: string | null) {
    const high = (WIDTH * height) / width;
    const at = ([x, y]: [number, number]) => `${(WIDTH * x).toFixed(1)} ${(high * y).toFixed(1)}`;
    const outline = (rings: [number, number][][]) => rings.map((ring) => `M${ring.map(at).join("L")}Z`).join("");
    const uri = picture?.startsWith("data:image/webp;base64,") ? picture : null;
    return html`<figure>
      <svg viewBox="0 0 ${WIDTH} ${high}" role="img" aria-label="Floor plan of the map">
        ${uri ? svg`<image href=${uri} width=${WIDTH} height=${high} preserveAspectRatio="none" />` : nothing}
        ${scenes.map(({ outlines }) => svg`<path class="outline" d=${outline(outlines)} />`)}
        ${scenes.map(
          ({ scene, at: [x, y] }) =>
            svg`<text x=${WIDTH * x} y=${high * y}>${this.state.map?.scenes[scene]?.name ?? ""}</text>`,
        )}
      </svg>
      <figcaption role="status">
        Floor plan, ${width.toFixed(0)} × ${height.toFixed(0)} m.
        ${
          error
            ? html`The 3D view does not work here: ${error} It needs WebGL 2: look whether the browser's hardware
              acceleration is on. Lists, reviews and pictures work without it.`
            : "The 3D view is being prepared."
        }
        ${this.isDrawn ? html`<button @click=${actions.stay}>Show what is there of it</button>` : nothing}
      </figcaption>
    </figure>`;
  }
}
