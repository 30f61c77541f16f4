// The edges, the most doubtful first.
import { css, html, nothing } from "lit";
import { customElement } from "lit/decorators.js";
import * as actions from "../actions";
import type { EdgeEntry } from "../contract";
import * as derive from "../derive";
import { EDGE_FILTERS, page } from "../state";
import type { EdgeFilter } from "../state";
import { percent } from "../words";
import { Panel } from "./base";
import { shared } from "./css";
import { icon } from "./icons";
import "./listing";

const NAMES: Record<EdgeFilter, string> = {
  doubtful: "To review",
  "one pair": "One pair",
  tentative: "Tentative",
  undecided: "Undecided",
  rejected: "Rejected or not found",
  reviewed: "Reviewed",
  all: "All",
};

const MARKS: Record<ReturnType<typeof derive.standing>, string> = {
  used: "good",
  "one pair": "warn hollow",
  tentative: "warn",
  undecided: "warn hollow",
  unused: "bad hollow",
  rejected: "bad",
  "no match": "hollow",
};

const SAID = { confirm: "confirmed", reject: "rejected" };

const NONE: Record<EdgeFilter, string> = {
  doubtful: "Nothing is in doubt on this component. “All” lists every pair that was tried.",
  "one pair": "No scene is placed by one pair alone.",
  tentative: "No tentative edge.",
  undecided: "No undecided edge: no two groups of edges contradict each other.",
  rejected: "No pair was rejected.",
  reviewed: "No pair has been reviewed yet.",
  all: "No pair of this component was tried yet: gsmap register tries them.",
};

/** How an edge stands, as a coloured mark of its own shape with its word. */
export const markOf = (edge: EdgeEntry) => {
  const how = derive.standing(edge);
  return html`<span class="mark ${MARKS[how]}">${how}</span>`;
};

@customElement("gs-review")
export class Review extends Panel {
  static override styles = [
    shared,
    css`
      :host {
        display: grid;
        grid-template-rows: auto auto auto minmax(0, 1fr) auto;
        gap: 10px;
      }
      gs-listing {
        margin: 0 -8px;
        padding: 0 4px;
        min-height: 170px;
      }
      @media (max-width: 759px) {
        .chips {
          flex-wrap: nowrap;
          overflow-x: auto;
          margin: -10px -14px 0;
          padding: 10px 14px 2px;
        }
        .chips button {
          flex: none;
        }
      }
      .undo {
        min-width: 0;
      }
      .cut {
        overflow: hidden;
        text-overflow: ellipsis;
        white-space: nowrap;
      }
      footer {
        display: grid;
        gap: 8px;
        border-top: 1px solid var(--line);
        padding-top: 10px;
      }
    `,
  ];

  protected override render() {
    const { state } = this;
    const { map } = state;
    if (!map) return nothing;
    const edges = derive.listedEdges(state);
    const chosen = state.selection?.kind === "edge" ? state.selection.key : null;
    return html`
      <gs-pair></gs-pair>
      <div class="chips" role="group" aria-label="Which edges">
        ${EDGE_FILTERS.map(
          (name) =>
            html`<button aria-pressed=${state.edgeFilter === name} @click=${() => page.set({ edgeFilter: name })}>
              ${NAMES[name]} <span class="count">${derive.countEdges(state, name)}</span>
            </button>`,
        )}
      </div>
      <input
        id="filter"
        type="search"
        aria-label="Find edges by the names of their scenes or by the reason"
        placeholder="Find by scene or reason"
        .value=${state.edgeQuery}
        @input=${(event: Event) => page.set({ edgeQuery: (event.target as HTMLInputElement).value })}
      />
      ${
        edges.length
          ? html`<gs-listing
              label="Edges"
              rem="4"
              .items=${edges}
              .keyOf=${(edge: EdgeEntry) => derive.edgeKey(map, edge)}
              .row=${this.row}
              .chosen=${chosen}
              .stamp=${state}
            ></gs-listing>`
          : html`<p class="empty">
              ${state.edgeQuery ? `No edge here fits “${state.edgeQuery}”.` : NONE[state.edgeFilter]}
            </p>`
      }
      ${this.footer()}
    `;
  }

  private footer() {
    const { state } = this;
    const last = state.undo[state.undo.length - 1];
    if (!actions.mayAct(state))
      return html`<p class="muted small">This page only shows the map: reviewing needs <kbd>gsmap view MAP</kbd>.</p>`;
    return html`<footer>
      ${
        state.map?.stale
          ? html`<p class="small">
              The poses are older than the edges, reviews or priors. Optimizing makes a new revision of them.
            </p>`
          : nothing
      }
      <div class="row">
        <button
          class=${state.map?.stale ? "main" : ""}
          ?disabled=${state.busy !== null}
          @click=${() => void actions.optimize()}
        >
          ${icon("optimize")} Optimize now
        </button>
        <button
          class="grow undo"
          ?disabled=${!last || state.busy !== null}
          title=${last ? `Undo ${last.label} (u)` : "Nothing to undo"}
          @click=${() => void actions.undo()}
        >
          ${icon("undo")}
          <span class="cut">Undo${last ? `: ${last.label}` : nothing}</span>
        </button>
      </div>
    </footer>`;
  }

  private readonly row = (edge: EdgeEntry) => {
    const { map } = this.state;
    if (!map) return html``;
    const [a, b] = [map.scenes[edge.target]?.name, map.scenes[edge.source]?.name];
    return html`<span role="gridcell" class="wide"
      ><button
        class="choose"
        title="${a} : ${b}"
        @click=${() => actions.select({ kind: "edge", key: derive.edgeKey(map, edge) })}
      >
        <span class="name">${a} <span class="muted">:</span> ${b}</span>
        <span class="detail"
          >${markOf(edge)}
          ${edge.review ? html`<span class="mark hollow">${SAID[edge.review]} by hand</span>` : nothing}
          <span>${edge.probability === null ? nothing : `${percent(edge.probability)}`}</span></span
        >
      </button></span
    >`;
  };
}
