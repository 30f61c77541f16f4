"""One capture twice is called so; two captures of one place are not."""

from dataclasses import replace

import numpy as np
import pytest
from register_worlds import splat_world

from gsmap.geometry.rotations import exp_so3
from gsmap.geometry.transforms import transform_cameras, transform_gaussians
from gsmap.register import register_pair
from gsmap.register.duplicate import SAME_CAPTURE, find_duplicate
from gsmap.types import Sim3

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
