// Two captures of choice: their edge, their comparison for changes, or the command that makes them.
import { css, html, nothing } from "lit";
import { customElement } from "lit/decorators.js";
import * as actions from "../actions";
import type { MapSummary } from "../contract";
import * as derive from "../derive";
import { day, plural, quote } from "../words";
import { Panel } from "./base";
import { shared } from "./css";
import { icon } from "./icons";
import "./kind";
import { markOf } from "./review";

const MOST_CHANGES = 3; // listed of a pair

@customElement("gs-pair")
export class Pair extends Panel {
  static override styles = [
    shared,
    css`
      .two {
        display: grid;
        grid-template-columns: 1fr 1fr;
        gap: 8px;
      }
      ul {
        padding-top: 6px;
      }
      li button {
        width: 100%;
        justify-content: flex-start;
        text-align: left;
      }
      li p {
        padding: 3px 10px;
      }
    `,
  ];

  protected override render() {
    const { state } = this;
    const { map } = state;
    if (!map || map.scenes.length < 2) return nothing;
    const facts = derive.pairFacts(state);
    return html`<h3>Two captures</h3>
      <div class="two">${this.choice(map, 0, "First capture")} ${this.choice(map, 1, "Second capture")}</div>
      ${
        facts
          ? html`<ul id="known">
              ${this.edge(map, facts)} ${this.changes(map, facts)} ${this.inThreeD(facts)}
            </ul>`
          : nothing
      }`;
  }

  private choice(map: MapSummary, at: 0 | 1, name: string) {
    const chosen = this.state.pair[at];
    return html`<select
      id="capture-${at}"
      aria-label=${name}
      @change=${(event: Event) => actions.choosePair(at, (event.target as HTMLSelectElement).value)}
    >
      <option value="" ?selected=${!chosen}>${name.split(" ")[0]}</option>
      ${map.scenes.map(
        ({ id, name: scene, captured_at: date }) =>
          html`<option value=${id} ?selected=${chosen === id} ?disabled=${this.state.pair[1 - at] === id}>
            ${scene}${date ? `, ${day(date)}` : nothing}
          </option>`,
      )}
    </select>`;
  }

  private edge(map: MapSummary, { edge, older, newer }: derive.PairFacts) {
    if (!edge)
      return html`<li>
        <p>
          Not registered: <kbd>gsmap register ${quote(map.title)} --pairs ${quote(`${older.name}:${newer.name}`)}</kbd>
        </p>
      </li>`;
    return html`<li>
      <button class="plain" @click=${() => actions.select({ kind: "edge", key: derive.edgeKey(map, edge) })}>
        ${edge.status === "no_match" ? "Connection: none found" : html`Edge ${markOf(edge)}`}
      </button>
    </li>`;
  }

  private changes(map: MapSummary, facts: derive.PairFacts) {
    const { older, newer, changes, isCompared, isUncompared } = facts;
    if (changes.length)
      return html`${changes.slice(0, MOST_CHANGES).map(
        (change) =>
          html`<li>
            <button class="plain" @click=${() => actions.select({ kind: "change", key: change.id })}>
              <gs-kind .change=${change}></gs-kind>
              ${actions.titleOfChange(change)}
            </button>
          </li>`,
      )}
      ${
        changes.length > MOST_CHANGES
          ? html`<li>
              <p class="muted">and ${plural(changes.length - MOST_CHANGES, "more change")}: Time lists all</p>
            </li>`
          : nothing
      }`;
    if (isCompared) return html`<li><p>Compared: nothing changed</p></li>`;
    const undated = [older, newer].find((scene) => !scene.captured_at);
    if (undated)
      return html`<li>
        <p>Changes: not compared, as ${undated.name} has no date, which <kbd>gsmap edit</kbd> or Time sets</p>
      </li>`;
    if (older.component !== newer.component)
      return html`<li><p>Changes: not comparable, as the two are in different components</p></li>`;
    return html`<li>
      ${
        isUncompared && actions.mayAct(this.state)
          ? html`<button class="plain" ?disabled=${this.state.busy !== null} @click=${() => void actions.compare()}>
              ${icon("clock")} Changes: not compared; compare now
            </button>`
          : html`<p>
              Changes: not compared.
              <kbd>gsmap changes ${quote(map.title)} ${quote(`${older.name}:${newer.name}`)}</kbd>
            </p>`
      }
    </li>`;
  }

  private inThreeD({ older, newer }: derive.PairFacts) {
    if (!actions.has3D(this.state) || older.component !== newer.component) return nothing;
    return html`<li>
      <button class="plain" @click=${() => actions.showPair(older, newer)}>${icon("split")} Side by side in 3D</button>
    </li>`;
  }
}
