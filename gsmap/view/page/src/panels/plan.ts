// A floor plan with its rooms, the numbered changes of the list, and the object that is chosen or pointed at.
import { css, html, nothing, svg } from "lit";
import { customElement, property, state } from "lit/decorators.js";
import * as actions from "../actions";
import type { Box, ChangeEntry, FloorPlan, GraphEntry, ObjectEntry, SceneEntry, Vector } from "../contract";
import * as derive from "../derive";
import { page } from "../state";
import { middleOf, titleOf } from "../words";
import { Panel, vars } from "./base";
import { shared } from "./css";
import "./kind";

const WIDTH = 1000; // of the drawing's own units
const MOST_ZOOM = 12;
const WHEEL_PX = 400; // of scrolling, by which the plan grows e-fold
const DRAG_PX = 4; // shorter ones are clicks
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
        touch-action: none;
      }
      :host([zoomed]) {
        overflow: hidden;
      }
      .sheet {
        position: relative;
        aspect-ratio: var(--ratio);
        width: 100%;
      }
      :host(:not([small])) .sheet {
        width: calc(min(100cqw, 100cqh * var(--ratio)) * var(--zoom));
        transform: translate(var(--right), var(--down));
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
      .object {
        stroke: var(--text);
        stroke-width: 1;
        opacity: 0.35;
        pointer-events: all;
        cursor: pointer;
      }
      .object:hover {
        stroke-width: 2.5;
        opacity: 1;
      }
      .thing {
        pointer-events: none;
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
      button.at {
        min-height: 0;
        padding: 2px 4px;
        border: 0;
        background: none;
        pointer-events: auto;
      }
      button.scene[aria-pressed="true"],
      button.scene:hover {
        color: var(--accent-text);
        text-decoration: underline;
      }
      button.spot {
        padding: 6px;
        text-shadow: none;
      }
      button.spot gs-kind {
        box-shadow: 0 0 0 1.5px var(--surface);
        border-radius: 99px;
      }
      @media (max-width: 759px) {
        button.at {
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

  @state() private zoom = 1;
  @state() private at: Place = [0, 0]; // of the sheet's middle from the element's, pixels
  private held: Place | null = null; // where the pointer was, of a drag

  constructor() {
    super();
    this.addEventListener("wheel", this.wheeled);
    this.addEventListener("pointerdown", ({ button, clientX, clientY }) => {
      this.held = button === 0 && this.zoom > 1 ? [clientX, clientY] : null;
    });
    this.addEventListener("pointermove", this.dragged);
    for (const name of ["pointerup", "pointercancel"]) this.addEventListener(name, () => (this.held = null));
  }

  /** Zooms about the pointer. */
  private readonly wheeled = (event: WheelEvent): void => {
    if (this.small) return;
    event.preventDefault();
    const zoom = Math.max(1, Math.min(MOST_ZOOM, this.zoom * Math.exp(-event.deltaY / WHEEL_PX)));
    const { left, top, width, height } = this.getBoundingClientRect();
    const pointer: Place = [event.clientX - left - width / 2, event.clientY - top - height / 2];
    const by = zoom / this.zoom;
    this.zoom = zoom;
    this.moveTo(this.at.map((v, i) => (pointer[i] ?? 0) * (1 - by) + v * by) as Place);
  };

  private readonly dragged = (event: PointerEvent): void => {
    if (!this.held || !(event.buttons & 1)) return;
    const by = [event.clientX - this.held[0], event.clientY - this.held[1]] as const;
    if (!this.hasPointerCapture(event.pointerId)) {
      if (Math.hypot(...by) < DRAG_PX) return; // still a click
      this.setPointerCapture(event.pointerId);
    }
    this.held = [event.clientX, event.clientY];
    this.moveTo([this.at[0] + by[0], this.at[1] + by[1]]);
  };

  /** Keeps the middle of the view on the sheet. */
  private moveTo(at: Place): void {
    this.toggleAttribute("zoomed", this.zoom > 1);
    const most = [this.clientWidth, this.clientHeight].map((side) => ((this.zoom - 1) * side) / 2);
    this.at = at.map((v, i) => Math.max(-(most[i] ?? 0), Math.min(most[i] ?? 0, v))) as Place;
  }

  protected override render() {
    const { plan, state } = this;
    const { map, component, selection } = state;
    if (!plan || !map) return nothing;
    const { picture, size_m: size } = plan;
    const scenes = plan.scenes.filter(({ scene }) => derive.isBy(map.scenes[scene]?.captured_at ?? null, state.until));
    const high = (WIDTH * size[1]) / size[0];
    const uri = picture?.startsWith("data:image/webp;base64,") ? picture : null;
    const changes = derive.shownChanges(state);
    const isOfThings = changes.length > 0 || state.tab === "things" || selection?.kind === "object";
    const known = isOfThings ? actions.graphOf(state) : null;
    const graph = known?.status === "ready" ? known.value : null;
    const rooms = graph?.rooms.filter((room) => room.component === component) ?? [];
    const bold = (id: string) => state.hovered === id || selection?.key === id;
    const isListed = !this.small && (state.tab === "things" || selection?.kind === "object");
    const objects = isListed
      ? this.objects(graph)
          .filter((one) => one.there)
          .sort(bySize)
      : [];
    const boxes = [...changes, ...this.objects(graph)].filter(({ id }) => bold(id)).map(({ box }) => box);
    const point = ([x, y]: Place) => `${(WIDTH * x).toFixed(1)} ${(high * y).toFixed(1)}`;
    const line = (ends: Place[]) => `M${ends.map(point).join("L")}`;
    const on = (at: Vector) => derive.onPlan(plan, at);
    return html`<div
      class="sheet"
      ${vars({
        "--ratio": (size[0] / size[1]).toFixed(4),
        "--zoom": String(this.zoom),
        "--right": `${this.at[0]}px`,
        "--down": `${this.at[1]}px`,
      })}
    >
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
        ${objects.map(
          (one) =>
            svg`<path class="object" data-id=${one.id} d="${line(footprint(one.box, on))}Z"
              @click=${() => actions.select({ kind: "object", key: one.id })}
              @pointerenter=${() => actions.hover(one.id)}
              @pointerleave=${() => actions.hover(null)}><title>${titleOf(one)}</title></path>`,
        )}
        ${boxes.map(
          (box) =>
            svg`<path class="thing" d=${edgesOf(box)
              .map((ends) => line(ends.map(on)))
              .join("")} />`,
        )}
      </svg>
      ${this.small ? nothing : scenes.map(({ scene, at }) => this.scene(map.scenes[scene], at))}
      ${rooms.map(({ id, outline }) => html`<span class="at room" ${place(on(middleOf(actions.around(outline.flat()))))}>${id}</span>`)}
      ${changes.map((one) => this.change(one, on(middleOf(one.box)), bold(one.id)))}
    </div>`;
  }

  private objects(graph: GraphEntry | null) {
    return graph?.objects.filter((one) => one.component === this.state.component) ?? [];
  }

  private scene(one: SceneEntry | undefined, at: Place) {
    if (!one) return nothing;
    return html`<button
      class="at scene"
      aria-pressed=${derive.isSelected(this.state, "scene", one.id)}
      ${place(at)}
      @click=${() => actions.select({ kind: "scene", key: one.id }, false)}
    >
      ${one.name}
    </button>`;
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

const volume = ([low, high]: Box) => low.reduce((product, v, i) => product * ((high[i] ?? v) - v), 1);

/** Large objects first, so that the small ones in them are on top. */
const bySize = (a: ObjectEntry, b: ObjectEntry) => volume(b.box) - volume(a.box);

/** Corner of a box by its number: bit i is set at the highest coordinate i. */
const cornerOf = (box: Box) => (i: number) => [0, 1, 2].map((axis) => box[(i >> axis) & 1]?.[axis] ?? 0) as Vector;

/** The face of a box that is the largest on the plan, in order around it. */
function footprint(box: Box, on: (at: Vector) => Place): Place[] {
  const faces = [
    [0, 1, 3, 2],
    [0, 1, 5, 4],
    [0, 2, 6, 4],
  ].map((face) => face.map(cornerOf(box)).map(on));
  const area = ([a, b, , d]: Place[]) =>
    a && b && d ? Math.abs((b[0] - a[0]) * (d[1] - a[1]) - (b[1] - a[1]) * (d[0] - a[0])) : 0;
  return faces.reduce((best, face) => (area(face) > area(best) ? face : best));
}

/** The twelve edges of a box. */
function edgesOf(box: Box): [Vector, Vector][] {
  const corner = cornerOf(box);
  return [0, 1, 2, 3, 4, 5, 6, 7].flatMap((i) =>
    [1, 2, 4].filter((bit) => !(i & bit)).map((bit): [Vector, Vector] => [corner(i), corner(i | bit)]),
  );
}
