"""From two captures to a report of what changed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsmap import compare as comparison
from gsmap import render
from gsmap.change.kinds import box_of, in_place, kind_of_paint
from gsmap.change.params import Params
from gsmap.change.sides import Side, sides
from gsmap.change.things import Cells, Thing, find_things, judge
from gsmap.geometry.cells import cell_labels, group_means
from gsmap.methods import RecipeKey
from gsmap.types import PlacedScene
from gsmap.types.change import Change, ChangeReport
from gsmap.types.plain import plain
from gsmap.types.progress import Progress, silent

VERSION = 1
"""Raised whenever a report comes out otherwise for the same two captures."""


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
    cells = judge(both[0], params), judge(both[1], params)
    things = _named(find_things(both, cells, params), both)
    changes = [_change(thing, kind, both, cells, params) for thing, kind in things]
    changes.sort(key=lambda c: (-c.confidence, c.box.tolist()))
    judged = (both[0].through + both[0].on) > 0
    report(1.0, "changes found")
    return ChangeReport(tuple(changes), float(judged.mean()) if len(judged) else 0.0, found.balance.gains())


def _named(things: list[Thing], both: tuple[Side, Side]) -> list[tuple[Thing, str]]:
    """Each thing with its kind; a thing that went and one that came to the same place are one that was replaced."""
    went = [t for t in things if len(t.older)]
    came = [t for t in things if len(t.newer)]
    named = [(t, kind_of_paint(t, both)) for t in things if not t.num()]
    for thing in went:
        k = next((i for i, t in enumerate(came) if in_place(both[0].points[thing.older], both[1].points[t.newer])), None)
        if k is None:
            named.append((thing, "disappeared"))
            continue
        other = came.pop(k)
        joined = replace(
            thing,
            newer=other.newer,
            older_paint=np.union1d(thing.older_paint, other.older_paint),
            newer_paint=np.union1d(thing.newer_paint, other.newer_paint),
        )
        named.append((joined, "replaced"))
    return named + [(t, "appeared") for t in came]


def _change(thing: Thing, kind: str, both: tuple[Side, Side], cells: tuple[Cells, Cells], params: Params) -> Change:
    rows = [np.union1d(thing.older, thing.older_paint), np.union1d(thing.newer, thing.newer_paint)]
    members = [side.rows[np.isin(side.label, r)] for side, r in zip(both, rows, strict=True)]
    points = np.concatenate([side.points[r] for side, r in zip(both, rows, strict=True)])
    grid = np.floor(points / params.voxel_m)
    label, counts = cell_labels(grid)
    voxels = (group_means(grid, label, counts) + 0.5) * params.voxel_m
    through = float(both[0].through[thing.older].sum() + both[1].through[thing.newer].sum())
    evidence = {
        "cells": float(len(points)),
        "through": through / max(thing.num(), 1),
        "strength": float(np.mean(np.r_[cells[0].strength[rows[0]], cells[1].strength[rows[1]]])),
        "offset_m": float(np.median(np.r_[cells[0].offset_m[rows[0]], -cells[1].offset_m[rows[1]]])),
    }
    return Change(
        kind,  # type: ignore[arg-type]
        box_of(points),
        voxels.astype(np.float32),
        members[0].astype(np.int32),
        members[1].astype(np.int32),
        confidence=1 - float(np.exp(-len(points) / 20)),
        evidence=evidence,
    )
