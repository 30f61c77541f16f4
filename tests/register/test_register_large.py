"""Places seen from farther than rooms are: the lengths of registration follow, whether or not a metre is known."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from register_worlds import layer, splat_world

from gsmap.geometry.transforms import transform_cameras, transform_gaussians
from gsmap.register import SceneView, register_pair
from gsmap.register.metric_scene import MetricPair, MetricScene
from gsmap.register.params import Params
from gsmap.register.proposers.graph import comparable_layers
from gsmap.types import SceneGraph, Sim3
from gsmap.types.registration import Proposal


def larger(view: SceneView, factor: float, policy: str) -> SceneView:
    """A scene of a world enlarged, with its landmarks described at that size."""
    S = Sim3(np.eye(3), np.zeros(3), factor)
    found = view.graph.layers["landmarks"]
    nodes = replace(found, positions=factor * found.positions, extents=factor * found.extents, unit_m=1 / factor)
    graph = SceneGraph(view.id, {"landmarks@2": nodes}, view.graph.up, 1.0, working_m=1 / factor)
    graph = replace(graph, layers={"landmarks": replace(nodes, unit_m=1.0), **graph.layers})
    return SceneView(view.id, transform_gaussians(view.gaussians, S), transform_cameras(view.cameras, S), graph, policy)


@pytest.mark.parametrize("policy", ["known", "auto"])
def test_a_place_four_times_as_large_registers_as_the_room_does(policy):
    world = splat_world(3, policy="known")
    room = register_pair(world.target, world.source)
    found = register_pair(larger(world.target, 4.0, policy), larger(world.source, 4.0, policy))
    assert room.status == found.status == "accepted"
    np.testing.assert_allclose(found.S_target_source.rotation, room.S_target_source.rotation, atol=1e-6)
    np.testing.assert_allclose(found.S_target_source.translation, 4 * room.S_target_source.translation, atol=1e-5)
    assert found.overlap == pytest.approx(room.overlap, abs=1e-3)
    assert found.num_inliers == room.num_inliers
    # Translations are four times as uncertain, in metres.
    ratio = np.linalg.inv(found.information)[3:6, 3:6] / np.linalg.inv(room.information)[3:6, 3:6]
    np.testing.assert_allclose(ratio, 16.0, rtol=0.05)


def test_a_pair_is_worked_on_between_both_of_its_scenes():
    world = splat_world(0, points=1000, policy="known")
    views = [replace(v, graph=replace(v.graph, working_m=w)) for v, w in ((world.target, 0.5), (world.source, 0.125))]
    rigid = Proposal("test", world.S_target_source, with_scale=False, num_inliers=5)
    pair = MetricPair.of(*views, rigid, Params())
    assert pair.target.unit_m == pair.source.unit_m == pytest.approx(0.25)
    again = pair.to_scene_units(pair.to_metres(world.S_target_source))
    np.testing.assert_allclose(again.matrix(), world.S_target_source.matrix())


def test_layers_of_one_size_are_compared_and_those_near_the_pairs_own_alone():
    rng = np.random.default_rng(0)

    def graph(name: str, octaves: list[int], working_m: float) -> SceneGraph:
        layers = {f"landmarks@{k}": replace(layer(rng, 5), unit_m=2.0**-k) for k in octaves}
        layers["landmarks"] = layer(rng, 5)
        return SceneGraph(name, layers, working_m=working_m)

    def sizes(a: SceneGraph, b: SceneGraph) -> list[float]:
        pairs = comparable_layers(a, b, "landmarks", with_scale=False)
        assert all(one.unit_m == two.unit_m for one, two in pairs)
        return sorted(one.unit_m for one, _ in pairs)

    far, farther = graph("a", [1, 2], 0.3), graph("b", [2, 3], 0.2)
    assert sizes(far, farther) == [0.25]
    assert sizes(far, far) == [0.25, 0.5]
    assert sizes(far, graph("room", [], 1.0)) == [1.0]


def test_poses_of_any_scale_are_converted_to_working_metres() -> None:
    view: Any = None
    pair = MetricPair(MetricScene(view, 2.0), MetricScene(view, 3.0), 1.5)
    S, points = Sim3(np.eye(3), np.array([1.0, 2, 3]), 1.2), np.array([[4.0, -5, 6]])
    np.testing.assert_allclose(pair.to_metres(S).apply(3 * points), 2 * S.apply(points))
