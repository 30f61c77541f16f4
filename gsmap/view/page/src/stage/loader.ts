// Keeps what is drawn at what the view asks for: chooses tiles, fetches the ones that are missing, drops what was not
// looked at for longest once the memory is used up.
import { Box3, Matrix4, Vector3 } from "three";
import type { Object3D } from "three";
import type { MapSummary, Overview } from "../contract";
import { choose, drawable } from "./lod";
import type { Cut } from "./lod";
import { SplatTile, Table } from "./splats";
import { unpack } from "./spz";
import { fetchContent, fetchTileset, readTileset, Tile, Tree } from "./tiles";

export interface Budget {
  splats: number; // drawn at a time
  bytes: number; // of splats held by the graphics card
  errorPx: number; // what is closer to the originals than this is not refined
  requests: number; // at a time; browsers open six to a server, and lists and pictures need some of them
}
export const BUDGET: Budget = { splats: 2_000_000, bytes: 600 << 20, errorPx: 0.5, requests: 4 };

/** What is seen: where the eye is and how large things get. */
export interface Viewpoint {
  viewProjection: Matrix4;
  eye: Vector3;
  focalPx: number;
  nearest: number;
}

/** Where each tree lies and whether it is drawn: 1 left of a split, 2 right of it, 3 both, 0 not at all. */
export interface TreePlacement {
  pose: Matrix4;
  sides: number;
}

interface DrawnOverview {
  tile: SplatTile | null; // null while it is on its way
  of: Overview;
  ids: string[]; // of the scenes in it
  written: Matrix4[]; // where they lay when it was made, by scene
}
/** A new overview is fetched when it has so many times the splats of the one that is there. */
const WORTH_FETCHING = 1.5;

interface TileRequest {
  tree: Tree;
  tile: Tile | null; // whose finer tiles are asked for; null: the root
  rank: number; // 0 matters most
}

export class Loader {
  splats = 0;
  bytesReceived = 0;
  bytesUploaded = 0;
  bytesHeld = 0;
  readonly table: Table;
  readonly merged: Tree | null;
  private readonly trees: Tree[];
  private readonly shares = new Map<Tree, Tile>();
  private overview: DrawnOverview | null = null;
  private cut: Cut<Tile> = { tiles: [], refined: new Set(), unknown: [], splats: 0 };
  private shown = new Set<Tile>();
  private readonly ready = new Set<Tile>();
  private readonly aborter = new AbortController();
  private active = 0;
  private tick = 0;
  private timer: ReturnType<typeof setTimeout> | undefined;
  private queue: (Tile | TileRequest)[] = []; // what matters most first
  private waiting = 0; // trees that are wanted and still being made
  private readonly placed: TreePlacement[];
  private readonly asWritten: Matrix4[];

  /**
   * @param group takes the tiles that are drawn
   * @param onChange something is there, or is to be asked for again
   */
  constructor(
    private readonly map: MapSummary,
    private readonly component: number,
    private readonly group: Object3D,
    private readonly budget: Budget,
    private readonly onChange: () => void,
    private readonly onError: (message: string) => void,
    before: Loader | null = null,
  ) {
    const { scenes } = map;
    const merged = map.components.find((one) => one.component === component)?.merged;
    this.table = new Table(2 * scenes.length + 1);
    const known = before?.release() ?? new Map<string, Tree>();
    const treeOf = (uri: string, row: number): Tree => {
      const url = new URL(uri, document.baseURI).href;
      const tree = known.get(url) ?? new Tree(url, row);
      known.delete(url);
      tree.row = row;
      return tree;
    };
    this.trees = scenes.map((scene, i) => treeOf(scene.tileset, 2 * i));
    this.merged = merged ? treeOf(merged, 2 * scenes.length) : null;
    if (before) this.takeOver(before, new Set(known.values()));
    this.asWritten = scenes.map((scene) => new Matrix4().set(...(scene.S_map_scene.flat() as Sixteen)));
    this.placed = scenes.map((_, i) => ({ pose: (this.asWritten[i] as Matrix4).clone(), sides: 0 }));
    const next = map.components.find((one) => one.component === component)?.overview;
    const kept = next ? before?.keepOverview(map, component) : null;
    if (kept) {
      kept.tile?.move(this.table, null);
      this.bytesHeld += kept.tile?.bytes ?? 0;
      this.share(kept);
    }
    before?.dispose();
    if (next?.scenes.length && !(kept && serves(kept.of, next))) {
      const ids = next.scenes.map((index) => scenes[index]?.id ?? "");
      const overview = { tile: null, of: next, ids, written: this.asWritten };
      if (!kept) this.share(overview);
      this.fetchOverview(overview); // until it is there, the one that was kept is drawn
    }
  }

  /** Begins every tree with its scene's share of an overview. */
  private share(overview: DrawnOverview): void {
    this.overview = overview;
    this.shares.clear();
    overview.of.scenes.forEach((index, k) => {
      const scene = this.map.scenes[index];
      const tree = this.trees[index];
      const count = overview.of.counts[k] ?? 0;
      if (!scene || !tree || !count) return;
      const box = new Box3(new Vector3(...scene.box[0]), new Vector3(...scene.box[1]));
      // How far apart its splats are, on surfaces that fill the box's largest side.
      const spacing = box.getSize(new Vector3()).length() / Math.sqrt(count);
      const finer = tree.root ? [tree.root] : tree.state === "failed" ? [] : null;
      const share = new Tile(tree, box, box, spacing, null, new Matrix4(), count, finer);
      if (overview.tile) share.state = "ready";
      this.shares.set(tree, share);
    });
  }

  get pending(): number {
    return this.active + this.queue.length + this.waiting;
  }

  /** Takes where scenes lie and which are drawn where. */
  place(placed: readonly TreePlacement[], merged: number): boolean {
    let changed = false;
    placed.forEach(({ pose, sides }, i) => {
      const own = this.placed[i];
      if (!own) return;
      own.pose.copy(pose);
      own.sides = sides;
      this.trees[i]?.pose.copy(pose);
      changed = this.table.set(2 * i, pose, sides) || changed;
    });
    if (this.merged) changed = this.table.set(this.merged.row, this.merged.pose, merged) || changed;
    return changed;
  }

  /** The scene whose tile it is, or -1. */
  sceneOf(tile: SplatTile, index: number): number {
    if (tile.row !== null) return tile.row % 2 === 0 && tile.row < 2 * this.trees.length ? tile.row / 2 : -1;
    let at = index;
    const { of } = this.overview ?? {};
    for (const [k, count] of (of?.counts ?? []).entries()) {
      if (at < count) return of?.scenes[k] ?? -1;
      at -= count;
    }
    return -1;
  }

  /** Chooses anew for what is seen; returns whether other splats are drawn than before. */
  update(viewpoint: Viewpoint): boolean {
    this.tick++;
    const roots: Tile[] = [];
    const treesAsked: Tree[] = [];
    const drawn = [...this.trees.keys()].filter((i) => this.placed[i]?.sides).map((i) => this.trees[i] as Tree);
    if (this.merged && this.table.sides(this.merged.row)) drawn.push(this.merged);
    for (const tree of drawn) {
      tree.see(viewpoint.viewProjection, viewpoint.eye);
      const share = this.shares.get(tree);
      if (share) roots.push(share);
      else if (tree.root) roots.push(tree.root);
      else treesAsked.push(tree);
    }
    const errors = new Map<Tile, number>();
    const errorOf = (tile: Tile): number => {
      let error = errors.get(tile);
      if (error === undefined) {
        error = tile.tree.errorPx(tile, viewpoint.focalPx, viewpoint.nearest);
        errors.set(tile, error);
      }
      return error;
    };
    const isReady = (tile: Tile) =>
      tile.state === "ready" || (!tile.uri && tile.count === 0 && tile.finer?.length === 0);
    this.cut = choose(roots, errorOf, this.budget.splats, this.budget.errorPx);
    const shown = new Set(drawable(roots, this.cut, (tile) => errorOf(tile) >= 0, isReady));
    const wanted = [...this.cut.refined, ...this.cut.tiles];
    for (const tile of [...wanted, ...shown]) tile.lastUsed = this.tick;

    // What is coarser than what is drawn already is not fetched.
    const missing = new Set<Tile>();
    const want = (tile: Tile, covered: boolean) => {
      if (errorOf(tile) < 0) return;
      const inCut = !this.cut.refined.has(tile);
      if (tile.state === "none" && tile.uri && (inCut || !covered)) missing.add(tile);
      if (!inCut) for (const finer of tile.finer ?? []) want(finer, covered || tile.state === "ready");
    };
    for (const root of roots) want(root, false);
    const loading = [...this.loading];
    for (const tile of loading) if (!wanted.includes(tile)) tile.aborter?.abort();
    const asked: TileRequest[] = [
      ...treesAsked.map((tree) => ({ tree, tile: null })),
      ...this.cut.unknown.map((tile) => ({ tree: tile.tree, tile })),
    ].map((one, rank) => ({ ...one, rank }));
    const now = performance.now();
    const isDue = ({ tree, tile }: TileRequest) =>
      tile?.external
        ? tile.state !== "loading"
        : tree.state === "none" || (tree.state === "waiting" && tree.retryAt <= now);
    const worth = (one: Tile | TileRequest) =>
      one instanceof Tile ? errorOf(one) : one.tile ? errorOf(one.tile) : Infinity;
    this.queue = [...missing, ...asked.filter(isDue)].sort((a, b) => worth(b) - worth(a));
    this.waiting = asked.filter(
      ({ tree, tile }) => !tile?.external && tree.state === "waiting" && tree.retryAt > now,
    ).length;
    this.pump();

    let changed = false;
    for (const tile of this.shown)
      if (!shown.has(tile)) {
        tile.mesh?.removeFromParent();
        changed = true;
      }
    for (const tile of shown)
      if (!this.shown.has(tile)) {
        if (tile.mesh) this.group.add(tile.mesh);
        changed = true;
      }
    this.shown = shown;
    for (const [tree, share] of this.shares) {
      const i = tree.row / 2;
      const placed = this.placed[i] as TreePlacement;
      const written = this.overview?.written[i] ?? (this.asWritten[i] as Matrix4);
      const moved = new Matrix4().multiplyMatrices(placed.pose, written.clone().invert());
      changed = this.table.set(tree.row + 1, moved, shown.has(share) ? placed.sides : 0) || changed;
    }
    this.splats = [...shown].reduce((sum, tile) => sum + tile.count, 0);
    this.drop();
    return changed;
  }

  private readonly loading = new Set<Tile>();

  private pump(): void {
    while (this.active < this.budget.requests && this.queue.length) {
      const next = this.queue.shift();
      if (next instanceof Tile) {
        if (next.state === "none") void this.fetchTile(next);
      } else if (next && (next.tile?.external ? next.tile : next.tree).state !== "loading") void this.fetchTree(next);
    }
  }

  private async during(work: () => Promise<void>): Promise<void> {
    this.active++;
    try {
      await work();
    } catch (error) {
      if (!this.aborter.signal.aborted) this.onError(error instanceof Error ? error.message : String(error));
    } finally {
      this.active--;
      if (!this.aborter.signal.aborted) {
        this.pump(); // what was chosen last; the next frame chooses anew
        this.onChange();
      }
    }
  }

  private fetchOverview(overview: DrawnOverview): void {
    void this.during(async () => {
      try {
        const response = await fetch(new URL(overview.of.uri, document.baseURI), {
          signal: this.aborter.signal,
          priority: "low",
        });
        if (!response.ok) throw new Error(`the overview: ${response.status} ${response.statusText}`);
        const bytes = new Uint8Array(await response.arrayBuffer());
        this.bytesReceived += bytes.length;
        const shares = overview.of.scenes.map((scene, k) => ({
          owner: 2 * scene + 1,
          count: overview.of.counts[k] ?? 0,
        }));
        const tile = new SplatTile(await unpack(bytes, shares), new Matrix4(), this.table, null);
        if (this.aborter.signal.aborted) return tile.dispose();
        const before = this.overview?.tile;
        this.bytesHeld += tile.bytes - (before?.bytes ?? 0);
        before?.dispose();
        overview.tile = tile;
        this.bytesUploaded += tile.bytes;
        this.group.add(tile);
        this.share(overview);
      } catch (error) {
        if (!this.overview?.tile) this.shares.clear(); // the trees show what they have
        throw error;
      }
    });
  }

  /** Hands the overview on where its scenes are still in their places. */
  private keepOverview(map: MapSummary, component: number): DrawnOverview | null {
    const { overview } = this;
    if (!overview?.tile || component !== this.component) return null;
    if (!overview.of.scenes.every((index, k) => map.scenes[index]?.id === overview.ids[k])) return null;
    this.overview = null;
    return overview;
  }

  /** Ends what is under way; its trees by their addresses, for the next one to go on with. */
  private release(): Map<string, Tree> {
    this.aborter.abort();
    clearTimeout(this.timer);
    const trees = [...this.trees, ...(this.merged ? [this.merged] : [])];
    for (const tree of trees) if (tree.state === "loading" || tree.state === "waiting") tree.state = "none";
    for (const tile of this.loading) tile.state = "none";
    return new Map(trees.map((tree) => [tree.url, tree]));
  }

  /** Goes on with the tiles of another loader, but for those of some trees. */
  private takeOver(before: Loader, gone: ReadonlySet<Tree>): void {
    this.bytesReceived = before.bytesReceived;
    this.bytesUploaded = before.bytesUploaded;
    for (const tile of before.shown) tile.mesh?.removeFromParent();
    for (const tile of before.ready) {
      if (gone.has(tile.tree)) tile.mesh?.dispose();
      else {
        tile.mesh?.move(this.table, tile.tree.row);
        this.ready.add(tile);
        this.bytesHeld += tile.mesh?.bytes ?? 0;
      }
    }
    before.ready.clear();
  }

  private async fetchTree({ tree, tile, rank }: TileRequest): Promise<void> {
    const external = tile?.external;
    if (external) tile.state = "loading";
    else tree.state = "loading";
    await this.during(async () => {
      try {
        const url = external ?? tree.url;
        const answer = await fetchTileset(url, rank, this.aborter.signal);
        if ("retry_s" in answer) {
          tree.state = "waiting";
          tree.retryAt = performance.now() + 1000 * answer.retry_s - 50;
          clearTimeout(this.timer);
          this.timer = setTimeout(this.onChange, 1000 * answer.retry_s);
          return;
        }
        const root = readTileset(tree, answer.json, url, external ? (tile as Tile).matrix : null);
        if (external) {
          (tile as Tile).finer = [root];
          (tile as Tile).state = "none";
        } else {
          tree.root = root;
          tree.state = "ready";
          const share = this.shares.get(tree);
          if (share) {
            share.finer = [root];
            guessCounts(root, 2 * share.count);
          }
        }
      } catch (error) {
        if (external) {
          (tile as Tile).finer = [];
        } else {
          tree.state = "failed";
          const share = this.shares.get(tree);
          if (share) share.finer = [];
        }
        throw error;
      }
    });
  }

  private async fetchTile(tile: Tile): Promise<void> {
    tile.state = "loading";
    tile.aborter = new AbortController();
    this.loading.add(tile);
    await this.during(async () => {
      try {
        const signal = AbortSignal.any([tile.aborter?.signal as AbortSignal, this.aborter.signal]);
        const { packed, matrix, bytes } = await fetchContent(tile.uri as string, signal);
        this.bytesReceived += bytes;
        if (this.aborter.signal.aborted) return;
        const inTree = new Matrix4().multiplyMatrices(tile.matrix, matrix);
        tile.mesh = new SplatTile(packed, inTree, this.table, tile.tree.row);
        tile.count = packed.count;
        tile.state = "ready";
        this.ready.add(tile);
        this.bytesUploaded += tile.mesh.bytes;
        this.bytesHeld += tile.mesh.bytes;
      } catch (error) {
        const cancelled = (tile.aborter?.signal.aborted ?? false) || this.aborter.signal.aborted;
        tile.state = cancelled ? "none" : "failed";
        if (!cancelled) throw error;
      } finally {
        tile.aborter = null;
        this.loading.delete(tile);
      }
    });
  }

  /** Lets go of what was not wanted for longest. */
  private drop(): void {
    if (this.bytesHeld <= this.budget.bytes) return;
    const old = [...this.ready].filter((tile) => tile.lastUsed < this.tick).sort((a, b) => a.lastUsed - b.lastUsed);
    for (const tile of old) {
      if (this.bytesHeld <= this.budget.bytes) return;
      this.bytesHeld -= tile.mesh?.bytes ?? 0;
      tile.mesh?.dispose();
      tile.mesh = null;
      tile.state = "none";
      this.ready.delete(tile);
    }
  }

  dispose(): void {
    this.aborter.abort();
    clearTimeout(this.timer);
    for (const tile of this.ready) tile.mesh?.dispose();
    this.overview?.tile?.dispose();
    this.table.dispose();
  }
}

/** Whether an overview that is there does for a new one: it is the same, or few scenes have come since. */
function serves(there: Overview, next: Overview): boolean {
  const total = (of: Overview) => of.counts.reduce((sum, count) => sum + count, 0);
  return next.uri === there.uri || (next.pending > 0 && total(next) < WORTH_FETCHING * total(there));
}

/** For tiles that do not say how many splats they have: what the coarsest level of their scene lets expect. */
function guessCounts(tile: Tile, count: number): void {
  if (tile.isCountGuessed && tile.uri) tile.count = count;
  for (const finer of tile.finer ?? []) guessCounts(finer, count);
}

export type Sixteen = Parameters<Matrix4["set"]>;
