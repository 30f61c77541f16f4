// Tells the 3D view what the state says, and only what is new in it.
import * as actions from "./actions";
import type { EdgeDetail, MapSummary, RevisionPoses, Vector } from "./contract";
import * as derive from "./derive";
import { OVERLAYS, page } from "./state";
import type { Overlay, State, Tab } from "./state";
import type { Stage } from "./stage/stage";

export const isDark = (state: State) =>
  state.theme === "dark" || (state.theme === "system" && matchMedia("(prefers-color-scheme: dark)").matches);

/** Poses of the revision that is looked at, once they are there. */
export function posesOf(state: State): RevisionPoses | null {
  const known = actions.posesOf(state);
  return known?.status === "ready" ? known.value : null;
}

function detailOf(state: State): EdgeDetail | null {
  const edge = state.correspondences ? derive.selectedEdge(state) : undefined;
  const known = edge && actions.edges.get(edge.detail);
  return known?.status === "ready" ? known.value : null;
}

/** One call of the stage, made when what it is told differs from last time. */
class StageCall<T> {
  private last: T | undefined;
  constructor(
    private readonly isSame: (a: T, b: T) => boolean,
    private readonly tell: (value: T) => void,
  ) {}

  now(value: T): void {
    if (this.last !== undefined && this.isSame(this.last, value)) return;
    this.last = value;
    this.tell(value);
  }

  /** The stage knows this already: it said so itself. */
  heard(value: T): void {
    this.last = value;
  }
}

const is = <T>(a: T, b: T) => a === b;
const alike = <T>(a: T, b: T) => JSON.stringify(a) === JSON.stringify(b);
const sameSet = <T>(a: ReadonlySet<T>, b: ReadonlySet<T>) => a.size === b.size && [...a].every((v) => b.has(v));

/** Who reviews edges sees them, and who looks for photos, whatever else is drawn. */
const OF_TAB: Partial<Record<Overlay, Tab>> = { edges: "review", photos: "things" };

/** Keeps the stage at what the state says from now on. */
export function drive(stage: Stage): () => void {
  const shown = new StageCall<{ map: MapSummary; component: number }>(
    (a, b) => a.map === b.map && a.component === b.component,
    ({ map, component }) => stage.show(map, component),
  );
  const visible = new StageCall<ReadonlySet<number>>(sameSet, (scenes) => stage.setVisible(scenes));
  const source = new StageCall<State["left"]["source"]>(is, (name) => stage.setSource(name));
  const split = new StageCall<{ at: number; scenes: ReadonlySet<number>; source: "scenes" | "merged" } | null>(
    (a, b) => a === b || (!!a && !!b && a.at === b.at && a.source === b.source && sameSet(a.scenes, b.scenes)),
    (value) => stage.setSplit(value),
  );
  const clip: StageCall<State["clip"]> = new StageCall<State["clip"]>(alike, (box) =>
    stage.setClip(box, (now) => {
      clip.heard(now);
      page.set({ clip: now });
    }),
  );
  const ceiling = new StageCall<boolean>(is, (value) => stage.setCeiling(value));
  const overlays = OVERLAYS.map(
    (name) => [name, new StageCall<boolean>(is, (on) => stage.setOverlay(name, on))] as const,
  );
  const changes = new StageCall<ReturnType<typeof derive.listedChanges>>(
    (a, b) => a.length === b.length && a.every((one, i) => one === b[i]),
    (list) => stage.setChanges(list),
  );
  const detail = new StageCall<EdgeDetail | null>(is, (value) => stage.setCorrespondences(value));
  const poses = new StageCall<RevisionPoses | null>(is, (value) => stage.setPoses(value));
  const dragging = new StageCall<string | null>(is, (id) => {
    const index = page.state.map?.scenes.findIndex((scene) => scene.id === id) ?? -1;
    if (id === null || index < 0) stage.drag(null);
    else stage.drag(index, (S_map_scene) => actions.dragged(S_map_scene));
  });
  const highlighted = new StageCall<ReadonlySet<string>>(sameSet, (ids) => stage.setHighlighted(ids));
  const measured = new StageCall<readonly Vector[]>(alike, (points) => stage.setMeasure(points));
  const ruler = new StageCall<boolean>(is, (taken) => {
    stage.setRuler(taken);
    document.documentElement.toggleAttribute("data-ruler", taken);
  });
  const theme = new StageCall<boolean>(is, (dark) => stage.setTheme(dark));
  let things: unknown = null;

  const sync = () => {
    const { state } = page;
    if (!state.map) return;
    theme.now(isDark(state));
    const then = posesOf(state);
    shown.now({ map: state.map, component: state.component });
    poses.now(then);
    source.now(state.left.source);
    visible.now(derive.visible(state, state.left, then));
    split.now(
      state.split && {
        at: state.split.at,
        source: state.split.source,
        scenes: derive.visible(state, state.split, then),
      },
    );
    clip.now(state.clip);
    ceiling.now(state.ceiling);
    for (const [name, told] of overlays) told.now(state.overlays.has(name) || OF_TAB[name] === state.tab);
    if (
      state.overlays.has("objects") ||
      state.overlays.has("rooms") ||
      state.tab === "things" ||
      state.selection?.kind === "object"
    ) {
      const known = actions.graphOf(state);
      if (known?.status === "ready" && known.value !== things) {
        things = known.value;
        stage.setGraph(known.value);
      }
    }
    changes.now(derive.shownChanges(state));
    detail.now(detailOf(state));
    const { selection } = state;
    const chosen = selection?.kind === "object" || selection?.kind === "change" ? selection.key : null;
    highlighted.now(new Set([chosen, state.hovered].flatMap((id) => id ?? [])));
    measured.now((state.ruler ?? [state.pick]).flatMap((pick) => (pick?.point ? [pick.point] : [])));
    ruler.now(state.ruler !== null);
    dragging.now(state.drag?.scene ?? null);
    for (const aim of actions.takeAims()) aim();
  };
  sync();
  return page.listen(sync);
}
