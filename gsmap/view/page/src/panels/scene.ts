// One scene: what is known of it, and where a person says that it lies.
import { css, html, nothing } from "lit";
import { customElement } from "lit/decorators.js";
import * as actions from "../actions";
import type { MapSummary, SceneEntry } from "../contract";
import * as derive from "../derive";
import type { Drag } from "../state";
import { day, metres, middleOf, moved, number, plural } from "../words";
import { Panel } from "./base";
import { shared } from "./css";
import { heading } from "./heading";
import { icon } from "./icons";
import { markOf } from "./review";

const MARKS: Record<string, string> = { placed: "good", "one pair": "warn hollow", tentative: "warn" };
const MOST_EDGES = 12;

@customElement("gs-scene")
export class SceneDetail extends Panel {
  static override styles = [
    shared,
    heading.styles,
    css`
      .edges li button {
        width: 100%;
        justify-content: space-between;
        text-align: left;
        border-color: transparent;
        background: none;
        padding: 3px 6px;
        margin: 0 -6px;
        width: calc(100% + 12px);
      }
      .edges li button:hover {
        background: var(--hover);
      }
      .sigmas {
        display: grid;
        grid-template-columns: 1fr 1fr;
        gap: 8px;
      }
      .sigmas label {
        display: grid;
        gap: 3px;
      }
    `,
  ];

  private sigmaM = "0.10";
  private sigmaDeg = "3";

  protected override render() {
    const { state } = this;
    const { map } = state;
    const scene = derive.selectedScene(state);
    if (!map || !scene) return nothing;
    const unit = derive.componentOf(map, scene.component)?.metres_per_unit ?? 1;
    const isHidden = actions.sideNow(state).hidden.has(scene.id);
    const tags = scene.tags ?? [];
    return html`
      ${heading(scene.name, html`<span class="mark ${MARKS[scene.status] ?? "hollow"}">${scene.status}</span>`, true)}
      <div class="body">
        ${
          actions.has3D(state)
            ? html`<section class="row">
                <button @click=${() => actions.flyToSelected()}>${icon("fly")} Fly to it</button>
                <button @click=${() => actions.solo(scene.id)}>${icon("solo")} Only this</button>
                <button @click=${() => actions.toggleScene(scene.id)}>
                  ${icon(isHidden ? "eye" : "hidden")} ${isHidden ? "Show" : "Hide"}
                </button>
              </section>`
            : nothing
        }
        ${state.drag?.scene === scene.id ? this.dragging(state.drag, scene, unit) : this.prior(scene)}
        <section>
          <dl class="facts">
            <dt>Captured</dt>
            <dd>${day(scene.captured_at)}</dd>
            <dt>Gaussians</dt>
            <dd>${number(scene.num_gaussians)}</dd>
            <dt>Cameras</dt>
            <dd>${number(scene.num_cameras)}</dd>
            <dt>Uncertainty of its middle</dt>
            <dd>${scene.sigma_m === null ? "unknown" : `± ${metres(scene.sigma_m)}`}</dd>
            <dt>Prior</dt>
            <dd>${scene.prior ?? "none"}</dd>
            ${
              tags.length
                ? html`<dt>Tags</dt>
                    <dd>${tags.map((tag) => `#${tag}`).join(" ")}</dd>`
                : nothing
            }
            <dt>Id</dt>
            <dd>${scene.id}</dd>
          </dl>
        </section>
        ${this.edges(scene, map)}
      </div>
    `;
  }

  private prior(scene: SceneEntry) {
    const { state } = this;
    if (!actions.mayAct(state)) return nothing;
    return html`<section class="row">
      ${
        actions.has3D(state)
          ? html`<button ?disabled=${state.busy !== null} @click=${() => actions.startDrag(scene.id)}>
              ${icon("move")} Move by hand
            </button>`
          : nothing
      }
      ${
        scene.prior
          ? html`<button
              ?disabled=${state.busy !== null}
              title="Forget: ${scene.prior}"
              @click=${() => void actions.removePrior(scene)}
            >
              ${icon("close")} Remove the prior
            </button>`
          : nothing
      }
    </section>`;
  }

  private dragging(drag: Drag, scene: SceneEntry, unit: number) {
    const by = moved(drag.from, drag.now, middleOf(scene.box), unit);
    const isMoved = by.metres > 1e-6 || by.degrees > 1e-4;
    return html`<section class="card stack">
      <h3>Where it lies</h3>
      <p>
        Drag the arrows and rings in the 3D view until the scene lies where it belongs. Saved, this is a prior: optimize
        weighs it against the edges by how sure you are.
      </p>
      <p class="figures" role="status">
        ${isMoved ? html`Moved by ${metres(by.metres)} and ${by.degrees.toFixed(1)}°` : "Not moved yet: it would be held where it is"}
      </p>
      <form class="stack" @submit=${this.save}>
        <div class="sigmas">
          ${sure("metres", "sigma_m", 0.001, 1000, this.sigmaM, (value) => (this.sigmaM = value))}
          ${sure("degrees", "sigma_deg", 0.01, 180, this.sigmaDeg, (value) => (this.sigmaDeg = value))}
        </div>
        ${scene.prior ? html`<p class="small muted">It takes the place of what was told before: ${scene.prior}.</p>` : nothing}
        <div class="row">
          <button class="main" ?disabled=${this.state.busy !== null}>Save as prior</button>
          <button type="button" @click=${actions.endDrag}>Cancel</button>
        </div>
      </form>
    </section>`;
  }

  private readonly save = (event: Event) => {
    event.preventDefault();
    void actions.savePrior(Number(this.sigmaM), Number(this.sigmaDeg));
  };

  private edges(scene: SceneEntry, map: MapSummary) {
    const index = map.scenes.indexOf(scene);
    const edges = map.edges
      .filter((edge) => edge.target === index || edge.source === index)
      .sort((a, b) => b.doubt - a.doubt || b.num_inliers - a.num_inliers);
    return html`<section>
      <h3>Its edges</h3>
      ${edges.length ? nothing : html`<p class="muted">No pair with it was tried.</p>`}
      <ul class="edges">
        ${edges.slice(0, MOST_EDGES).map(
          (edge) =>
            html`<li>
              <button @click=${() => actions.select({ kind: "edge", key: derive.edgeKey(map, edge) })}>
                <span class="anywhere">${map.scenes[edge.target === index ? edge.source : edge.target]?.name}</span>
                ${markOf(edge)}
              </button>
            </li>`,
        )}
      </ul>
      ${
        edges.length > MOST_EDGES
          ? html`<p class="muted small">and ${plural(edges.length - MOST_EDGES, "further pair")}: Review lists all.</p>`
          : nothing
      }
    </section>`;
  }
}

/** How surely a scene lies where it was put. */
function sure(unit: string, name: string, min: number, max: number, value: string, set: (value: string) => void) {
  return html`<label
    ><span>Sure to, ${unit}</span
    ><input
      name=${name}
      type="number"
      min=${min}
      max=${max}
      step="any"
      required
      .value=${value}
      @input=${(event: Event) => set((event.target as HTMLInputElement).value)}
  /></label>`;
}
