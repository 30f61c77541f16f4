// The view as the part of the address after "#": written when the view comes to rest, read when the page opens and when
// a person goes back or forward. Whatever it says is checked against the map: an address may be old, or anybody's.
import { componentOf, edgeOf, sceneOf } from "./derive";
import { COMPARISONS, EDGE_FILTERS, OVERLAYS, TABS } from "./state";
import type { Overlay, Selection, Side, State } from "./state";
import type { Box, MapSummary, Vector } from "./contract";
import type { Source, Standpoint } from "./stage/stage";

const MOST_SCENES = 40; // named in an address; beyond, it would not fit where links are pasted
const BY_KIND: Record<Selection["kind"], string> = {
  scene: "scene",
  edge: "edge",
  change: "change",
  object: "object",
  photo: "photo",
};
const DAY = /^\d{4}(-\d\d(-\d\d)?)?$/;

/** What of the state is in the address. */
export type Shared = Pick<
  State,
  | "component"
  | "tab"
  | "left"
  | "split"
  | "clip"
  | "ceiling"
  | "overlays"
  | "selection"
  | "edgeFilter"
  | "comparison"
  | "view"
  | "until"
  | "revision"
  | "standpoint"
>;

export function write(state: Shared, map: MapSummary): string {
  const out = new URLSearchParams();
  const put = (name: string, value: string | null | undefined) => {
    if (value) out.set(name, value);
  };
  put("island", String(state.component));
  if (state.tab !== "look") put("tab", state.tab);
  if (state.standpoint) {
    put("at", numbers(state.standpoint.position));
    put("to", numbers(state.standpoint.target));
  }
  writeSide(put, "", state.left, map, state.component);
  if (state.split) {
    put("split", state.split.at.toFixed(3));
    writeSide(put, "right-", state.split, map, state.component);
  }
  if (state.clip) put("clip", numbers(state.clip.flat() as number[]));
  if (!state.ceiling) put("ceiling", "0");
  const overlays = OVERLAYS.filter((name) => state.overlays.has(name)).join(",");
  put("overlays", overlays);
  if (state.selection) put(BY_KIND[state.selection.kind], state.selection.key);
  if (state.selection?.kind === "edge" && state.view > 0) put("view", String(state.view));
  if (state.comparison !== "blink") put("compare", state.comparison);
  if (state.edgeFilter !== "doubtful") put("edges", state.edgeFilter);
  put("until", state.until);
  if (state.revision !== null) put("revision", String(state.revision));
  return out.toString().replaceAll("%2C", ",").replaceAll("%3A", ":");
}

export function read(hash: string, map: MapSummary): Shared {
  const given = new URLSearchParams(hash.replace(/^#/, ""));
  const get = (name: string) => given.get(name);
  const one = <T extends string>(name: string, known: readonly T[], otherwise: T): T =>
    known.find((word) => word === get(name)) ?? otherwise;

  const asked = integer(get("island"));
  const component =
    asked !== null && componentOf(map, asked) ? asked : (map.components[0]?.component ?? map.scenes[0]?.component ?? 0);
  const position = vector(get("at"));
  const target = vector(get("to"));
  const standpoint: Standpoint | null = position && target ? { position, target } : null;
  const at = Number(get("split"));
  const split = get("split") !== null && at >= 0 && at <= 1 ? { at, ...readSide(get, "right-", map, component) } : null;
  const overlays = get("overlays")?.split(",") ?? [];
  const revision = integer(get("revision"));
  const until = get("until");
  return {
    component,
    standpoint,
    split,
    tab: one("tab", TABS, "look"),
    left: readSide(get, "", map, component),
    clip: box(get("clip")),
    ceiling: get("ceiling") !== "0",
    overlays: new Set<Overlay>(OVERLAYS.filter((name) => overlays.includes(name))),
    selection: readSelection(get, map),
    view: Math.min(integer(get("view")) ?? 0, 99),
    comparison: one("compare", COMPARISONS, "blink"),
    edgeFilter: one("edges", EDGE_FILTERS, "doubtful"),
    until: until && DAY.test(until) ? until : null,
    revision:
      map.revisions.some((row) => row.number === revision && row.poses !== null) && revision !== map.revision
        ? revision
        : null,
  };
}

/** Whether an address can name which scenes are hidden; too many are left out of it. */
export const fits = (state: Shared, map: MapSummary) =>
  [state.left, ...(state.split ? [state.split] : [])].every((side) => namesOf(side, map, state.component) !== null);

function namesOf(side: Side, map: MapSummary, component: number): { show?: string[]; hide?: string[] } | null {
  if (!side.hidden.size) return {};
  const inside = map.scenes.filter((scene) => scene.component === component).map((scene) => scene.id);
  const hide = inside.filter((id) => side.hidden.has(id));
  const show = inside.filter((id) => !side.hidden.has(id));
  if (!hide.length) return {};
  if (Math.min(hide.length, show.length) > MOST_SCENES) return null;
  return show.length < hide.length ? { show } : { hide };
}

type Put = (name: string, value: string | null | undefined) => void;

function writeSide(put: Put, prefix: string, side: Side, map: MapSummary, component: number): void {
  if (side.source !== "scenes") put(`${prefix}source`, side.source);
  const names = namesOf(side, map, component);
  if (names?.show) put(`${prefix}show`, names.show.join(",") || "none");
  if (names?.hide) put(`${prefix}hide`, names.hide.join(","));
}

function readSide(get: (name: string) => string | null, prefix: string, map: MapSummary, component: number): Side {
  const merged = componentOf(map, component)?.merged;
  const source: Source = get(`${prefix}source`) === "merged" && merged ? "merged" : "scenes";
  const show = get(`${prefix}show`)?.split(",");
  const hide = get(`${prefix}hide`)?.split(",");
  const hidden = new Set<string>();
  for (const scene of map.scenes)
    if (scene.component === component && (show ? !show.includes(scene.id) : hide?.includes(scene.id)))
      hidden.add(scene.id);
  return { source, hidden };
}

function readSelection(get: (name: string) => string | null, map: MapSummary): Selection | null {
  const found = (kind: Selection["kind"], isThere: (key: string) => boolean): Selection | null => {
    const key = get(BY_KIND[kind]);
    return key !== null && isThere(key) ? { kind, key } : null;
  };
  return (
    found("edge", (key) => edgeOf(map, key) !== undefined) ??
    found("change", (key) => map.changes.some((one) => one.id === key)) ??
    found("scene", (key) => sceneOf(map, key) !== undefined) ??
    found("photo", (key) => map.photos.some((one) => one.file === key)) ??
    found("object", (key) => /^o\d{1,9}$/.test(key))
  );
}

/** Six digits of the largest; what is nothing beside it is 0. */
function numbers(values: readonly number[]): string {
  const digits = Math.min(20, Math.max(0, 5 - Math.floor(Math.log10(Math.max(1e-9, ...values.map(Math.abs))))));
  return values.map((v) => String(Number(v.toFixed(digits)) || 0)).join(",");
}

function floats(text: string | null, length: number): number[] | null {
  const values = text?.split(",").map((part) => (part.trim() === "" ? NaN : Number(part))) ?? [];
  return values.length === length && values.every((v) => Number.isFinite(v) && Math.abs(v) < 1e9) ? values : null;
}

const vector = (text: string | null) => floats(text, 3) as Vector | null;

function box(text: string | null): Box | null {
  const six = floats(text, 6);
  if (!six) return null;
  const [low, high] = [six.slice(0, 3) as Vector, six.slice(3) as Vector];
  return low.every((v, i) => v < (high[i] ?? v)) ? [low, high] : null;
}

const integer = (text: string | null) => (text !== null && /^\d{1,9}$/.test(text) ? Number(text) : null);
