// Two pictures of the same camera, so that the eye finds what differs: blinking, under a swipe, beside each other, or
// their difference.
import { css, html, LitElement, nothing } from "lit";
import type { PropertyValues } from "lit";
import { customElement, property, state } from "lit/decorators.js";
import { relative } from "../api";
import { COMPARISONS, page } from "../state";
import type { Comparison } from "../state";
import { vars } from "./base";
import { shared } from "./css";
import { icon } from "./icons";

const NAMES: Record<Comparison, string> = {
  blink: "Blink",
  swipe: "Swipe",
  beside: "Side by side",
  difference: "Difference",
};
const BLINK_MS = 700;

@customElement("gs-compare")
export class Compare extends LitElement {
  static override styles = [
    shared,
    css`
      :host {
        display: grid;
        gap: 8px;
      }
      .pictures {
        position: relative;
        display: grid;
        border-radius: 6px;
        overflow: hidden;
        background: #000;
        aspect-ratio: var(--ratio);
        max-height: 60vh;
        grid-template-rows: minmax(0, 1fr);
      }
      .pictures.beside {
        grid-template-columns: 1fr 1fr;
        gap: 2px;
      }
      .stacked > img {
        grid-area: 1 / 1;
      }
      img {
        display: block;
        width: 100%;
        height: 100%;
        object-fit: contain;
        min-width: 0;
        color: #fff;
      }
      .loading {
        position: absolute;
        inset: 0;
        display: grid;
        place-content: center;
        color: #fff;
        pointer-events: none;
      }
      .out {
        visibility: hidden;
      }
      .swiped {
        clip-path: inset(0 0 0 var(--at));
      }
      .swipe-line {
        grid-area: 1 / 1;
        position: absolute;
        top: 0;
        bottom: 0;
        left: var(--at);
        width: 2px;
        margin-left: -1px;
        background: #fff;
        box-shadow: 0 0 0 1px #0006;
        pointer-events: none;
      }
      .swipe-range {
        position: absolute;
        inset: 0;
        width: 100%;
        height: 100%;
        opacity: 0;
        cursor: ew-resize;
      }
      .pictures:has(.swipe-range:focus-visible) {
        outline: 2px solid var(--focus);
        outline-offset: 2px;
      }
      .label {
        position: absolute;
        bottom: 6px;
        max-width: 46%;
        padding: 1px 7px;
        border-radius: 4px;
        background: #000a;
        color: #fff;
        font-size: 0.85rem;
        overflow-wrap: anywhere;
        pointer-events: none;
      }
      .label.left {
        left: 6px;
      }
      .label.right {
        right: 6px;
      }
      .enlarge {
        position: absolute;
        top: 6px;
        right: 6px;
        background: #000a;
        color: #fff;
        border: 0;
      }
      .enlarge:hover {
        background: #000;
      }
      .broken {
        align-self: center;
        color: #fff;
        padding: 24px;
        text-align: center;
        overflow-wrap: anywhere;
      }
      .broken button {
        color: var(--text);
        margin-top: 8px;
      }
      dialog {
        width: 100vw;
        height: 100dvh;
        max-width: none;
        max-height: none;
        margin: 0;
        border: 0;
        padding: 12px;
        background: #0c0e10;
        color: #fff;
        color-scheme: dark;
        overflow: hidden;
      }
      dialog[open] {
        display: grid;
        grid-template-rows: minmax(0, 1fr) auto;
        gap: 10px;
      }
      dialog .pictures {
        border-radius: 0;
        min-height: 0;
        height: 100%;
        width: fit-content;
        max-width: 100%;
        margin: 0 auto;
        aspect-ratio: auto;
        max-height: none;
      }
      dialog img {
        width: auto;
        max-width: 100%;
      }
    `,
  ];

  @property() first = "";
  @property() second = "";
  @property() difference = "";
  @property() firstName = "";
  @property() secondName = "";
  @property({ attribute: false }) mode: Comparison = "blink";

  @state() private isSecond = false;
  @state() private paused = matchMedia("(prefers-reduced-motion: reduce)").matches;
  @state() private at = 50;
  @state() private broken = false;
  @state() private isLarge = false;
  @state() private ratio = Compare.lastRatio; // width over height of the pictures
  @state() private loaded: ReadonlySet<string> = new Set(); // their addresses
  private timer = 0;
  private tries = 0;
  private static lastRatio = 4 / 3; // expected of pictures that are still loading

  override connectedCallback(): void {
    super.connectedCallback();
    this.timer = window.setInterval(() => {
      if (this.mode === "blink" && !this.paused) this.isSecond = !this.isSecond;
    }, BLINK_MS);
  }

  override disconnectedCallback(): void {
    super.disconnectedCallback();
    clearInterval(this.timer);
  }

  protected override willUpdate(changed: PropertyValues): void {
    if (changed.has("first") || changed.has("second")) this.broken = false;
  }

  protected override render() {
    const pictures = this.isLarge ? nothing : this.pictures();
    return html`
      ${pictures} ${this.isLarge ? nothing : this.controls()}
      <dialog aria-label="Pictures, enlarged" @close=${() => (this.isLarge = false)}>
        ${this.isLarge ? html`${this.pictures()}${this.controls()}` : nothing}
      </dialog>
    `;
  }

  protected override updated(changed: PropertyValues): void {
    const dialog = this.renderRoot.querySelector("dialog");
    if (changed.has("isLarge") && this.isLarge && dialog && !dialog.open) dialog.showModal();
  }

  private controls() {
    return html`<div class="row">
      <div class="segments grow" role="group" aria-label="How to compare the pictures">
        ${COMPARISONS.filter((name) => name !== "difference" || this.difference).map(
          (name) =>
            html`<button aria-pressed=${this.mode === name} @click=${() => page.set({ comparison: name })}>
              ${NAMES[name]}
            </button>`,
        )}
      </div>
      <button
        class="square ${this.mode === "blink" ? "" : "out"}"
        aria-label=${this.paused ? "Go on blinking" : "Stop blinking"}
        @click=${() => (this.paused = !this.paused)}
      >
        ${icon(this.paused ? "play" : "pause")}
      </button>
      ${this.isLarge ? html`<button @click=${() => this.renderRoot.querySelector("dialog")?.close()}>Close</button>` : nothing}
    </div>`;
  }

  private pictures() {
    const [first, second, difference] = [this.first, this.second, this.difference].map(relative);
    if (this.broken || !first || !second)
      return html`<div class="pictures" ${this.space()}>
        <div class="broken" role="alert">
          These pictures could not be loaded.<br />
          <button @click=${this.again}>Load them again</button>
        </div>
      </div>`;
    const [a, b] = [this.picture(first, this.firstName), this.picture(second, this.secondName)];
    const label = (side: string, text: string) => html`<span class="label ${side}">${text}</span>`;
    const enlarge = this.isLarge
      ? nothing
      : html`<button
          class="enlarge square"
          aria-label="Enlarge the pictures"
          title="Enlarge"
          @click=${() => (this.isLarge = true)}
        >
          ${icon("enlarge")}
        </button>`;
    const isDifference = this.mode === "difference" && difference;
    const isLoading = !(isDifference ? [difference] : [first, second]).every((uri) => this.loaded.has(uri));
    const loading = isLoading ? html`<span class="loading" role="status">Loading the pictures</span>` : nothing;
    if (this.mode === "beside")
      return html`<div class="pictures beside" ${this.space()}>
        ${a()}${b()}${loading}${label("left", this.firstName)}${label("right", this.secondName)}${enlarge}
      </div>`;
    if (isDifference)
      return html`<div class="pictures" ${this.space()}>
        ${this.picture(difference, "Difference of both")()}${loading}${enlarge}
      </div>`;
    if (this.mode === "swipe")
      return html`<div class="pictures stacked" ${this.space()}>
        ${a()}${b("swiped")}${loading}<span class="swipe-line"></span>
        <input
          class="swipe-range"
          type="range"
          min="0"
          max="100"
          aria-label="How much of the first picture is seen"
          .value=${String(this.at)}
          @input=${(event: Event) => (this.at = (event.target as HTMLInputElement).valueAsNumber)}
        />
        ${label("left", this.firstName)}${label("right", this.secondName)}${enlarge}
      </div>`;
    return html`<div class="pictures stacked" ${this.space()}>
      ${a(this.isSecond ? "out" : "")}${b(this.isSecond ? "" : "out")}${loading}
      ${label("left", this.isSecond ? this.secondName : this.firstName)}${enlarge}
    </div>`;
  }

  private readonly picture =
    (uri: string, name: string) =>
    (kind = "") =>
      html`<img
        class=${kind}
        src=${this.tries ? `${uri}?again=${this.tries}` : uri}
        alt=${name}
        decoding="async"
        @load=${(event: Event) => this.arrived(uri, event.target as HTMLImageElement)}
        @error=${() => (this.broken = true)}
      />`;

  /** The same space before the pictures come and in every mode, so that the buttons below stay where they are. */
  private space() {
    return vars({ "--ratio": this.ratio.toFixed(4), "--at": `${this.at}%` });
  }

  private arrived(uri: string, { naturalWidth: width, naturalHeight: height }: HTMLImageElement): void {
    this.loaded = new Set([...this.loaded, uri]);
    if (width && height) this.ratio = Compare.lastRatio = width / height;
  }

  private again(): void {
    this.tries++;
    this.broken = false;
  }
}
