"""From the cells of two captures to what changed between them."""

from __future__ import annotations

from functools import reduce

import numpy as np
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from gsmap.change.kinds import Found, are_two, kind_in_place, kind_of_paint
from gsmap.change.moving import find_moves
from gsmap.change.params import Params
from gsmap.change.sides import Side
from gsmap.change.things import Cells, Thing, behind, gathered, is_paint, joined, paints, parts, things_of, with_behind
from gsmap.compare import Looks

_IN_PLACE_M = 0.1  # cells of two captures so close to each other are of one place ...
_IN_PLACE = 0.3  # ... and so are two things, if this share of the smaller one is
_SPLIT = (0.15, 0.85)  # share of a thing that stands where another does, for it to be two side by side
_FEWEST_OF_PART = 60


def find_changes(
    both: tuple[Side, Side],
    cells: tuple[Cells, Cells],
    unlike: float,
    looks: tuple[Looks, Looks],
    params: Params,
) -> list[Found]:
    """Everything that changed, one by one, before it is judged how sure it is.

    Args:
        unlike: how unlike the light falls, see `gsmap.change.things.light`.
    """
    tints = [p for p in paints(both, cells, params) if is_paint(p, unlike)]
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
            found.append(Found(kind_of_paint(paint, both), (None, None), paint))
        elif k < len(older):
            older[k] = with_behind(older[k], paint.cells[0])
        else:
            newer[k - len(older)] = with_behind(newer[k - len(older)], paint.cells[1])
    older, newer = gathered(older, both[0]), gathered(newer, both[1])
    moves, older, newer = find_moves(older, newer, both, cells, looks, params)
    for move in moves:
        evidence = {"fit": move.score, "next_fit": move.runner_up}
        found.append(Found("moved", (move.older, move.newer), None, move.S_after_before, move.symmetry, evidence))
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


def _in_place(older: list[Thing], newer: list[Thing], both: tuple[Side, Side]) -> list[Found]:
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
        if a is not None and b is not None and are_two(a, b, both):
            found += [Found("disappeared", (a, None)), Found("appeared", (None, b))]
        else:
            found.append(Found(kind_in_place(a, b, both), (a, b)))
    return found
