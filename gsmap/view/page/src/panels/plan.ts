// A floor plan with its rooms, the numbered changes of the list, and the object that is chosen or pointed at.
import { css, html, nothing, svg } from "lit";
import { customElement, property } from "lit/decorators.js";
import * as actions from "../actions";
import type { Box, ChangeEntry, FloorPlan, GraphEntry, Vector } from "../contract";
import * as derive from "../derive";
import { page } from "../state";
import { middleOf } from "../words";
import { Panel, vars } from "./base";
import { shared } from "./css";
import "./kind";

const WIDTH = 1000; // of the drawing's own units
type Place = [number, number];

@customElement("gs-plan")
export class Plan extends Panel {
  static override styles = [
    shared,
    css`
      :host {
        min-height: 0;
      }
      :host(:not([small])) {
        container-type: size;
        display: grid;
        place-content: center;
      }
      .sheet {
        position: relative;
        aspect-ratio: var(--ratio);
        width: 100%;
      }
      :host(:not([small])) .sheet {
        width: min(100cqw, 100cqh * var(--ratio));
      }
      svg {
        position: absolute;
        inset: 0;
        width: 100%;
        height: 100%;
      }
      path {
        fill: none;
        stroke: var(--accent);
        stroke-width: 1.2;
        opacity: 0.7;
        vector-effect: non-scaling-stroke;
      }
      .room-outline {
        stroke: var(--muted);
        stroke-width: 1;
      }
      .thing {
        stroke: var(--bad);
        stroke-width: 2.5;
        opacity: 1;
      }
      .at {
        position: absolute;
        left: var(--x);
        top: var(--y);
        transform: translate(-50%, -50%);
        font-size: 0.85rem;
        font-weight: 600;
        white-space: nowrap;
        text-shadow:
          0 0 3px var(--ground),
          0 0 3px var(--ground),
          0 0 3px var(--ground);
        pointer-events: none;
      }
      .room {
        color: var(--muted);
        font-size: 0.78rem;
      }
      button.spot {
        min-height: 0;
        padding: 6px;
        border: 0;
        background: none;
        pointer-events: auto;
        text-shadow: none;
      }
      button.spot gs-kind {
        box-shadow: 0 0 0 1.5px var(--surface);
        border-radius: 99px;
      }
      @media (max-width: 759px) {
        button.spot {
          min-width: 36px;
          min-height: 36px;
        }
      }
      button.bold {
        z-index: 1;
        transform: translate(-50%, -50%) scale(1.35);
      }
      button.bold gs-kind {
        box-shadow: 0 0 0 2px var(--text);
      }
    `,
  ];

  @property({ attribute: false }) plan: FloorPlan | null = null;
  @property({ type: Boolean, reflect: true }) small = false;

  protected override render() {
    const { plan, state } = this;
    const { map, component, selection } = state;
    if (!plan || !map) return nothing;
    const { picture, size_m: size, scenes } = plan;
    const high = (WIDTH * size[1]) / size[0];
    const uri = picture?.startsWith("data:image/webp;base64,") ? picture : null;
    const changes = derive.shownChanges(state);
    const isOfThings = changes.length > 0 || state.tab === "things" || selection?.kind === "object";
    const known = isOfThings ? actions.graphOf(state) : null;
    const graph = known?.status === "ready" ? known.value : null;
    const rooms = graph?.rooms.filter((room) => room.component === component) ?? [];
    const bold = (id: string) => state.hovered === id || selection?.key === id;
    const boxes = [...changes, ...this.objects(graph)].filter(({ id }) => bold(id)).map(({ box }) => box);
    const point = ([x, y]: Place) => `${(WIDTH * x).toFixed(1)} ${(high * y).toFixed(1)}`;
    const line = (ends: Place[]) => `M${ends.map(point).join("L")}`;
    const on = (at: Vector) => derive.onPlan(plan, at);
    return html`<div class="sheet" ${vars({ "--ratio": (size[0] / size[1]).toFixed(4) })}>
      <svg viewBox="0 0 ${WIDTH} ${high}" role="img" aria-label="Floor plan of the map">
        ${uri ? svg`<image href=${uri} width=${WIDTH} height=${high} preserveAspectRatio="none" />` : nothing}
        ${
          this.small
            ? nothing
            : scenes.map(({ outlines }) => svg`<path d=${outlines.map((ring) => `${line(ring)}Z`).join("")} />`)
        }
        ${rooms.map(
          ({ outline }) => svg`<path class="room-outline" d=${outline.map((ends) => line(ends.map(on))).join("")} />`,
        )}
        ${boxes.map(
          (box) =>
            svg`<path class="thing" d=${edgesOf(box)
              .map((ends) => line(ends.map(on)))
              .join("")} />`,
        )}
      </svg>
      ${
        this.small
          ? nothing
          : scenes.map(({ scene, at }) => html`<span class="at" ${place(at)}>${map.scenes[scene]?.name ?? ""}</span>`)
      }
      ${rooms.map(({ id, outline }) => html`<span class="at room" ${place(on(middleOf(actions.around(outline.flat()))))}>${id}</span>`)}
      ${changes.map((one) => this.change(one, on(middleOf(one.box)), bold(one.id)))}
    </div>`;
  }

  private objects(graph: GraphEntry | null) {
    return graph?.objects.filter((one) => one.component === this.state.component) ?? [];
  }

  private change(one: ChangeEntry, at: Place, isBold: boolean) {
    const name = `${one.id}: ${actions.titleOfChange(one)}`;
    return html`<button
      class="at spot ${isBold ? "bold" : ""}"
      title=${name}
      aria-label=${name}
      aria-pressed=${derive.isSelected(this.state, "change", one.id)}
      ${place(at)}
      @click=${() => actions.select({ kind: "change", key: one.id })}
      @pointerenter=${() => actions.hover(one.id)}
      @pointerleave=${() => actions.hover(null)}
    >
      <gs-kind .change=${one}></gs-kind>
    </button>`;
  }
}

/** The floor plan of what is chosen, beside a 3D view; without one the floor plan takes its place. */
export function whereItIs() {
  const known = actions.has3D(page.state) ? actions.planOf(page.state) : null;
  if (known?.status !== "ready") return nothing;
  return html`<section>
    <h3>Where it is</h3>
    <gs-plan small .plan=${known.value}></gs-plan>
  </section>`;
}

const place = ([x, y]: Place) => vars({ "--x": `${(100 * x).toFixed(2)}%`, "--y": `${(100 * y).toFixed(2)}%` });

/** The twelve edges of a box. */
function edgesOf(box: Box): [Vector, Vector][] {
  const corner = (i: number) => [0, 1, 2].map((axis) => box[(i >> axis) & 1]?.[axis] ?? 0) as Vector;
  return [0, 1, 2, 3, 4, 5, 6, 7].flatMap((i) =>
    [1, 2, 4].filter((bit) => !(i & bit)).map((bit): [Vector, Vector] => [corner(i), corner(i | bit)]),
  );
}
