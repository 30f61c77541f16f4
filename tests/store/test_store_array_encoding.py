"""Arrays in the narrowest type that holds them, and graphs made of such: nothing is lost, whatever is in them."""

from dataclasses import fields

import numpy as np
import pytest
from raising import raises

from gsmap.describe.precision import round_graph
from gsmap.errors import CorruptError
from gsmap.store.array_encoding import decode_array, encode_array, encoded_shape
from gsmap.store.graph_content import from_arrays, shapes_of, to_arrays
from gsmap.types import NodeLayer, SceneGraph, Segments

RNG = np.random.default_rng(0)


@pytest.mark.parametrize(
    ("values", "kept"),
    [
        (np.array([[0.5, -1.25], [3.0, 0.0]]), "i1"),
        (np.array([0.0, 200.0]), "u1"),
        (np.array([1e-3, 2.5e-3]), "f8"),
        (RNG.integers(-4000, 4000, (50, 3)) * 2.0**-10, "i2"),
        (RNG.integers(-(1 << 30), 1 << 30, 50) * 2.0**-20, "i4"),
        ((RNG.normal(size=50) * 10.0 ** RNG.uniform(-6, 6, 50)).astype(np.float32).astype(np.float64), "f4"),
        (RNG.normal(size=50).astype(np.float16).astype(np.float32), "f2"),
        (RNG.normal(size=(50, 2, 3)), "f8"),
        (np.array([0.0, -0.0, 1.0], np.float32), "f2"),
        (np.array([2.0**-1060, 1.0]), "f8"),
        (np.array([1e300, 1.0]), "f8"),
        (np.zeros((0, 3)), "u1"),
        (np.zeros((4, 0), np.float32), "u1"),
        (np.arange(-1, 300, dtype=np.int32), "i2"),
        (np.array([1 << 40, 1], np.int64), "i8"),
        (np.array([7], np.uint8), "u1"),
    ],
)
@pytest.mark.guards("data")
def test_every_value_comes_back_to_the_bit(values, kept):
    stored, how = encode_array(values)
    assert how["as"] == kept
    assert stored.nbytes == values.size * np.dtype(kept).itemsize
    assert stored.shape == encoded_shape(how)
    back = decode_array(stored, how)
    assert (back.dtype, back.shape, back.tobytes()) == (values.dtype, values.shape, values.tobytes())


def test_what_is_stored_in_another_type_is_refused():
    stored, how = encode_array(np.array([1.0, 2.0]))
    with pytest.raises(ValueError):
        decode_array(stored.astype(np.float64), how)


@pytest.mark.parametrize(
    "bad",
    [
        {"is": "O"}, {"as": "f16"}, {"as": 1}, {"step": 0.0}, {"step": float("nan")}, {"step": "1"},
        {"shape": [-1]}, {"shape": [True]}, {"shape": []}, {"shape": [1 << 41]}, {"shape": 3}, {"shape": [1] * 9},
    ],
)  # fmt: skip
def test_what_no_array_is_kept_as_is_refused(bad):
    with raises(CorruptError, code="catalog_invalid", match="array encoding"):
        encoded_shape({"is": "f8", "as": "i2", "step": 0.5, "shape": [4, 3]} | bad)


def layer(m, width, features, *, exact=True):
    positions = RNG.normal(size=(m, 3))
    half = np.full((m, 1, 3), 0.125)
    extents = np.concatenate([positions[:, None] - half, positions[:, None] + half], axis=1)
    embeddings = RNG.normal(size=(m, width))
    own = embeddings if width == features else RNG.normal(size=(m, features))
    return NodeLayer(
        positions, embeddings, RNG.integers(0, 9, m), RNG.uniform(size=m), extents, own, np.zeros(m), "d", 0.7
    )


def things(n=200):
    members = RNG.integers(-1, 2, n)
    return Segments(
        members, RNG.normal(size=(2, 3)), RNG.normal(size=(2, 2, 3)), RNG.normal(size=(2, 3)),
        RNG.normal(size=(9, 3)), RNG.normal(size=(9, 3)), np.array([4, 5]), 1.5,
    )  # fmt: skip


def graph():
    layers = {"landmarks": layer(30, 12, 2), "landmarks:0": layer(20, 12, 2), "none": NodeLayer.empty("d", 12)}
    layers |= {"landmarks_gravity_free": layer(30, 5, 2), "objects": layer(7, 6, 6)}
    return SceneGraph("0" * 32, layers, np.array([0, 0, 1.0]), 0.5, ("few",), things(), 0.5)


def bits(graph):
    for part in (*graph.layers.values(), graph.segments):
        for field in fields(part):
            value = getattr(part, field.name)
            yield (value.tobytes(), value.shape, value.dtype) if isinstance(value, np.ndarray) else value


@pytest.mark.parametrize("round_it", [False, True])
@pytest.mark.guards("data")
def test_a_graph_comes_back_to_the_bit(round_it):
    made = round_graph(graph()) if round_it else graph()
    arrays, about = to_arrays(made)
    assert {name: array.shape for name, array in arrays.items()} == shapes_of(about)
    back = from_arrays(made.scene_id, about, arrays)
    assert list(back.layers) == list(made.layers)
    assert list(bits(back)) == list(bits(made))
    assert (back.unit_m, back.working_m, back.notes) == (made.unit_m, made.working_m, made.notes)
    assert len(arrays) < 20


def test_a_rounded_graph_takes_a_fraction_of_the_bytes():
    whole, less = (sum(array.nbytes for array in to_arrays(g)[0].values()) for g in (graph(), round_graph(graph())))
    assert less < 0.4 * whole


def test_a_graph_that_does_not_fit_its_row_is_refused():
    arrays, about = to_arrays(graph())
    del arrays["nodes.positions"]
    with raises(CorruptError, code="catalog_invalid", match="does not match its row .*nodes.positions"):
        from_arrays("0" * 32, about, arrays)
    arrays, about = to_arrays(graph())
    about["layers"]["objects"]["count"] = 8
    with raises(CorruptError, code="catalog_invalid", match="does not match its row"):
        from_arrays("0" * 32, about, arrays)
