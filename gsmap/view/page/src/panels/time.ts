// The map through time: what was captured until a day, where everything lay in an old revision, what changed.
import { css, html, nothing } from "lit";
import { customElement } from "lit/decorators.js";
import * as actions from "../actions";
import type { ChangeEntry, MapSummary, SceneEntry } from "../contract";
import * as derive from "../derive";
import { CHANGE_FILTERS, page } from "../state";
import type { ChangeFilter } from "../state";
import { day, moment, pairText, percent, plural, quote } from "../words";
import { Panel } from "./base";
import { shared } from "./css";
import { icon } from "./icons";
import "./kind";
import "./listing";

const MOST_UNDATED = 20; // captures that have a field for their date at a time

const NAMES: Record<ChangeFilter, string> = { open: "Open", confirmed: "Confirmed", rejected: "Rejected", all: "All" };

@customElement("gs-time")
export class Time extends Panel {
  static override styles = [
    shared,
    css`
      .slider {
        display: grid;
        grid-template-columns: auto minmax(0, 1fr) auto;
        gap: 0 6px;
        align-items: center;
      }
      .said {
        display: flex;
        justify-content: space-between;
        gap: 4px 12px;
        flex-wrap: wrap;
        font-variant-numeric: tabular-nums;
      }
      .said strong {
        font-weight: 600;
      }
      gs-listing {
        height: min(21rem, 50vh);
        margin: 4px -8px 0;
        padding: 0 4px;
      }
      .chips {
        margin-bottom: 6px;
      }
      input[type="date"] {
        width: auto;
      }
      .stack,
      .pairs {
        margin-top: 10px;
      }
    `,
  ];

  protected override render() {
    if (!this.state.map) return nothing;
    return html`${this.changes()}
      <section><gs-pair></gs-pair></section>
      ${this.dates()} ${actions.has3D(this.state) ? this.revisions() : nothing}`;
  }

  private dates() {
    const { state } = this;
    const days = derive.captureDays(state);
    const scenes = state.map?.scenes.filter((scene) => scene.component === state.component) ?? [];
    const undated = scenes.filter((scene) => !scene.captured_at).length;
    const has = "Scenes by their date";
    if (!days.length)
      return html`<section>
        <h3>${has}</h3>
        <p class="muted">No capture of this component has a date.</p>
      </section>`;
    const last = days.length - 1;
    const at =
      state.until === null ? last : Math.max(0, days.filter((one) => derive.isBy(one, state.until)).length - 1);
    const shown = scenes.filter((scene) => derive.isBy(scene.captured_at, state.until)).length;
    const go = (index: number) => actions.until(index >= last ? null : (days[Math.max(0, index)] ?? null));
    return html`<section>
      <h3 id="dates">${has}</h3>
      ${this.slider("until", "dates", at, last, `until ${day(days[at] ?? null)}`, go)}
      <p class="said">
        <strong>${state.until === null ? "All dates" : `Until ${day(days[at] ?? null)}`}</strong
        ><span class="muted">${shown} of ${plural(scenes.length, "scene")}</span>
      </p>
      ${undated ? html`<p class="muted small">${plural(undated, "scene")} without a date, always shown</p>` : nothing}
    </section>`;
  }

  private revisions() {
    const { state } = this;
    const rows = (state.map?.revisions ?? [])
      .filter((row) => row.poses !== null || row.number === state.map?.revision)
      .sort((a, b) => a.number - b.number);
    if (!rows.length)
      return html`<section>
        <h3>Poses by revision</h3>
        <p class="muted">No revision yet: optimize makes the first.</p>
      </section>`;
    const last = rows.length - 1;
    const at = state.revision === null ? last : rows.findIndex((row) => row.number === state.revision);
    const row = rows[at];
    if (!row) return nothing;
    const known = actions.posesOf(state);
    const go = (index: number) => actions.revision(rows[Math.max(0, Math.min(last, index))]?.number ?? null);
    return html`<section>
      <h3 id="revisions">Poses by revision</h3>
      ${this.slider("revision", "revisions", at, last, `revision ${row.number} of ${moment(row.created_at)}`, go)}
      <p class="said">
        <strong>Revision ${row.number}${at === last ? ", the newest" : ""}</strong
        ><span class="muted">${moment(row.created_at)}</span>
      </p>
      <p class="muted small figures">
        ${plural(row.scenes, "scene")}, ${plural(row.edges_used, "edge")} used
        ${known?.status === "loading" ? html`<span class="waiting"></span>` : nothing}
      </p>
      ${
        known?.status === "failed"
          ? html`<div class="failed" role="alert">
              <p>Its poses could not be loaded: ${known.error}</p>
              <p><button @click=${() => actions.revisions.forget()}>Ask again</button></p>
            </div>`
          : nothing
      }
    </section>`;
  }

  private slider(id: string, label: string, at: number, last: number, text: string, go: (index: number) => void) {
    return html`<div class="slider">
      <button class="plain square" aria-label="Earlier: ${label}" ?disabled=${at <= 0} @click=${() => go(at - 1)}>
        ${icon("back")}
      </button>
      <input
        id=${id}
        type="range"
        min="0"
        max=${last}
        step="1"
        aria-labelledby=${label}
        aria-valuetext=${text}
        ?disabled=${last === 0}
        .value=${String(at)}
        @input=${(event: Event) => go((event.target as HTMLInputElement).valueAsNumber)}
      />
      <button class="plain square" aria-label="Later: ${label}" ?disabled=${at >= last} @click=${() => go(at + 1)}>
        ${icon("next")}
      </button>
    </div>`;
  }

  private changes() {
    const { state } = this;
    const { map } = state;
    if (!map) return nothing;
    const changes = derive.listedChanges(state);
    const ofComponent = map.changes.filter((one) => one.component === state.component);
    const chosen = state.selection?.kind === "change" ? state.selection.key : null;
    const count = (name: ChangeFilter) =>
      ofComponent.filter((one) => (name === "all" || one.status === name) && derive.isBy(one.newer_at, state.until))
        .length;
    return html`<section>
      <h3>What changed</h3>
      ${
        ofComponent.length
          ? html`<div class="chips" role="group" aria-label="Which changes">
              ${CHANGE_FILTERS.map(
                (name) =>
                  html`<button
                    aria-pressed=${state.changeFilter === name}
                    @click=${() => page.set({ changeFilter: name })}
                  >
                    ${NAMES[name]} <span class="count">${count(name)}</span>
                  </button>`,
              )}
            </div>`
          : nothing
      }
      ${
        changes.length
          ? html`<gs-listing
              label="Changes"
              rem="4.7"
              .items=${changes}
              .keyOf=${(one: ChangeEntry) => one.id}
              .row=${this.row}
              .chosen=${chosen}
              .stamp=${state}
            ></gs-listing>`
          : ofComponent.length
            ? html`<p class="empty">
                ${state.until === null ? "None of this kind." : `None until ${day(state.until)}.`}
              </p>`
            : this.unchanged(map)
      }
      ${this.undated(map)} ${this.uncompared(map)}
    </section>`;
  }

  private isHere(map: MapSummary, [, newer]: [number, number]): boolean {
    return map.scenes[newer]?.component === this.state.component;
  }

  private unchanged(map: MapSummary) {
    const pairs = map.compared.filter((pair) => this.isHere(map, pair));
    if (!pairs.length) return nothing;
    return html`<p>Nothing changed between</p>
      <ul class="pairs">
        ${pairs.map((pair) => html`<li class="anywhere">${pairText(map, ...pair)}</li>`)}
      </ul>`;
  }

  /** What was never compared: nothing is known of it, which is not the same as no change. */
  private uncompared(map: MapSummary) {
    const pairs = map.uncompared.filter((pair) => this.isHere(map, pair));
    if (!pairs.length) return nothing;
    return html`<div class="stack">
      <p>Not compared yet, so that nothing is known of their changes:</p>
      <ul class="pairs">
        ${pairs.map((pair) => html`<li class="anywhere">${pairText(map, ...pair)}</li>`)}
      </ul>
      ${
        actions.mayAct(this.state)
          ? html`<p>
              <button class="main" ?disabled=${this.state.busy !== null} @click=${() => void actions.compare()}>
                Compare them now
              </button>
            </p>`
          : html`<p><kbd>gsmap changes ${quote(map.title)}</kbd></p>`
      }
    </div>`;
  }

  private undated(map: MapSummary) {
    const scenes = map.scenes.filter((one) => one.component === this.state.component && !one.captured_at);
    const [first] = scenes;
    if (!first) return nothing;
    const shown = scenes.slice(0, MOST_UNDATED);
    return html`<div class="stack">
      <p>
        ${plural(scenes.length, "capture has", "captures have")} no date, so that which is newer is not known: nothing
        is compared with ${scenes.length === 1 ? "it" : "them"}.
      </p>
      ${
        actions.mayAct(this.state)
          ? shown.map(
              (scene) =>
                html`<label class="row spread"
                  ><span class="anywhere">${scene.name}</span
                  ><input
                    type="date"
                    min="1970-01-01"
                    aria-label="Date of ${scene.name}"
                    ?disabled=${this.state.busy !== null}
                    @change=${(event: Event) => this.setDate(scene, event.target as HTMLInputElement)}
                /></label>`,
            )
          : html`<p><kbd>gsmap edit ${quote(map.title)} ${quote(first.name)} --captured-at 2026-03-31</kbd></p>`
      }
      ${scenes.length > shown.length ? html`<p class="muted small">and ${scenes.length - shown.length} more</p>` : nothing}
    </div>`;
  }

  private setDate(scene: SceneEntry, { value, validity }: HTMLInputElement): void {
    // While a year is typed its first digits are a year, too, before the earliest that is allowed.
    if (value && validity.valid) void actions.setDate(scene, value);
  }

  private readonly row = (change: ChangeEntry) => {
    const { map } = this.state;
    const [before, after] = [map?.scenes[change.older], map?.scenes[change.newer]];
    return html`<span
      role="gridcell"
      class="wide"
      @pointerenter=${() => actions.hover(change.id)}
      @pointerleave=${() => actions.hover(null)}
      ><button class="choose" @click=${() => actions.select({ kind: "change", key: change.id })}>
        <span class="name"
          ><gs-kind .change=${change}></gs-kind>
          ${actions.titleOfChange(change)}
          <span class="muted"
            >${percent(change.confidence)}${change.status === "open" ? nothing : `, ${change.status}`}</span
          ></span
        >
        <span class="detail"><span>${before?.name} →</span><span>${day(before?.captured_at ?? null)}</span></span>
        <span class="detail"><span>${after?.name}</span><span>${day(after?.captured_at ?? null)}</span></span>
      </button></span
    >`;
  };
}
