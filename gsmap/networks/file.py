"""Check that an ONNX file contains all its weights."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from gsmap.errors import InputError

# Fields that lead to tensors, by message type (onnx.proto3); field 13 of a tensor names a file outside the model.
_CHILDREN = {
    "model": {7: "graph", 25: "function"},
    "graph": {1: "node", 5: "tensor", 15: "sparse"},
    "function": {7: "node"},
    "node": {5: "attribute"},
    "attribute": {5: "tensor", 6: "graph", 10: "tensor", 11: "graph", 22: "sparse", 23: "sparse"},
    "sparse": {1: "tensor", 2: "tensor"},
}
_EXTERNAL_DATA, _DATA_LOCATION = 13, 14


def refuse_external_data(path: Path) -> None:
    """Reject a model that refers to other files.

    Raises:
        InputError: the model has weights in other files, or the file is not a protobuf message.
    """
    try:
        outside = _has_external(memoryview(path.read_bytes()), "model", 0)
    except (ValueError, IndexError):
        raise InputError(f"{path} is not an ONNX model: it cannot be parsed", code="not_a_model") from None
    if outside:
        raise InputError(
            f"{path} has weights in other files; save it as a single file (onnx.save without external data)",
            code="model_has_external_data",
        )


def _has_external(data: memoryview, message: str, depth: int) -> bool:
    if depth > 64:
        raise ValueError("nested too deeply")
    for number, value in _fields(data):
        if message == "tensor":
            if number == _EXTERNAL_DATA or (number == _DATA_LOCATION and value == 1):
                return True
            continue
        child = _CHILDREN[message].get(number)
        if child and isinstance(value, memoryview) and _has_external(value, child, depth + 1):
            return True
    return False


def _fields(data: memoryview) -> Iterator[tuple[int, int | memoryview]]:
    """Yield (field number, value) of a protobuf message: integers for varints, views for fields with a length."""
    at = 0
    while at < len(data):
        key, at = _varint(data, at)
        number, wire = key >> 3, key & 7
        if wire == 0:
            value, at = _varint(data, at)
            yield number, value
            continue
        if wire == 2:
            size, at = _varint(data, at)
        elif wire in (1, 5):
            size = 8 if wire == 1 else 4
        else:
            raise ValueError(f"wire type {wire}")
        if number == 0 or at + size > len(data):
            raise ValueError("truncated")
        yield number, data[at : at + size]
        at += size


def _varint(data: memoryview, at: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 70, 7):
        byte = data[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, at
    raise ValueError("varint too long")
