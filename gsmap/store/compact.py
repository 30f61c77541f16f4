"""Compact storage of superseded captures, which keeps Gaussians in a fifth of their bytes.

Each value is quantized to 8 bits (positions to 16 within their chunk, rotations to the three smallest components at
10), which is not visible in renders; `gsmap.thin` measures that. Row order is kept, so that parts of a scene are read
as before.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from gsmap.errors import CorruptError
from gsmap.formats.quantise import from_smallest_three, logits_of_bytes, opacity_bytes, smallest_three
from gsmap.geometry.boxes import box_around
from gsmap.store.layout import CHUNK_ROWS, Shape
from gsmap.types import Gaussians
from gsmap.types.gaussians import FIELDS

_SQRT2 = np.sqrt(2.0)
_LEVELS_16, _LEVELS_10, _LEVELS_8 = 65535.0, 1023.0, 255.0
# Quantization steps below these are not visible (over 50 dB PSNR), and coarser values compress better.
_SIZE_STEP = 0.06  # of the natural logarithm: 6 percent
_COLOUR_STEP = 0.02  # 0.006 of a colour in [0, 1]
_GLOSS_STEP = 0.06  # of the view-dependent coefficients
_NOT_FINITE = "a thinned scene has numbers that are not finite: ingest its capture again"
_VALUES = ("log_scales", "sh0", "sh_rest")
_PARTS = {"logit_opacities": ("opacities",), "sh": ("sh0", "sh_rest")}


def pack(gaussians: Gaussians) -> dict[str, np.ndarray]:
    """Return the arrays of compact Gaussians, in the same order, in chunks of `CHUNK_ROWS` rows.

    Args:
        gaussians: finite (`gsmap.ingest.validate`), sorted so that a chunk is small (Morton order).
    """
    n, k = gaussians.sh.shape[:2]
    starts = np.arange(0, n, CHUNK_ROWS)
    boxes = np.zeros((len(starts), 2, 3))
    for box, start in zip(boxes, starts, strict=True):
        box[:] = box_around(gaussians.means[start : start + CHUNK_ROWS])
    chunk = np.arange(n) // CHUNK_ROWS
    size = np.maximum(boxes[:, 1] - boxes[:, 0], 1e-30)
    means = np.round((gaussians.means - boxes[chunk, 0]) / size[chunk] * _LEVELS_16)
    largest, three = smallest_three(gaussians.quats)
    q = np.round((three / _SQRT2 + 0.5) * _LEVELS_10).astype(np.uint32)
    out = {
        "compact.boxes": boxes,
        "compact.means": _split_bytes(means.astype(np.uint16)),
        "compact.quats": (largest.astype(np.uint32) << 30) | (q[:, 0] << 20) | (q[:, 1] << 10) | q[:, 2],
        "compact.opacities": opacity_bytes(gaussians.logit_opacities),
    }
    for name, value, step in (
        ("log_scales", gaussians.log_scales, _SIZE_STEP),
        ("sh0", gaussians.sh[:, 0], _COLOUR_STEP),
        ("sh_rest", gaussians.sh[:, 1:].reshape(n, 3 * (k - 1)), _GLOSS_STEP),
    ):
        lowest = value.min(0) if n else np.zeros(value.shape[1])
        spread = value.max(0) - lowest if n else np.zeros(value.shape[1])
        steps = np.maximum(step, spread / _LEVELS_8)
        out[f"compact.{name}_range"] = np.stack([lowest, steps]).astype(np.float64)
        out[f"compact.{name}"] = np.round((value - lowest) / steps).astype(np.uint8)
    return out


def unpack(arrays: Mapping[str, np.ndarray], rows: np.ndarray) -> Gaussians:
    """Return the Gaussians that compact arrays store, as `unpack_fields`."""
    return Gaussians(**unpack_fields(arrays, rows, FIELDS))


def unpack_fields(arrays: Mapping[str, np.ndarray], rows: np.ndarray, names: Sequence[str]) -> dict[str, np.ndarray]:
    """Return fields of the Gaussians (or ``sh0``) that compact arrays store.

    Args:
        arrays: arrays of `arrays_of`: boxes and ranges whole, of the others the rows that were read.
        rows: (N,) numbers of the rows that were read.

    Raises:
        CorruptError: values that `pack` does not write.
    """

    def finite(values: np.ndarray) -> np.ndarray:
        if not np.isfinite(values).all():
            raise CorruptError(_NOT_FINITE, code="not_finite")
        return values

    def values(name: str) -> np.ndarray:
        low, step = finite(arrays[f"compact.{name}_range"])
        return finite((low + arrays[f"compact.{name}"] * step).astype(np.float32))

    def means() -> np.ndarray:
        boxes, chunk = finite(arrays["compact.boxes"]), rows // CHUNK_ROWS
        size = (boxes[:, 1] - boxes[:, 0])[chunk]
        found = boxes[chunk, 0] + _join_bytes(arrays["compact.means"]) / _LEVELS_16 * size
        return finite(found.astype(np.float32))

    def quats() -> np.ndarray:
        packed = arrays["compact.quats"]
        three = np.stack([packed >> 20, packed >> 10, packed], axis=1) & 1023
        return from_smallest_three(packed >> 30, (three / _LEVELS_10 - 0.5) * _SQRT2).astype(np.float32)

    made: Mapping[str, Callable[[], np.ndarray]] = {
        "means": means,
        "quats": quats,
        "log_scales": lambda: values("log_scales"),
        "logit_opacities": lambda: logits_of_bytes(arrays["compact.opacities"]).astype(np.float32),
        "sh0": lambda: values("sh0").reshape(len(rows), 1, 3),
        "sh": lambda: np.concatenate([values("sh0"), values("sh_rest")], axis=1).reshape(len(rows), -1, 3),
    }
    with np.errstate(over="ignore", invalid="ignore"):
        return {name: made[name]() for name in names}


def arrays_of(names: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return the names of the arrays that hold some fields of Gaussians (or ``sh0``): those read by rows, and those
    always read whole."""
    by_row = [f"compact.{part}" for name in names for part in _PARTS.get(name, (name,))]
    whole = ["compact.boxes"] if "means" in names else []
    return by_row, whole + [f"{name}_range" for name in by_row if name.removeprefix("compact.") in _VALUES]


def round_trip(gaussians: Gaussians) -> Gaussians:
    """Return the Gaussians as they would be read back from compact storage."""
    return unpack(pack(gaussians), np.arange(len(gaussians)))


def num_bytes(gaussians: Gaussians) -> int:
    """Estimate the bytes of Gaussians in compact storage."""
    return sum(len(zlib.compress(array.tobytes(), 1)) for array in pack(gaussians).values())


def shapes(n: int, sh_degree: int) -> dict[str, Shape]:
    """Return the shapes of the arrays of `pack`."""
    k = 3 * (sh_degree + 1) ** 2 - 3
    return {
        "compact.boxes": (-(-n // CHUNK_ROWS), 2, 3),
        "compact.log_scales_range": (2, 3),
        "compact.sh0_range": (2, 3),
        "compact.sh_rest_range": (2, k),
        "compact.means": (n, 6),
        "compact.quats": (n,),
        "compact.opacities": (n,),
        "compact.log_scales": (n, 3),
        "compact.sh0": (n, 3),
        "compact.sh_rest": (n, k),
    }


KEPT = "compact.kept"
"""Name of the array of `pack_kept`."""


def pack_kept(kept: np.ndarray) -> dict[str, np.ndarray]:
    """Return the array that marks the Gaussians of the whole capture that are kept.

    Args:
        kept: (N,) bool.
    """
    return {KEPT: np.packbits(kept)}


def kept_shape(num_whole: int) -> Shape:
    """Return the shape of the array of `pack_kept`."""
    return (-(-num_whole // 8),)


def unpack_kept(bits: np.ndarray, num_whole: int) -> np.ndarray:
    """Return the rows (n,) int64 of the whole capture that are kept, ascending."""
    return np.flatnonzero(np.unpackbits(bits, count=num_whole))


def _split_bytes(values: np.ndarray) -> np.ndarray:
    """Convert (N, 3) uint16 to (N, 6) uint8, high bytes first: they change slowly and compress well."""
    return np.concatenate([values >> 8, values & 255], axis=1).astype(np.uint8)


def _join_bytes(values: np.ndarray) -> np.ndarray:
    out: np.ndarray = (values[:, :3].astype(np.uint16) << 8) | values[:, 3:]
    return out
