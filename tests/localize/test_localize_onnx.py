"""An extractor that the user gives as ONNX: the published signatures are read, others are refused."""

from __future__ import annotations

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper
from raising import raises

from gsmap.describe.onnx.check import check_model
from gsmap.errors import InputError
from gsmap.localize.extractors import onnx as extractor

POINTS = np.array([[0, 0], [10, 20], [31, 63]], np.float32)


NAMES = ("keypoints", "descriptors", "scores")


def network(path, channels=3, points=POINTS, batched=True, normalised=False, names=NAMES):
    """Always the same points, described by the colour means of the picture and their number."""
    given = points
    if normalised:
        given = points / (np.array([63, 95]) / 2) - 1  # of a picture of 64 x 96
    descriptors = np.eye(len(points), 8, dtype=np.float32)
    scores = np.linspace(0.2, 0.9, len(points)).astype(np.float32)
    values = dict(zip(names, (given.astype(np.float32), descriptors, scores), strict=True))
    if batched:
        values = {name: value[None] for name, value in values.items()}
    initial = [numpy_helper.from_array(value, f"{name}_c") for name, value in values.items()]
    initial.append(numpy_helper.from_array(np.zeros(1, np.float32), "zero"))
    nodes = [helper.make_node("ReduceMean", ["image"], ["mean"], keepdims=0)]
    nodes.append(helper.make_node("Mul", ["mean", "zero"], ["nothing"]))
    nodes += [helper.make_node("Add", [f"{name}_c", "nothing"], [name]) for name in values]
    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, channels, "height", "width"])
    outputs = [helper.make_tensor_value_info(n, TensorProto.FLOAT, list(v.shape)) for n, v in values.items()]
    graph = helper.make_graph(nodes, "tiny", [image], outputs, initial)
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), str(path))
    return path


@pytest.mark.parametrize("options", [{}, {"channels": 1, "batched": False}, {"normalised": True}])
def test_published_signatures_are_read(tmp_path, options) -> None:
    spec = check_model("extractor", network(tmp_path / "e.onnx", **options), "unit")
    made = extractor.make({"extractor": spec}, extractor.Params())
    found = made.extract(np.full((96, 64, 3), 90, np.uint8))
    order = [2, 1, 0]  # the surest first
    assert np.allclose(found.pixels, POINTS[order] + 0.5, atol=1e-3)
    assert np.allclose(found.descriptors, np.eye(3, 8)[order])
    assert found.angles_rad is None
    few = extractor.make({"extractor": spec}, extractor.Params(max_features=1, min_score=0.5))
    assert len(few.extract(np.full((96, 64, 3), 90, np.uint8))) == 1


def test_pixels_are_those_of_the_picture_whatever_its_size(tmp_path) -> None:
    """Sides become multiples of 32, and what is found goes back."""
    spec = check_model("extractor", network(tmp_path / "e.onnx"), "unit")
    made = extractor.make({"extractor": spec}, extractor.Params())
    found = made.extract(np.full((100, 70, 3), 90, np.uint8))
    assert np.allclose(found.pixels[0], (POINTS[2] + 0.5) * [70 / 64, 100 / 96], atol=1e-3)


def test_other_networks_are_refused(tmp_path) -> None:
    with raises(InputError, code="model_misfit"):
        check_model("extractor", network(tmp_path / "e.onnx", channels=7), "unit")
    with raises(InputError, code="model_misfit"):
        check_model("extractor", network(tmp_path / "f.onnx", points=np.zeros((3, 5), np.float32)), "unit")
