"""From two captures to a report of what changed."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import reduce

import numpy as np
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from gsmap import compare as comparison
from gsmap import render
from gsmap.change.kinds import kind_of_paint
from gsmap.change.moving import find_moves
from gsmap.change.params import Params
from gsmap.change.sides import Side, sides
from gsmap.change.things import (
    Cells,
    Paint,
    Thing,
    behind,
    gathered,
    is_paint,
    joined,
    judge,
    paints,
    parts,
    things_of,
    with_behind,
)
from gsmap.geometry.cells import cell_labels, group_means
from gsmap.methods import RecipeKey
from gsmap.types import PlacedScene, Sim3
from gsmap.types.change import Change, ChangeKind, ChangeReport
from gsmap.types.plain import plain
from gsmap.types.progress import Progress, silent

VERSION = 1
"""Raised whenever a report comes out otherwise for the same two captures."""

_IN_PLACE_M = 0.1  # cells of two captures so close to each other are of one place ...
_IN_PLACE = 0.3  # ... and so are two things, if this share of the smaller one is
_REPAINTED = 0.03  # where less of it was looked through, a thing was painted and not replaced, ...
_FEWEST_MOVED = 8  # ... or fewer cells
_GONE = 0.5  # share of what changed that was looked through, from which a thing went or came as a whole
_ONE_PLACE = 0.4  # share of the larger footprint that both cover, if one took the other's place
_SPLIT = (0.15, 0.85)  # share of a thing that stands where another does, for it to be two side by side
_FEWEST_OF_PART = 60


@dataclass(frozen=True, eq=False)
class _Found:
    """A change, before it becomes one of the report: what each capture shows of it."""

    kind: ChangeKind
    things: tuple[Thing | None, Thing | None]
    paint: Paint | None = None
    S_after_before: Sim3 | None = None
    symmetry: str = "none"
    evidence: dict[str, float] = field(default_factory=dict)


def recipe_key(params: Params | None = None) -> RecipeKey:
    """What names every report that is made in this way; the two captures are added by whoever knows them."""
    version = {"change": VERSION, "compare": comparison.VERSION}
    return RecipeKey("change", "evidence", version, plain(params or Params()), render.backend())


def compare(
    older: PlacedScene, newer: PlacedScene, params: Params | None = None, progress: Progress | None = None
) -> ChangeReport:
    """What changed from an older capture of a place to a newer one.

    Args:
        older, newer: both in one metric frame with z up.
        params: see `Params`.
        progress: told the fraction done in [0, 1] and what is being done.
    """
    params, report = params or Params(), progress or silent
    report(0.0, "looking at the older capture")
    looks_older = comparison.look(older, params.compare)
    report(0.15, "looking at the newer capture")
    looks_newer = comparison.look(newer, params.compare)
    report(0.3, "comparing what both show")
    found = comparison.compare(looks_older, looks_newer, params.compare)
    report(0.7, "finding what changed")
    both = sides(looks_older, looks_newer, found, params)
    cells = judge(both, params)
    changes = [_change(one, both, cells, params) for one in _find(both, cells, found.balance, (looks_older, looks_newer), params)]
    changes = [c for c in changes if c.confidence >= params.min_confidence]
    changes.sort(key=lambda c: (-c.confidence, c.box.tolist()))
    report(1.0, "changes found")
    seen = float(cells[0].judged.mean()) if len(both[0]) else 0.0
    return ChangeReport(tuple(changes), seen, found.balance.gains())


def _find(
    both: tuple[Side, Side],
    cells: tuple[Cells, Cells],
    line: comparison.Balance,
    looks: tuple[comparison.Looks, comparison.Looks],
    params: Params,
) -> list[_Found]:
    tints = [p for p in paints(both, cells, params) if is_paint(p, line, params)]
    clear = [np.zeros(len(side), dtype=bool) for side in both]
    for paint in tints:
        if not paint.is_shell:
            for mask, rows in zip(clear, paint.cells, strict=True):
                mask[rows] = True
    older, newer = (things_of(both[k], cells[k], clear[k], params) for k in (0, 1))
    found = []
    for paint in tints:
        if not paint.is_shell:
            continue
        everything, which = older + newer, [0] * len(older) + [1] * len(newer)
        k = behind(everything, both, paint, which)
        if k is None:
            found.append(_Found(kind_of_paint(paint, both), (None, None), paint))
        elif k < len(older):
            older[k] = with_behind(older[k], paint.cells[0])
        else:
            newer[k - len(older)] = with_behind(newer[k - len(older)], paint.cells[1])
    older, newer = gathered(older, both[0]), gathered(newer, both[1])
    moves, older, newer = find_moves(older, newer, both, cells, looks, params)
    for move in moves:
        evidence = {"fit": move.score, "next_fit": move.runner_up}
        found.append(_Found("moved", (move.older, move.newer), None, move.S_after_before, move.symmetry, evidence))
    older, newer = _split(older, newer, both, 0), _split(newer, older, both, 1)
    return found + _in_place(older, newer, both)


def _split(things: list[Thing], others: list[Thing], both: tuple[Side, Side], which: int) -> list[Thing]:
    """Things, of which those that another takes the place of in part become two."""
    out = []
    for thing in things:
        points = both[which].points[thing.cells]
        for other in others:
            at = both[1 - which].points[other.cells]
            low, high = np.quantile(at, 0.02, axis=0) - 0.08, np.quantile(at, 0.98, axis=0) + 0.08
            inside = ((points > low) & (points < high)).all(1)
            if _SPLIT[0] < inside.mean() < _SPLIT[1]:
                here, rest = parts(thing, thing.cells[inside])
                gone = len(rest.moved) / max(len(rest.changed), 1)
                if len(rest.cells) >= _FEWEST_OF_PART and gone > 0.5 > len(here.moved) / max(len(here.changed), 1):
                    out += [here, rest]
                    break
        else:
            out.append(thing)
    return out


def _in_place(older: list[Thing], newer: list[Thing], both: tuple[Side, Side]) -> list[_Found]:
    """What went, what came, and what went where another thing came."""
    same = np.zeros((len(older), len(newer)), dtype=bool)
    for i, thing in enumerate(older):
        tree = cKDTree(both[0].points[thing.cells])
        for j, other in enumerate(newer):
            near = np.isfinite(tree.query(both[1].points[other.cells], distance_upper_bound=_IN_PLACE_M)[0]).sum()
            same[i, j] = near >= _IN_PLACE * min(len(thing.cells), len(other.cells))
    graph = np.zeros((len(older) + len(newer),) * 2, dtype=bool)
    graph[: len(older), len(older) :] = same
    labels = connected_components(graph, directed=False)[1]
    found = []
    for k in range(int(labels.max(initial=-1)) + 1):
        mine = [older[i] for i in np.flatnonzero(labels[: len(older)] == k)]
        theirs = [newer[j] for j in np.flatnonzero(labels[len(older) :] == k)]
        a, b = (reduce(joined, things) if things else None for things in (mine, theirs))
        if a is not None and b is not None and _are_two(a, b, both):
            found += [_Found("disappeared", (a, None)), _Found("appeared", (None, b))]
        else:
            found.append(_Found(_kind_in_place(a, b, both), (a, b)))
    return found


def _are_two(older: Thing, newer: Thing, both: tuple[Side, Side]) -> bool:
    """Whether what went and what came only touch: then neither took the other's place."""
    if min(len(t.moved) / max(len(t.changed), 1) for t in (older, newer)) < _GONE:
        return False
    boxes = [np.quantile(side.points[t.cells], (0.03, 0.97), axis=0) for side, t in zip(both, (older, newer), strict=True)]
    low, high = np.maximum(boxes[0][0], boxes[1][0])[:2], np.minimum(boxes[0][1], boxes[1][1])[:2]
    shared = float(np.prod(np.maximum(high - low, 0)))
    return shared < _ONE_PLACE * max(float(np.prod((box[1] - box[0])[:2])) for box in boxes)


def _kind_in_place(older: Thing | None, newer: Thing | None, both: tuple[Side, Side]) -> ChangeKind:
    """What happened where one capture or both show something that changed."""
    moved = tuple(len(t.moved) if t is not None else 0 for t in (older, newer))
    changed = sum(len(t.changed) for t in (older, newer) if t is not None)
    if sum(moved) < min(_FEWEST_MOVED, changed / 2) or sum(moved) < _REPAINTED * changed:
        return "recoloured"
    if older is None or newer is None:
        return "appeared" if older is None else "disappeared"
    # What a thing stood on or before is seen in another light without it, and is no thing in its place.
    gone = [len(t.moved) / max(len(t.changed), 1) for t in (older, newer)]
    if max(gone) >= _GONE and min(gone) < _REPAINTED:
        return "appeared" if moved[1] > moved[0] else "disappeared"
    slight = [_is_slight(a, b) for a, b in (((both[0], older), (both[1], newer)), ((both[1], newer), (both[0], older)))]
    if moved[1] > moved[0] and slight[0]:
        return "appeared"
    if moved[0] > moved[1] and slight[1]:
        return "disappeared"
    return "replaced"


def _is_slight(a: tuple[Side, Thing], b: tuple[Side, Thing]) -> bool:
    """Whether a thing is much less than another, or much flatter."""
    (side_a, thing_a), (side_b, thing_b) = a, b
    flat = np.ptp(side_a.points[thing_a.cells, 2]) < 0.3 * np.ptp(side_b.points[thing_b.cells, 2])
    return bool(flat or len(thing_a.cells) < 0.35 * len(thing_b.cells))


def _change(one: _Found, both: tuple[Side, Side], cells: tuple[Cells, Cells], params: Params) -> Change:
    rows, seen = [], []
    for k in (0, 1):
        thing = one.things[k]
        parts = [one.paint.cells[k]] if one.paint is not None else []
        parts += [thing.cells, thing.behind] if thing is not None else []
        rows.append(np.unique(np.concatenate(parts)) if parts else np.zeros(0, np.int64))
        seen.append(rows[k][cells[k].judged[rows[k]]])
    members = [side.rows[np.isin(side.label, r)] for side, r in zip(both, rows, strict=True)]
    points = np.concatenate([side.points[r] for side, r in zip(both, seen, strict=True)])
    grid = np.floor(points / params.voxel_m)
    voxels = (group_means(grid, *cell_labels(grid)) + 0.5) * params.voxel_m
    moved = [t.moved if t is not None else np.zeros(0, np.int64) for t in one.things]
    through = sum(float(side.through[m].sum()) for side, m in zip(both, moved, strict=True))
    count = sum(len(m) for m in moved)
    evidence = {
        "cells": float(len(points)),
        "looked_through": float(count),
        "views_through": through / max(count, 1),
        "strength": float(np.mean(np.concatenate([c.strength[r] for c, r in zip(cells, rows, strict=True)]))),
        "offset_m": float(np.median(np.r_[cells[0].offset_m[rows[0]], -cells[1].offset_m[rows[1]]])),
    } | one.evidence
    if one.paint is not None:
        evidence |= {"strength": one.paint.strength, "leak": one.paint.leak}
    return Change(
        one.kind,
        np.stack([points.min(0), points.max(0)]),
        voxels.astype(np.float32),
        members[0].astype(np.int32),
        members[1].astype(np.int32),
        one.S_after_before,
        one.symmetry,  # type: ignore[arg-type]
        _confidence(one, evidence),
        evidence,
    )


def _confidence(one: _Found, evidence: dict[str, float]) -> float:
    """In [0, 1]: how much was looked through, how clear a change of colour is, and how well a moved thing fits."""
    through = evidence["looked_through"] * min(evidence["views_through"], 6) / 6
    paint = max(evidence["cells"] - evidence["looked_through"], 0) * np.clip(evidence["strength"] / 2 - 0.4, 0, 2)
    sure = 1 - float(np.exp(-through / 10 - paint / 50))
    return sure * float(np.clip(evidence["fit"] / 0.8, 0, 1)) if one.kind == "moved" else sure
