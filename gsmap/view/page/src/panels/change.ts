// One change: before and after, where and when, and a person's word on it.
import { css, html, nothing } from "lit";
import { customElement, state } from "lit/decorators.js";
import * as actions from "../actions";
import { relative } from "../api";
import * as derive from "../derive";
import { CHANGE_WORDS, metres, pairText, percent } from "../words";
import { Panel } from "./base";
import { shared } from "./css";
import { heading } from "./heading";
import { icon } from "./icons";
import "./kind";
import { verdictBelow } from "./verdict";

const STANDS: Record<string, string> = { open: "warn", confirmed: "good", rejected: "bad" };

@customElement("gs-change")
export class ChangeDetail extends Panel {
  static override styles = [
    shared,
    heading.styles,
    verdictBelow,
    css`
      img {
        display: block;
        width: 100%;
        height: auto;
        border-radius: 6px;
      }
      figcaption {
        display: grid;
        grid-template-columns: 1fr 1fr;
        gap: 8px;
        padding-top: 6px;
        font-size: 0.85rem;
        color: var(--muted);
        overflow-wrap: anywhere;
      }
      gs-verdict {
        margin-top: auto;
      }
    `,
  ];

  @state() private broken: string | null = null;

  protected override render() {
    const { state: now } = this;
    const change = derive.selectedChange(now);
    const { map } = now;
    if (!map || !change) return nothing;
    const [before, after] = [map.scenes[change.before], map.scenes[change.after]];
    const unit = derive.componentOf(map, change.component)?.metres_per_unit ?? 1;
    const sides = change.box[1].map((v, i) => metres((v - (change.box[0][i] ?? v)) * unit));
    const picture = relative(change.pictures);
    const isBroken = this.broken === change.id;
    return html`
      ${heading(
        html`<gs-kind of=${change.kind}></gs-kind> ${CHANGE_WORDS[change.kind] ?? change.kind}`,
        html`<span class="mark ${STANDS[change.status] ?? ""}">${change.status}</span>
          <span>confidence ${percent(change.confidence)}</span>
          <span class="anywhere">${pairText(map, change.before, change.after)}</span> <span>${change.id}</span>`,
        true,
      )}
      <div class="body">
        <section>
          ${
            picture && !isBroken
              ? html`<figure>
                  <img
                    src=${picture}
                    alt="The place before and after, beside each other"
                    @error=${() => (this.broken = change.id)}
                  />
                  <figcaption><span>before: ${before?.name}</span><span>after: ${after?.name}</span></figcaption>
                </figure>`
              : html`<p class="empty">
                  ${isBroken ? "The picture could not be loaded." : "There is no picture of this change."}
                  ${isBroken ? html`<button @click=${() => (this.broken = null)}>Load it again</button>` : nothing}
                </p>`
          }
        </section>
        <section class="row">
          <button @click=${() => actions.flyToSelected()}>${icon("fly")} Fly to it</button>
          ${
            before && after
              ? html`<button @click=${() => actions.splitPair(before.id, after.id)}>
                  ${icon("split")} Before and after in 3D
                </button>`
              : nothing
          }
        </section>
        <section>
          <dl class="facts">
            <dt>Size of the box</dt>
            <dd>${sides.join(" × ")}</dd>
          </dl>
        </section>
      </div>
      <gs-verdict
        .of=${now.selection}
        .said=${change.status === "confirmed" ? "confirm" : change.status === "rejected" ? "reject" : null}
        .note=${change.note ?? ""}
      ></gs-verdict>
    `;
  }
}
