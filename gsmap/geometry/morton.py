"""Order points along a Z-order (Morton) curve, so that neighbours in space are neighbours in a file."""

from __future__ import annotations

import numpy as np

from gsmap.geometry.boxes import box_around

BITS = 21
"""Number of bits per axis; three axes fill 63 bits."""


def morton_order(points: np.ndarray) -> np.ndarray:
    """Return the (N,) permutation that sorts finite points (N, 3) stably along a Z-order curve through cubic cells."""
    if not len(points):
        return np.zeros(0, np.int64)
    return np.argsort(morton_codes(points, box_around(points)), kind="stable")


def morton_codes(points: np.ndarray, box: np.ndarray) -> np.ndarray:
    """Return the (N,) uint64 Morton codes of points (N, 3) in the smallest cube that contains a box (2, 3) and starts
    at its low corner."""
    low, high = box.astype(np.float64)
    step = max((high - low).max(), np.finfo(np.float32).tiny) / ((1 << BITS) - 1)
    return codes_of_cells(((points - low) / step).astype(np.uint64))


def codes_of_cells(cells: np.ndarray) -> np.ndarray:
    """Return the (N,) uint64 Morton codes of cells (N, 3) uint64, each of 21 bits."""
    code = np.zeros(len(cells), np.uint64)
    for axis in range(3):
        code |= _spread(cells[:, axis]) << np.uint64(2 - axis)
    return code


def cells_of_codes(codes: np.ndarray) -> np.ndarray:
    """Return the (N, 3) uint64 cells of Morton codes."""
    return np.stack([_gathered(codes >> np.uint64(2 - axis)) for axis in range(3)], axis=1)


_MASKS = (0x1FFFFF, 0x1F00000000FFFF, 0x1F0000FF0000FF, 0x100F00F00F00F00F, 0x10C30C30C30C30C3, 0x1249249249249249)
_SHIFTS = (32, 16, 8, 4, 2)


def _spread(cell: np.ndarray) -> np.ndarray:
    """Insert two zero bits before each of the low 21 bits of an integer."""
    for shift, mask in zip(_SHIFTS, _MASKS[1:], strict=True):
        cell = (cell | (cell << np.uint64(shift))) & np.uint64(mask)
    return cell


def _gathered(code: np.ndarray) -> np.ndarray:
    """Gather every third bit of an integer; the inverse of `_spread`."""
    code = code & np.uint64(_MASKS[-1])
    for shift, mask in zip(_SHIFTS[::-1], _MASKS[-2::-1], strict=True):
        code = (code | (code >> np.uint64(shift))) & np.uint64(mask)
    return code
