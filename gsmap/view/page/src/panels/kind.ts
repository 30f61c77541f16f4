// The colour of a kind of change, as the 3D view draws its boxes.
import { css, html } from "lit";
import { LitElement } from "lit";
import { customElement, property } from "lit/decorators.js";
import type { ChangeEntry } from "../contract";
import { vars } from "./base";

export const KINDS: Record<ChangeEntry["kind"], string> = {
  appeared: "#2f9e5b",
  disappeared: "#d4493e",
  moved: "#3b7dd8",
  recoloured: "#9b5bd4",
  replaced: "#d98a1f",
  lighting: "#8a9099",
};

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
    return html`<i ${vars({ "--kind": KINDS[this.of] ?? "#8a9099" })}></i>`;
  }
}
