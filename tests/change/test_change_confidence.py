"""How sure changes are, which pieces are one change, and what smooth things are made of."""

import numpy as np
import pytest

from gsmap.change import Params
from gsmap.change.confidence import confidence
from gsmap.change.relocations import Relocation, _is_stationary
from gsmap.change.reporting import merge_pieces
from gsmap.change.segments import ChangedSegment, classify_cells, find_segments
from gsmap.change.surface_cells import SurfaceCells
from gsmap.types import Sim3
from gsmap.types.change import Change

SEEN = {"cells": 30.0, "looked_through": 20.0, "views_through": 3.0, "views_on": 0.0, "strength": 0.0, "slender": 0.0}
SEEN |= {"appearance": 2.0}
PAINTED = SEEN | {"cells": 60.0, "looked_through": 0.0, "views_through": 0.0, "strength": 4.0}


@pytest.mark.guards("answers")
def test_more_that_speaks_for_a_change_makes_it_surer():
    sure = confidence(SEEN)
    assert 0.5 < sure < 1
    for less in (
        {"looked_through": 4.0},
        {"views_through": 1.0},
        {"views_on": 3.0},
        {"slender": 1.0},
        {"appearance": 1.0},
    ):
        assert confidence(SEEN | less) < sure
    assert confidence(SEEN | {"views_through": 0.7}) < 0.5  # Hardly one look proves nothing, however much it covers.
    assert confidence(SEEN | {"views_through": 6.0}) == confidence(SEEN | {"views_through": 20.0})
    # What looks alike from the cameras of one capture is a difference of reconstruction, however often it was seen.
    assert confidence(SEEN | {"views_through": 20.0, "appearance": 0.1}) < 0.5
    assert confidence(PAINTED | {"strength": 1.0}) < confidence(PAINTED) > confidence(PAINTED | {"cells": 6.0})


def change(kind, voxels, rows, sure=0.9):
    voxels = np.asarray(voxels, dtype=np.float32)
    box = np.stack([voxels.min(0), voxels.max(0)]).astype(np.float64)
    rows = np.asarray(rows, dtype=np.int32)
    return Change(kind, box, voxels, rows, rows[:0], confidence=sure, evidence={})


def test_pieces_of_one_kind_that_lie_by_a_larger_change_are_a_part_of_it():
    wall = change("recoloured", [[0.05 + 0.1 * x, 0.05, 0.05] for x in range(10)], [1, 2, 3])
    piece = change("recoloured", [[0.45, 0.15, 0.05], [0.55, 0.15, 0.05], [0.55, 0.05, 0.05]], [3, 4], 0.6)
    far = change("recoloured", [[0.45, 0.85, 0.05]], [9])
    came = change("appeared", [[0.45, 0.15, 0.05]], [7])
    moved = [change("moved", wall.voxels, [5]), change("moved", piece.voxels, [6])]
    found = merge_pieces([piece, came, *moved, far, wall], Params())
    assert sorted(c.kind for c in found) == ["appeared", "moved", "moved", "recoloured", "recoloured"]
    (whole,) = (c for c in found if c.kind == "recoloured" and len(c.voxels) > 1)
    assert whole.before.tolist() == [1, 2, 3, 4]
    assert len(whole.voxels) == 12  # the one that both have once
    assert whole.confidence == 0.9
    assert whole.box == pytest.approx(np.array([[0.05, 0.05, 0.05], [0.95, 0.15, 0.05]]))


def test_a_smooth_thing_of_few_cells_is_one_thing():
    # The top of a box that nine large Gaussians make up: their cells do not touch each other.
    points = np.array([[0.09 * x, 0.09 * y, 0.3] for x in range(3) for y in range(3)])
    count = len(points)
    seen, none = np.full(count, 4.0), np.zeros(count)
    side = SurfaceCells(
        np.arange(count),
        np.arange(count),
        points,
        np.full((count, 3), 0.5),
        seen,
        none,
        none,
        np.zeros((count, 3)),
        none,
        none,
        np.zeros((count, 2)),
        np.zeros((count, 2)),
    )
    cells, _ = classify_cells((side, side))
    (segment,) = find_segments(side, cells, np.zeros(count, dtype=bool), Params())
    assert len(segment.moved) == count


@pytest.mark.parametrize(("looked_through", "stays"), [(5, True), (40, False)])
def test_what_was_hardly_looked_through_did_not_move(looked_through, stays):
    segment = ChangedSegment(np.arange(100), np.arange(looked_through), np.arange(0))
    assert _is_stationary(Relocation(segment, segment, Sim3.identity(), 0.9, 0.3, "none")) is stays
