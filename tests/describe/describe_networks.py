"""Tiny ONNX networks with the signatures of real ones, made by the tests."""

from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper


def _save(path: Path, nodes, inputs, outputs, constants) -> Path:
    initial = [numpy_helper.from_array(np.asarray(v), k) for k, v in constants.items()]
    graph = helper.make_graph(nodes, "tiny", inputs, outputs, initial)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    onnx.checker.check_model(model)
    onnx.save(model, str(path))
    return path


def _value(name, shape, kind=TensorProto.FLOAT):
    return helper.make_tensor_value_info(name, kind, shape)


def sam_encoder(path: Path, side: int = 1024, cell: int = 16) -> Path:
    """(1, 3, side, side) to the mean colour of each cell x cell pixels, of 1024 and 16 to (1, 3, 64, 64)."""
    node = helper.make_node("AveragePool", ["image"], ["image_embeddings"], kernel_shape=[cell] * 2, strides=[cell] * 2)
    out = [1, 3, side // cell, side // cell]
    return _save(path, [node], [_value("image", [1, 3, side, side])], [_value("image_embeddings", out)], {})


def sam_decoder(path: Path, *, batch: int | str = "batch") -> Path:
    """The mask of a point: the cells whose colour is that of the point's cell. Signature of the published export."""
    make = helper.make_node
    nodes = [
        # Colour at the first point of each prompt: (B, 3).
        make("Slice", ["point_coords", "zero", "one", "axis1"], ["first"]),
        make("Div", ["first", "sixteen"], ["cell_f"]),
        make("Cast", ["cell_f"], ["cell_xy"], to=TensorProto.INT64),
        make("Gather", ["cell_xy", "yx"], ["cell_yx"], axis=2),
        make("Squeeze", ["cell_yx", "axis1"], ["cell"]),
        make("Transpose", ["image_embeddings"], ["hwc1"], perm=[2, 3, 1, 0]),
        make("Squeeze", ["hwc1", "axis3"], ["hwc"]),
        make("GatherND", ["hwc", "cell"], ["colour"]),
        make("Unsqueeze", ["colour", "axes23"], ["colour_bc11"]),
        make("Sub", ["image_embeddings", "colour_bc11"], ["difference"]),
        make("Abs", ["difference"], ["distance_c"]),
        make("ReduceSum", ["distance_c", "axis1"], ["distance"], keepdims=1),
        make("Sub", ["half", "distance"], ["margin"]),
        make("Mul", ["margin", "steep"], ["low_res_masks"]),
        # The part that is not padding, at the picture's size.
        make("ReduceMax", ["orig_im_size"], ["longest"], keepdims=1),
        make("Div", ["orig_im_size", "longest"], ["share"]),
        make("Mul", ["share", "sixty_four"], ["part_f"]),
        make("Ceil", ["part_f"], ["part_c"]),
        make("Cast", ["part_c"], ["part"], to=TensorProto.INT64),
        make("Slice", ["low_res_masks", "zeros2", "part", "axes23"], ["cropped"]),
        make("Shape", ["cropped"], ["shape"]),
        make("Slice", ["shape", "zero", "two", "axis0"], ["leading"]),
        make("Cast", ["orig_im_size"], ["orig"], to=TensorProto.INT64),
        make("Concat", ["leading", "orig"], ["sizes"], axis=0),
        make("Resize", ["cropped", "", "", "sizes"], ["masks"], mode="nearest"),
        # A prediction that everything is a good mask; the other inputs are used so that none is optimised away.
        make("ReduceMean", ["point_labels"], ["mean_label"], axes=[1], keepdims=1),
        make("ReduceMean", ["mask_input"], ["mean_mask"], keepdims=0),
        make("ReduceMean", ["has_mask_input"], ["mean_has"], keepdims=0),
        make("Add", ["mean_mask", "mean_has"], ["nothing"]),
        make("Add", ["mean_label", "nothing"], ["zero_b1"]),
        make("Add", ["zero_b1", "good"], ["iou_predictions"]),
    ]
    inputs = [
        _value("image_embeddings", [1, 3, 64, 64]),
        _value("point_coords", [batch, "num_points", 2]),
        _value("point_labels", [batch, "num_points"]),
        _value("mask_input", [1, 1, 256, 256]),
        _value("has_mask_input", [1]),
        _value("orig_im_size", [2]),
    ]
    outputs = [
        _value("masks", [batch, 1, "height", "width"]),
        _value("iou_predictions", [batch, 1]),
        _value("low_res_masks", [batch, 1, 64, 64]),
    ]
    integers = {
        "zero": [0],
        "one": [1],
        "two": [2],
        "axis0": [0],
        "axis1": [1],
        "axis3": [3],
        "axes23": [2, 3],
        "zeros2": [0, 0],
        "yx": [1, 0],
    }
    numbers = {"sixteen": 16.0, "half": 0.5, "steep": 20.0, "sixty_four": 64.0, "good": 0.95}
    constants = {k: np.array(v, np.int64) for k, v in integers.items()}
    constants |= {k: np.array(v, np.float32) for k, v in numbers.items()}
    return _save(path, nodes, inputs, outputs, constants)


def image_encoder(path: Path, side: int | str = 8, *, channels_last: bool = False, batch: int | str = "n") -> Path:
    """Pictures to their mean colour, (N, 3)."""
    shape = [batch, side, side, 3] if channels_last else [batch, 3, side, side]
    axes = [1, 2] if channels_last else [2, 3]
    node = helper.make_node("ReduceMean", ["pixels"], ["features"], axes=axes, keepdims=0)
    return _save(path, [node], [_value("pixels", shape)], [_value("features", [batch, 3])], {})


def fixed_inside(path: Path) -> Path:
    """An image encoder that declares any size and takes only 64 x 64."""
    node = helper.make_node("Reshape", ["pixels", "shape"], ["features"])
    constants = {"shape": np.array([1, 3 * 64 * 64], np.int64)}
    return _save(path, [node], [_value("pixels", ["n", 3, "h", "w"])], [_value("features", ["n", 12288])], constants)


def external(path: Path) -> Path:
    """An image encoder that keeps a weight in another file."""
    weight = numpy_helper.from_array(np.ones((1, 3, 8, 8), np.float32), "w")
    node = helper.make_node("Mul", ["pixels", "w"], ["features"])
    graph = helper.make_graph(
        [node], "outside", [_value("pixels", [1, 3, 8, 8])], [_value("features", [1, 3, 8, 8])], [weight]
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    onnx.save(model, str(path), save_as_external_data=True, location="weights.bin", size_threshold=0)
    return path


def endless(path: Path, *, grows: bool = False) -> Path:
    """An image encoder that takes 2^62 turns of a loop; where it grows, each doubles what it holds."""
    value = helper.make_tensor_value_info
    turn = ("Concat", ["x", "x"]) if grows else ("Add", ["x", "one"])
    body = helper.make_graph(
        [
            helper.make_node("Identity", ["go_on"], ["goes_on"]),
            helper.make_node(*turn, ["y"], **({"axis": 0} if grows else {})),
        ],
        "body",
        [value("i", TensorProto.INT64, []), value("go_on", TensorProto.BOOL, []), value("x", TensorProto.FLOAT, None)],
        [value("goes_on", TensorProto.BOOL, []), value("y", TensorProto.FLOAT, None)],
        [numpy_helper.from_array(np.ones(1, np.float32), "one")],
    )
    mean = helper.make_node("ReduceMean", ["pixels"], ["mean"], axes=[2, 3], keepdims=0)
    loop = helper.make_node("Loop", ["turns", "go"], ["features"], body=body)
    loop.input.append("mean")
    constants = {"turns": np.array(2**62, np.int64), "go": np.array(True)}
    shapes = [_value("pixels", ["n", 3, 8, 8])], [_value("features", ["n", 3])]
    return _save(path, [mean, loop], *shapes, constants)


def enormous(path: Path, numbers: int = 40_000_000_000) -> Path:
    """An image encoder whose weights are 160 GB of zeros in a few bytes."""
    nodes = [
        helper.make_node("ConstantOfShape", ["shape"], ["zeros"]),
        helper.make_node("ReduceSum", ["zeros"], ["zero"], keepdims=0),
        helper.make_node("ReduceMean", ["pixels"], ["mean"], axes=[2, 3], keepdims=0),
        helper.make_node("Add", ["mean", "zero"], ["features"]),
    ]
    shape = {"shape": np.array([numbers], np.int64)}
    return _save(path, nodes, [_value("pixels", ["n", 3, 8, 8])], [_value("features", ["n", 3])], shape)
