"""One capture twice is called so; two captures of one place are not."""

from dataclasses import replace

import numpy as np
import pytest
from register_worlds import splat_world

from gsmap.geometry.rotations import exp_so3
from gsmap.geometry.transforms import transform_cameras, transform_gaussians
from gsmap.register import SceneView, register_pair
from gsmap.register.duplicate import SAME_CAPTURE, find_duplicate
from gsmap.types import Cameras, Gaussians, Registration, SceneGraph, Sim3

MOVED = Sim3(exp_so3([0.3, -0.2, 1.0]), np.array([3.0, -2.0, 1.0]))


def again(view, gaussians, cameras=None):
    """A scene in another frame, by other Gaussians of it."""
    layers = {name: replace(layer, positions=MOVED.apply(layer.positions)) for name, layer in view.graph.layers.items()}
    graph = replace(view.graph, layers=layers, up=MOVED.rotation @ view.graph.up)
    return replace(
        view,
        id="again",
        gaussians=transform_gaussians(gaussians, MOVED),
        cameras=None if cameras is None else transform_cameras(cameras, MOVED),
        graph=graph,
    )


@pytest.mark.parametrize("kept", [1.0, 0.5, 0.1])
def test_a_scene_and_its_thinned_copy_are_one_capture(kept):
    view = splat_world(0).target
    rng = np.random.default_rng(0)
    copy = view.gaussians[np.sort(rng.choice(len(view.gaussians), int(kept * len(view.gaussians)), replace=False))]
    copy = replace(copy, means=copy.means.astype(np.float16).astype(np.float32))  # as a smaller format keeps them
    found = register_pair(view, again(view, copy, view.cameras))
    assert found.status == "accepted"
    assert any(note.startswith(f"{SAME_CAPTURE} twice") for note in found.notes)


def test_a_scene_trained_again_from_its_pictures_is_one_capture_and_a_second_visit_is_not():
    view = splat_world(0).target
    # Other Gaussians of the same place by its cameras; then by those of another walk.
    trained = splat_world(9).target
    for cameras, said in ((view.cameras, True), (trained.cameras, False)):
        found = register_pair(view, again(view, trained.gaussians, cameras))
        assert found.status == "accepted"
        assert found.overlap > 0.9
        assert any(note.startswith(f"{SAME_CAPTURE} trained twice") for note in found.notes) is said
        assert not any(note.startswith(f"{SAME_CAPTURE} twice") for note in found.notes)


def test_neighbours_and_refused_pairs_are_not_called_one_capture():
    world = splat_world(0)
    found = register_pair(world.target, world.source)
    assert found.notes == ()
    itself = again(world.target, world.target.gaussians, world.target.cameras)
    whole = register_pair(world.target, itself)
    assert find_duplicate(world.target, itself, whole)
    assert not find_duplicate(world.target, itself, replace(whole, status="rejected"))


def cloud(seed: int, cameras: Cameras | None = None) -> SceneView:
    """500 Gaussians in a cubic metre, about 7 cm apart, and some cameras."""
    points = np.random.default_rng(seed).uniform(-0.5, 0.5, (500, 3))
    quats, sh = np.tile([1.0, 0, 0, 0], (500, 1)), np.zeros((500, 1, 3))
    gaussians = Gaussians(points, quats, np.full((500, 3), -4.0), np.full(500, 4.0), sh)
    return SceneView(str(seed), gaussians, cameras, SceneGraph(str(seed)))


def around(count: int, off_m: float = 0.0, turn_deg: float = 0.0) -> Cameras:
    """Cameras 3 m from the origin, each moved and turned by as much in a direction of its own."""
    rng = np.random.default_rng(1)
    away, off, axes = (x / np.linalg.norm(x, axis=1, keepdims=True) for x in rng.normal(size=(3, count, 3)))
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, 3] = 3.0 * away + off_m * off
    poses[:, :3, :3] = np.stack([exp_so3(np.radians(turn_deg) * np.cross(axis, [0, 0, 1])) for axis in axes])
    return Cameras(poses, np.tile([120.0, 120, 80, 60], (count, 1)), np.tile([160, 120], (count, 1)))


def found_at(target: SceneView, source: SceneView, off_m: float = 0.0) -> str:
    S = Sim3(np.eye(3), np.array([off_m, 0.0, 0.0]))
    found = Registration("t", "s", "accepted", S_target_source=S, information=np.eye(7), overlap=0.9)
    return find_duplicate(target, source, found)


@pytest.mark.parametrize(
    ("count", "off_m", "turn_deg", "said"),
    [(8, 0.0, 0.0, True), (8, 0.008, 0.5, True), (8, 0.05, 0.0, False), (8, 0.0, 4.0, False), (4, 0.0, 0.0, False)],
)
def test_cameras_coincide_within_half_a_percent_of_their_distance(count, off_m, turn_deg, said):
    target, source = cloud(0, around(count)), cloud(1, around(count, off_m, turn_deg))
    assert ("trained twice" in found_at(target, source)) is said
    more = cloud(2, Cameras.concatenate([around(count), around(9, 0.5)]))
    assert ("trained twice" in found_at(more, source)) is ("trained twice" in found_at(source, more)) is said


def test_gaussians_coincide_though_the_pose_is_a_third_of_their_spacing_off():
    whole = cloud(0)
    half = replace(whole, id="half", gaussians=whole.gaussians[np.arange(0, 500, 2)])
    for pair in ((whole, half), (half, whole)):
        assert "twice: 100% of the Gaussians" in found_at(*pair, 0.02)
    assert found_at(whole, cloud(1)) == ""
