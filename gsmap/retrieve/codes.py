"""Vectors as an index keeps them: a few bytes each, compared by whole numbers, in lists by the signs of their axes.

Whole numbers of this size add up exactly in float32, in any order, so that every machine finds the same neighbours.
"""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path

import numpy as np

AXES = Path(__file__).with_name("axes.npz")
"""Mean and principal axes of the built-in descriptors' vectors, by dimension (`tools/fit/retrieve.py`)."""

NUM_DIMS = 48  # of a code
SCALE = 200  # of a unit vector's components; what is beyond 127 / 200 is cut off, which next to none is
NUM_SIGNS = 6  # axes whose signs name a list: 64 lists for every type of node


def encode(vectors: np.ndarray) -> np.ndarray:
    """(M, NUM_DIMS) int8 codes of (M, D) unit vectors; distances of codes are those of the vectors times `SCALE`."""
    mean, axes = _axes(vectors.shape[1])
    along = (vectors.astype(np.float64) - mean) @ axes
    return np.clip(np.rint(along * SCALE), -127, 127).astype(np.int8)


def similarity(squared: np.ndarray) -> np.ndarray:
    """Cosines of vectors by squared distances of their codes."""
    return 1.0 - squared / (2.0 * SCALE**2)


@cache
def _axes(dim: int) -> tuple[np.ndarray, np.ndarray]:
    """(dim,) mean and (dim, NUM_DIMS) axes: fitted ones, or seeded random ones; all of those that there are."""
    with np.load(AXES) as stored:
        if f"{dim}.mean" in stored:
            fitted = stored[f"{dim}.axes"].astype(np.float64)
            return stored[f"{dim}.mean"].astype(np.float64), np.pad(fitted, ((0, 0), (0, NUM_DIMS - fitted.shape[1])))
    if dim <= NUM_DIMS:
        return np.zeros(dim), np.eye(dim, NUM_DIMS)
    random = np.random.Generator(np.random.PCG64([dim, NUM_DIMS])).standard_normal((dim, NUM_DIMS))
    return np.zeros(dim), np.linalg.qr(random)[0] * np.sqrt(dim / NUM_DIMS)


def space(descriptor_id: str, *, second: bool) -> int:
    """What keys of lists begin with: 31 bits of a descriptor's digest.

    Args:
        second: vectors that a scene has besides its own, for scenes that know no up.
    """
    digest = hashlib.sha256(f"{descriptor_id} {int(second)}".encode()).digest()
    return int.from_bytes(digest[:4], "little") >> 1


def keys_of(space_number: int, types: np.ndarray, codes: np.ndarray) -> np.ndarray:
    """(M,) int64 the list that each node lies in: of its descriptor, its type, and the signs of its first axes."""
    return with_signs((np.int64(space_number) << 32) | ((types.astype(np.int64) & 0xFFFFFF) << 8), codes)


def with_signs(keys: np.ndarray, codes: np.ndarray) -> np.ndarray:
    """Keys (M,) with the signs of these codes for those that they hold."""
    signs = (codes[:, :NUM_SIGNS] >= 0) @ (1 << np.arange(NUM_SIGNS))
    return (keys & ~np.int64(0xFF)) | signs


def probes(keys: np.ndarray, codes: np.ndarray, num_turned: int) -> np.ndarray:
    """(M, 2 ** num_turned) int64 lists in which to look: with each of the least certain signs as it is and turned."""
    unsure = np.argsort(np.abs(codes[:, :NUM_SIGNS].astype(np.int16)), axis=1, kind="stable")[:, :num_turned]
    masks = np.zeros((len(keys), 1), dtype=np.int64)
    for column in range(unsure.shape[1]):
        masks = np.concatenate([masks, masks ^ (np.int64(1) << unsure[:, column : column + 1].astype(np.int64))], 1)
    return keys[:, None] ^ masks
