// Which tiles are to be drawn: a greedy cut through all trees under one budget of splats. Pure: knows no graphics.

/** A tile of a tree, as the choice sees it. */
export interface Choice<T extends Choice<T>> {
  readonly count: number; // splats of it
  /** Finer tiles that replace it; empty: it is the finest; null: not known yet. */
  readonly finer: readonly T[] | null;
}

export interface Cut<T> {
  /** What is to be drawn, each root's descendants once; those not in sight are left out. */
  tiles: T[];
  /** Tiles that are replaced by finer ones, coarse ones before what replaces them. */
  refined: Set<T>;
  /** Tiles that are to be replaced once their finer ones are known. */
  unknown: T[];
  splats: number;
}

/**
 * Refines the tile with the largest error until no error is above `least` or nothing more fits the budget.
 *
 * @param roots what is drawn at least, whatever the budget
 * @param errorOf error on the screen in pixels; negative where the tile is not in sight
 */
export function choose<T extends Choice<T>>(
  roots: readonly T[],
  errorOf: (tile: T) => number,
  budget: number,
  least: number,
): Cut<T> {
  const heap = new Heap<T>();
  const kept = new Set<T>();
  const refined = new Set<T>();
  const unknown: T[] = [];
  let splats = 0;
  const add = (tile: T) => {
    const error = errorOf(tile);
    if (error < 0) return;
    splats += tile.count;
    kept.add(tile);
    if (error > least && (tile.finer === null || tile.finer.length)) heap.push(error, tile);
  };
  for (const root of roots) add(root);
  for (let tile = heap.pop(); tile; tile = heap.pop()) {
    if (tile.finer === null) {
      unknown.push(tile);
      continue;
    }
    const seen = tile.finer.filter((finer) => errorOf(finer) >= 0);
    const more = seen.reduce((sum, finer) => sum + finer.count, 0) - tile.count;
    // What does not fit is left as it is; something smaller may still.
    if (more > 0 && splats + more > budget) continue;
    splats -= tile.count;
    kept.delete(tile);
    refined.add(tile);
    for (const finer of seen) add(finer);
  }
  return { tiles: [...kept], refined, unknown, splats };
}

/** What of a cut can be drawn now: a tile is replaced only when all that replaces it is there. */
export function drawable<T extends Choice<T>>(
  roots: readonly T[],
  cut: Cut<T>,
  isInSight: (tile: T) => boolean,
  isReady: (tile: T) => boolean,
): T[] {
  const known = new Map<T, boolean>();
  const finerOf = (tile: T) => (tile.finer ?? []).filter(isInSight);
  const covers = (tile: T): boolean => {
    let does = known.get(tile);
    if (does === undefined) {
      does = isReady(tile) || (cut.refined.has(tile) && finerOf(tile).every(covers));
      known.set(tile, does);
    }
    return does;
  };
  const out: T[] = [];
  const visit = (tile: T) => {
    const finer = finerOf(tile);
    if (cut.refined.has(tile) && (finer.every(covers) || !isReady(tile))) finer.forEach(visit);
    else if (isReady(tile)) out.push(tile);
  };
  roots.filter(isInSight).forEach(visit);
  return out;
}

/** Largest first; of equals the one that came first. */
class Heap<T> {
  private readonly items: { key: number; order: number; value: T }[] = [];
  private pushed = 0;

  private before(i: number, j: number): boolean {
    const a = this.items[i];
    const b = this.items[j];
    return !!a && !!b && (a.key > b.key || (a.key === b.key && a.order < b.order));
  }

  private swap(i: number, j: number): void {
    const { items } = this;
    [items[i], items[j]] = [items[j] as (typeof items)[0], items[i] as (typeof items)[0]];
  }

  push(key: number, value: T): void {
    let i = this.items.push({ key, order: this.pushed++, value }) - 1;
    for (let up = (i - 1) >> 1; i > 0 && this.before(i, up); up = (i - 1) >> 1) {
      this.swap(i, up);
      i = up;
    }
  }

  pop(): T | undefined {
    const { items } = this;
    const top = items[0];
    const last = items.pop();
    if (!top || !last) return undefined;
    if (items.length) {
      items[0] = last;
      for (let i = 0; ;) {
        let next = i;
        for (const child of [2 * i + 1, 2 * i + 2]) if (child < items.length && this.before(child, next)) next = child;
        if (next === i) break;
        this.swap(i, next);
        i = next;
      }
    }
    return top.value;
  }
}
