// The keys of the page and of the 3D view.
import { css, html, nothing } from "lit";
import type { PropertyValues } from "lit";
import { customElement } from "lit/decorators.js";
import * as actions from "../actions";
import { KEYS } from "../keys";
import { Panel } from "./base";
import { shared } from "./css";
import { icon } from "./icons";

const HAND: [string, string][] = [
  ["Drag", "Turn"],
  ["Right drag, two fingers", "Move"],
  ["Wheel, pinch", "Nearer, further"],
  ["Click", "Pick a place"],
  ["Double click", "Fly there"],
  ["Arrows", "Turn"],
  ["W A S D, Q E", "Walk, down and up"],
  ["+ −", "Nearer, further"],
];

@customElement("gs-help")
export class Help extends Panel {
  static override styles = [
    shared,
    css`
      :host {
        display: contents;
      }
      dialog {
        width: min(46rem, calc(100vw - 24px));
        max-height: calc(100dvh - 24px);
        padding: 0;
        border: 1px solid var(--line);
        border-radius: 10px;
        background: var(--surface);
        color: var(--text);
        box-shadow: 0 12px 48px var(--shade);
        overflow-y: auto;
      }
      dialog::backdrop {
        background: #0006;
      }
      .top {
        position: sticky;
        top: 0;
        display: flex;
        justify-content: space-between;
        align-items: center;
        padding: 12px 12px 8px 20px;
        background: var(--surface);
      }
      .groups {
        columns: 20rem 2;
        column-gap: 32px;
        padding: 0 20px 20px;
      }
      .group {
        break-inside: avoid;
        margin: 0 0 18px;
      }
      dl {
        display: grid;
        grid-template-columns: auto 1fr;
        gap: 6px 14px;
        align-items: baseline;
      }
      dt {
        text-align: right;
        min-width: 2.2rem;
      }
    `,
  ];

  protected override render() {
    const groups = ["Everywhere", "Review", ...(actions.has3D(this.state) ? ["View"] : [])];
    return html`<dialog aria-labelledby="title" @close=${() => actions.help(false)} @click=${this.beside}>
      <div class="top">
        <h2 id="title">Keys</h2>
        <button class="plain square" aria-label="Close" @click=${() => actions.help(false)}>${icon("close")}</button>
      </div>
      <div class="groups">
        ${groups.map(
          (group) =>
            html`<div class="group">
              <h3>${group}</h3>
              <dl>
                ${KEYS.filter((one) => one.group === group).map(
                  (one) =>
                    html`<dt><kbd>${one.shown ?? one.key}</kbd></dt>
                      <dd>${one.what}</dd>`,
                )}
              </dl>
            </div>`,
        )}
        ${actions.has3D(this.state) ? this.hand() : nothing}
      </div>
    </dialog>`;
  }

  private hand() {
    return html`<div class="group">
      <h3>In the 3D view, when it has the focus</h3>
      <dl>
        ${HAND.map(
          ([how, what]) =>
            html`<dt><kbd>${how}</kbd></dt>
              <dd>${what}</dd>`,
        )}
      </dl>
    </div>`;
  }

  protected override updated(changed: PropertyValues): void {
    super.updated(changed);
    const dialog = this.renderRoot.querySelector("dialog");
    if (!dialog || dialog.open === this.state.help) return;
    if (this.state.help) dialog.showModal();
    else dialog.close();
  }

  private beside(event: MouseEvent): void {
    if (event.target === event.currentTarget) actions.help(false);
  }
}
