// What the page has to say: what was done, what failed, and that the server is away.
import { css, html, nothing } from "lit";
import { customElement } from "lit/decorators.js";
import { repeat } from "lit/directives/repeat.js";
import * as actions from "../actions";
import { Panel } from "./base";
import { shared } from "./css";
import { icon } from "./icons";

@customElement("gs-notices")
export class Notices extends Panel {
  static override styles = [
    shared,
    css`
      :host {
        display: grid;
        gap: 8px;
        justify-items: center;
        max-width: 100%;
      }
      .notice {
        display: flex;
        align-items: center;
        gap: 10px;
        max-width: min(38rem, 100%);
        padding: 5px 6px 5px 14px;
        min-height: calc(var(--target) + 10px);
        border-radius: 8px;
        border: 1px solid var(--line);
        background: var(--surface);
        box-shadow: 0 2px 12px var(--shade);
        overflow-wrap: anywhere;
      }
      .notice.done {
        padding-right: 14px;
      }
      .bad {
        border-left: 4px solid var(--bad);
      }
      .warn {
        border-left: 4px solid var(--warn);
      }
      .live {
        display: contents;
      }
    `,
  ];

  protected override render() {
    const { notices, gone, busy, unsent, phase } = this.state;
    const bad = notices.filter((one) => one.bad);
    const good = notices.filter((one) => !one.bad);
    return html`
      <div role="alert" class="live">
        ${gone && phase === "ready" ? this.away(unsent.map((one) => one.label)) : nothing}
        ${repeat(
          bad,
          (one) => one.id,
          (one) =>
            html`<div class="notice bad">
              <span class="grow">${one.text}</span>
              <button class="plain square" aria-label="Dismiss" @click=${() => actions.dismiss(one.id)}>
                ${icon("close")}
              </button>
            </div>`,
        )}
      </div>
      <div role="status" class="live">
        ${busy ? html`<div class="notice done"><span class="waiting">${busy}</span></div>` : nothing}
        ${repeat(
          good,
          (one) => one.id,
          (one) => html`<div class="notice done">${one.text}</div>`,
        )}
      </div>
    `;
  }

  private away(labels: string[]) {
    return html`<div class="notice warn">
      <span class="grow"
        ><strong>gsmap view does not answer.</strong> What is loaded stays.
        ${
          labels.length
            ? html`Not saved yet, and sent when it is back: ${labels.join("; ")}.`
            : "Start it again on the same port, or open the address that it prints."
        }</span
      >
      <button class="main" ?disabled=${this.state.busy !== null} @click=${() => void actions.retry()}>Try again</button>
    </div>`;
  }
}
