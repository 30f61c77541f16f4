"""Things: which Gaussians are one piece of furniture, and which are the building."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gsmap.describe import Params, describe, recipe_key
from gsmap.describe.cloud import surface_cloud
from gsmap.describe.gravity import Params as GravityParams
from gsmap.describe.objects.things import find_things
from gsmap.errors import InputError
from gsmap.geometry.rotations import matrices_to_quats
from gsmap.geometry.sh import sh0_of_rgb
from gsmap.types import Gaussians, SceneGraph, Sim3, Things

UP = np.array([0.0, 0.0, 1.0])
SPACING_M = 0.05
SHELL = -1


class Room:
    """A 4 x 3 x 2.5 m room of flat Gaussians in which every Gaussian knows whose it is."""

    def __init__(self, seed: int = 0) -> None:
        self.rng = np.random.default_rng(seed)
        self.points: list[np.ndarray] = []
        self.normals: list[np.ndarray] = []
        self.colours: list[np.ndarray] = []
        self.owners: list[np.ndarray] = []
        for axis, end in enumerate((4.0, 3.0, 2.5)):
            for at in (0.0, end):
                low, high = np.zeros(3), np.array([4.0, 3.0, 2.5])
                low[axis] = high[axis] = at
                self.rectangle(low, high, (0.8, 0.8, 0.75), SHELL)

    def rectangle(self, low, high, colour, owner) -> None:
        """Gaussians on an axis-parallel rectangle, 2 mm off it."""
        low, high = np.array(low, float), np.array(high, float)
        axis = int(np.argmin(high - low))
        count = int(np.prod(np.delete(high - low, axis)) / SPACING_M**2) + 1
        points = self.rng.uniform(low, high, (count, 3))
        points[:, axis] += self.rng.normal(0, 0.002, count)
        self.points.append(points)
        self.normals.append(np.tile(np.eye(3)[axis], (count, 1)))
        self.colours.append(np.clip(np.array(colour) + self.rng.normal(0, 0.01, (count, 3)), 0, 1))
        self.owners.append(np.full(count, owner))

    def box(self, low, high, colour, owner) -> None:
        """The faces of a box that can be seen: not its bottom, nor its back where it stands against a wall."""
        low, high = np.array(low, float), np.array(high, float)
        for axis in range(3):
            for at in (low[axis], high[axis]) if axis < 2 else (high[axis],):
                a, b = low.copy(), high.copy()
                a[axis] = b[axis] = at
                if at > 0.04:
                    self.rectangle(a, b, colour, owner)

    def made(self) -> tuple[Gaussians, np.ndarray]:
        points, normals = np.concatenate(self.points), np.concatenate(self.normals)
        frames = np.stack([np.roll(normals, 1, axis=1), np.roll(normals, 2, axis=1), normals], axis=2)
        scales = np.tile(np.log([0.6 * SPACING_M, 0.6 * SPACING_M, 0.005]), (len(points), 1))
        sh = sh0_of_rgb(np.concatenate(self.colours))[:, None]
        quats = matrices_to_quats(frames)
        return Gaussians(points, quats, scales, np.full(len(points), 3.0), sh), np.concatenate(self.owners)


def furnished() -> tuple[Gaussians, np.ndarray]:
    """A cupboard and a table by the walls, a box on the table, a picture, and a lamp whose pole is too thin to see."""
    room = Room()
    room.box([0.03, 0.5, 0.0], [0.5, 1.5, 1.8], (0.5, 0.3, 0.2), 0)
    room.box([2.0, 0.03, 0.0], [3.2, 0.7, 0.75], (0.3, 0.4, 0.6), 1)
    room.box([2.4, 0.2, 0.75], [2.7, 0.5, 1.0], (0.7, 0.2, 0.2), 1)
    room.rectangle([1.0, 2.955, 1.2], [1.7, 2.955, 1.7], (0.2, 0.5, 0.3), 2)
    room.box([3.3, 2.3, 0.0], [3.7, 2.7, 0.2], (0.1, 0.1, 0.1), 3)
    room.box([3.3, 2.3, 1.3], [3.7, 2.7, 1.6], (0.9, 0.9, 0.6), 3)
    return room.made()


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
    found = find_things(gaussians, surface_cloud(gaussians), UP, 1.0)
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
    found = find_things(there, surface_cloud(there), S.rotation @ UP, 1 / 2.5)
    assert min(ious(found.members, owners)) > 0.75
    assert (found.members[owners == SHELL] >= 0).mean() < 0.01


def test_faint_gaussians_belong_to_the_thing_they_lie_on(place):
    gaussians, owners = place
    faint = gaussians.logit_opacities.copy()
    rows = np.flatnonzero(owners == 0)[::3]
    faint[rows] = -4.0
    dimmed = Gaussians(gaussians.means, gaussians.quats, gaussians.log_scales, faint, gaussians.sh)
    found = find_things(dimmed, surface_cloud(dimmed), UP, 1.0)
    cupboard = found.members[np.setdiff1d(np.flatnonzero(owners == 0), rows)]
    assert (found.members[rows] == np.bincount(cupboard[cupboard >= 0]).argmax()).mean() > 0.8


def test_nothing_is_told_apart_where_up_is_unknown_or_nothing_is_there(place):
    gaussians, _ = place
    assert (find_things(gaussians, surface_cloud(gaussians), None, 1.0).members == -1).all()
    assert len(find_things(gaussians, surface_cloud(gaussians), UP, 1e4)) == 0
    none = gaussians[:3]
    found = find_things(none, surface_cloud(none), UP, 1.0)
    assert len(found) == 0
    assert found.members.shape == (3,)


def test_graphs_name_the_thing_of_every_gaussian(place):
    gaussians, owners = place
    params = Params(landmarks=False, objects=False, gravity=GravityParams(max_normals=500))
    graph = describe("a", gaussians, None, params)
    assert graph.things is not None
    assert graph.layers == {}
    assert graph.things.members.shape == (len(gaussians),)
    if graph.up is not None:
        assert min(ious(graph.things.members, owners)) > 0.75
    without = describe("a", gaussians, None, Params(landmarks=False, objects=False, things=False))
    assert without.things is None


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
    assert len(Things(**good)) == 1
    assert SceneGraph("a", things=Things(**good)).num_nodes == 0  # they are no nodes: nothing is registered by them
    with pytest.raises(InputError):
        Things(**good | change)
