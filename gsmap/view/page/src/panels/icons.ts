// The page's own pictograms: 20 x 20, drawn with the colour of the text.
import { svg } from "lit";
import type { SVGTemplateResult } from "lit";

const PATHS = {
  close: "M5 5l10 10M15 5L5 15",
  fold: "M5 7.5l5 5 5-5",
  unfold: "M5 12.5l5-5 5 5",
  back: "M12.5 4.5L7 10l5.5 5.5",
  next: "M7.5 4.5L13 10l-5.5 5.5",
  up: "M5 12.5l5-5 5 5",
  down: "M5 7.5l5 5 5-5",
  link: "M8.5 11.5a3 3 0 0 0 4.2 0l2.6-2.6a3 3 0 0 0-4.2-4.2l-.8.8M11.5 8.5a3 3 0 0 0-4.2 0l-2.6 2.6a3 3 0 0 0 4.2 4.2l.8-.8",
  help: "M7.5 7.6a2.5 2.5 0 1 1 3.6 2.2c-.8.4-1.1.9-1.1 1.7M10 14.4v.1",
  theme: "M10 3.5a6.5 6.5 0 1 0 0 13zM10 3.5a6.5 6.5 0 0 1 0 13",
  fit: "M4 8V4h4M12 4h4v4M16 12v4h-4M8 16H4v-4",
  house: "M3.5 9.5v7h13v-7M3.5 6.5l3-2.5M16.5 6.5l-3-2.5M7 12.5h6",
  clip: "M6 2.5v11.5h11.5M2.5 6h11.5v11.5",
  split: "M3.5 4.5h13v11h-13zM10 2.5v15",
  layers: "M10 3.5l7 3.7-7 3.7-7-3.7zM3.5 10.6l6.5 3.4 6.5-3.4M3.5 13.4l6.5 3.4 6.5-3.4",
  eye: "M2.5 10s2.7-5 7.5-5 7.5 5 7.5 5-2.7 5-7.5 5-7.5-5-7.5-5zM10 12.2a2.2 2.2 0 1 0 0-4.4 2.2 2.2 0 0 0 0 4.4z",
  hidden:
    "M4 4l12 12M8.2 5.2c.6-.1 1.2-.2 1.8-.2 4.8 0 7.5 5 7.5 5s-.7 1.3-2 2.6M5.2 6.7C3.4 8 2.5 10 2.5 10s2.7 5 7.5 5c1.3 0 2.4-.4 3.4-.9",
  solo: "M10 13.5a3.5 3.5 0 1 0 0-7 3.5 3.5 0 0 0 0 7zM10 2.5v2M10 15.5v2M2.5 10h2M15.5 10h2",
  check: "M4.5 10.5l3.7 3.7 7.3-8",
  cross: "M5.5 5.5l9 9M14.5 5.5l-9 9",
  undo: "M7 4.5L3.5 8 7 11.5M3.5 8h8a4.5 4.5 0 0 1 0 9H8",
  optimize: "M4 15.5a7 7 0 0 1 11.5-7.5M16 4.5V8.5h-4M16.5 12",
  move: "M10 2.5v15M2.5 10h15M8 4.5l2-2 2 2M8 15.5l2 2 2-2M4.5 8l-2 2 2 2M15.5 8l2 2-2 2",
  play: "M7 5l8 5-8 5z",
  pause: "M7 5v10M13 5v10",
  enlarge: "M11.5 3.5h5v5M8.5 16.5h-5v-5M16.5 3.5L11.5 8.5M3.5 16.5l5-5",
  swap: "M4 7.5h11.5l-3-3M16 12.5H4.5l3 3",
  warning: "M10 3.5l7.5 13h-15zM10 8.5v3.5M10 14.3v.1",
  clock: "M10 17a7 7 0 1 0 0-14 7 7 0 0 0 0 14zM10 6v4.3l2.8 1.7",
  walk: "M5 17.5V3.5h8v14M3 17.5h14M10.5 10.5v.1",
  ruler: "M2.5 13.5l11-11 4 4-11 11zM6 10l1.5 1.5M8.5 7.5L10.5 9.5M11 5l1.5 1.5",
  fly: "M3 10.5L17 3.5l-5 13.5-2.7-5.5z",
} as const;

export type Icon = keyof typeof PATHS;

export function icon(name: Icon): SVGTemplateResult {
  return svg`<svg class="icon" viewBox="0 0 20 20" aria-hidden="true" focusable="false"><path d=${PATHS[name]} /></svg>`;
}
