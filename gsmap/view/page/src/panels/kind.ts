// The colour of a kind of change, as the 3D view draws its boxes.
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
      width: 0.7em;
      height: 0.7em;
      border-radius: 2px;
      background: var(--kind);
    }
  `;

  @property() of: ChangeEntry["kind"] = "moved";

  protected override render() {
    return html`<i
      ${vars({ "--kind": `#${(CHANGE_COLOURS[this.of] ?? 0x8a8f98).toString(16).padStart(6, "0")}` })}
    ></i>`;
  }
}
