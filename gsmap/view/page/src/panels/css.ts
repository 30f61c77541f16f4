// What all elements share: controls, text, chips. Colours come from style.css as custom properties, which cross into
// shadow roots; so light and dark are decided in one place.
import { css } from "lit";

export const shared = css`
  :host {
    display: block;
    color: var(--text);
    font: var(--font);
  }
  :host([hidden]) {
    display: none;
  }
  *,
  *::before,
  *::after {
    box-sizing: border-box;
  }
  h2,
  h3,
  p,
  ul,
  ol,
  dl,
  dd,
  figure {
    margin: 0;
    padding: 0;
  }
  ul,
  ol {
    list-style: none;
  }
  h2 {
    font-size: 1.07rem;
    font-weight: 650;
    line-height: 1.3;
    overflow-wrap: anywhere;
  }
  h3 {
    font-size: 0.85rem;
    font-weight: 600;
    color: var(--muted);
    margin-bottom: 6px;
  }
  section + section {
    margin-top: 18px;
  }
  .icon {
    width: 18px;
    height: 18px;
    flex: none;
    fill: none;
    stroke: currentColor;
    stroke-width: 1.5;
    stroke-linecap: round;
    stroke-linejoin: round;
    display: block;
  }
  button,
  select,
  input,
  textarea {
    font: inherit;
    color: inherit;
  }
  button {
    display: inline-flex;
    align-items: center;
    justify-content: center;
    gap: 6px;
    min-height: var(--target);
    padding: 3px 10px;
    border: 1px solid var(--line-strong);
    border-radius: 6px;
    background: var(--raised);
    cursor: pointer;
    line-height: 1.25;
    text-align: center;
  }
  button:hover {
    background: var(--hover);
  }
  button:disabled {
    opacity: 0.5;
    cursor: default;
  }
  button.plain {
    border-color: transparent;
    background: none;
  }
  button.plain:hover:not(:disabled) {
    background: var(--hover);
  }
  button.square {
    padding: 0;
    width: var(--target);
    flex: none;
  }
  button.main {
    background: var(--accent);
    border-color: var(--accent);
    color: var(--on-accent);
    font-weight: 600;
  }
  button.main:hover:not(:disabled) {
    background: var(--accent-strong);
  }
  button[aria-pressed="true"] {
    background: var(--accent-soft);
    border-color: var(--accent);
    color: var(--accent-text);
  }
  :focus-visible {
    outline: 2px solid var(--focus);
    outline-offset: 2px;
  }
  input:not([type]),
  input[type="text"],
  input[type="search"],
  input[type="number"],
  input[type="date"],
  textarea,
  select {
    width: 100%;
    min-height: var(--target);
    padding: 4px 9px;
    border: 1px solid var(--line-strong);
    border-radius: 6px;
    background: var(--field);
  }
  input::placeholder,
  textarea::placeholder {
    color: var(--muted);
    opacity: 1;
  }
  textarea {
    resize: vertical;
    min-height: 2.6rem;
  }
  input[type="checkbox"],
  input[type="radio"] {
    width: 16px;
    height: 16px;
    margin: 0;
    flex: none;
    accent-color: var(--accent);
  }
  input[type="range"] {
    width: 100%;
    margin: 0;
    height: var(--target);
    accent-color: var(--accent);
  }
  label {
    display: flex;
    align-items: center;
    gap: 8px;
  }
  .muted {
    color: var(--muted);
  }
  .small {
    font-size: 0.85rem;
  }
  .row {
    display: flex;
    align-items: center;
    gap: 8px;
    flex-wrap: wrap;
  }
  .spread {
    justify-content: space-between;
  }
  .grow {
    flex: 1;
    min-width: 0;
  }
  .stack {
    display: grid;
    gap: 8px;
  }
  .anywhere {
    min-width: 0;
    overflow-wrap: anywhere;
  }
  .figures {
    font-variant-numeric: tabular-nums;
  }
  .segments {
    display: flex;
    border: 1px solid var(--line-strong);
    border-radius: 6px;
    overflow: hidden;
  }
  .segments button {
    flex: 1;
    border: 0;
    border-radius: 0;
    padding: 3px 8px;
  }
  .segments button + button {
    border-left: 1px solid var(--line-strong);
  }
  .segments button:focus-visible {
    outline-offset: -3px;
  }
  .chips {
    display: flex;
    flex-wrap: wrap;
    gap: 6px;
  }
  .chips button {
    border-radius: 99px;
    padding: 2px 10px;
  }
  .chips .count {
    color: var(--muted);
    font-variant-numeric: tabular-nums;
  }
  .chips [aria-pressed="true"] .count {
    color: inherit;
  }
  .mark {
    display: inline-flex;
    align-items: center;
    gap: 5px;
    font-size: 0.85rem;
    white-space: nowrap;
  }
  .mark::before {
    content: "";
    width: 8px;
    height: 8px;
    border-radius: 50%;
    background: var(--mark, var(--muted));
    flex: none;
  }
  .mark.good {
    --mark: var(--good);
  }
  .mark.warn {
    --mark: var(--warn);
  }
  .mark.warn::before {
    border-radius: 1px;
    transform: rotate(45deg);
  }
  .mark.bad {
    --mark: var(--bad);
  }
  .mark.bad::before {
    border-radius: 1px;
  }
  .mark.hollow::before {
    background: none;
    border: 1.5px solid var(--mark, var(--muted));
  }
  .card {
    border: 1px solid var(--line);
    border-radius: 8px;
    padding: 12px;
    background: var(--raised);
  }
  dl.facts {
    display: grid;
    grid-template-columns: auto 1fr;
    gap: 4px 14px;
  }
  dl.facts dt {
    color: var(--muted);
  }
  dl.facts dd {
    text-align: right;
    font-variant-numeric: tabular-nums;
    overflow-wrap: anywhere;
  }
  table {
    width: 100%;
    border-collapse: collapse;
  }
  th,
  td {
    text-align: left;
    padding: 4px 8px 4px 0;
    vertical-align: top;
    overflow-wrap: anywhere;
    font-weight: inherit;
  }
  tr + tr > * {
    border-top: 1px solid var(--line);
  }
  .empty {
    color: var(--muted);
    padding: 10px 0;
    text-wrap: pretty;
  }
  .failed {
    border-left: 3px solid var(--bad);
    padding: 6px 0 6px 10px;
    overflow-wrap: anywhere;
  }
  .waiting {
    color: var(--muted);
    padding: 10px 0;
  }
  .waiting::after {
    content: "";
    display: inline-block;
    width: 0.8em;
    height: 0.8em;
    margin-left: 8px;
    vertical-align: -0.1em;
    border: 2px solid var(--line-strong);
    border-top-color: var(--accent);
    border-radius: 50%;
    animation: turn 0.9s linear infinite;
  }
  @keyframes turn {
    to {
      transform: rotate(1turn);
    }
  }
  @media (prefers-reduced-motion: reduce) {
    .waiting::after {
      animation-duration: 6s;
    }
  }
  kbd {
    display: inline-block;
    min-width: 1.7em;
    padding: 0 5px;
    border: 1px solid var(--line-strong);
    border-bottom-width: 2px;
    border-radius: 4px;
    background: var(--field);
    font: inherit;
    font-size: 0.85rem;
    text-align: center;
  }
  .visually-hidden {
    position: absolute;
    width: 1px;
    height: 1px;
    overflow: hidden;
    clip-path: inset(50%);
    white-space: nowrap;
  }
`;
