// What is pressed often, over the 3D view.
import { css, html, nothing } from "lit";
import { customElement } from "lit/decorators.js";
import * as actions from "../actions";
import type { Theme } from "../state";
import { Panel } from "./base";
import { shared } from "./css";
import { icon } from "./icons";
import type { Icon } from "./icons";

const NEXT: Record<Theme, Theme> = { system: "light", light: "dark", dark: "system" };

@customElement("gs-tools")
export class Tools extends Panel {
  static override styles = [
    shared,
    css`
      :host {
        display: grid;
        gap: 8px;
      }
      [role="toolbar"] {
        display: grid;
        border-radius: 8px;
        background: var(--surface);
        border: 1px solid var(--line);
        box-shadow: 0 2px 10px var(--shade);
        padding: 3px;
        gap: 2px;
      }
      button {
        border-color: transparent;
        background: none;
        width: var(--target);
        padding: 0;
      }
    `,
  ];

  protected override render() {
    const { state } = this;
    return html`
      ${actions.has3D(state) ? this.view() : nothing}
      <div role="toolbar" aria-label="Page" aria-orientation="vertical" @keydown=${this.arrows}>
        ${this.button("link", "Copy a link to this view", "l", () => void actions.copyLink())}
        ${this.button("theme", `Colours: ${state.theme}`, "", () => actions.theme(NEXT[state.theme]))}
        ${this.button("help", "Keys and help", "?", () => actions.help(true))}
      </div>
    `;
  }

  private view() {
    const { state } = this;
    return html`<div role="toolbar" aria-label="View" aria-orientation="vertical" @keydown=${this.arrows}>
      ${this.button("fit", "Fit all in view", "f", actions.fit)}
      ${this.button("house", "Doll’s house: no ceiling", "h", () => actions.ceiling(), !state.ceiling)}
      ${this.button("ruler", "Measure a length", "m", () => actions.measure(), state.ruler !== null)}
      ${this.button("clip", "Clip box", "x", () => actions.clip(), state.clip !== null)}
      ${this.button("split", "Split view", "v", () => actions.split(), state.split !== null)}
    </div>`;
  }

  private button(name: Icon, label: string, key: string, press: () => void, pressed?: boolean) {
    return html`<button
      aria-label=${label}
      title=${key ? `${label} (${key})` : label}
      aria-pressed=${pressed ?? nothing}
      @click=${press}
    >
      ${icon(name)}
    </button>`;
  }

  private arrows(event: KeyboardEvent): void {
    const by = { ArrowDown: 1, ArrowUp: -1 }[event.key];
    if (by === undefined) return;
    const all = [...this.renderRoot.querySelectorAll("button")];
    const at = all.indexOf(event.target as HTMLButtonElement);
    all[(at + by + all.length) % all.length]?.focus();
    event.preventDefault();
    event.stopPropagation();
  }
}
