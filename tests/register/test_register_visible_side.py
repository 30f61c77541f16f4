"""Which side of a wall was seen, on a wall that two captures know from one side each."""

import numpy as np
import pytest
from register_worlds import texture

from gsmap import _native
from gsmap.evaluate.registration import pose_error
from gsmap.geometry.rotations import exp_so3
from gsmap.geometry.transforms import transform_cameras, transform_gaussians
from gsmap.register import SceneView
from gsmap.register.covariance import condition
from gsmap.register.refiners import colored_icp
from gsmap.register.surface import Surface
from gsmap.register.visible_side import _fill_unknown
from gsmap.types import Cameras, Gaussians, SceneGraph, Sim3

THICK = 0.08
STEP = 0.03


def _sheet(rng, low, high, across: int, at: float) -> np.ndarray:
    """Points of a rectangle across one axis; ``low`` and ``high`` are its corners along the other two."""
    sides = [np.arange(a, b, STEP) for a, b in zip(low, high, strict=True)]
    u, v = (x.ravel() for x in np.meshgrid(*sides))
    plane = np.c_[u, v] + rng.uniform(-0.3, 0.3, (len(u), 2)) * STEP
    return np.insert(plane, across, at + rng.normal(size=len(u)) * 0.002, axis=1)


def _looking(centre, at) -> np.ndarray:
    """A camera's pose, z up in the world."""
    forward = np.subtract(at, centre) / np.linalg.norm(np.subtract(at, centre))
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = centre
    return pose


def capture(side: float, seed: int, S: Sim3 | None = None) -> SceneView:
    """One of two rooms whose wall (x = 0) has a doorway (y > .5), filmed from within; ``side`` is its sign of x.

    Floor and far wall go on behind the doorway; of the wall the front is known, in the captures' common frame.
    """
    rng = np.random.default_rng(seed)
    x = sorted((3.0 * side, -1.0 * side))
    floor = _sheet(rng, (x[0], -2.0), (x[1], 2.0), 2, 0.0)
    floor = floor[(floor[:, 0] * side > 0) | (floor[:, 1] > 0.5)]
    far = _sheet(rng, (x[0], 0.0), (x[1], 2.5), 1, 2.0)
    wall = _sheet(rng, (-2.0, 0.0), (0.5, 2.5), 0, side * THICK / 2)
    boards = [_sheet(rng, (1.4, 0.0), (2.0, 1.2), 0, at) for at in (-0.9, 0.9)]  # both captures see their inner sides
    points = np.concatenate([floor, far, wall, *boards])
    n = len(points)
    gaussians = Gaussians(
        points,
        np.tile([1.0, 0, 0, 0], (n, 1)),
        np.full((n, 3), np.log(0.02)),
        np.full(n, 3.0),
        ((texture(points, 5) - 0.5) / 0.28209479177387814)[:, None],
    )
    centres = [(2.0 * side, y, 1.3) for y in (-1.0, 0.0, 1.0)]
    targets = [(0, -1.0, 1.0), (0, 0.0, 0.6), (1.0 * side, -0.5, 0.0), (1.5 * side, 2.0, 0.5)]
    poses = [_looking(c, t) for c in centres for t in targets]
    poses += [_looking((0.2 * side, 1.0, 1.3), (x, 1.6, z)) for x in (-0.9, 0.9) for z in (0.4, 1.0)]
    poses = np.stack(poses)
    cameras = Cameras(poses, np.tile([120.0, 120, 80, 60], (len(poses), 1)), np.tile([160, 120], (len(poses), 1)))
    S = S or Sim3.identity()
    return SceneView(
        f"room{side:+g}", transform_gaussians(gaussians, S), transform_cameras(cameras, S), SceneGraph("room")
    )


@pytest.mark.parametrize("unit_m", [1.0, 0.25])
def test_cells_face_the_cameras_that_saw_them(unit_m):
    S = Sim3(exp_so3([0.4, -1.0, 2.0]), [3.0, -20.0, 7.0], 1 / unit_m)
    surface = capture(1.0, 0, S).surface(unit_m)
    back = S.inverse()
    points, faces = back.apply(surface.coarse[0] / unit_m), surface.oriented_normals @ S.rotation
    wall = (np.abs(points[:, 0] - THICK / 2) < 0.02) & (points[:, 1] < 0.3) & (points[:, 2] > 0.1)
    floor = (points[:, 2] < 0.02) & (points[:, 1] < 0.5) & (np.abs(points[:, 0] - 0.8) < 0.3)
    assert min(wall.sum(), floor.sum()) > 500
    for cells, inward in ((wall, [1.0, 0, 0]), (floor, [0, 0, 1.0])):
        along = faces[cells] @ inward
        assert (along > 0.9).mean() > 0.9
        assert not (along < -0.5).any()


def test_what_no_camera_of_the_capture_saw_faces_nowhere():
    room = capture(1.0, 0)
    alone = SceneView("alone", room.gaussians, None, room.graph)
    assert alone.surface().oriented_normals is None
    # Cameras that look away from the wall leave it unknown, but for what lies level with what they see.
    away = np.flatnonzero(room.cameras.T_frame_camera[:, 0, 2] > 0)
    seen = SceneView("away", room.gaussians, room.cameras[away], room.graph).surface()
    wall = (np.abs(seen.coarse[0][:, 0] - THICK / 2) < 0.02) & (seen.coarse[0][:, 1] < -0.5)
    assert not np.any(seen.oriented_normals[wall])
    assert np.any(seen.oriented_normals)


def test_cells_of_unknown_side_take_that_of_their_own_sheet():
    """Two sheets 6 cm apart, seen from above and from below; of the upper one only every third row was seen."""
    x, y = (0.05 * one.ravel() for one in np.meshgrid(np.arange(12), np.arange(13)))
    points = np.concatenate([np.c_[x, y, np.full(156, 0.06)], np.c_[x, y, np.zeros(156)]])
    normals = np.tile([0, 0, 1.0], (312, 1))
    normals[::2] *= -1
    faces = np.repeat([1.0, -1.0], 156)
    seen = (np.round(y / 0.05).astype(int) % 3 == 0)[np.r_[0:156, 0:156]] | (faces < 0)
    tree = _native.PointTree(points)
    found = _fill_unknown(np.where(seen, faces * normals[:, 2], 0.0), points, normals, tree)
    assert np.array_equal(found * normals[:, 2], faces)


def test_a_wall_s_back_is_not_laid_on_its_front():
    S = Sim3(exp_so3([0.3, 0.5, -2.0]), [4.0, 1.0, -2.0])
    target, source = capture(-1.0, 0), capture(1.0, 1, S.inverse())
    surfaces = {
        "blind": [Surface.of(view.gaussians) for view in (target, source)],
        "facing": [target.surface(), source.surface()],
    }
    centre = S.inverse().apply(np.array([[0.0, 1.0, 0.8]]))[0]
    # The start is off as a coarse pose is, towards one wall on the other.
    start = Sim3(np.eye(3), [-0.05, 0.01, 0.0]) @ S
    off = {}
    for name, pair in surfaces.items():
        found = colored_icp.refine(*pair, start)
        off[name] = pose_error(found, S, centre).centroid_m
        if name == "blind":
            wrong = found
    assert off["blind"] > 0.04
    assert off["facing"] < 0.01
    # Laid on each other, the two sides seem to hold the pose across them; who tells them apart knows it less well.
    across = S.rotation.T @ [1.0, 0, 0]
    sigmas = [np.sqrt(across @ condition(*pair, wrong).rigid[3:6, 3:6] @ across) for pair in surfaces.values()]
    assert sigmas[1] > 1.5 * sigmas[0]


def test_nearest_cells_are_those_of_brute_force_that_face_the_same_way():
    surface = capture(1.0, 0).surface()
    points, faces = surface.coarse[0], surface.oriented_normals
    rng = np.random.default_rng(2)
    rows = rng.choice(len(points), 400, replace=False)
    asked, own = points[rows] + rng.normal(size=(400, 3)) * 0.03, faces[rows] * rng.choice([-1.0, 0.0, 1.0], (400, 1))
    distance, row = surface.nearest(asked, 0.1, own)
    every = np.linalg.norm(asked[:, None] - points[None], axis=2)
    every[own @ faces.T <= -0.5] = np.inf
    near = every.min(1) < 0.1
    assert 0.2 < near.mean() < 1.0
    assert np.array_equal(np.isfinite(distance), near)
    assert np.array_equal(row[near], every.argmin(1)[near])
