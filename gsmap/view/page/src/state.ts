// What the page shows, in one value. Elements read it, actions change it, and whoever shows a part of it is told.
// Scenes, pairs and changes are named by their ids, so a map that others changed meanwhile keeps what was chosen.
import type { Box, MapSummary, Matrix } from "./contract";
import type { Pick, Source, Stage, Standpoint } from "./stage/stage";

export const TABS = ["look", "review", "time", "things"] as const;
export type Tab = (typeof TABS)[number];
export const TAB_NAMES: Record<Tab, string> = { look: "Look", review: "Review", time: "Time", things: "Objects" };

export const OVERLAYS = ["cameras", "nodes", "boxes", "edges", "ellipsoids", "objects", "rooms", "photos"] as const;
export type Overlay = (typeof OVERLAYS)[number];

export const EDGE_FILTERS = ["doubtful", "one pair", "tentative", "undecided", "rejected", "reviewed", "all"] as const;
export type EdgeFilter = (typeof EDGE_FILTERS)[number];

export const CHANGE_FILTERS = ["open", "confirmed", "rejected", "all"] as const;
export type ChangeFilter = (typeof CHANGE_FILTERS)[number];

export const COMPARISONS = ["blink", "swipe", "beside", "difference"] as const;
export type Comparison = (typeof COMPARISONS)[number];

/** `key`: a scene's id, a pair "A:B" of ids, a change "c12", an object "o12", a photo's file. */
export interface Selection {
  kind: "scene" | "edge" | "change" | "object" | "photo";
  key: string;
}

/** One half of the picture, or all of it where it is not split. */
export interface Side {
  source: Source;
  hidden: ReadonlySet<string>; // scene ids
}

export interface Split extends Side {
  at: number; // 0..1 of the width
}

/** An action that the server did not take because it was away. */
export interface Unsent {
  label: string;
  send: () => Promise<boolean>;
}

export interface Undo {
  label: string;
  run: () => Promise<boolean>;
}

export interface Notice {
  id: number;
  text: string;
  bad: boolean;
}

export interface Drag {
  scene: string;
  from: Matrix;
  now: Matrix;
}

export type Theme = "system" | "light" | "dark";

export interface State {
  phase: "loading" | "ready" | "failed";
  failure: string;
  map: MapSummary | null;
  component: number;
  tab: Tab;
  folded: boolean;
  theme: Theme;
  left: Side;
  split: Split | null;
  side: "left" | "right"; // which half the scene list acts on
  clip: Box | null;
  ceiling: boolean;
  overlays: ReadonlySet<Overlay>;
  selection: Selection | null;
  sceneQuery: string;
  thingQuery: string; // of objects and photos
  pair: readonly [string, string]; // ids of the two captures that are chosen for comparison; "" for none
  edgeFilter: EdgeFilter;
  edgeQuery: string;
  changeFilter: ChangeFilter;
  comparison: Comparison;
  view: number; // which of an edge's cameras is shown
  correspondences: boolean;
  until: string | null; // only scenes captured until then
  revision: number | null; // null: the newest
  pick: Pick | null;
  ruler: readonly Pick[] | null; // ends of the measured length that are set: none, one or both; null: put away
  hovered: string | null; // id of the object or change that the pointer is on
  drag: Drag | null;
  standpoint: Standpoint | null;
  busy: string | null; // what the server is doing
  gone: boolean;
  unsent: readonly Unsent[];
  undo: readonly Undo[];
  notices: readonly Notice[];
  help: boolean;
  stageError: string | null;
}

export function initial(): State {
  return {
    phase: "loading",
    failure: "",
    map: null,
    component: 0,
    tab: "look",
    folded: false,
    theme: "system",
    left: { source: "scenes", hidden: new Set() },
    split: null,
    side: "left",
    clip: null,
    ceiling: true,
    overlays: new Set(),
    selection: null,
    sceneQuery: "",
    thingQuery: "",
    pair: ["", ""],
    edgeFilter: "doubtful",
    edgeQuery: "",
    changeFilter: "open",
    comparison: "blink",
    view: 0,
    correspondences: true,
    until: null,
    revision: null,
    pick: null,
    ruler: null,
    hovered: null,
    drag: null,
    standpoint: null,
    busy: null,
    gone: false,
    unsent: [],
    undo: [],
    notices: [],
    help: false,
    stageError: null,
  };
}

type Listener = () => void;

/** The one value and who listens to it. Listeners are called once for all changes of one turn. */
export class Page {
  state: State = initial();
  stage: Stage | null = null;
  private readonly listeners = new Set<Listener>();
  private isTold = false;

  set(change: Partial<State>): void {
    this.state = { ...this.state, ...change };
    this.tell();
  }

  /** Something outside the state that elements show has come: an answer of the server. */
  tell(): void {
    if (this.isTold) return;
    this.isTold = true;
    queueMicrotask(() => {
      this.isTold = false;
      for (const listener of [...this.listeners]) listener();
    });
  }

  listen(listener: Listener): () => void {
    this.listeners.add(listener);
    return () => this.listeners.delete(listener);
  }
}

export const page = new Page();
