"""Outlines of segments in renders: what lies beside them."""

import numpy as np
import pytest

from gsmap.geometry.sh import SH_C0
from gsmap.objects import render_views
from gsmap.objects.outlines import Outline, measure_outlines
from gsmap.types import Cameras, Gaussians

RED, BLUE, GREY = (1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.6, 0.6, 0.6)
HALF_M = 0.6


def square(z: float, half: float, colour, hole: float = 0.0) -> Gaussians:
    """Gaussians of a square sheet at a depth, with a square hole."""
    x, y = (axis.ravel() for axis in np.mgrid[-half:half:0.05, -half:half:0.05] + 0.025)
    x, y = np.stack([x, y])[:, np.maximum(abs(x), abs(y)) > hole]
    sh = np.tile((np.array(colour) - 0.5) / SH_C0, (len(x), 1, 1))
    log_scales = np.log(np.tile([0.03, 0.03, 0.003], (len(x), 1)))
    return Gaussians(np.c_[x, y, np.full_like(x, z)], np.tile([1.0, 0, 0, 0], (len(x), 1)), log_scales, x * 0 + 8, sh)


def outline(*others: tuple[Gaussians, int], z: float = 2.0, unit_m: float = 1.0) -> Outline:
    """The outline of a red square of a segment 0 among surfaces of other segments; -1 is the building."""
    parts = [(square(z, HALF_M, RED), 0), *others]
    members = np.repeat([segment for _, segment in parts], [len(part) for part, _ in parts])
    gaussians = Gaussians.concatenate([part for part, _ in parts])
    gaussians = Gaussians(
        gaussians.means / unit_m,
        gaussians.quats,
        gaussians.log_scales - np.log(unit_m),
        gaussians.logit_opacities,
        gaussians.sh,
    )
    camera = Cameras(np.eye(4)[None], np.array([[128.0, 128, 64, 48]]), np.array([[128, 96]]))
    return measure_outlines(render_views(gaussians, camera, members=members), 2, unit_m)[0]


@pytest.mark.parametrize("unit_m", [1.0, 0.01])
@pytest.mark.parametrize(
    ("kind", "others"),
    [
        ("free", [(square(3.0, 3, BLUE), -1)]),
        ("touching", [(square(2.0, 3, BLUE, HALF_M), -1)]),
        ("continuing", [(square(2.0, 3, RED, HALF_M), -1)]),
        ("behind_building", [(square(1.4, 3, BLUE, 0.68 * HALF_M), -1)]),
        ("behind_segments", [(square(1.4, 3, BLUE, 0.68 * HALF_M), 1)]),
    ],
)
def test_each_pixel_of_an_outline_counts_by_what_lies_beside_it(kind, others, unit_m):
    found = outline(*others, unit_m=unit_m)
    side_px = 2 * HALF_M / 2.0 * 128
    whole = sum(found[:5])
    assert getattr(found, kind) > 0.9 * whole
    assert whole == pytest.approx(4 * side_px, rel=0.25)
    assert found.largest_px == pytest.approx(side_px**2, rel=0.3)


def test_outlines_at_the_border_of_a_view_do_not_count():
    assert sum(outline(z=0.5)[:5]) == 0
