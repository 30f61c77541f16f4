// The page's frame: the panel with its tabs, the 3D view, and what is known of the one thing that is chosen.
import { css, html, nothing } from "lit";
import type { PropertyValues } from "lit";
import { customElement } from "lit/decorators.js";
import * as actions from "../actions";
import * as derive from "../derive";
import { TAB_NAMES, TABS } from "../state";
import type { Tab } from "../state";
import { Panel } from "./base";
import { shared } from "./css";
import { icon } from "./icons";
import "./change";
import "./divider";
import "./edge";
import "./entry";
import "./help";
import "./labels";
import "./look";
import "./notices";
import "./pair";
import "./place";
import "./progress";
import "./review";
import "./scene";
import "./thing";
import "./things";
import "./time";
import "./tools";

@customElement("gs-app")
export class App extends Panel {
  static override styles = [
    shared,
    css`
      :host {
        position: fixed;
        inset: 0;
        display: grid;
        grid-template-columns: auto minmax(0, 1fr) auto;
        grid-template-rows: minmax(0, 1fr);
      }
      aside {
        display: flex;
        flex-direction: column;
        min-height: 0;
        background: var(--surface);
        z-index: 2;
      }
      .panel {
        width: 364px;
        border-right: 1px solid var(--line);
      }
      .panel.folded {
        width: auto;
      }
      .detail {
        width: 440px;
        border-left: 1px solid var(--line);
        overflow-y: auto;
        overscroll-behavior: contain;
      }
      .detail > * {
        flex: none; /* as high as its content: its heading is sticky within it */
      }
      header {
        display: flex;
        align-items: center;
        gap: 8px;
        padding: 10px 8px 6px 16px;
      }
      .folded header {
        padding: 10px 8px;
      }
      h1 {
        flex: 1;
        min-width: 0;
        margin: 0;
        font-size: 1.15rem;
        font-weight: 650;
        line-height: 1.25;
        overflow-wrap: anywhere;
        display: -webkit-box;
        -webkit-box-orient: vertical;
        -webkit-line-clamp: 2;
        overflow: hidden;
      }
      [role="tablist"] {
        display: flex;
        padding: 0 10px;
        border-bottom: 1px solid var(--line);
      }
      [role="tab"] {
        border: 0;
        border-radius: 0;
        background: none;
        padding: 6px 8px;
        margin: 0 2px -1px;
        border-bottom: 2px solid transparent;
        color: var(--muted);
        font-weight: 550;
      }
      [role="tab"]:hover {
        color: var(--text);
      }
      [role="tab"][aria-selected="true"] {
        color: var(--text);
        border-bottom-color: var(--accent);
      }
      [role="tab"]:focus-visible {
        outline-offset: -2px;
      }
      .badge {
        min-width: 1.5em;
        padding: 0 5px;
        border-radius: 99px;
        background: var(--accent-soft);
        color: var(--accent-text);
        font-size: 0.78rem;
        font-variant-numeric: tabular-nums;
      }
      [role="tabpanel"] {
        flex: 1;
        min-height: 0;
        overflow-y: auto;
        overscroll-behavior: contain;
        padding: 14px 16px;
      }
      [role="tabpanel"] > * {
        min-height: 100%;
      }
      [role="tabpanel"].fixed > * {
        height: 100%;
      }
      main {
        position: relative;
        min-width: 0;
        min-height: 0;
        overflow: hidden;
        background: var(--ground);
      }
      gs-tools {
        position: absolute;
        top: 12px;
        right: 12px;
      }
      gs-progress {
        position: absolute;
        top: 12px;
        left: 12px;
        right: calc(var(--target) + 32px);
      }
      .below {
        position: absolute;
        left: 12px;
        right: 12px;
        bottom: calc(var(--target) + 24px); /* above the way in and out */
        display: grid;
        justify-items: center;
        gap: 8px;
        pointer-events: none;
      }
      .below > * {
        pointer-events: auto;
      }
      .start {
        position: absolute;
        inset: 0;
        display: grid;
        place-content: center;
        padding: 24px;
        background: var(--ground);
      }
      .start > * {
        max-width: 34rem;
      }
      @media (max-width: 759px) {
        :host {
          grid-template-columns: minmax(0, 1fr);
          grid-template-rows: minmax(0, 1fr) auto;
        }
        main {
          grid-row: 1;
        }
        aside.panel,
        aside.detail {
          grid-row: 2;
          width: auto;
          height: 33.3dvh;
          border: 0;
          border-top: 1px solid var(--line);
          box-shadow: 0 -4px 20px var(--shade);
        }
        aside.panel.folded {
          height: auto;
        }
        aside.panel.behind {
          display: none;
        }
        header {
          display: none;
        }
        [role="tablist"] {
          padding: 0 4px 0 6px;
        }
        [role="tab"] {
          padding: 6px;
        }
        [role="tabpanel"] {
          padding: 10px 14px;
        }
        [role="tabpanel"].fixed > * {
          height: auto;
        }
      }
      @media (min-width: 760px) {
        .sheet-fold {
          display: none;
        }
        .folded [role="tablist"],
        .folded h1 {
          display: none;
        }
      }
      @media (min-width: 760px) and (max-width: 1100px) {
        .panel {
          width: 320px;
        }
        .detail {
          width: 360px;
        }
      }
    `,
  ];

  private wasChosen = false;

  protected override updated(changed: PropertyValues): void {
    super.updated(changed);
    const isChosen = this.state.selection !== null;
    // What had the focus in the details went away with them: go on in the list they were opened from.
    if (this.wasChosen && !isChosen && document.activeElement === document.body) focusList(this.renderRoot);
    this.wasChosen = isChosen;
    const title = this.state.map?.title;
    document.title = title ? `${title} · gsmap` : "gsmap";
  }

  protected override render() {
    const { state } = this;
    const { folded, selection } = state;
    const title = state.map?.title ?? "gsmap";
    const foldLabel = folded ? "Open the panel" : "Fold the panel";
    return html`
      <aside class="panel ${folded ? "folded" : ""} ${selection ? "behind" : ""}" aria-label="Panel">
        <header>
          <h1 title=${title}>${title}</h1>
          <button
            class="plain square"
            aria-label=${foldLabel}
            title="${foldLabel} (p)"
            aria-expanded=${!folded}
            @click=${() => actions.fold()}
          >
            ${icon(folded ? "next" : "back")}
          </button>
        </header>
        <div role="tablist" aria-label="What to do" @keydown=${this.arrows}>
          ${TABS.map((name) => this.tab(name))}
          <span class="grow"></span>
          <button
            class="plain square sheet-fold"
            aria-label=${foldLabel}
            aria-expanded=${!folded}
            @click=${() => actions.fold()}
          >
            ${icon(folded ? "unfold" : "fold")}
          </button>
        </div>
        ${folded ? nothing : this.body()}
      </aside>
      <main>
        <slot></slot>
        <gs-labels></gs-labels>
        <gs-entry></gs-entry>
        ${state.split ? html`<gs-divider></gs-divider>` : nothing}
        <gs-tools></gs-tools>
        <gs-progress></gs-progress>
        <div class="below">
          <gs-place></gs-place>
          <gs-notices></gs-notices>
        </div>
        ${this.start()}
      </main>
      ${selection ? html`<aside class="detail" aria-label="Details" id="detail">${this.detail()}</aside>` : nothing}
      <gs-help></gs-help>
    `;
  }

  private tab(name: Tab) {
    const isOn = this.state.tab === name;
    const doubtful = name === "review" ? derive.countEdges(this.state, "doubtful") : 0;
    return html`<button
      role="tab"
      id="tab-${name}"
      aria-selected=${isOn}
      aria-controls="body"
      tabindex=${isOn ? 0 : -1}
      @click=${() => actions.tab(name)}
    >
      ${TAB_NAMES[name]}${doubtful ? html`<span class="badge" aria-label="${doubtful} to review">${doubtful}</span>` : nothing}
    </button>`;
  }

  private arrows(event: KeyboardEvent): void {
    const by = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
    if (by === undefined || !(event.target as HTMLElement).matches("[role=tab]")) return;
    event.preventDefault();
    event.stopPropagation();
    const name = TABS[(TABS.indexOf(this.state.tab) + by + TABS.length) % TABS.length] ?? "look";
    actions.tab(name);
    void this.updateComplete.then(() => this.renderRoot.querySelector<HTMLElement>(`#tab-${name}`)?.focus());
  }

  private body() {
    const { tab, phase } = this.state;
    const parts = {
      look: html`<gs-look></gs-look>`,
      review: html`<gs-review></gs-review>`,
      time: html`<gs-time></gs-time>`,
      things: html`<gs-things></gs-things>`,
    };
    return html`<div role="tabpanel" id="body" aria-labelledby="tab-${tab}" class=${tab === "time" ? "" : "fixed"}>
      ${phase === "ready" ? parts[tab] : nothing}
    </div>`;
  }

  private detail() {
    switch (this.state.selection?.kind) {
      case "edge":
        return html`<gs-edge></gs-edge>`;
      case "change":
        return html`<gs-change></gs-change>`;
      case "scene":
        return html`<gs-scene></gs-scene>`;
      default:
        return html`<gs-thing></gs-thing>`;
    }
  }

  private start() {
    const { phase, failure, map, stageError } = this.state;
    if (phase === "loading" && !map)
      return html`<div class="start"><p class="waiting" role="status">Loading the map</p></div>`;
    if (phase === "failed")
      return html`<div class="start">
        <div class="card stack" role="alert">
          <h2>The map could not be loaded</h2>
          <p class="anywhere">${failure}</p>
          <p class="muted">
            Is <kbd>gsmap view</kbd> still running where you started it? If it was started anew, open the address that
            it prints now: the old one is of the old server.
          </p>
          <p><button class="main" @click=${() => void actions.retry()}>Try again</button></p>
        </div>
      </div>`;
    const plan = actions.planOf(this.state)?.status;
    if (stageError && plan === "loading")
      return html`<div class="start"><p class="waiting" role="status">Loading the floor plan</p></div>`;
    if (stageError && plan !== "ready")
      return html`<div class="start">
        <div class="card stack" role="alert">
          <h2>The 3D view does not work here</h2>
          <p class="anywhere">${stageError}</p>
          <p class="muted">
            It needs WebGL 2: look whether the browser's hardware acceleration is on. Lists, reviews and pictures work
            without it.
          </p>
        </div>
      </div>`;
    if (map && !map.scenes.length)
      return html`<div class="start">
        <div class="card stack">
          <h2>This map has no scenes yet</h2>
          <p>Add captures to it, then reload this page:</p>
          <p><kbd>gsmap update MAP capture.ply</kbd></p>
        </div>
      </div>`;
    return nothing;
  }
}

function focusList(root: Node): boolean {
  if (!(root instanceof ShadowRoot)) return false;
  const list = root.querySelector("gs-listing");
  const cell = list?.shadowRoot?.querySelector<HTMLElement>('[tabindex="0"]');
  cell?.focus({ preventScroll: true });
  return Boolean(cell) || [...root.querySelectorAll("*")].some((one) => one.shadowRoot && focusList(one.shadowRoot));
}
