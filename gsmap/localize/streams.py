"""Arrays in few bytes: places as steps along a space-filling curve, and bytes by LZMA, which learns how they spread.

Between neighbours on the curve a place is a small step; of N places in no order log2(N!) bits need not be said.
"""

from __future__ import annotations

import lzma

import numpy as np

from gsmap.geometry.morton import BITS, cells_of_codes, codes_of_cells

# What was rounded has neither words nor alignment: what a byte is depends on no byte before it.
_FILTERS = [{"id": lzma.FILTER_LZMA2, "preset": 6, "lc": 0, "lp": 0, "pb": 0}]


def squeezed(values: np.ndarray) -> np.ndarray:
    """(B,) uint8: the bytes of an array, packed; those of one column after those of another pack best."""
    packed = lzma.compress(np.ascontiguousarray(values).tobytes(), lzma.FORMAT_RAW, filters=_FILTERS)
    return np.frombuffer(packed, np.uint8)


def expanded(stream: np.ndarray, shape: tuple[int, ...], dtype: type) -> np.ndarray:
    """The array again.

    Raises:
        ValueError: the bytes are of something else, or more.
    """
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    if stream.dtype != np.uint8 or stream.ndim != 1:
        raise ValueError("bytes that are none")
    try:
        found = lzma.LZMADecompressor(lzma.FORMAT_RAW, filters=_FILTERS).decompress(stream.tobytes(), size + 1)
    except lzma.LZMAError as error:
        raise ValueError(f"bytes that cannot be unpacked: {error}") from error
    if len(found) != size:
        raise ValueError("bytes that do not fit what they are of")
    return np.frombuffer(found, dtype).reshape(shape)


def finest_step(points: np.ndarray, wanted: float) -> float:
    """A step to round places (N, 3) to: the wanted one, or the finest that the curve can count."""
    spread = float(np.ptp(points, axis=0).max()) if len(points) else 0.0
    return max(wanted, spread / ((1 << BITS) - 2), float(np.finfo(np.float32).tiny))


def codes_of(points: np.ndarray, low: np.ndarray, step: float) -> np.ndarray:
    """(N,) uint64 where places (N, 3) lie on the curve through cells of a grid that begins at ``low`` (3,)."""
    cells = np.round((np.asarray(points, np.float64) - low) / step)
    return codes_of_cells(np.maximum(cells, 0).astype(np.uint64))


def places_of(codes: np.ndarray, low: np.ndarray, step: float) -> np.ndarray:
    """(N, 3) float64 the middles of these cells."""
    out: np.ndarray = low + cells_of_codes(codes).astype(np.float64) * step
    return out


def steps_between(codes: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """(8, N) uint8 by how much each code is larger than the one before, low bytes first.

    Args:
        codes: (N,) uint64, rising within each run.
        starts: (R,) where runs begin; the first of each is said whole.
    """
    steps = np.diff(codes, prepend=np.uint64(0))
    begins = starts[starts < len(codes)]
    steps[begins] = codes[begins]
    return steps.astype("<u8").view(np.uint8).reshape(len(codes), 8).T


def codes_between(steps: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """(N,) uint64 the codes again."""
    each = np.ascontiguousarray(steps.T).view("<u8")[:, 0].astype(np.uint64)
    total = np.cumsum(each)  # what was before a run is taken off again, modulo 2 ** 64
    begins = np.unique(starts[starts < len(each)])
    before = np.zeros(len(begins), np.uint64)
    before[1:] = total[begins[1:] - 1]
    out: np.ndarray = total - np.repeat(before, np.diff(np.r_[begins, len(each)]))
    return out
