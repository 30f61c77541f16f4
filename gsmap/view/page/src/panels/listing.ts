// A long list of which only what is in sight is in the page. Arrow keys walk over rows, left and right over what can be
// pressed in a row; one stop of the Tab key, as the grid pattern of ARIA has it.
import { css, html } from "lit";
import type { PropertyValues, TemplateResult } from "lit";
import { customElement, property, state } from "lit/decorators.js";
import { repeat } from "lit/directives/repeat.js";
import { LitElement } from "lit";
import { shared } from "./css";
import { vars } from "./base";

const BEYOND = 4; // rows above and below the window that are there already

@customElement("gs-listing")
export class Listing extends LitElement {
  static override styles = [
    shared,
    css`
      :host {
        overflow-y: auto;
        overscroll-behavior: contain;
        min-height: 0;
      }
      @media (max-width: 759px) {
        :host {
          max-height: calc(33.3dvh - 70px);
          overscroll-behavior: auto;
        }
      }
      [role="grid"] {
        position: relative;
        height: var(--height);
      }
      [role="row"] {
        position: absolute;
        top: var(--top);
        left: 0;
        right: 0;
        height: var(--row);
        display: flex;
        align-items: center;
        gap: 4px;
        padding: 0 6px 0 4px;
        border-radius: 6px;
      }
      [role="row"]:hover {
        background: var(--hover);
      }
      [role="row"][aria-selected="true"] {
        background: var(--accent-soft);
      }
      [role="gridcell"] {
        display: flex;
        align-items: center;
        flex: none;
      }
      [role="gridcell"].wide {
        flex: 1;
        min-width: 0;
        height: 100%;
      }
      .choose {
        all: unset;
        display: grid;
        align-content: center;
        width: 100%;
        height: 100%;
        min-width: 0;
        padding: 0 4px;
        cursor: pointer;
        border-radius: 6px;
        gap: 1px;
      }
      .choose.pictured {
        grid-template-columns: 76px minmax(0, 1fr);
        column-gap: 10px;
      }
      .pictured img {
        grid-row: 1 / 4;
        width: 76px;
        height: 52px;
        object-fit: cover;
        border-radius: 4px;
        background: var(--line);
      }
      .pictured .name {
        align-self: end;
        -webkit-line-clamp: 1;
      }
      .pictured .detail {
        align-self: start;
      }
      .choose:focus-visible {
        outline: 2px solid var(--focus);
        outline-offset: -2px;
      }
      .name {
        display: -webkit-box;
        -webkit-box-orient: vertical;
        -webkit-line-clamp: 2;
        overflow: hidden;
        overflow-wrap: anywhere;
        line-height: 1.25;
      }
      .detail {
        display: flex;
        gap: 4px 12px;
        align-items: baseline;
        color: var(--muted);
        font-size: 0.85rem;
        font-variant-numeric: tabular-nums;
        line-height: 1.25;
        white-space: nowrap;
        overflow: hidden;
      }
      .detail > :last-child:not(:first-child) {
        margin-left: auto;
      }
      .off .name,
      .off .detail {
        opacity: 0.55;
      }
      button.plain {
        border: 0;
      }
      .swatch {
        width: 10px;
        height: 10px;
        border-radius: 2px;
        background: var(--swatch);
        flex: none;
      }
    `,
  ];

  @property({ attribute: false }) items: readonly unknown[] = [];
  @property({ attribute: false }) keyOf: (item: never) => string = String;
  @property({ attribute: false }) row: (item: never) => TemplateResult = () => html``;
  @property({ attribute: false }) chosen: string | null = null;
  @property({ attribute: false }) stamp: unknown = null; // anything whose change draws the rows again
  @property() label = "";
  @property({ type: Number }) rem = 3.5; // height of a row

  @state() private top = 0;
  @state() private height = 400;
  @state() private active = 0; // the row that the Tab key enters
  private cell = 0;
  private wantsFocus = false;
  private readonly watcher = new ResizeObserver(() => (this.height = this.clientHeight));

  private get rowHeight(): number {
    return Math.round(this.rem * parseFloat(getComputedStyle(document.documentElement).fontSize));
  }

  override connectedCallback(): void {
    super.connectedCallback();
    this.watcher.observe(this);
    this.addEventListener("scroll", this.scrolled, { passive: true });
  }

  override disconnectedCallback(): void {
    super.disconnectedCallback();
    this.watcher.disconnect();
    this.removeEventListener("scroll", this.scrolled);
  }

  private readonly scrolled = () => {
    this.top = this.scrollTop;
  };

  protected override willUpdate(changed: PropertyValues): void {
    if (changed.has("chosen") || changed.has("items")) {
      const at = this.indexOf(this.chosen);
      if (at >= 0 && changed.has("chosen")) {
        this.active = at;
        this.wantsFocus ||= Boolean(this.shadowRoot?.activeElement); // the focus does not stay at the row before
      }
      this.active = Math.max(0, Math.min(this.active, this.items.length - 1));
    }
  }

  private indexOf(key: string | null): number {
    return key === null ? -1 : this.items.findIndex((item) => this.keyOf(item as never) === key);
  }

  protected override render() {
    const tall = this.rowHeight;
    const first = Math.max(0, Math.floor(this.top / tall) - BEYOND);
    const last = Math.min(this.items.length, Math.ceil((this.top + this.height) / tall) + BEYOND);
    const shown = Array.from({ length: Math.max(0, last - first) }, (_, i) => first + i);
    if (this.items.length && !shown.includes(this.active)) shown.push(this.active);
    const height = vars({ "--height": `${tall * this.items.length}px`, "--row": `${tall}px` });
    return html`<div
      role="grid"
      aria-label=${this.label}
      aria-rowcount=${this.items.length}
      ${height}
      @keydown=${this.pressed}
      @focusin=${this.entered}
    >
      ${repeat(
        shown,
        (index) => this.keyOf(this.items[index] as never),
        (index) => {
          const item = this.items[index] as never;
          const isChosen = this.keyOf(item) === this.chosen;
          return html`<div
            role="row"
            aria-rowindex=${index + 1}
            aria-selected=${isChosen}
            data-index=${index}
            ${vars({ "--top": `${index * tall}px` })}
          >
            ${this.row(item)}
          </div>`;
        },
      )}
    </div>`;
  }

  protected override updated(changed: PropertyValues): void {
    for (const row of this.renderRoot.querySelectorAll<HTMLElement>("[role=row]")) {
      const isActive = Number(row.dataset["index"]) === this.active;
      this.cellsOf(row).forEach((cell, i, all) => {
        cell.tabIndex = isActive && i === Math.min(this.cell, all.length - 1) ? 0 : -1;
      });
    }
    if (changed.has("chosen")) this.reveal(this.indexOf(this.chosen));
    if (this.wantsFocus) {
      this.wantsFocus = false;
      const row = this.renderRoot.querySelector<HTMLElement>(`[data-index="${this.active}"]`);
      const cells = row ? this.cellsOf(row) : [];
      cells[Math.min(this.cell, cells.length - 1)]?.focus({ preventScroll: true });
    }
  }

  private cellsOf(row: HTMLElement): HTMLElement[] {
    return [...row.querySelectorAll<HTMLElement>("button, input")];
  }

  /** Scrolls as little as shows a row. */
  private reveal(index: number): void {
    if (index < 0) return;
    const tall = this.rowHeight;
    if (index * tall < this.scrollTop) this.scrollTop = index * tall;
    else if ((index + 1) * tall > this.scrollTop + this.clientHeight)
      this.scrollTop = (index + 1) * tall - this.clientHeight;
  }

  private entered(event: FocusEvent): void {
    const cell = event.target as HTMLElement;
    const row = cell.closest<HTMLElement>("[role=row]");
    if (!row) return;
    this.active = Number(row.dataset["index"]);
    this.cell = Math.max(0, this.cellsOf(row).indexOf(cell));
  }

  private pressed(event: KeyboardEvent): void {
    const page = Math.max(1, Math.floor(this.height / this.rowHeight) - 1);
    const steps: Record<string, number> = {
      ArrowDown: 1,
      ArrowUp: -1,
      PageDown: page,
      PageUp: -page,
      Home: -this.items.length,
      End: this.items.length,
    };
    const by = steps[event.key];
    if (event.ctrlKey || event.altKey || event.metaKey) return;
    if (by !== undefined) {
      this.active = Math.max(0, Math.min(this.items.length - 1, this.active + by));
    } else if (event.key === "ArrowLeft" || event.key === "ArrowRight") {
      const row = this.renderRoot.querySelector<HTMLElement>(`[data-index="${this.active}"]`);
      const most = row ? this.cellsOf(row).length - 1 : 0;
      this.cell = Math.max(0, Math.min(most, this.cell + (event.key === "ArrowLeft" ? -1 : 1)));
    } else return;
    event.preventDefault();
    event.stopPropagation();
    this.reveal(this.active);
    this.wantsFocus = true;
    this.requestUpdate();
  }
}
