// One edge: both captures from the same cameras, why it is what it is, and a person's word on it.
import { css, html, nothing } from "lit";
import { customElement } from "lit/decorators.js";
import * as actions from "../actions";
import type { EdgeDetail, EdgeEntry, MapSummary, SceneEntry } from "../contract";
import * as derive from "../derive";
import { page } from "../state";
import { moment, percent, plural } from "../words";
import { Panel, vars } from "./base";
import "./compare";
import { shared } from "./css";
import { heading } from "./heading";
import { icon } from "./icons";
import { markOf } from "./review";
import { waiting } from "./waiting";
import { verdictBelow } from "./verdict";

@customElement("gs-edge")
export class Edge extends Panel {
  static override styles = [
    shared,
    heading.styles,
    verdictBelow,
    css`
      .reason {
        margin-bottom: 10px;
      }
      @media (max-width: 759px) {
        /* Above the sheet, where there is room for them. */
        .pictures {
          position: fixed;
          left: 0;
          right: 0;
          bottom: 33.3dvh;
          padding: 10px 14px 4px;
          background: var(--surface);
          border-top: 1px solid var(--line);
          box-shadow: 0 -4px 20px var(--shade);
        }
        .pictures + section {
          margin-top: 0;
        }
      }
      .step {
        display: grid;
        grid-template-columns: 18px minmax(0, 1fr) auto;
        gap: 2px 8px;
        padding: 6px 0;
        font-variant-numeric: tabular-nums;
      }
      .step + .step {
        border-top: 1px solid var(--line);
      }
      .step .value {
        text-align: right;
        overflow-wrap: anywhere;
        max-width: 15rem;
      }
      .step .bar {
        grid-column: 2 / 4;
        color: var(--muted);
        font-size: 0.85rem;
      }
      .passed {
        color: var(--good);
      }
      .not-passed {
        color: var(--bad);
      }
      .gauge {
        grid-column: 2 / 4;
        position: relative;
        height: 5px;
        border-radius: 3px;
        background: var(--line);
        margin: 3px 0 2px;
      }
      .gauge .fill {
        position: absolute;
        inset: 0 auto 0 0;
        width: var(--value);
        border-radius: 3px;
        background: var(--good);
      }
      .not-held .fill {
        background: var(--bad);
      }
      .gauge .bar-line {
        position: absolute;
        top: -3px;
        bottom: -3px;
        left: var(--bar);
        width: 2px;
        background: var(--text);
      }
      .advice li {
        padding: 8px 10px;
        border-left: 3px solid var(--warn);
        background: var(--raised);
        overflow-wrap: anywhere;
      }
      .events li {
        display: grid;
        grid-template-columns: auto minmax(0, 1fr);
        gap: 2px 12px;
        padding: 4px 0;
        overflow-wrap: anywhere;
      }
      gs-verdict {
        margin-top: auto;
      }
    `,
  ];

  protected override render() {
    const { state } = this;
    const { map } = state;
    const edge = derive.selectedEdge(state);
    if (!map || !edge) return nothing;
    const [a, b] = [map.scenes[edge.target], map.scenes[edge.source]];
    if (!a || !b) return nothing;
    const known = actions.edges.get(edge.detail);
    return html`
      ${heading(
        html`${a.name} <span class="muted">:</span> ${b.name}`,
        html`${markOf(edge)}
          ${edge.probability === null ? nothing : html`<span>probability ${percent(edge.probability)}</span>`}
          <span>overlap ${percent(edge.overlap)}</span> <span>${plural(edge.num_inliers, "inlier")}</span>`,
        true,
      )}
      <div class="body">
        ${this.reason(edge, a, b)}
        ${waiting(
          known,
          "Both captures are rendered from the cameras of the pair",
          () => actions.edges.forget(edge.detail),
          (detail) => this.known(detail, edge, map),
        )}
      </div>
      <gs-verdict
        .of=${state.selection}
        .said=${edge.review}
        .note=${edge.note}
        .unconfirmable=${edge.status === "no_match" ? "Nothing to confirm: no pose of this pair was found." : ""}
      ></gs-verdict>
    `;
  }

  private reason(edge: EdgeEntry, a: SceneEntry, b: SceneEntry) {
    if (derive.standing(edge) !== "one pair" || edge.review)
      return edge.reason ? html`<p class="anywhere reason">${edge.reason}</p>` : nothing;
    const alone = [a, b].filter((scene) => scene.status === "one pair").map((scene) => scene.name);
    return html`<p class="anywhere reason">
      ${alone.length === 1 ? `${alone[0]} is placed` : "The two are tied"} by this pair alone: no third capture checks
      it. Look whether the pictures show one
      place${actions.mayAct(this.state) ? ", then press Confirm or Reject below: that settles it" : nothing}.
    </p>`;
  }

  private known(detail: EdgeDetail, edge: EdgeEntry, map: MapSummary) {
    return html`
      ${this.pictures(detail, edge, map)} ${this.inThreeD(detail, edge, map)}
      ${
        detail.advice.length
          ? html`<section>
              <h3>What would settle it</h3>
              <ul class="advice stack">
                ${detail.advice.map((line) => html`<li>${line}</li>`)}
              </ul>
            </section>`
          : nothing
      }
      <section>
        <h3>Evidence, each with its bar</h3>
        ${
          detail.steps.length
            ? html`<div role="list">${detail.steps.map((step) => this.step(step))}</div>`
            : html`<p class="muted">This pair was never registered.</p>`
        }
      </section>
      ${
        detail.events.length
          ? html`<section>
              <h3>What happened to it</h3>
              <ul class="events">
                ${detail.events.map(
                  (event) =>
                    html`<li>
                      <span class="muted figures">${moment(event.at)}</span
                      ><span>${event.what}${event.reason ? html`: ${event.reason}` : nothing}</span>
                    </li>`,
                )}
              </ul>
            </section>`
          : nothing
      }
    `;
  }

  private pictures(detail: EdgeDetail, edge: EdgeEntry, map: MapSummary) {
    const count = detail.views.length;
    const shown = detail.views[Math.min(this.state.view, count - 1)];
    if (!shown)
      return html`<p class="empty">
        ${
          detail.S_target_source
            ? map.history === null
              ? "This page has no pictures of this pair: gsmap view MAP draws them."
              : "There are no pictures of this pair: its captures have no cameras, or are too large to be drawn here."
            : "There are no pictures of this pair: no pose was found that would lay one over the other."
        }
      </p>`;
    const at = detail.views.indexOf(shown);
    return html`<section class="pictures">
      <gs-compare
        .first=${shown.target}
        .second=${shown.source}
        .difference=${shown.difference}
        .firstName=${map.scenes[edge.target]?.name ?? ""}
        .secondName=${map.scenes[edge.source]?.name ?? ""}
        .mode=${this.state.comparison}
      ></gs-compare>
      ${
        count > 1
          ? html`<div class="row spread">
              <button class="plain square" aria-label="Previous camera" @click=${() => actions.view(-1, count)}>
                ${icon("back")}
              </button>
              <span class="muted small anywhere" title="The most telling first">
                camera ${at + 1} of ${count}: ${shown.camera}
              </span>
              <button class="plain square" aria-label="Next camera" @click=${() => actions.view(1, count)}>
                ${icon("next")}
              </button>
            </div>`
          : html`<p class="muted small anywhere">camera ${shown.camera}</p>`
      }
    </section>`;
  }

  private inThreeD(detail: EdgeDetail, edge: EdgeEntry, map: MapSummary) {
    if (!actions.has3D(this.state)) return nothing;
    const [a, b] = [map.scenes[edge.target], map.scenes[edge.source]];
    const isTogether = a && b && a.component === b.component;
    const count = detail.correspondences.length;
    return html`<section class="row">
      <button @click=${() => actions.flyToSelected()}>${icon("fly")} Fly to it</button>
      ${
        isTogether
          ? html`<button @click=${() => actions.splitPair(a.id, b.id)}>${icon("split")} Compare in 3D</button>`
          : nothing
      }
      ${
        count
          ? html`<label
              ><input
                type="checkbox"
                .checked=${this.state.correspondences}
                @change=${(event: Event) => page.set({ correspondences: (event.target as HTMLInputElement).checked })}
              />Draw ${plural(count, "correspondence")} in 3D</label
            >`
          : nothing
      }
    </section>`;
  }

  private step(step: EdgeDetail["steps"][number]) {
    const sign =
      step.passed === null
        ? html`<span></span>`
        : html`<span
            class=${step.passed ? "passed" : "not-passed"}
            role="img"
            aria-label=${step.passed ? "held" : "not held"}
            >${icon(step.passed ? "check" : "cross")}</span
          >`;
    const gauge = gaugeOf(step.value, step.bar);
    return html`<div class="step" role="listitem">
      ${sign}<span class="anywhere">${step.name}</span><span class="value">${step.value}</span>
      ${
        gauge
          ? html`<span
              class="gauge ${step.passed === false ? "not-held" : ""}"
              aria-hidden="true"
              ${vars({ "--value": `${gauge.value}%`, "--bar": `${gauge.bar}%` })}
              ><span class="fill"></span><span class="bar-line"></span
            ></span>`
          : nothing
      }
      ${step.bar ? html`<span class="bar">${step.bar}</span>` : nothing}
    </div>`;
  }
}

/** Where a number and its bar ("at least 0.3") lie on one scale, in percent; null where there are no two numbers. */
export function gaugeOf(value: string, bar: string): { value: number; bar: number } | null {
  const found = /^at (?:least|most) ([\d.e+-]+)/.exec(bar);
  const [at, limit] = [Number(value), Number(found?.[1])];
  if (!found || value.trim() === "" || !Number.isFinite(at) || !Number.isFinite(limit) || limit <= 0) return null;
  const most = limit <= 1 && at <= 1 ? 1 : Math.max(2 * limit, at);
  return { value: Math.max(0, Math.min(100, (100 * at) / most)), bar: Math.min(99, (100 * limit) / most) };
}
