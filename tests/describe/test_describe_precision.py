"""How finely a graph is told: near what was found, and the same whatever unit a capture is in."""

import numpy as np
import pytest

from gsmap.describe.precision import round_graph
from gsmap.types import NodeLayer, SceneGraph, Segments

RNG = np.random.default_rng(3)


def graph(unit: float = 1.0) -> SceneGraph:
    """A place in units of ``1 / unit`` metres."""
    rng = np.random.default_rng(3)
    positions = rng.uniform(-5, 5, (60, 3)) * unit
    half = rng.uniform(0.05, 0.3, (60, 1, 1)) * unit * np.ones((1, 1, 3))
    extents = np.concatenate([positions[:, None] - half, positions[:, None] + half], axis=1)
    embeddings = rng.normal(size=(60, 112))
    embeddings[:, :20] = 0
    embeddings /= np.linalg.norm(embeddings, axis=1, keepdims=True)
    weights = rng.uniform(1, 30, 60)
    features = np.stack([weights, rng.uniform(1e-6, 1e6, 60)], 1)
    layer = NodeLayer(positions, embeddings, np.zeros(60), weights, extents, features, np.zeros(60), "d")
    samples = rng.uniform(-5, 5, (9, 3)) * unit
    lab = rng.uniform(-60, 90, (9, 3))
    things = Segments(np.zeros(4), samples[:1], np.stack([samples[:2]]), lab[:1], samples, lab, np.array([9]), 1 / unit)
    return SceneGraph("a", {"landmarks": layer}, None, 1.0, (), things, 1 / unit)


@pytest.mark.parametrize("unit", [1.0, 0.01, 3.7])
def test_numbers_stay_near_what_was_found(unit: float) -> None:
    found, told = graph(unit), round_graph(graph(unit))
    a, b = found.layers["landmarks"], told.layers["landmarks"]
    half_step = 0.5 * 0.001 * unit * np.sqrt(2)  # the step is a power of two near a millimetre
    for before, after in ((a.positions, b.positions), (found.segments.samples, told.segments.samples)):
        assert 0 < np.abs(before - after).max() <= half_step
    assert np.abs(a.extents - b.extents).max() <= 2 * half_step
    assert np.abs(a.embeddings - b.embeddings).max() <= 0.5 / 256
    assert (b.embeddings[:, :20] == 0).all()
    assert np.abs(np.linalg.norm(b.embeddings, axis=1) - 1).max() < 0.01
    assert np.allclose(a.features, b.features, rtol=2.0**-11)
    assert np.allclose(a.weights, b.weights, rtol=2.0**-11)
    assert np.abs(found.segments.sample_colours - told.segments.sample_colours).max() <= 0.25


def test_a_landmark_reaches_as_far_to_all_sides() -> None:
    layer = round_graph(graph()).layers["landmarks"]
    around = layer.extents - layer.positions[:, None]
    assert (around[:, 1] == -around[:, 0]).all()
    assert np.ptp(around[:, 1], axis=1).max() == 0


def test_rounding_again_changes_nothing() -> None:
    once = round_graph(graph())
    again = round_graph(once)
    for name in ("positions", "embeddings", "weights", "extents", "features"):
        assert np.array_equal(getattr(once.layers["landmarks"], name), getattr(again.layers["landmarks"], name))


def test_every_component_fits_a_byte() -> None:
    layer = NodeLayer(np.zeros((1, 3)), [[0.7, -0.7, 0.1]], [0], [1], np.zeros((1, 2, 3)), np.ones((1, 2)), [0], "d")
    (one,) = round_graph(SceneGraph("a", {"landmarks": layer})).layers.values()
    assert one.embeddings.tolist() == [[127 / 256, -0.5, 26 / 256]]


def test_an_object_is_still_told_by_its_feature() -> None:
    feature = RNG.normal(size=(5, 512)).astype(np.float32)
    layer = NodeLayer(np.zeros((5, 3)), feature, [0] * 5, [1] * 5, np.zeros((5, 2, 3)), feature, [1] * 5, "d")
    (told,) = round_graph(SceneGraph("a", {"objects": layer})).layers.values()
    assert np.array_equal(told.embeddings, told.features)
    assert np.allclose(told.features, feature, rtol=2.0**-11)
