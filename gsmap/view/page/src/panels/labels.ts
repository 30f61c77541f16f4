// Numbers of changes over the 3D view, and names of the scenes while the viewer sees them from above.
import { css, html } from "lit";
import type { PropertyValues } from "lit";
import { customElement } from "lit/decorators.js";
import { repeat } from "lit/directives/repeat.js";
import * as actions from "../actions";
import type { SceneEntry } from "../contract";
import * as derive from "../derive";
import { page } from "../state";
import { middleOf } from "../words";
import { posesOf } from "../driver";
import { CanvasPanel } from "./base";
import { shared } from "./css";
import "./kind";

const HIGH = 26; // px, of a label and its margin
const MOST = 200; // of a component that are labelled

@customElement("gs-labels")
export class Labels extends CanvasPanel {
  static override styles = [
    shared,
    css`
      :host {
        position: absolute;
        inset: 0;
        overflow: hidden;
        pointer-events: none;
      }
      button {
        position: absolute;
        left: 0;
        top: 0;
        min-height: 0;
        max-width: 14rem;
        padding: 1px 9px;
        border: 1px solid var(--line);
        border-radius: 99px;
        background: var(--surface);
        box-shadow: 0 1px 6px var(--shade);
        color: var(--text);
        font-size: 0.85rem;
        font-weight: 600;
        white-space: nowrap;
        overflow: hidden;
        text-overflow: ellipsis;
        pointer-events: auto;
        transform: translate(var(--x), var(--y)) translate(-50%, -50%);
      }
      button[aria-pressed="true"] {
        border-color: var(--accent);
        color: var(--accent-text);
      }
      button.change {
        padding: 2px;
      }
      button.change:hover,
      button.change[aria-pressed="true"] {
        z-index: 1; /* above others at the same place */
      }
      @media (max-width: 759px) {
        button,
        button.change {
          min-width: 36px;
          min-height: 36px;
        }
      }
      .out {
        visibility: hidden;
        transform: none;
      }
    `,
  ];

  private scenes(): { scene: SceneEntry; index: number }[] {
    const { map, left, drag } = this.state;
    if (!map || drag || this.state.revision !== null) return [];
    const seen = derive.visible(this.state, left, posesOf(this.state));
    const all = map.scenes.map((scene, index) => ({ scene, index })).filter(({ index }) => seen.has(index));
    return all.sort((a, b) => b.scene.num_gaussians - a.scene.num_gaussians).slice(0, MOST);
  }

  protected override render() {
    return html`${repeat(
      derive.shownChanges(this.state).slice(0, MOST),
      ({ id }) => id,
      (change) =>
        html`<button
          class="change out"
          data-change=${change.id}
          tabindex="-1"
          title="${change.id}: ${actions.titleOfChange(change)}"
          aria-label="${change.id}: ${actions.titleOfChange(change)}"
          aria-pressed=${derive.isSelected(this.state, "change", change.id)}
          @click=${() => actions.select({ kind: "change", key: change.id })}
          @pointerenter=${() => actions.hover(change.id)}
          @pointerleave=${() => actions.hover(null)}
        >
          <gs-kind .change=${change}></gs-kind>
        </button>`,
    )}
    ${repeat(
      this.scenes(),
      ({ scene }) => scene.id,
      ({ scene }) =>
        html`<button
          class="scene-label out"
          data-id=${scene.id}
          tabindex="-1"
          title="Show what is known of ${scene.name}"
          aria-pressed=${derive.isSelected(this.state, "scene", scene.id)}
          @click=${() => actions.select({ kind: "scene", key: scene.id }, false)}
        >
          ${scene.name}
        </button>`,
    )}`;
  }

  protected override updated(changed: PropertyValues): void {
    super.updated(changed);
    this.drawn();
  }

  /** Where two would cover each other, the larger scene keeps its name. */
  protected readonly drawn = (): void => {
    const { stage } = page;
    const taken: { x: number; y: number; half: number }[] = [];
    const scenes = new Map(this.scenes().map(({ scene }) => [scene.id, scene]));
    const changes = new Map(derive.shownChanges(this.state).map((change) => [change.id, change]));
    for (const button of this.renderRoot.querySelectorAll<HTMLElement>("button")) {
      const change = changes.get(button.dataset["change"] ?? "");
      const scene = scenes.get(button.dataset["id"] ?? "");
      const point = change ? middleOf(change.box) : stage?.state.isAbove ? scene?.middle : undefined;
      const at = point && stage?.state.isShown ? stage.project(point) : null;
      const half = button.offsetWidth / 2 + 4;
      const isFree =
        at &&
        at[0] > half &&
        at[0] < this.clientWidth - half &&
        at[1] > HIGH &&
        at[1] < this.clientHeight - HIGH &&
        (change !== undefined ||
          taken.every(({ x, y, half: other }) => Math.abs(x - at[0]) > half + other || Math.abs(y - at[1]) > HIGH));
      button.classList.toggle("out", !isFree);
      if (!at || !isFree) continue;
      taken.push({ x: at[0], y: at[1], half });
      button.style.setProperty("--x", `${at[0].toFixed(1)}px`);
      button.style.setProperty("--y", `${at[1].toFixed(1)}px`);
    }
  };
}
