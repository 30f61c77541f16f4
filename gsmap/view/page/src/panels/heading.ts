// The top of what is known of one thing: its name, how it stands, and the way out and on.
import { css, html, nothing } from "lit";
import type { TemplateResult } from "lit";
import * as actions from "../actions";
import { icon } from "./icons";

export function heading(name: TemplateResult | string, facts: TemplateResult | string, hasNext = false) {
  const way = (by: 1 | -1, name: string, key: string) =>
    html`<button
      class="plain square"
      aria-label=${name}
      title="${name} (${key})"
      ?disabled=${actions.neighbour(by) === "end"}
      @click=${() => actions.step(by)}
    >
      ${icon(by > 0 ? "down" : "up")}
    </button>`;
  const next = hasNext ? html`${way(-1, "Previous", "k")}${way(1, "Next", "j")}` : nothing;
  return html`<div class="heading">
    <h2 class="grow">${name}</h2>
    <span class="ways"
      >${next}<button class="plain square" aria-label="Close" title="Close (Esc)" @click=${() => actions.select(null)}>
        ${icon("close")}
      </button></span
    >
    <p class="facts">${facts}</p>
  </div>`;
}

/** What all details share: the heading stays, the rest scrolls below it. */
heading.styles = css`
  .body {
    padding: 0 16px 16px;
  }
  .heading {
    position: sticky;
    top: 0;
    z-index: 1;
    display: grid;
    grid-template-columns: minmax(0, 1fr) auto;
    gap: 2px 8px;
    padding: 12px 10px 10px 16px;
    background: var(--surface);
  }
  .heading h2 {
    padding-top: 3px;
  }
  .heading .ways {
    display: flex;
    align-self: start;
  }
  .heading .facts {
    grid-column: 1 / 3;
    display: flex;
    flex-wrap: wrap;
    gap: 2px 14px;
    color: var(--muted);
    font-size: 0.85rem;
    font-variant-numeric: tabular-nums;
  }
  @media (max-width: 759px) {
    .heading {
      padding: 6px 6px 6px 14px;
    }
  }
`;
