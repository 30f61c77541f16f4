"""A small ONNX image encoder, for maps and tests that need any."""


def image_encoder(window: int = 16) -> bytes:
    """The mean of each ``window`` x ``window`` pixels of a 32 x 32 picture."""
    from onnx import TensorProto, helper

    across = 32 // window
    pool = helper.make_node("AveragePool", ["image"], ["pooled"], kernel_shape=[window] * 2, strides=[window] * 2)
    flat = helper.make_node("Flatten", ["pooled"], ["features"])
    graph = helper.make_graph(
        [pool, flat],
        "encoder",
        [helper.make_tensor_value_info("image", TensorProto.FLOAT, ["n", 3, 32, 32])],
        [helper.make_tensor_value_info("features", TensorProto.FLOAT, ["n", 3 * across * across])],
    )
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9).SerializeToString()
