"""From two captures to a report of what changed."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial import cKDTree

from gsmap import compare as comparison
from gsmap import render
from gsmap.change.kinds import kind_of_paint
from gsmap.change.moving import find_moves
from gsmap.change.params import Params
from gsmap.change.sides import Side, sides
from gsmap.change.things import Cells, Paint, Thing, behind, is_paint, judge, paints, things_of, with_behind
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
_REPAINTED = 0.15  # where less of it was looked through a thing was painted, not replaced


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
    for move in find_moves(older, newer, both, looks, params):
        evidence = {"fit": move.score, "next_fit": move.runner_up}
        things = (older[move.older], newer[move.newer])
        found.append(_Found("moved", things, None, move.S_after_before, move.symmetry, evidence))
    taken = [{id(t) for one in found for t in one.things if t is not None}]
    older, newer = ([t for t in things if id(t) not in taken[0]] for things in (older, newer))
    return found + _in_place(older, newer, both)


def _in_place(older: list[Thing], newer: list[Thing], both: tuple[Side, Side]) -> list[_Found]:
    """What went, what came, and what went where another thing came."""
    found, left = [], list(newer)
    for thing in older:
        tree = cKDTree(both[0].points[thing.cells])
        shares = []
        for other in left:
            near = np.isfinite(tree.query(both[1].points[other.cells], distance_upper_bound=_IN_PLACE_M)[0]).sum()
            shares.append(near / min(len(thing.cells), len(other.cells)))
        k = int(np.argmax(shares)) if shares else -1
        if k < 0 or shares[k] < _IN_PLACE:
            found.append(_Found("disappeared", (thing, None)))
            continue
        other = left.pop(k)
        moved, total = len(thing.moved) + len(other.moved), len(thing.changed) + len(other.changed)
        found.append(_Found("recoloured" if moved < _REPAINTED * total else "replaced", (thing, other)))
    return found + [_Found("appeared", (None, other)) for other in left]


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
    return 1 - float(np.exp(-evidence["cells"] / 20))
