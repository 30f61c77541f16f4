"""Quantize local features to visual words with binary signatures: Hamming embedding (Jegou et al. 2008).

A descriptor is reduced by principal components and assigned to its nearest word; the signs of the residual along 64
axes are its signature. Features of one place have the same word and most signs in common. Words, axes and the rate of
chance matches were fitted on synthetic places by ``tools/fit/localize.py`` and are stored beside this file. For
descriptors of other lengths a fixed random vocabulary is used.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files

import numpy as np

VERSION = 1

NUM_SIGNS = 64

_FILE = "vocabulary.npz"
_NUM_RANDOM = 1024
_BLOCK = 4096  # number of descriptors that are compared with all words at the same time


@dataclass(frozen=True, eq=False)
class Vocabulary:
    """A quantizer of descriptors.

    Args:
        mean: (D,) float32 mean of descriptors.
        axes: (D, P) float32 principal axes.
        centres: (W, P) float32 words.
        sign_axes: (P, 64) float32 axes of the signatures.
        chance: (65,) float64 expected number of features of an unrelated scene within each Hamming distance.
    """

    mean: np.ndarray
    axes: np.ndarray
    centres: np.ndarray
    sign_axes: np.ndarray
    chance: np.ndarray

    def reduce(self, descriptors: np.ndarray) -> np.ndarray:
        """Return the (N, P) float32 principal components of unit vectors (N, D)."""
        out: np.ndarray = (descriptors.astype(np.float32) - self.mean) @ self.axes
        return out

    def nearest(self, reduced: np.ndarray, count: int = 1) -> np.ndarray:
        """Return the (N, count) int64 words nearest to reduced descriptors, nearest first."""
        half = (self.centres**2).sum(1) / 2
        out = np.empty((len(reduced), count), np.int64)
        for start in range(0, len(reduced), _BLOCK):
            distance = half - reduced[start : start + _BLOCK] @ self.centres.T
            for k in range(count):  # repeated minima are ten times faster than sorting
                near = distance.argmin(1)
                out[start : start + _BLOCK, k] = near
                distance[np.arange(len(distance)), near] = np.inf
        return out

    def signatures(self, reduced: np.ndarray, words: np.ndarray) -> np.ndarray:
        """Return (N,) uint64: the signs of the residuals of reduced descriptors from one word each."""
        left = (reduced - self.centres[words]) @ self.sign_axes
        return np.packbits(left > 0, axis=1).view("<u8")[:, 0]


@lru_cache(maxsize=4)
def load_vocabulary(width: int) -> Vocabulary:
    """Load the vocabulary for descriptors of ``width`` numbers."""
    path = files("gsmap.localize") / _FILE
    if path.is_file():
        with path.open("rb") as file, np.load(file) as stored:
            if stored["mean"].shape == (width,):
                centres = stored["centres"].astype(np.float32) * stored["step"]
                mean, axes, sign_axes = (stored[name].astype(np.float32) for name in ("mean", "axes", "turned"))
                return Vocabulary(mean, axes, centres, sign_axes, stored["chance"].astype(np.float64))
    return random_vocabulary(width)


def random_vocabulary(width: int) -> Vocabulary:
    """Return a vocabulary with random words for descriptors of ``width`` numbers."""
    rng = np.random.default_rng([width, 11])
    axes = np.linalg.qr(rng.normal(size=(width, min(NUM_SIGNS, width))))[0].astype(np.float32)
    centres = rng.normal(size=(_NUM_RANDOM, axes.shape[1])).astype(np.float32)
    centres *= 0.25 / np.linalg.norm(centres, axis=1, keepdims=True)
    mean, chance = np.zeros(width, np.float32), np.zeros(NUM_SIGNS + 1)
    return Vocabulary(mean, axes, centres, random_sign_axes(axes.shape[1]), chance)


def random_sign_axes(num_axes: int) -> np.ndarray:
    """Return the (P, 64) float32 random axes of signatures, orthogonal in groups of P."""
    rng = np.random.default_rng([num_axes, 13])
    parts = [np.linalg.qr(rng.normal(size=(num_axes, num_axes)))[0] for _ in range(-(-NUM_SIGNS // num_axes))]
    out: np.ndarray = np.concatenate(parts, axis=1)[:, :NUM_SIGNS].astype(np.float32)
    return out
