"""True overlap, counted by hand and on real captures."""

import json

import numpy as np
import pytest

from gsmap.evaluate.overlap import solid_centres, true_overlaps
from gsmap.geometry.rotations import exp_so3
from gsmap.ingest import read_captures
from gsmap.types import Gaussians, Sim3


def points(xs, opacity=0.9, size_m=0.01) -> Gaussians:
    n = len(xs)
    means = np.stack([xs, np.zeros(n), np.zeros(n)], axis=1)
    logit = np.full(n, np.log(opacity / (1 - opacity)))
    return Gaussians(
        means, np.tile([1.0, 0, 0, 0], (n, 1)), np.full((n, 3), np.log(size_m)), logit, np.zeros((n, 1, 3))
    )


def test_the_smaller_of_both_shares():
    at = {"a": np.arange(10.0), "b": np.arange(6, 26) + 0.07, "c": np.arange(8.0) + 0.5, "d": np.zeros(0)}
    centres = {name: np.stack([x, 0 * x, 0 * x], axis=1) for name, x in at.items()}
    found = true_overlaps(list(centres), centres.__getitem__)
    assert found[frozenset("ab")] == pytest.approx(4 / 20)  # 4 of 10 one way, 4 of 20 the other
    assert found[frozenset("ac")] == 0
    assert found[frozenset("ad")] == 0
    assert len(found) == 6
    assert true_overlaps("ab", centres.__getitem__, radius_m=0.06) == {frozenset("ab"): 0}


def test_only_opaque_and_not_huge_gaussians_count_in_metres():
    scene = Gaussians.concatenate([points(np.arange(4.0)), points([9.0], opacity=0.2), points([8.0], size_m=0.05)])
    assert len(solid_centres(scene, Sim3.identity())) == 5
    S = Sim3(exp_so3([0, 0, np.pi / 2]), [1.0, 2, 3], 0.1)  # a unit of ten metres: 0.05 of it is half a metre
    centres = solid_centres(scene, S)
    assert len(centres) == 4
    np.testing.assert_allclose(S.apply(centres), scene.means[:4], atol=1e-6)


def test_real_captures_of_a_house_overlap_as_they_are_known_to(shared_data):
    house = shared_data / "house"

    def centres(name):
        truth = json.loads((house / "truth" / f"{name}.json").read_text())["T_scene_world"]
        return solid_centres(read_captures(house / f"{name}.ply")[0].gaussians, Sim3.from_matrix(np.array(truth)))

    found = true_overlaps(["c0", "c3", "c5"], centres)
    assert found[frozenset(("c0", "c3"))] == pytest.approx(0.55, abs=0.01)
    assert found[frozenset(("c3", "c5"))] == pytest.approx(0.25, abs=0.01)
    assert found[frozenset(("c0", "c5"))] == pytest.approx(0, abs=0.005)
