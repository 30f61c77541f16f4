// The scenes of the component: found by name, date, tag or status; shown, hidden, alone, flown to.
import { css, html, nothing } from "lit";
import { customElement } from "lit/decorators.js";
import * as actions from "../actions";
import type { SceneEntry } from "../contract";
import * as derive from "../derive";
import { page } from "../state";
import { compact, day, plural } from "../words";
import { Panel } from "./base";
import { shared } from "./css";
import { icon } from "./icons";
import "./listing";

const MARKS: Record<string, string> = { placed: "good", "one pair": "warn hollow", tentative: "warn" };

@customElement("gs-scene-list")
export class SceneList extends Panel {
  static override styles = [
    shared,
    css`
      :host {
        display: grid;
        grid-template-rows: auto auto minmax(0, 1fr);
        gap: 8px;
        min-height: 0;
      }
      gs-listing {
        margin: 0 -8px;
        padding: 0 4px;
      }
    `,
  ];

  protected override render() {
    const { state } = this;
    const scenes = derive.listedScenes(state);
    const { hidden } = actions.sideNow(state);
    const all = state.map?.scenes.filter((scene) => scene.component === state.component) ?? [];
    const shown = all.filter((scene) => !hidden.has(scene.id)).length;
    const chosen = state.selection?.kind === "scene" ? state.selection.key : null;
    return html`
      <input
        id="filter"
        type="search"
        aria-label="Find scenes by name, date, #tag or status"
        placeholder="Find by name, date, #tag"
        .value=${state.sceneQuery}
        @input=${(event: Event) => page.set({ sceneQuery: (event.target as HTMLInputElement).value })}
      />
      <div class="row spread">
        <span class="muted small" role="status"
          >${scenes.length === all.length ? plural(all.length, "scene") : `${scenes.length} of ${all.length}`}${
            !actions.has3D(state) ? nothing : shown === all.length ? ", all shown" : `, ${shown} shown`
          }</span
        >
        ${
          actions.has3D(state)
            ? html`<span class="row">
                <button class="plain" ?disabled=${shown === all.length} @click=${actions.showAll}>Show all</button>
                <button class="plain" ?disabled=${shown === 0} @click=${actions.hideAll}>Hide all</button>
              </span>`
            : nothing
        }
      </div>
      ${
        scenes.length
          ? html`<gs-listing
              label="Scenes"
              .items=${scenes}
              .keyOf=${(scene: SceneEntry) => scene.id}
              .row=${this.row}
              .chosen=${chosen}
              .stamp=${state}
            ></gs-listing>`
          : html`<p class="empty">
              ${all.length ? `No scene fits “${state.sceneQuery}”.` : "This map has no scenes yet: gsmap update adds captures."}
            </p>`
      }
    `;
  }

  private readonly row = (scene: SceneEntry) => {
    const { state } = this;
    const isHidden = actions.sideNow(state).hidden.has(scene.id);
    const isLate = !derive.isBy(scene.captured_at, state.until);
    const show = html`<span role="gridcell"
      ><input
        type="checkbox"
        aria-label="Show ${scene.name}"
        .checked=${!isHidden}
        @change=${() => actions.toggleScene(scene.id)}
    /></span>`;
    const only = html`<span role="gridcell"
      ><button
        class="plain square"
        title="Only this scene"
        aria-label="Only ${scene.name}"
        @click=${() => actions.solo(scene.id)}
      >
        ${icon("solo")}
      </button></span
    >`;
    return html`
      ${actions.has3D(state) ? show : nothing}
      <span role="gridcell" class="wide ${isHidden || isLate ? "off" : ""}"
        ><button class="choose" title=${scene.name} @click=${() => actions.select({ kind: "scene", key: scene.id })}>
          <span class="name">${scene.name}</span>
          <span class="detail"
            ><span class="mark ${MARKS[scene.status] ?? "hollow"}">${scene.status}</span
            ><span>${isLate ? "captured later" : scene.captured_at ? day(scene.captured_at) : nothing}</span
            ><span>${compact(scene.num_gaussians)}</span></span
          >
        </button></span
      >
      ${actions.has3D(state) ? only : nothing}
    `;
  };
}
