// How far the 3D view is: what is on its way, what the server still makes.
import { css, html, nothing } from "lit";
import { customElement, state } from "lit/decorators.js";
import * as derive from "../derive";
import { page } from "../state";
import { compact, plural } from "../words";
import { Panel } from "./base";
import { shared } from "./css";

const EVERY_MS = 300;

@customElement("gs-progress")
export class Progress extends Panel {
  static override styles = [
    shared,
    css`
      :host {
        pointer-events: none;
      }
      p {
        width: fit-content;
        margin-bottom: 6px;
        padding: 2px 10px;
        border-radius: 6px;
        border: 1px solid var(--line);
        background: var(--surface);
        color: var(--muted);
        font-size: 0.85rem;
        font-variant-numeric: tabular-nums;
      }
    `,
  ];

  @state() private splats = 0;
  @state() private isLoading = false;
  private timer = 0;

  override connectedCallback(): void {
    super.connectedCallback();
    this.timer = window.setInterval(() => {
      const known = page.stage?.state;
      this.isLoading = known !== undefined && known.pending > 0;
      if (known && this.isLoading) this.splats = known.splats;
    }, EVERY_MS);
  }

  override disconnectedCallback(): void {
    super.disconnectedCallback();
    clearInterval(this.timer);
  }

  protected override render() {
    const { map, component } = this.state;
    const making = (map && derive.componentOf(map, component)?.overview?.pending) ?? 0;
    if (!this.isLoading && !making) return nothing;
    const said = [
      this.isLoading ? `loading, ${compact(this.splats)} Gaussians so far` : "",
      making ? `preparing ${plural(making, "scene")}, once` : "",
    ];
    return html`${said.filter(Boolean).map((line) => html`<p role="status">${line}</p>`)}`;
  }
}
