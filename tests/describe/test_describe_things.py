"""Things: which Gaussians are one piece of furniture, and which are the building."""

import numpy as np
import pytest
from made_room import SHELL, furnished
from scipy.spatial.transform import Rotation

from gsmap.describe import Params, describe, recipe_key
from gsmap.describe.cloud import surface_cloud
from gsmap.describe.objects.segments import find_segments
from gsmap.errors import InputError
from gsmap.geometry.rotations import matrices_to_quats
from gsmap.types import Gaussians, SceneGraph, Segments, Sim3

UP = np.array([0.0, 0.0, 1.0])


def ious(members: np.ndarray, owners: np.ndarray) -> list[float]:
    """Of each piece with the thing that covers it best."""
    out = []
    for owner in range(owners.max() + 1):
        mine = owners == owner
        best = max(
            np.mean((members == t)[mine | (members == t)] & mine[mine | (members == t)]) for t in {*members[mine]}
        )
        out.append(float(best))
    return out


@pytest.fixture(scope="module")
def place() -> tuple[Gaussians, np.ndarray]:
    return furnished()


def test_each_piece_is_one_thing_and_the_building_is_none(place):
    gaussians, owners = place
    found = find_segments(gaussians, surface_cloud(gaussians), UP, 1.0)
    assert min(ious(found.members, owners)) > 0.75
    assert len(found) == 4
    assert (found.members[owners == SHELL] >= 0).mean() < 0.01
    # The largest comes first, and what is said of things is true of their members.
    assert (np.diff(np.bincount(found.members[found.members >= 0])) <= 0).all()
    for i in range(len(found)):
        mine = gaussians.means[found.members == i]
        np.testing.assert_allclose(found.positions[i], mine.mean(0), atol=1e-4)
        np.testing.assert_allclose(found.extents[i], [mine.min(0), mine.max(0)], atol=1e-6)


def test_things_do_not_depend_on_frame_or_unit(place):
    gaussians, owners = place
    S = Sim3(Rotation.from_rotvec([0.4, -1.1, 2.0]).as_matrix(), np.array([20.0, -7, 3]), 2.5)
    quats = matrices_to_quats(S.rotation @ Rotation.from_quat(gaussians.quats[:, [1, 2, 3, 0]]).as_matrix())
    there = Gaussians(
        S.apply(gaussians.means), quats, gaussians.log_scales + np.log(2.5), gaussians.logit_opacities, gaussians.sh
    )
    found = find_segments(there, surface_cloud(there), S.rotation @ UP, 1 / 2.5)
    assert min(ious(found.members, owners)) > 0.75
    assert (found.members[owners == SHELL] >= 0).mean() < 0.01


def test_faint_gaussians_belong_to_the_thing_they_lie_on(place):
    gaussians, owners = place
    faint = gaussians.logit_opacities.copy()
    rows = np.flatnonzero(owners == 0)[::3]
    faint[rows] = -4.0
    dimmed = Gaussians(gaussians.means, gaussians.quats, gaussians.log_scales, faint, gaussians.sh)
    found = find_segments(dimmed, surface_cloud(dimmed), UP, 1.0)
    cupboard = found.members[np.setdiff1d(np.flatnonzero(owners == 0), rows)]
    assert (found.members[rows] == np.bincount(cupboard[cupboard >= 0]).argmax()).mean() > 0.8


def test_nothing_is_told_apart_where_up_is_unknown_or_nothing_is_there(place):
    gaussians, _ = place
    assert (find_segments(gaussians, surface_cloud(gaussians), None, 1.0).members == -1).all()
    assert len(find_segments(gaussians, surface_cloud(gaussians), UP, 1e4)) == 0
    none = gaussians[:3]
    found = find_segments(none, surface_cloud(none), UP, 1.0)
    assert len(found) == 0
    assert found.members.shape == (3,)


def test_graphs_name_the_thing_of_every_gaussian(place):
    gaussians, owners = place
    params = Params(landmarks=False, objects=False)
    graph = describe("a", gaussians, None, params)
    assert graph.segments is not None
    assert graph.layers == {}
    assert graph.segments.members.shape == (len(gaussians),)
    if graph.up is not None:
        assert min(ious(graph.segments.members, owners)) > 0.75
    without = describe("a", gaussians, None, Params(landmarks=False, objects=False, things=False))
    assert without.segments is None


def test_the_key_of_a_graph_without_things_is_that_of_older_releases():
    """Graphs that were made before are found again by those who switch things off."""
    off = recipe_key(Params(things=False))
    assert "things" not in off.version
    assert "thing" not in off.settings
    assert off.settings["layers"] == ["landmarks", "objects"]
    assert recipe_key(Params()).recipe != off.recipe


@pytest.mark.parametrize(
    "change",
    [
        {"members": np.array([0, 2])},
        {"members": np.array([-2, 0])},
        {"extents": np.zeros((2, 3))},
        {"positions": np.full((1, 3), np.nan)},
        {"unit_m": 0.0},
        {"sample_counts": np.array([2])},
        {"samples": np.zeros((2, 3))},
    ],
)
def test_things_that_do_not_fit_together_are_refused(change):
    good = {
        "members": np.array([0, -1]),
        "positions": np.zeros((1, 3)),
        "extents": np.zeros((1, 2, 3)),
        "colours": np.zeros((1, 3)),
        "samples": np.zeros((1, 3)),
        "sample_colours": np.zeros((1, 3)),
        "sample_counts": np.array([1]),
    }
    assert len(Segments(**good)) == 1
    assert SceneGraph("a", segments=Segments(**good)).num_nodes == 0  # they are no nodes: nothing is registered by them
    with pytest.raises(InputError):
        Segments(**good | change)
