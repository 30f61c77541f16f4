// The line between the two halves of a split view.
import { css, html } from "lit";
import { customElement } from "lit/decorators.js";
import * as actions from "../actions";
import type { Side } from "../state";
import { Panel, vars } from "./base";
import { shared } from "./css";

@customElement("gs-divider")
export class Divider extends Panel {
  static override styles = [
    shared,
    css`
      :host {
        position: absolute;
        inset: 0;
        pointer-events: none;
      }
      .line {
        position: absolute;
        top: 0;
        bottom: 0;
        left: var(--at);
        width: 24px;
        margin-left: -12px;
        cursor: ew-resize;
        pointer-events: auto;
        touch-action: none;
      }
      .line::before {
        content: "";
        position: absolute;
        inset: 0 11px;
        background: var(--surface);
        box-shadow: 0 0 0 0.5px var(--line-strong);
      }
      .line::after {
        content: "";
        position: absolute;
        top: 50%;
        left: 6px;
        width: 12px;
        height: 34px;
        margin-top: -17px;
        border-radius: 6px;
        background: var(--surface);
        border: 1px solid var(--line-strong);
      }
      .line:focus-visible {
        outline-offset: -6px;
      }
      .name {
        position: absolute;
        bottom: 12px;
        padding: 2px 9px;
        border-radius: 6px;
        background: var(--surface);
        border: 1px solid var(--line);
        font-size: 0.85rem;
        max-width: 14rem;
        overflow-wrap: anywhere;
      }
      .left {
        right: calc(100% - var(--at) + 18px);
      }
      .right {
        left: calc(var(--at) + 18px);
      }
    `,
  ];

  protected override render() {
    const { state } = this;
    if (!state.split) return html``;
    const percent = Math.round(100 * state.split.at);
    return html`<div ${vars({ "--at": `${percent}%` })}>
      <span class="name left">${this.name(state.left)}</span>
      <span class="name right">${this.name(state.split)}</span>
      <div
        class="line"
        role="slider"
        tabindex="0"
        aria-label="Divider between the two halves"
        aria-orientation="horizontal"
        aria-valuemin="5"
        aria-valuemax="95"
        aria-valuenow=${percent}
        aria-valuetext="${percent} % of the width"
        @pointerdown=${this.grab}
        @pointermove=${this.drag}
        @keydown=${this.press}
      ></div>
    </div>`;
  }

  private name(side: Side): string {
    if (side.source === "merged") return "merged";
    const scenes = this.state.map?.scenes.filter((scene) => scene.component === this.state.component) ?? [];
    const shown = scenes.filter((scene) => !side.hidden.has(scene.id));
    if (shown.length === 1) return shown[0]?.name ?? "";
    return shown.length === scenes.length ? "all scenes" : `${shown.length} scenes`;
  }

  private grab(event: PointerEvent): void {
    (event.target as HTMLElement).setPointerCapture(event.pointerId);
  }

  private drag(event: PointerEvent): void {
    if (!(event.target as HTMLElement).hasPointerCapture(event.pointerId)) return;
    const { left, width } = this.getBoundingClientRect();
    actions.splitAt((event.clientX - left) / width);
  }

  private press(event: KeyboardEvent): void {
    const by = { ArrowLeft: -0.02, ArrowRight: 0.02, PageDown: -0.1, PageUp: 0.1, Home: -1, End: 1 }[event.key];
    if (by === undefined) return;
    event.preventDefault();
    event.stopPropagation();
    actions.splitAt((this.state.split?.at ?? 0.5) + by);
  }
}
