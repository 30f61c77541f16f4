// The place that was clicked: where it is, whose surface, and what happened there.
import { css, html, nothing } from "lit";
import { customElement, state } from "lit/decorators.js";
import * as actions from "../actions";
import * as derive from "../derive";
import { page } from "../state";
import type { Component, PlaceHistory, Vector } from "../contract";
import { day, metres, point } from "../words";
import { Panel } from "./base";
import { shared } from "./css";
import { icon } from "./icons";
import { waiting } from "./waiting";

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
    const { map, pick, component, measureFrom } = this.state;
    const shown = map && derive.componentOf(map, component);
    if (!map || !shown || (!pick && !measureFrom)) return nothing;
    const unit = shown.metres_per_unit;
    if (measureFrom) return this.measure(measureFrom, pick?.point ?? null, shown);
    if (!pick) return nothing;
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
        <button class="plain" title="Measure from here (m)" @click=${actions.measure}>
          ${icon("ruler")} Measure from here
        </button>
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

  private measure(from: Vector, to: Vector | null, { up, metres_per_unit: unit }: Component) {
    const off = to ? from.map((v, i) => (to[i] ?? v) - v) : [];
    const high = Math.abs(off.reduce((sum, v, i) => sum + v * (up[i] ?? 0), 0));
    const whole = Math.hypot(...off);
    return html`<div class="card" role="group" aria-label="A length">
      <div class="row">
        ${
          to
            ? html`<strong class="figures" role="status">${metres(whole * unit)}</strong>
                <span class="figures muted">height ${metres(high * unit)}</span>
                <span class="figures muted"
                  >level ${metres(Math.sqrt(Math.max(0, whole ** 2 - high ** 2)) * unit)}</span
                >
                <span class="figures muted">${point(from, unit)} to ${point(to, unit)}</span>`
            : html`<span role="status">Click the other end of the length</span>`
        }
        <button class="plain square" aria-label="End measuring" title="End measuring (Esc)" @click=${actions.measure}>
          ${icon("close")}
        </button>
      </div>
    </div>`;
  }

  private history({ rows }: PlaceHistory) {
    if (!rows.length) return html`<p class="empty">The map knows of nothing that happened here.</p>`;
    return html`<ul>
      ${rows.map((row) => {
        const object = row.object;
        return html`<li>
          <span class="muted figures">${day(row.at)}</span
          ><span
            >${row.what}
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
