// The place that was clicked: where it is, whose surface, and what happened there.
import { css, html, nothing } from "lit";
import { customElement, state } from "lit/decorators.js";
import * as actions from "../actions";
import * as derive from "../derive";
import { page } from "../state";
import type { Component, MapSummary, PlaceHistory } from "../contract";
import type { Pick } from "../stage/stage";
import { day, metres, point } from "../words";
import { Panel } from "./base";
import { shared } from "./css";
import { icon } from "./icons";
import { waiting } from "./waiting";

const LEVEL = 0.05; // of a length: what its ends may differ in height for it to be called level

@customElement("gs-place")
export class Place extends Panel {
  static override styles = [
    shared,
    css`
      :host {
        max-width: 100%;
      }
      .card {
        background: var(--surface);
        padding: 4px 4px 4px 12px;
        box-shadow: 0 2px 10px var(--shade);
        max-height: 40vh;
        overflow-y: auto;
        overscroll-behavior: contain;
      }
      .row {
        gap: 2px 10px;
      }
      ul {
        padding: 4px 8px 6px 0;
      }
      li {
        display: grid;
        grid-template-columns: 7em minmax(0, 1fr);
        gap: 10px;
        padding: 3px 0;
        overflow-wrap: anywhere;
      }
      li button {
        min-height: 0;
        padding: 0 4px;
      }
      li + li {
        border-top: 1px solid var(--line);
      }
    `,
  ];

  @state() private asked: string | null = null; // the place whose history was asked for

  protected override render() {
    const { map, pick, component, ruler } = this.state;
    const shown = map && derive.componentOf(map, component);
    if (!map || !shown) return nothing;
    if (ruler) return this.measure(ruler, map, shown);
    if (!pick) return nothing;
    const unit = shown.metres_per_unit;
    const scene = pick.scene === null ? undefined : map.scenes[pick.scene];
    const key = `${component} ${pick.point.map((v) => v.toFixed(4)).join(",")}`;
    const isAsked = this.asked === key;
    return html`<div class="card" role="group" aria-label="The place that was clicked">
      <div class="row">
        <span class="figures">${point(pick.point, unit)}</span>
        ${
          scene
            ? html`<button class="plain" @click=${() => actions.select({ kind: "scene", key: scene.id }, false)}>
                ${scene.name}
              </button>`
            : nothing
        }
        ${
          map.history === null
            ? nothing
            : html`<button class="plain" aria-expanded=${isAsked} @click=${() => (this.asked = isAsked ? null : key)}>
                ${icon("clock")} What happened here
              </button>`
        }
        <button class="plain" @click=${() => actions.measure(pick)}>${icon("ruler")} Measure from here</button>
        <button class="plain square" aria-label="Close" @click=${() => page.set({ pick: null })}>
          ${icon("close")}
        </button>
      </div>
      ${
        isAsked
          ? waiting(
              actions.histories.get(key),
              "Asking the map",
              () => actions.histories.forget(key),
              (history) => this.history(history),
            )
          : nothing
      }
    </div>`;
  }

  private measure([from, to]: readonly Pick[], map: MapSummary, component: Component) {
    return html`<div class="card" role="group" aria-label="A length">
      <div class="row">
        ${
          from && to
            ? html`<span class="figures" role="status">${this.length(derive.lengthOf(map, component, from, to))}</span>
                <span class="muted">Click for another length</span>`
            : html`<span role="status">Click ${from ? "the other end" : "one end"} of the length in the 3D view</span>`
        }
        <button
          class="plain square"
          aria-label="End measuring"
          title="End measuring (Esc)"
          @click=${() => actions.measure()}
        >
          ${icon("close")}
        </button>
      </div>
    </div>`;
  }

  /** One number where the ends are at one height or one above the other; else all three, none before the others. */
  private length({ across, up, straight, sigma }: derive.Length) {
    const known =
      sigma === null
        ? html` <span class="muted">the map's scale is not known</span>`
        : html` <span class="muted" title="Standard deviation, by the picked pixels, the poses and the scale"
            >± ${metres(sigma)}</span
          >`;
    const [level, upright] = [`${metres(across)} across`, `${metres(Math.abs(up))} ${up < 0 ? "down" : "up"}`];
    const least = LEVEL * straight;
    if (Math.abs(up) <= least) return html`<strong>${level}</strong>${known}`;
    if (across <= least) return html`<strong>${upright}</strong>${known}`;
    return html`${level}, ${upright}, ${metres(straight)} straight${known}`;
  }

  private history({ rows }: PlaceHistory) {
    if (!rows.length) return html`<p class="empty">The map knows of nothing that happened here.</p>`;
    return html`<ul>
      ${rows.map((row) => {
        const object = row.object;
        return html`<li>
          <span class="muted figures">${day(row.captured_at)}</span
          ><span
            >${row.state}
            ${
              object
                ? html`<button class="plain" @click=${() => actions.select({ kind: "object", key: object })}>
                    ${object}
                  </button>`
                : nothing
            } <span class="muted">${this.state.map?.scenes[row.scene]?.name}</span></span
          >
        </li>`;
      })}
    </ul>`;
  }
}
