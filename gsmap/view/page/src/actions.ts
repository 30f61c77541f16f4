// Everything that a person can do on the page, one function each. What changes the map goes through `send`.
import { act, getEdge, getGraph, getHistory, getMap, getPlan, getRevision, getState, Gone } from "./api";
import { fits } from "./address";
import type {
  Actions,
  Box,
  ChangeEntry,
  FloorPlan,
  GraphEntry,
  MapSummary,
  Matrix,
  RevisionPoses,
  SceneEntry,
  Vector,
} from "./contract";
import * as derive from "./derive";
import { Resources } from "./resources";
import type { Resource } from "./resources";
import { COMPARISONS, page } from "./state";
import type { Pick } from "./stage/stage";
import type { Overlay, Selection, Side, State, Tab, Theme, Undo } from "./state";
import { CHANGE_WORDS, middleOf, standpointOf } from "./words";

// ---- what is asked of the server, once --------------------------------------------------------------------------

// By their addresses, which name them by content: what an address gives stays what it is.
export const revisions = new Resources(getRevision);
export const edges = new Resources(getEdge);
export const graphs = new Resources(getGraph);
export const plans = new Resources(getPlan);
/** By "component at X,Y,Z", in the map as it is. */
export const histories = new Resources((key) => {
  const [component, at] = key.split(" ");
  return getHistory(page.state.map?.history ?? "", at ?? "", Number(component));
});

export function graphOf(state: State): Resource<GraphEntry> | null {
  return state.map?.graph ? graphs.get(state.map.graph) : null;
}

export function planOf(state: State): Resource<FloorPlan> | null {
  const plan = state.map && derive.componentOf(state.map, state.component)?.plan;
  return plan ? plans.get(plan) : null;
}

/** Where everything lay in the revision that is looked at; null for the newest, whose poses the map has. */
export function posesOf(state: State): Resource<RevisionPoses> | null {
  const uri = state.map?.revisions.find((row) => row.number === state.revision)?.poses;
  return uri ? revisions.get(uri) : null;
}

const objectsOf = (state: State) => {
  const known = graphOf(state);
  return known?.status === "ready" ? known.value.objects : [];
};

// ---- the map ----------------------------------------------------------------------------------------------------

export async function load(): Promise<MapSummary | null> {
  page.set({ phase: "loading", failure: "" });
  try {
    const map = await getMap();
    setMap(map);
    page.set({ phase: "ready", gone: false });
    return map;
  } catch (error) {
    page.set({ phase: "failed", failure: messageOf(error) });
    return null;
  }
}

/** Another state of the map: what was chosen stays, where it is still there. */
export function setMap(map: MapSummary): void {
  const { state } = page;
  const components = map.components.map((one) => one.component);
  const before = state.map?.scenes.find((scene) => scene.component === state.component)?.id;
  const moved = before ? derive.sceneOf(map, before)?.component : undefined;
  const component = moved ?? (components.includes(state.component) ? state.component : (components[0] ?? 0));
  const hasMerged = Boolean(derive.componentOf(map, component)?.merged);
  const kept = (side: Side): Side => (hasMerged ? side : { ...side, source: "scenes" });
  const { selection } = state;
  page.set({
    map,
    component,
    left: kept(state.left),
    split: state.split && { ...state.split, ...kept(state.split) },
    selection: selection && isThere(map, selection) ? selection : null,
    revision: map.revisions.some((row) => row.number === state.revision) ? state.revision : null,
  });
  histories.forget();
}

function isThere(map: MapSummary, { kind, key }: Selection): boolean {
  if (kind === "edge") return derive.edgeOf(map, key) !== undefined;
  if (kind === "change") return map.changes.some((one) => one.id === key);
  if (kind === "scene") return derive.sceneOf(map, key) !== undefined;
  return kind === "object" || map.photos.some((one) => one.file === key);
}

const messageOf = (error: unknown) => (error instanceof Error ? error.message : String(error));

// ---- notices ----------------------------------------------------------------------------------------------------

let lastNotice = 0;

export function say(text: string, bad = false): void {
  const id = ++lastNotice;
  page.set({ notices: [...page.state.notices.slice(-3), { id, text, bad }] });
  if (!bad) setTimeout(() => dismiss(id), 5000);
}

export const dismiss = (id: number) => page.set({ notices: page.state.notices.filter((one) => one.id !== id) });

// ---- looking ----------------------------------------------------------------------------------------------------

const aims: (() => void)[] = [];

export function showComponent(component: number): void {
  if (component === page.state.component) return;
  const blank: Side = { source: "scenes", hidden: new Set() };
  page.set({
    component,
    left: blank,
    split: null,
    side: "left",
    selection: null,
    clip: null,
    until: null,
    pick: null,
    ruler: null,
    drag: null,
    standpoint: null,
  });
  aim(() => page.stage?.fit());
}

/** Moves the viewer, after the stage has been told of the new state. */
export function aim(how: () => void): void {
  aims.push(how);
  page.tell();
}

export function takeAims(): (() => void)[] {
  return aims.splice(0);
}

/** Opens a tab. What was chosen on another one closes with it, unless a scene is being moved by hand. */
export function tab(name: Tab): void {
  const { tab: before, drag, selection } = page.state;
  page.set({ tab: name, folded: false, selection: name === before || drag ? selection : null });
}

export const fold = (folded = !page.state.folded) => page.set({ folded });
export const help = (shown = !page.state.help) => page.set({ help: shown });

export function theme(name: Theme): void {
  page.set({ theme: name });
  try {
    localStorage.setItem("gsmap.theme", name);
  } catch {
    // kept for this visit only
  }
}

function side(change: Partial<Side>): void {
  const { state } = page;
  if (state.side === "right" && state.split) page.set({ split: { ...state.split, ...change } });
  else page.set({ left: { ...state.left, ...change } });
}

export const sideNow = (state: State): Side => (state.side === "right" && state.split ? state.split : state.left);

export const source = (name: "scenes" | "merged") => side({ source: name });

export function toggleScene(id: string): void {
  const hidden = new Set(sideNow(page.state).hidden);
  if (!hidden.delete(id)) hidden.add(id);
  side({ hidden });
}

export function showAll(): void {
  side({ hidden: new Set() });
}

export function hideAll(): void {
  side({ hidden: new Set(idsOf(page.state)) });
}

const idsOf = (state: State) =>
  state.map?.scenes.filter((scene) => scene.component === state.component).map((scene) => scene.id) ?? [];

const allBut = (...shown: string[]) => new Set(idsOf(page.state).filter((id) => !shown.includes(id)));

/** Only this scene; all of them where it is the only one already. */
export function solo(id: string): void {
  const { hidden } = sideNow(page.state);
  const ids = idsOf(page.state);
  const isSolo = !hidden.has(id) && ids.every((other) => other === id || hidden.has(other));
  side({ hidden: isSolo ? new Set() : allBut(id) });
}

export function split(on = !page.state.split): void {
  if (!on) {
    page.set({ split: null, side: "left" });
    return;
  }
  const { left, map, component } = page.state;
  const merged = map ? derive.componentOf(map, component)?.merged : null;
  const other = merged && left.source === "scenes" ? "merged" : "scenes";
  page.set({ split: { at: 0.5, source: other, hidden: left.hidden }, side: "right" });
}

export function splitAt(at: number): void {
  const { split: now } = page.state;
  if (now) page.set({ split: { ...now, at: Math.max(0.05, Math.min(0.95, at)) } });
}

export function swap(): void {
  const { left, split: right } = page.state;
  if (right) page.set({ left: { source: right.source, hidden: right.hidden }, split: { ...left, at: right.at } });
}

/** Both captures of a pair beside each other, whatever else is shown. */
export function splitPair(a: string, b: string): void {
  page.set({
    left: { source: "scenes", hidden: allBut(a) },
    split: { at: 0.5, source: "scenes", hidden: allBut(b) },
    side: "left",
    until: null,
  });
}

/** The same of any two scenes of one component, which is shown. */
export function showPair(a: SceneEntry, b: SceneEntry): void {
  showComponent(a.component);
  splitPair(a.id, b.id);
}

export function clip(on = !page.state.clip): void {
  const { map, component } = page.state;
  const whole = map ? derive.componentOf(map, component)?.box : null;
  page.set({ clip: on && whole ? structuredClone(whole) : null });
}

function shrunk(box: Box, share: number): Box {
  const middle = middleOf(box);
  return box.map((corner) => corner.map((v, i) => (middle[i] ?? v) + share * (v - (middle[i] ?? v)))) as Box;
}

/** Moves one face of the clip box; faces never cross. */
export function clipFace(corner: 0 | 1, axis: 0 | 1 | 2, value: number): void {
  const { clip: now, map, component } = page.state;
  const whole = map && derive.componentOf(map, component)?.box;
  if (!now || !whole || !Number.isFinite(value)) return;
  const box = structuredClone(now);
  const least = 0.01 * (whole[1][axis] - whole[0][axis]);
  box[corner][axis] = corner === 0 ? Math.min(value, now[1][axis] - least) : Math.max(value, now[0][axis] + least);
  page.set({ clip: box });
}

export const ceiling = (shown = !page.state.ceiling) => page.set({ ceiling: shown });

export function overlay(name: Overlay, shown = !page.state.overlays.has(name)): void {
  const overlays = new Set(page.state.overlays);
  if (shown) overlays.add(name);
  else overlays.delete(name);
  page.set({ overlays });
}

export function fit(): void {
  aim(() => page.stage?.fit(undefined, true));
}

/** Stands in the chosen scene, or in the largest one. */
export async function walkIn(): Promise<void> {
  const { map, selection } = page.state;
  const index = selection?.kind === "scene" ? map?.scenes.findIndex((scene) => scene.id === selection.key) : undefined;
  if (!(await page.stage?.walkIn(index))) say("No camera of these scenes is known: W A S D and the mouse walk in");
}

/** Looks at the 3D view before all of it is there. */
export function stay(): void {
  if (page.stage) page.stage.stand(page.stage.standpoint());
}

export function flyTo(box: Box): void {
  aim(() => page.stage?.fit(box, true));
}

export function around(points: Vector[]): Box {
  const at = (how: (...v: number[]) => number) => [0, 1, 2].map((i) => how(...points.map((p) => p[i] ?? 0))) as Vector;
  return [at(Math.min), at(Math.max)];
}

export async function copyLink(): Promise<void> {
  const { state } = page;
  try {
    await navigator.clipboard.writeText(location.href);
    say("Link copied: it opens this very view");
  } catch {
    say(`The browser does not let the page copy. The link is in the address bar: ${location.href}`, true);
    return;
  }
  if (state.map && !fits(state, state.map))
    say("Too many scenes are hidden to be named in a link: it shows all of them");
}

// ---- choosing ---------------------------------------------------------------------------------------------------

export function select(selection: Selection | null, fly = true): void {
  const { map } = page.state;
  page.set({ selection, view: 0, drag: null, folded: false });
  if (!map || !selection) return;
  const at = componentOfSelection(map, selection);
  if (at !== null && at !== page.state.component) {
    showComponent(at);
    page.set({ selection });
  }
  if (fly) flyToSelected(selection);
}

function componentOfSelection(map: MapSummary, { kind, key }: Selection): number | null {
  if (kind === "scene") return derive.sceneOf(map, key)?.component ?? null;
  if (kind === "change") return map.changes.find((one) => one.id === key)?.component ?? null;
  if (kind === "photo") return map.photos.find((one) => one.file === key)?.component ?? null;
  if (kind === "edge") {
    const edge = derive.edgeOf(map, key);
    const ends = edge ? [edge.target, edge.source].map((index) => map.scenes[index]?.component ?? null) : [];
    return ends.includes(page.state.component) ? page.state.component : (ends[0] ?? null);
  }
  return null;
}

export function flyToSelected(selection = page.state.selection): void {
  const { map } = page.state;
  if (!map || !selection) return;
  const { kind, key } = selection;
  if (kind === "scene") {
    const scene = derive.sceneOf(map, key);
    if (scene) flyTo(around(scene.corners));
  } else if (kind === "edge") {
    const edge = derive.edgeOf(map, key);
    const ends = edge ? [edge.target, edge.source].flatMap((index) => map.scenes[index] ?? []) : [];
    const here = ends.filter((scene) => scene.component === page.state.component);
    if (here.length) flyTo(around(here.flatMap((scene) => scene.corners)));
  } else if (kind === "change") {
    const change = map.changes.find((one) => one.id === key);
    if (change) flyTo(grown(change.box));
  } else if (kind === "photo") {
    const photo = map.photos.find((one) => one.file === key);
    const unit = photo && derive.componentOf(map, photo.component)?.metres_per_unit;
    if (photo) aim(() => page.stage?.stand(standpointOf(photo, unit ?? 1), true));
  } else {
    const object = objectsOf(page.state).find((one) => one.id === key);
    if (object) flyTo(grown(object.box));
  }
}

/** So much around a thing that one sees where it stands. */
const grown = (box: Box) => shrunk(box, 3);

/** A click in the 3D view: an end for the ruler; else on a thing chooses it, anywhere else tells the place. */
export function picked(pick: Pick): void {
  const { map, ruler } = page.state;
  const { thing } = pick;
  if (ruler) {
    page.set({ ruler: ruler.length === 1 ? [...ruler, pick] : [pick] });
    return;
  }
  page.set({ pick });
  if (!map) return;
  if (!thing) {
    const object = page.state.tab === "things" ? objectAt(pick.point) : undefined;
    if (object) select({ kind: "object", key: object.id }, false);
    return;
  }
  const edge = thing.kind === "edge" ? map.edges[thing.index] : undefined;
  const key = {
    edge: () => edge && derive.edgeKey(map, edge),
    change: () => map.changes[thing.index]?.id,
    photo: () => map.photos[thing.index]?.file,
    object: () => objectsOf(page.state)[thing.index]?.id,
    camera: () => undefined,
  }[thing.kind]();
  if (key && thing.kind !== "camera") select({ kind: thing.kind, key }, thing.kind === "photo");
}

/** The smallest object whose box holds a point. */
function objectAt(point: Vector) {
  const { state } = page;
  const holds = ([low, high]: Box) => point.every((v, i) => v >= (low[i] ?? v) && v <= (high[i] ?? v));
  const size = ([low, high]: Box) => low.reduce((sum, v, i) => sum * ((high[i] ?? v) - v), 1);
  return objectsOf(state)
    .filter((one) => one.component === state.component && one.there && holds(one.box))
    .sort((a, b) => size(a.box) - size(b.box))[0];
}

/** Takes the ruler: the next two clicks are the ends of a length. Puts it away where it was taken. */
export function measure(from?: Pick): void {
  if (page.state.ruler) page.set({ ruler: null });
  else page.set({ ruler: from ? [from] : [], pick: null });
}

/** @param thing id of an object or a change */
export const hover = (thing: string | null) => {
  if (thing !== page.state.hovered) page.set({ hovered: thing });
};

/** "Moved in room r2": the kind of a change, and its room once rooms are known. */
export function titleOfChange({ id, kind }: ChangeEntry): string {
  const known = graphOf(page.state);
  const room = known?.status === "ready" ? known.value.changes[id] : undefined;
  return `${CHANGE_WORDS[kind] ?? kind}${room ? ` in room ${room}` : ""}`;
}

/** Whether there is a 3D view, or one is being made: without WebGL there is only the floor plan. */
export const has3D = (state: State) => state.stageError === null;

/** Chooses one of the two captures that are compared. */
export function choosePair(place: 0 | 1, id: string): void {
  const [a, b] = page.state.pair;
  page.set({ pair: place === 0 ? [id, b] : [a, id] });
}

const OF_TAB = { look: "scene", review: "edge", time: "change", things: "object" } as const;

/** The next or previous of the list that the selection is in; without a selection, of the list that is open. */
export function neighbour(by: 1 | -1): Selection | "end" | null {
  const { state } = page;
  const { map } = state;
  if (!map) return null;
  const kind = state.selection?.kind ?? OF_TAB[state.tab];
  const listed: Record<Selection["kind"], () => string[]> = {
    scene: () => derive.listedScenes(state).map((one) => one.id),
    edge: () => derive.listedEdges(state).map((one) => derive.edgeKey(map, one)),
    change: () => derive.listedChanges(state).map((one) => one.id),
    object: () => derive.listedObjects(state, objectsOf(state)).map((one) => one.id),
    photo: () => derive.listedPhotos(state).map((one) => one.file),
  };
  const keys = listed[kind]();
  if (!keys.length) return null;
  const now = keys.findIndex((key) => derive.isSelected(state, kind, key));
  const next = now < 0 ? (by > 0 ? 0 : keys.length - 1) : now + by;
  const key = keys[next];
  return key === undefined ? "end" : { kind, key };
}

export function step(by: 1 | -1): void {
  const next = neighbour(by);
  if (next && next !== "end") select(next);
  else if (next) say(by > 0 ? "That was the last one" : "That was the first one");
}

export function view(by: 1 | -1, count: number): void {
  if (count) page.set({ view: (page.state.view + by + count) % count });
}

export function nextComparison(): void {
  const at = COMPARISONS.indexOf(page.state.comparison);
  page.set({ comparison: COMPARISONS[(at + 1) % COMPARISONS.length] ?? "blink" });
}

// ---- time -------------------------------------------------------------------------------------------------------

export const until = (day: string | null) => page.set({ until: day });

export function revision(id: number | null): void {
  const { map } = page.state;
  page.set({ revision: id === map?.revision ? null : id, drag: null });
}

// ---- changing the map -------------------------------------------------------------------------------------------

export const mayAct = (state: State) => state.map?.actions === true;

/** Sends an action. Gives whether the server took it; one that could not reach it is kept until it can. */
async function send<Name extends keyof Actions>(
  name: Name,
  body: Actions[Name],
  said: { doing: string; done: string; undo?: Undo },
): Promise<boolean> {
  if (page.state.busy) {
    say("One thing at a time: the last one is still being saved");
    return false;
  }
  page.set({ busy: said.doing });
  try {
    const map = await act(name, body);
    page.set({ busy: null, gone: false, undo: said.undo ? [...page.state.undo, said.undo] : page.state.undo });
    edges.refresh(); // a review is one of its events
    graphs.refresh(); // and a name one of an object's
    setMap(map);
    say(said.done);
    return true;
  } catch (error) {
    page.set({ busy: null });
    if (error instanceof Gone) {
      const label = said.doing;
      const again = { label, send: () => send(name, body, said) };
      page.set({ gone: true, unsent: [...page.state.unsent, again] });
    } else {
      say(messageOf(error), true);
      await refresh(); // it may be refused because the map is another one by now
    }
    return false;
  }
}

async function refresh(): Promise<void> {
  try {
    setMap(await getMap());
  } catch (error) {
    if (error instanceof Gone) page.set({ gone: true });
  }
}

const isStatic = (map: MapSummary) => map.history === null;

/** Looks every few seconds whether others changed the map, and whether the server is there. */
export async function watch(every_ms = 4000): Promise<void> {
  for (;;) {
    // What a scene looks like from afar comes in the seconds after a map was opened for the first time.
    const isComing = page.state.map?.components.some(
      (one) => one.component === page.state.component && one.overview?.pending,
    );
    await new Promise((rest) => setTimeout(rest, isComing ? every_ms / 8 : every_ms));
    const { map, busy, phase } = page.state;
    if (!map || busy || phase !== "ready" || document.hidden || isStatic(map)) continue;
    try {
      const { state } = await getState();
      const isBack = page.state.gone;
      if (isBack) await retry();
      else if (state !== map.state && !page.state.busy) setMap(await getMap());
    } catch (error) {
      if (error instanceof Gone) page.set({ gone: true });
    }
  }
}

/** Asks whether the server is back, and sends what it did not get, in order. */
export async function retry(): Promise<void> {
  if (page.state.phase === "failed") {
    await load();
    return;
  }
  page.set({ busy: "asking gsmap view" });
  try {
    const map = await getMap();
    const { unsent } = page.state;
    page.set({ gone: false, unsent: [], busy: null });
    for (const resources of [revisions, edges, graphs, histories]) resources.forgetFailed();
    setMap(map);
    for (const [index, one] of unsent.entries())
      if (!(await one.send()) && page.state.gone) {
        page.set({ unsent: [...page.state.unsent, ...unsent.slice(index + 1)] });
        return;
      }
    if (!unsent.length) say("gsmap view is there again");
  } catch (error) {
    page.set({ busy: null, gone: true });
    say(error instanceof Gone ? "Still no answer" : messageOf(error), true);
  }
}

export type Verdict = "confirm" | "reject" | "withdraw";
const DONE: Record<Verdict, string> = { confirm: "Confirmed", reject: "Rejected", withdraw: "Review withdrawn" };
const DOING: Record<Verdict, string> = { confirm: "confirming", reject: "rejecting", withdraw: "withdrawing" };

/** Reviews an edge or a change; its inverse is put on the stack of what can be undone. */
export function review(what: Selection, verdict: Verdict, note = ""): Promise<boolean> {
  const before = reviewed(what);
  if (!before) return Promise.resolve(false);
  if (verdict === "withdraw" && before.verdict === "withdraw") {
    say(`There is no review of ${before.name} to withdraw`);
    return Promise.resolve(false);
  }
  const undo: Undo = {
    label: `review of ${before.name}`,
    run: () =>
      send(
        before.verdict,
        { what: what.key, note: before.note },
        { doing: `undoing: ${before.name}`, done: `Undone: ${before.name}` },
      ),
  };
  return send(
    verdict,
    { what: what.key, note: note.trim() },
    {
      doing: `${DOING[verdict]} ${before.name}`,
      done: `${DONE[verdict]}: ${before.name}${what.kind === "edge" ? ". It takes effect with Optimize now" : ""}`,
      undo,
    },
  );
}

/** What a person has said of it so far, as the action that says it again. */
function reviewed({ kind, key }: Selection): { verdict: Verdict; note: string; name: string } | null {
  const { map } = page.state;
  if (!map) return null;
  if (kind === "change") {
    const change = map.changes.find((one) => one.id === key);
    if (!change) return null;
    const verdict = change.status === "confirmed" ? "confirm" : change.status === "rejected" ? "reject" : "withdraw";
    return { verdict, note: change.note ?? "", name: `change ${key}` };
  }
  const edge = kind === "edge" ? derive.edgeOf(map, key) : undefined;
  if (!edge) return null;
  const name = [edge.target, edge.source].map((index) => map.scenes[index]?.name).join(" : ");
  return { verdict: edge.review ?? "withdraw", note: edge.note, name };
}

export async function undo(): Promise<void> {
  const { undo: stack } = page.state;
  const last = stack[stack.length - 1];
  if (!last) {
    say("Nothing to undo");
    return;
  }
  const isDone = await last.run();
  if (isDone || page.state.gone) page.set({ undo: page.state.undo.filter((one) => one !== last) });
}

export const optimize = () =>
  send(
    "optimize",
    {},
    { doing: "optimizing: all poses are solved for anew", done: "Optimized: a new revision is shown" },
  );

export const compare = () =>
  send(
    "compare",
    {},
    { doing: "comparing captures: minutes on a large map", done: "Compared: changes are listed by date" },
  );

export function setDate({ id, name, captured_at: before }: SceneEntry, at: string): Promise<boolean> {
  const said = { doing: `dating ${name}`, done: at ? `Dated: ${name}` : `Date of ${name} taken back` };
  const told = (when: string | null, undo?: Undo) =>
    send("date", { scene: id, captured_at: when || "none" }, undo ? { ...said, undo } : said);
  return told(at, { label: `date of ${name}`, run: () => told(before) });
}

export async function nameObject(id: string, name: string, before: string): Promise<boolean> {
  const told = (text: string, said: string): Promise<boolean> =>
    send("name_object", { object: id, name: text }, { doing: `naming ${id}`, done: said });
  const undo: Undo = { label: `name of ${id}`, run: () => told(before, `Undone: name of ${id}`) };
  const isDone = await send(
    "name_object",
    { object: id, name },
    { doing: `naming ${id}`, done: name ? `${id} is called ${name}` : `Name of ${id} taken back`, undo },
  );
  return isDone;
}

// ---- priors -----------------------------------------------------------------------------------------------------

export function startDrag(id: string): void {
  const { map } = page.state;
  const scene = map && derive.sceneOf(map, id);
  if (!scene) return;
  page.set({ drag: { scene: id, from: scene.S_map_scene, now: scene.S_map_scene }, revision: null });
}

export function dragged(now: Matrix): void {
  const { drag } = page.state;
  if (drag) page.set({ drag: { ...drag, now } });
}

export const endDrag = () => page.set({ drag: null });

export async function savePrior(sigma_m: number, sigma_deg: number): Promise<void> {
  const { drag, map } = page.state;
  const scene = drag && map && derive.sceneOf(map, drag.scene);
  if (!scene) return;
  const { name, id } = scene;
  const isDone = await send(
    "prior",
    { scene: id, S_map_scene: drag.now, sigma_m, sigma_deg },
    { doing: `saving where ${name} lies`, done: `Saved: where ${name} lies`, undo: priorAsBefore(scene) },
  );
  if (isDone) endDrag();
}

export const removePrior = (scene: SceneEntry) =>
  send(
    "remove_prior",
    { scene: scene.id },
    {
      doing: `removing the prior of ${scene.name}`,
      done: `Removed: prior of ${scene.name}`,
      undo: priorAsBefore(scene),
    },
  );

/** What is told of a scene now holds again, or nothing where nothing is. */
function priorAsBefore({ id, name, prior_number: number }: SceneEntry): Undo {
  const said = { doing: `undoing: prior of ${name}`, done: `Undone: prior of ${name}` };
  return {
    label: `prior of ${name}`,
    run: () =>
      number === null ? send("remove_prior", { scene: id }, said) : send("earlier_prior", { scene: id, number }, said),
  };
}
