// What is looked at: the component, its scenes or their merged tiles, what is drawn over them.
import { css, html, nothing } from "lit";
import { customElement } from "lit/decorators.js";
import * as actions from "../actions";
import type { Component } from "../contract";
import * as derive from "../derive";
import { OVERLAYS, page } from "../state";
import type { Overlay } from "../state";
import { compact, metres, number, plural } from "../words";
import { Panel } from "./base";
import "./clip";
import { shared } from "./css";
import { icon } from "./icons";
import "./scene_list";

const OVERLAY_NAMES: Record<Overlay, string> = {
  edges: "Edges",
  cameras: "Cameras",
  boxes: "Boxes",
  ellipsoids: "Uncertainty",
  nodes: "Nodes",
  objects: "Objects",
  rooms: "Rooms",
  photos: "Photos",
};

@customElement("gs-look")
export class Look extends Panel {
  static override styles = [
    shared,
    css`
      :host {
        display: flex;
        flex-direction: column;
        gap: 14px;
      }
      gs-scene-list {
        flex: 1;
        min-height: 220px;
      }
      section + section {
        margin-top: 0;
      }
      .overlays {
        border: 0;
        margin: 0;
        padding: 0;
        min-width: 0;
        display: grid;
        grid-template-columns: repeat(3, auto);
        justify-content: space-between;
        gap: 6px 10px;
      }
      legend {
        padding: 0 0 6px;
        font-size: 0.85rem;
        font-weight: 600;
        color: var(--muted);
      }
      .overlays label {
        min-height: 24px;
      }
      @media (max-width: 759px) {
        gs-scene-list {
          flex: none;
          order: -1;
        }
        .component {
          order: -2;
        }
        dl.facts {
          grid-template-columns: repeat(4, auto);
          justify-content: space-between;
        }
        .overlays label {
          min-height: 36px;
        }
      }
    `,
  ];

  protected override render() {
    const { state } = this;
    const { map } = state;
    if (!map) return nothing;
    const component = derive.componentOf(map, state.component);
    return html`
      <section class="component stack">
        ${this.componentChoice(map.components)} ${component ? this.facts(component) : nothing}
      </section>
      ${state.split || component?.merged ? this.sources(component) : nothing}
      ${state.clip ? html`<gs-clip></gs-clip>` : nothing} ${actions.has3D(state) ? this.overlays() : nothing}
      <gs-scene-list></gs-scene-list>
    `;
  }

  private overlays() {
    return html`<fieldset class="overlays">
      <legend>Drawn over the map</legend>
      ${OVERLAYS.map(
        (name) =>
          html`<label
            ><input
              type="checkbox"
              .checked=${this.state.overlays.has(name)}
              @change=${() => actions.overlay(name)}
            />${OVERLAY_NAMES[name]}</label
          >`,
      )}
    </fieldset>`;
  }

  private componentChoice(components: readonly Component[]) {
    if (components.length < 2) return nothing;
    return html`<label
      ><span class="muted">Component</span>
      <select @change=${(event: Event) => actions.showComponent(Number((event.target as HTMLSelectElement).value))}>
        ${components.map(
          (one, index) =>
            html`<option value=${one.component} ?selected=${one.component === this.state.component}>
              ${index + 1} of ${components.length}: ${plural(one.num_scenes, "scene")}
            </option>`,
        )}
      </select></label
    >`;
  }

  private facts(component: Component) {
    const { map } = this.state;
    const scenes = map?.scenes.filter((scene) => scene.component === component.component) ?? [];
    const gaussians = scenes.reduce((sum, scene) => sum + scene.num_gaussians, 0);
    const unit = component.metres_per_unit;
    const sides = component.overview?.size?.map((side) => Number((side * unit).toPrecision(3)));
    return html`<dl class="facts">
      ${
        sides
          ? html`<dt>Size</dt>
              <dd title="length × width × height, a few strays left out">
                ${`${sides.join("\u00a0×\u00a0")}\u00a0m`}
              </dd>`
          : nothing
      }
      <dt>Unit</dt>
      <dd>${Math.abs(unit - 1) < 5e-4 ? "1 m" : metres(unit)}</dd>
      <dt>Gaussians</dt>
      <dd title=${number(gaussians)}>${compact(gaussians)}</dd>
      <dt>Poses</dt>
      <dd>${this.revision()}</dd>
    </dl>`;
  }

  private revision() {
    const { revision, map } = this.state;
    if (revision !== null) return html`revision ${revision}, an old one`;
    return map?.revision == null ? "not optimized yet" : html`revision ${map.revision}`;
  }

  private sources(component: Component | undefined) {
    const { state } = this;
    const side = actions.sideNow(state);
    const press = (name: "left" | "right") => page.set({ side: name });
    return html`<section class="stack">
      ${
        state.split
          ? html`<div class="row">
              <div class="segments grow" role="group" aria-label="Which half the choices below are for">
                <button aria-pressed=${state.side === "left"} @click=${() => press("left")}>Left half</button>
                <button aria-pressed=${state.side === "right"} @click=${() => press("right")}>Right half</button>
              </div>
              <button class="square" aria-label="Swap the halves" title="Swap the halves" @click=${actions.swap}>
                ${icon("swap")}
              </button>
            </div>`
          : nothing
      }
      ${
        component?.merged
          ? html`<div class="segments" role="group" aria-label="What is drawn">
              <button aria-pressed=${side.source === "scenes"} @click=${() => actions.source("scenes")}>Scenes</button>
              <button aria-pressed=${side.source === "merged"} @click=${() => actions.source("merged")}>Merged</button>
            </div>`
          : nothing
      }
    </section>`;
  }
}
