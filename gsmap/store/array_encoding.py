"""Encode arrays without loss in few bytes, in an order that compresses well.

Numbers that are multiples of a power of two are stored as small integers, others in the narrowest exact type. Types of
several bytes are stored byte plane by byte plane (all high bytes of a column first), because neighbouring values share
high bytes, which then compress well.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, TypeGuard

import numpy as np

from gsmap.errors import CorruptError
from gsmap.store.layout import Shape

_WHOLE = tuple(np.dtype(f"{kind}{size}") for size in (1, 2, 4) for kind in "ui")
_FLOATS = (np.dtype("f2"), np.dtype("f4"))
_TYPES = {t.str[1:]: t for t in (*_WHOLE, *_FLOATS, np.dtype("i8"), np.dtype("u8"), np.dtype("f8"))}


def encode_array(values: np.ndarray) -> tuple[np.ndarray, dict[str, Any]]:
    """Return the encoded array and a JSON description of the encoding; `decode_array` is the inverse."""
    step = _step(values) if values.dtype.kind == "f" else 1.0
    found = values
    candidates = (*_WHOLE, *_FLOATS) if values.dtype.kind == "f" else _WHOLE
    for dtype in sorted(candidates, key=lambda t: (t.itemsize, t.kind == "f")):
        if dtype.itemsize >= values.dtype.itemsize:
            break
        kept = _as(values, dtype, step if dtype.kind in "ui" else 1.0)
        if kept is not None:
            found = kept
            break
    scale = step if found.dtype.kind in "ui" and found is not values else 1.0
    encoding = {"is": values.dtype.str[1:], "as": found.dtype.str[1:], "step": scale, "shape": list(values.shape)}
    return (found if found.dtype.itemsize == 1 else _split_bytes(found)), encoding


def decode_array(stored: np.ndarray, encoding: Mapping[str, Any]) -> np.ndarray:
    """Decode an array that `encode_array` returned, which has the shape `encoded_shape`.

    Raises:
        ValueError: the array has another type.
    """
    kept, dtype = _TYPES[encoding["as"]], _TYPES[encoding["is"]]
    if stored.dtype != (kept if kept.itemsize == 1 else np.uint8):
        raise ValueError(f"its values have the type {stored.dtype}, but the catalog records {kept}")
    values = stored if kept.itemsize == 1 else _join_bytes(stored, kept)
    values = values.reshape(encoding["shape"])
    if kept == dtype:
        return values
    step = encoding["step"]
    out: np.ndarray = values.astype(dtype) if step == 1.0 else np.multiply(values, dtype.type(step), dtype=dtype)
    return out


def encoded_shape(encoding: Mapping[str, Any]) -> Shape:
    """Return the shape of an encoded array.

    Raises:
        CorruptError: not an encoding of `encode_array`.
    """
    shape, step, known = (
        encoding.get("shape"),
        encoding.get("step"),
        {encoding.get("is"), encoding.get("as")} <= set(_TYPES),
    )
    if not (_is_shape(shape) and known and type(step) is float and math.isfinite(step) and step > 0):
        raise CorruptError(
            f"the catalog records an array encoding {encoding!r:.100} that gsmap does not write",
            code="catalog_invalid",
        )
    width = _TYPES[encoding["as"]].itemsize
    return tuple(shape) if width == 1 else (width * math.prod(shape[1:]), shape[0])


def _is_shape(value: object) -> TypeGuard[list[int]]:
    return isinstance(value, list) and 1 <= len(value) <= 4 and all(type(n) is int and 0 <= n < 1 << 40 for n in value)


def _as(values: np.ndarray, dtype: np.dtype, step: float) -> np.ndarray | None:
    """Divide values by ``step`` and convert them to another type; return None if this is not exact."""
    if dtype.kind in "ui":
        limits = np.iinfo(dtype)
        over = values / step if step != 1.0 else values
        if values.size and not (limits.min <= over.min() and over.max() <= limits.max):
            return None
        kept = over.astype(dtype)
    else:
        with np.errstate(over="ignore"):
            kept = values.astype(dtype)
    again = kept.astype(values.dtype) if step == 1.0 else kept.astype(values.dtype) * values.dtype.type(step)
    return kept if again.tobytes() == np.ascontiguousarray(values).tobytes() else None


def _step(values: np.ndarray) -> float:
    """Return the largest power of two that divides all values; 1 if there is none."""
    some = values[values != 0].astype(np.float64)
    if not some.size or not np.isfinite(some).all():
        return 1.0
    mantissa, exponent = np.frexp(some)
    whole = (mantissa * 2.0**53).astype(np.int64)
    lowest = np.frexp((whole & -whole).astype(np.float64))[1] - 1 - 53 + exponent
    return float(2.0 ** np.clip(lowest.min(), -1000, 1000))


def _split_bytes(values: np.ndarray) -> np.ndarray:
    """Split an array (N, ...) of a type of B bytes into its bytes, (B * columns, N) uint8."""
    n, width = len(values), values.dtype.itemsize
    columns = math.prod(values.shape[1:])
    apart = np.ascontiguousarray(values).view(np.uint8).reshape(n, columns, width)[:, :, ::-1]
    return np.ascontiguousarray(apart.transpose(2, 1, 0)).reshape(width * columns, n)


def _join_bytes(stored: np.ndarray, dtype: np.dtype) -> np.ndarray:
    width, n = dtype.itemsize, stored.shape[1]
    apart = stored.reshape(width, -1, n) if stored.size else np.zeros((width, 0, n), np.uint8)
    return np.ascontiguousarray(apart.transpose(2, 1, 0)[:, :, ::-1]).view(dtype)
