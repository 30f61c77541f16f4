"""Changes of colour: what counts as paint."""

import numpy as np

from gsmap.change.params import Params
from gsmap.change.segments import CellLabels, find_colour_changes
from gsmap.change.surface_cells import SurfaceCells


def test_paint_that_no_pixel_compared_is_none():
    """Cells that are taken for painted by their neighbours alone, which are of another wall, say nothing."""
    points = np.stack([*np.meshgrid(np.arange(0, 0.5, 0.05), np.arange(0, 0.5, 0.05)), np.zeros((10, 10))], -1)
    points = points.reshape(-1, 3)
    none, zero = np.zeros(len(points)), np.zeros(len(points), dtype=np.int64)
    apart = np.zeros_like(points), none, none, *np.zeros((2, len(points), 2))
    side = SurfaceCells(zero, zero, points, np.ones_like(points), none, none, none, *apart)
    painted = np.ones(len(points), dtype=bool)
    cells = CellLabels(zero, zero - 1, ~painted, painted, painted, none, none)
    assert find_colour_changes((side, side), (cells, cells), Params()) == []
