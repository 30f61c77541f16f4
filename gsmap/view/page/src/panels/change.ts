// One change: before and after, where and when, and a person's word on it.
import { css, html, nothing } from "lit";
import { customElement } from "lit/decorators.js";
import * as actions from "../actions";
import * as derive from "../derive";
import { metres, pairText, percent } from "../words";
import { Panel } from "./base";
import { shared } from "./css";
import { heading } from "./heading";
import { icon } from "./icons";
import "./compare";
import "./kind";
import { whereItIs } from "./plan";
import { verdictBelow } from "./verdict";

const STANDS: Record<string, string> = { open: "warn", confirmed: "good", rejected: "bad" };

@customElement("gs-change")
export class ChangeDetail extends Panel {
  static override styles = [
    shared,
    heading.styles,
    verdictBelow,
    css`
      gs-verdict {
        margin-top: auto;
      }
    `,
  ];

  protected override render() {
    const { state: now } = this;
    const change = derive.selectedChange(now);
    const { map } = now;
    if (!map || !change) return nothing;
    const [before, after] = [map.scenes[change.older], map.scenes[change.newer]];
    const unit = derive.componentOf(map, change.component)?.metres_per_unit ?? 1;
    const sides = change.box[1].map((v, i) => metres((v - (change.box[0][i] ?? v)) * unit));
    return html`
      ${heading(
        html`<gs-kind .change=${change}></gs-kind> ${actions.titleOfChange(change)}`,
        html`<span class="mark ${STANDS[change.status] ?? ""}">${change.status}</span>
          <span>confidence ${percent(change.confidence)}</span>
          <span class="anywhere">${pairText(map, change.older, change.newer)}</span> <span>change ${change.id}</span>`,
        true,
      )}
      <div class="body">
        ${
          change.pictures
            ? html`<section>
                <gs-compare
                  .first=${change.pictures[0]}
                  .second=${change.pictures[1]}
                  .firstName="before: ${before?.name}"
                  .secondName="after: ${after?.name}"
                  .mode=${now.comparison}
                ></gs-compare>
              </section>`
            : html`<p class="empty">There are no pictures of this change.</p>`
        }
        ${
          actions.has3D(now)
            ? html`<section class="row">
                <button @click=${() => actions.flyToSelected()}>${icon("fly")} Fly to it</button>
                ${
                  before && after
                    ? html`<button @click=${() => actions.splitPair(before.id, after.id)}>
                        ${icon("split")} Before and after in 3D
                      </button>`
                    : nothing
                }
              </section>`
            : nothing
        }
        ${whereItIs()}
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
