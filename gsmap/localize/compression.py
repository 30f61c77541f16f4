"""Compress arrays: store points as steps along a Morton curve, and bytes by LZMA.

Steps between neighbours on the curve are small, and sorting N points saves the log2(N!) bits of their order.
"""

from __future__ import annotations

import lzma

import numpy as np

from gsmap.geometry.morton import BITS, cells_of_codes, codes_of_cells

# Quantized values have neither literal context nor alignment.
_FILTERS = [{"id": lzma.FILTER_LZMA2, "preset": 6, "lc": 0, "lp": 0, "pb": 0}]


def compress(values: np.ndarray) -> np.ndarray:
    """Compress an array to (B,) uint8; an array that is contiguous by columns compresses best."""
    packed = lzma.compress(np.ascontiguousarray(values).tobytes(), lzma.FORMAT_RAW, filters=_FILTERS)
    return np.frombuffer(packed, np.uint8)


def decompress(stream: np.ndarray, shape: tuple[int, ...], dtype: type) -> np.ndarray:
    """Restore an array from the output of `compress`.

    Raises:
        ValueError: the bytes do not hold an array of this shape and type.
    """
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    if stream.dtype != np.uint8 or stream.ndim != 1:
        raise ValueError("the data are no LZMA stream")
    try:
        found = lzma.LZMADecompressor(lzma.FORMAT_RAW, filters=_FILTERS).decompress(stream.tobytes(), size + 1)
    except lzma.LZMAError as error:
        raise ValueError(f"the LZMA stream cannot be decompressed: {error}") from error
    if len(found) != size:
        raise ValueError("the LZMA stream and its array differ in size")
    return np.frombuffer(found, dtype).reshape(shape)


def finest_step(points: np.ndarray, wanted: float) -> float:
    """Return the step to which points (N, 3) are rounded: the wanted step, or the finest step that the curve can
    encode."""
    spread = float(np.ptp(points, axis=0).max()) if len(points) else 0.0
    return max(wanted, spread / ((1 << BITS) - 2), float(np.finfo(np.float32).tiny))


def encode_points(points: np.ndarray, low: np.ndarray, step: float) -> np.ndarray:
    """Return the (N,) uint64 Morton codes of points (N, 3) in a grid that begins at ``low`` (3,)."""
    cells = np.round((np.asarray(points, np.float64) - low) / step)
    return codes_of_cells(np.maximum(cells, 0).astype(np.uint64))


def decode_points(codes: np.ndarray, low: np.ndarray, step: float) -> np.ndarray:
    """Return the (N, 3) float64 points of Morton codes."""
    out: np.ndarray = low + cells_of_codes(codes).astype(np.float64) * step
    return out


def code_steps(codes: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """Return (8, N) uint8: the bytes of the differences between successive codes, low bytes first.

    Args:
        codes: (N,) uint64, sorted within each run.
        starts: (R,) first index of each run; the first code of a run is stored whole.
    """
    steps = np.diff(codes, prepend=np.uint64(0))
    begins = starts[starts < len(codes)]
    steps[begins] = codes[begins]
    return steps.astype("<u8").view(np.uint8).reshape(len(codes), 8).T


def codes_from_steps(steps: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """Return the (N,) uint64 codes from the output of `code_steps`."""
    each = np.ascontiguousarray(steps.T).view("<u8")[:, 0].astype(np.uint64)
    total = np.cumsum(each)  # modulo 2 ** 64; the sum before each run is subtracted
    begins = np.unique(starts[starts < len(each)])
    before = np.zeros(len(begins), np.uint64)
    before[1:] = total[begins[1:] - 1]
    out: np.ndarray = total - np.repeat(before, np.diff(np.r_[begins, len(each)]))
    return out
