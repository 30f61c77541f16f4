// What follows from the state: which scenes are seen, which edges are listed. Pure functions.
import type {
  ChangeEntry,
  Component,
  EdgeEntry,
  FloorPlan,
  MapSummary,
  ObjectEntry,
  PhotoEntry,
  RevisionPoses,
  SceneEntry,
  Vector,
} from "./contract";
import type { Pick } from "./stage/stage";
import type { EdgeFilter, Selection, Side, State } from "./state";

export const edgeKey = (map: MapSummary, edge: EdgeEntry) =>
  `${map.scenes[edge.target]?.id ?? "?"}:${map.scenes[edge.source]?.id ?? "?"}`;

export const sceneOf = (map: MapSummary, id: string) => map.scenes.find((scene) => scene.id === id);

export const edgeOf = (map: MapSummary, key: string) => map.edges.find((edge) => edgeKey(map, edge) === key);

export const componentOf = (map: MapSummary, component: number): Component | undefined =>
  map.components.find((one) => one.component === component);

export function selectedEdge(state: State): EdgeEntry | undefined {
  return state.map && state.selection?.kind === "edge" ? edgeOf(state.map, state.selection.key) : undefined;
}

export function selectedChange(state: State): ChangeEntry | undefined {
  const { map, selection } = state;
  return selection?.kind === "change" ? map?.changes.find((one) => one.id === selection.key) : undefined;
}

export function selectedScene(state: State): SceneEntry | undefined {
  return state.map && state.selection?.kind === "scene" ? sceneOf(state.map, state.selection.key) : undefined;
}

export function selectedPhoto(state: State): PhotoEntry | undefined {
  const { map, selection } = state;
  return selection?.kind === "photo" ? map?.photos.find((one) => one.file === selection.key) : undefined;
}

export const isSelected = (state: State, kind: Selection["kind"], key: string) =>
  state.selection?.kind === kind && state.selection.key === key;

/** Whether a capture was made by the end of that day; one without a date is always there. */
export const isBy = (at: string | null, until: string | null) =>
  until === null || at === null || at.slice(0, until.length) <= until;

/** Indices of the scenes that one side shows. */
export function visible(state: State, side: Side, poses: RevisionPoses | null): Set<number> {
  const { map, component, until } = state;
  const out = new Set<number>();
  if (!map) return out;
  const then = poses && new Set(poses.scenes.filter((one) => one.status !== "not placed").map((one) => one.scene));
  map.scenes.forEach((scene, index) => {
    if (scene.component !== component || side.hidden.has(scene.id) || !isBy(scene.captured_at, until)) return;
    if (!then || then.has(index)) out.add(index);
  });
  return out;
}

/** Scenes of the component that fit every word of the query: in name, date, tag or status. */
export function listedScenes(state: State): SceneEntry[] {
  const { map, component, sceneQuery } = state;
  if (!map) return [];
  const words = sceneQuery.toLowerCase().split(/\s+/).filter(Boolean);
  return map.scenes.filter((scene) => {
    if (scene.component !== component) return false;
    const said = [scene.name, scene.captured_at ?? "", scene.status, ...(scene.tags ?? []).map((tag) => `#${tag}`)];
    const text = said.join(" ").toLowerCase();
    return words.every((word) => text.includes(word));
  });
}

/** Days on which captures of the component were made, in order. */
export function captureDays(state: State): string[] {
  const scenes = state.map?.scenes.filter((scene) => scene.component === state.component) ?? [];
  return [...new Set(scenes.flatMap((scene) => (scene.captured_at ? [scene.captured_at.slice(0, 10)] : [])))].sort();
}

const IS_IN: Record<EdgeFilter, (edge: EdgeEntry) => boolean> = {
  doubtful: (edge) => edge.doubt > 0 && edge.review === null,
  "one pair": (edge) => edge.one_pair,
  tentative: (edge) => edge.used === "tentative" && !edge.one_pair,
  undecided: (edge) => edge.undecided,
  rejected: (edge) => edge.status !== "accepted",
  reviewed: (edge) => edge.review !== null,
  all: () => true,
};

const isInComponent = (state: State, edge: EdgeEntry) =>
  [edge.target, edge.source].some((index) => state.map?.scenes[index]?.component === state.component);

export const countEdges = (state: State, filter: EdgeFilter) =>
  state.map?.edges.filter((edge) => isInComponent(state, edge) && IS_IN[filter](edge)).length ?? 0;

/** The edges of the list, the most doubtful first. The selected one stays, so that a review does not take it away. */
export function listedEdges(state: State): EdgeEntry[] {
  const { map } = state;
  if (!map) return [];
  const words = state.edgeQuery.toLowerCase().split(/\s+/).filter(Boolean);
  const listed = map.edges.filter((edge) => {
    if (isSelected(state, "edge", edgeKey(map, edge))) return true;
    if (!isInComponent(state, edge) || !IS_IN[state.edgeFilter](edge)) return false;
    const names = `${map.scenes[edge.target]?.name} ${map.scenes[edge.source]?.name} ${edge.reason}`.toLowerCase();
    return words.every((word) => names.includes(word));
  });
  return listed.sort((a, b) => b.doubt - a.doubt || a.target - b.target || a.source - b.source);
}

/** Changes of the component until the date looked at, the newest first. */
export function listedChanges(state: State): ChangeEntry[] {
  const { map, component, until, changeFilter } = state;
  const shown = (one: ChangeEntry) =>
    changeFilter === "all" || one.status === changeFilter || isSelected(state, "change", one.id);
  return (map?.changes ?? [])
    .filter((one) => one.component === component && isBy(one.newer_at, until) && shown(one))
    .sort((a, b) => (b.newer_at ?? "").localeCompare(a.newer_at ?? "") || b.confidence - a.confidence);
}

const fits = (query: string, ...texts: (string | null)[]): boolean => {
  const text = texts.join(" ").toLowerCase();
  return query
    .toLowerCase()
    .split(/\s+/)
    .every((word) => text.includes(word));
};

/** Objects of the component that fit every word of the query: in name, label, id, room or date. */
export const listedObjects = ({ component, thingQuery }: State, objects: readonly ObjectEntry[]): ObjectEntry[] =>
  objects.filter(
    (one) => one.component === component && fits(thingQuery, one.name, one.label, one.id, one.room, one.last_seen),
  );

/** Photos of the component that fit every word of the query: in file name or date. */
export const listedPhotos = ({ map, component, thingQuery }: State): PhotoEntry[] =>
  map?.photos.filter((one) => one.component === component && fits(thingQuery, one.file, one.captured_at)) ?? [];

/** What the map knows of two captures: their edge, and their comparison for changes. */
export interface PairFacts {
  older: SceneEntry;
  newer: SceneEntry;
  edge: EdgeEntry | undefined;
  changes: ChangeEntry[];
  isCompared: boolean;
  isUncompared: boolean; // and the action `compare` would compare them
}

export function pairFacts({ map, pair: [a, b] }: State): PairFacts | null {
  const [one, other] = map ? [sceneOf(map, a), sceneOf(map, b)] : [];
  if (!map || !one || !other || one === other) return null;
  const isTurned = (one.captured_at ?? "") > (other.captured_at ?? "");
  const [older, newer] = isTurned ? [other, one] : [one, other];
  const ends = [map.scenes.indexOf(older), map.scenes.indexOf(newer)];
  const isThis = (p: number, q: number) => ends.includes(p) && ends.includes(q);
  return {
    older,
    newer,
    edge: map.edges.find((edge) => isThis(edge.target, edge.source)),
    changes: map.changes.filter((change) => isThis(change.older, change.newer)),
    isCompared: map.compared.some((pair) => isThis(...pair)),
    isUncompared: map.uncompared.some((pair) => isThis(...pair)),
  };
}

/** Where a point of the map lies on a floor plan, as shares of its width and height from the top left. */
export const onPlan = ({ P_plan_map: rows }: FloorPlan, [x, y, z]: Vector) =>
  rows.map(([a, b, c, d]) => a * x + b * y + c * z + d) as [number, number];

/** The changes that are drawn over the map: those of the list, while it or one of them is looked at. */
export const shownChanges = (state: State) =>
  state.tab === "time" || state.selection?.kind === "change" ? listedChanges(state) : [];

export interface Length {
  across: number;
  up: number; // negative where the second end is lower
  straight: number;
  sigma: number | null; // standard deviation of the straight length; null where the map's scale is not known
}

/** A length between two picked places, in metres: as sure as the picks, the poses of their scenes and the scale. */
export function lengthOf(map: MapSummary, component: Component, from: Pick, to: Pick): Length {
  const { up, metres_per_unit: unit, scale_sigma: scale } = component;
  const off = from.point.map((v, i) => (to.point[i] ?? v) - v);
  const high = off.reduce((sum, v, i) => sum + v * (up[i] ?? 0), 0);
  const whole = Math.hypot(...off);
  const poseOf = ({ scene }: Pick) => (scene === null ? 0 : (map.scenes[scene]?.sigma_m ?? 0));
  const poses = from.scene === to.scene ? [] : [poseOf(from), poseOf(to)];
  const parts = [from.pixel * unit, to.pixel * unit, whole * unit * (scale ?? 0), ...poses];
  return {
    across: Math.sqrt(Math.max(0, whole ** 2 - high ** 2)) * unit,
    up: high * unit,
    straight: whole * unit,
    sigma: scale === null ? null : Math.hypot(...parts),
  };
}

/** How an edge stands, in one word of the map's. */
export function standing(
  edge: EdgeEntry,
): "used" | "one pair" | "tentative" | "undecided" | "unused" | "rejected" | "no match" {
  if (edge.undecided) return "undecided";
  if (edge.status === "no_match") return "no match";
  if (edge.status === "rejected") return "rejected";
  if (edge.used === "tentative") return edge.one_pair ? "one pair" : "tentative";
  return edge.used === false ? "unused" : "used";
}
