"""The picture of a graph shows its nodes where the camera sees them."""

import numpy as np
from raising import raises

from gsmap.errors import InputError
from gsmap.types import Cameras, Gaussians, NodeLayer, SceneGraph
from gsmap.view.graph_picture import draw_graph


def wall() -> tuple[Gaussians, Cameras]:
    """Grey Gaussians in the plane z = 3, and three cameras side by side that look at it."""
    x, y = np.meshgrid(np.linspace(-2.5, 2.5, 80), np.linspace(-1.5, 1.5, 50))
    means = np.stack([x.ravel(), y.ravel(), np.full(x.size, 3.0)], 1)
    n = len(means)
    gaussians = Gaussians(
        means, np.tile([1.0, 0, 0, 0], (n, 1)), np.full((n, 3), np.log(0.05)), np.full(n, 4.0), np.zeros((n, 1, 3))
    )
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = [-0.5, 0, 0.5]
    return gaussians, Cameras(poses, np.tile([200.0, 200, 160, 120], (3, 1)), np.tile([320, 240], (3, 1)), "abc")


def layer(positions: list[list[float]]) -> NodeLayer:
    m = len(positions)
    return NodeLayer(
        np.array(positions, float).reshape(-1, 3),
        *(np.ones((m, 1)), np.zeros(m), np.ones(m), np.zeros((m, 2, 3)), np.ones((m, 1)), np.ones(m), "test"),
    )


def test_a_picture_of_the_graph_shows_it():
    gaussians, cameras = wall()
    cameras = cameras[1]
    graph = SceneGraph("w", {"objects": layer([[0.6, 0, 3], [-0.6, 0, 3]]), "landmarks": layer([[0, 0.9, 3]])})
    empty = draw_graph(gaussians, cameras, SceneGraph("w"), width_px=320)
    drawn = (draw_graph(gaussians, cameras, graph, width_px=320) != empty).any(2)
    assert drawn.shape == (240, 320)
    assert drawn.dtype == bool
    for column, row in ((200, 120), (120, 120), (160, 180)):
        assert drawn[row - 2 : row + 3, column - 2 : column + 3].any()
    assert drawn[120, 130:190].mean() > 0.9  # the edge between the two objects
    assert drawn.mean() < 0.05
    assert draw_graph(gaussians, cameras, graph).shape == (720, 960, 3)


def test_what_is_hidden_is_a_ring_and_landmarks_behind_the_wall_are_not_drawn():
    gaussians, cameras = wall()
    cameras = cameras[1]
    graph = SceneGraph("w", {"objects": layer([[0, 0, 6]]), "landmarks": layer([[1.0, 1.0, 6]])})
    empty = draw_graph(gaussians, cameras, SceneGraph("w"), width_px=320)
    drawn = (draw_graph(gaussians, cameras, graph, width_px=320) != empty).any(2)
    assert drawn[114:127, 154:167].any()
    assert not drawn[118:123, 158:163].any()
    drawn[110:131, 150:171] = False
    assert not drawn.any()


def test_a_scene_without_cameras_is_refused():
    gaussians, cameras = wall()
    with raises(InputError, code="nothing_to_draw"):
        draw_graph(gaussians, cameras[[]], SceneGraph("w"))
