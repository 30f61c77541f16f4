// The number of a change on the colour of its kind, as its row, the floor plan and the 3D view show it.
import { css, html } from "lit";
import { LitElement } from "lit";
import { customElement, property } from "lit/decorators.js";
import type { ChangeEntry } from "../contract";
import { CHANGE_COLOURS } from "../stage/overlays";
import { vars } from "./base";

@customElement("gs-kind")
export class Kind extends LitElement {
  static override styles = css`
    :host {
      display: inline-block;
    }
    i {
      display: block;
      min-width: 1.6em;
      padding: 0 0.35em;
      border-radius: 99px;
      background: var(--kind);
      color: #101418;
      font:
        650 0.82rem/1.55 system-ui,
        sans-serif;
      font-variant-numeric: tabular-nums;
      text-align: center;
    }
  `;

  @property({ attribute: false }) change: ChangeEntry | null = null;

  protected override render() {
    const colour = (this.change && CHANGE_COLOURS[this.change.kind]) ?? 0x8a8f98;
    return html`<i ${vars({ "--kind": `#${colour.toString(16).padStart(6, "0")}` })}>${this.change?.id.slice(1)}</i>`;
  }
}
