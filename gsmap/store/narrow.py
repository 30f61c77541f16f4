"""Arrays in as few bytes as hold every value without loss, in an order that packs well.

Numbers that are multiples of a power of two are kept as small integers, others in the narrowest type that has them all.
Types of several bytes are kept byte by byte (all high bytes of a column, then all low ones): neighbours are alike in
their high bytes, which then pack to little.
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


def narrow(values: np.ndarray) -> tuple[np.ndarray, dict[str, Any]]:
    """What to store of an array, and how it is to be read again (plain, for JSON): `widen` is the inverse."""
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
    how = {"is": values.dtype.str[1:], "as": found.dtype.str[1:], "step": scale, "shape": list(values.shape)}
    return (found if found.dtype.itemsize == 1 else _bytes_apart(found)), how


def widen(stored: np.ndarray, how: Mapping[str, Any]) -> np.ndarray:
    """The array again, from what `narrow` gave for it; its shape is that of `shape_of`.

    Raises:
        ValueError: it is of another type.
    """
    kept, dtype = _TYPES[how["as"]], _TYPES[how["is"]]
    if stored.dtype != (kept if kept.itemsize == 1 else np.uint8):
        raise ValueError(f"its values are {stored.dtype}, but the catalog says {kept}")
    values = stored if kept.itemsize == 1 else _bytes_together(stored, kept)
    values = values.reshape(how["shape"])
    if kept == dtype:
        return values
    step = how["step"]
    out: np.ndarray = values.astype(dtype) if step == 1.0 else np.multiply(values, dtype.type(step), dtype=dtype)
    return out


def shape_of(how: Mapping[str, Any]) -> Shape:
    """The shape that what is stored has.

    Raises:
        CorruptError: `narrow` does not say that of any array.
    """
    shape, step, known = how.get("shape"), how.get("step"), {how.get("is"), how.get("as")} <= set(_TYPES)
    if not (_is_shape(shape) and known and type(step) is float and math.isfinite(step) and step > 0):
        raise CorruptError(
            f"the catalog has an array that is kept as {how!r:.100}: gsmap did not write that", code="catalog_invalid"
        )
    width = _TYPES[how["as"]].itemsize
    return tuple(shape) if width == 1 else (width * math.prod(shape[1:]), shape[0])


def _is_shape(value: object) -> TypeGuard[list[int]]:
    return isinstance(value, list) and 1 <= len(value) <= 4 and all(type(n) is int and 0 <= n < 1 << 40 for n in value)


def _as(values: np.ndarray, dtype: np.dtype, step: float) -> np.ndarray | None:
    """The values over ``step`` as another type; None where that loses anything."""
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
    """The largest power of two that all values are multiples of; 1 where that makes no sense."""
    some = values[values != 0].astype(np.float64)
    if not some.size or not np.isfinite(some).all():
        return 1.0
    mantissa, exponent = np.frexp(some)
    whole = (mantissa * 2.0**53).astype(np.int64)
    lowest = np.frexp((whole & -whole).astype(np.float64))[1] - 1 - 53 + exponent
    return float(2.0 ** np.clip(lowest.min(), -1000, 1000))


def _bytes_apart(values: np.ndarray) -> np.ndarray:
    """(N, ...) of a type of B bytes as (B * columns, N) uint8."""
    n, width = len(values), values.dtype.itemsize
    columns = math.prod(values.shape[1:])
    apart = np.ascontiguousarray(values).view(np.uint8).reshape(n, columns, width)[:, :, ::-1]
    return np.ascontiguousarray(apart.transpose(2, 1, 0)).reshape(width * columns, n)


def _bytes_together(stored: np.ndarray, dtype: np.dtype) -> np.ndarray:
    width, n = dtype.itemsize, stored.shape[1]
    apart = stored.reshape(width, -1, n) if stored.size else np.zeros((width, 0, n), np.uint8)
    return np.ascontiguousarray(apart.transpose(2, 1, 0)[:, :, ::-1]).view(dtype)
