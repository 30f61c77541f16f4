"""Quantize vectors to integer codes, and assign the codes to inverted lists by the signs of their first axes.

In float32, sums of integers of this size are exact in any order, so every machine finds the same neighbours.
"""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path

import numpy as np

AXES = Path(__file__).with_name("axes.npz")
"""File with the mean and the principal axes of the built-in descriptors, by dimension (`tools/fit/retrieve.py`)."""

NUM_DIMS = 48  # of a code
SCALE = 200  # factor on the components of a unit vector; the few components beyond 127 / 200 are clipped
NUM_SIGNS = 6  # number of axes whose signs select a list: 64 lists for every type of node


def encode(vectors: np.ndarray) -> np.ndarray:
    """Return the (M, NUM_DIMS) int8 codes of (M, D) unit vectors; distances of codes are larger by the factor
    `SCALE`."""
    mean, axes = _axes(vectors.shape[1])
    along = (vectors.astype(np.float64) - mean) @ axes
    return np.clip(np.rint(along * SCALE), -127, 127).astype(np.int8)


def similarity(squared: np.ndarray) -> np.ndarray:
    """Return the cosines between vectors from the squared distances of their codes."""
    return 1.0 - squared / (2.0 * SCALE**2)


@cache
def _axes(dim: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the (dim,) mean and (dim, NUM_DIMS) axes: fitted axes, the identity, or seeded random axes."""
    with np.load(AXES) as stored:
        if f"{dim}.mean" in stored:
            fitted = stored[f"{dim}.axes"].astype(np.float64)
            return stored[f"{dim}.mean"].astype(np.float64), np.pad(fitted, ((0, 0), (0, NUM_DIMS - fitted.shape[1])))
    if dim <= NUM_DIMS:
        return np.zeros(dim), np.eye(dim, NUM_DIMS)
    random = np.random.Generator(np.random.PCG64([dim, NUM_DIMS])).standard_normal((dim, NUM_DIMS))
    return np.zeros(dim), np.linalg.qr(random)[0] * np.sqrt(dim / NUM_DIMS)


def space(descriptor_id: str, *, second: bool) -> int:
    """Return the prefix of the keys of lists: 31 bits of a descriptor's digest.

    Args:
        second: the vectors are the additional, gravity-free vectors of a scene with known gravity.
    """
    digest = hashlib.sha256(f"{descriptor_id} {int(second)}".encode()).digest()
    return int.from_bytes(digest[:4], "little") >> 1


def keys_of(space_number: int, types: np.ndarray, codes: np.ndarray) -> np.ndarray:
    """Return the (M,) int64 list of each node, given by its descriptor, its type and the signs of its first axes."""
    return with_signs((np.int64(space_number) << 32) | ((types.astype(np.int64) & 0xFFFFFF) << 8), codes)


def with_signs(keys: np.ndarray, codes: np.ndarray) -> np.ndarray:
    """Replace the signs in keys (M,) by the signs of the codes."""
    signs = (codes[:, :NUM_SIGNS] >= 0) @ (1 << np.arange(NUM_SIGNS))
    return (keys & ~np.int64(0xFF)) | signs


def probes(keys: np.ndarray, codes: np.ndarray, num_flipped: int) -> np.ndarray:
    """Return the (M, 2 ** num_flipped) int64 lists to search: each of the least certain signs is both kept and
    flipped."""
    unsure = np.argsort(np.abs(codes[:, :NUM_SIGNS].astype(np.int16)), axis=1, kind="stable")[:, :num_flipped]
    masks = np.zeros((len(keys), 1), dtype=np.int64)
    for column in range(unsure.shape[1]):
        masks = np.concatenate([masks, masks ^ (np.int64(1) << unsure[:, column : column + 1].astype(np.int64))], 1)
    return keys[:, None] ^ masks
