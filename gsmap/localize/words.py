"""Words for local features, and what else tells features of one word apart: Hamming embedding (Jegou et al. 2008).

A descriptor, shortened by principal components, goes to its nearest word; the signs of what is left over along 64 axes
are its signature. Features of one place of a surface share words and most signs. Words, axes, and how often features of
other places come so near are fitted on made places by ``tools/fit/localize.py`` and lie beside this file; for
extractors that none were fitted for, they are drawn at random, always the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files

import numpy as np

VERSION = 1

NUM_SIGNS = 64

_FILE = "words.npz"
_NUM_RANDOM = 1024
_BLOCK = 4096  # descriptors that are compared with all words at a time


@dataclass(frozen=True, eq=False)
class Words:
    """How features become words and signatures.

    Args:
        mean: (D,) float32 of descriptors.
        axes: (D, P) float32 their principal axes.
        centres: (W, P) float32 the words.
        turned: (P, 64) float32 axes whose signs are kept.
        chance: (65,) float64 how many features of a scene that shows something else come so near, by the signs that
            differ at most.
    """

    mean: np.ndarray
    axes: np.ndarray
    centres: np.ndarray
    turned: np.ndarray
    chance: np.ndarray

    def shortened(self, descriptors: np.ndarray) -> np.ndarray:
        """(N, P) float32 of unit vectors (N, D)."""
        out: np.ndarray = (descriptors.astype(np.float32) - self.mean) @ self.axes
        return out

    def nearest(self, short: np.ndarray, count: int = 1) -> np.ndarray:
        """(N, count) int64 words of shortened descriptors, nearest first."""
        half = (self.centres**2).sum(1) / 2
        out = np.empty((len(short), count), np.int64)
        for start in range(0, len(short), _BLOCK):
            farness = half - short[start : start + _BLOCK] @ self.centres.T
            for k in range(count):  # a few times the nearest: sorting so many would take ten times as long
                near = farness.argmin(1)
                out[start : start + _BLOCK, k] = near
                farness[np.arange(len(farness)), near] = np.inf
        return out

    def signatures(self, short: np.ndarray, words: np.ndarray) -> np.ndarray:
        """(N,) uint64 the signs of what is left of shortened descriptors, beside a word of each."""
        left = (short - self.centres[words]) @ self.turned
        return np.packbits(left > 0, axis=1).view("<u8")[:, 0]


@lru_cache(maxsize=4)
def words_for(width: int) -> Words:
    """The words for descriptors of so many numbers."""
    path = files("gsmap.localize") / _FILE
    if path.is_file():
        with path.open("rb") as file, np.load(file) as stored:
            if stored["mean"].shape == (width,):
                centres = stored["centres"].astype(np.float32) * stored["step"]
                mean, axes, turned = (stored[name].astype(np.float32) for name in ("mean", "axes", "turned"))
                return Words(mean, axes, centres, turned, stored["chance"].astype(np.float64))
    return random_words(width)


def random_words(width: int) -> Words:
    """Words that fit any descriptors of so many numbers a little."""
    rng = np.random.default_rng([width, 11])
    axes = np.linalg.qr(rng.normal(size=(width, min(NUM_SIGNS, width))))[0].astype(np.float32)
    centres = rng.normal(size=(_NUM_RANDOM, axes.shape[1])).astype(np.float32)
    centres *= 0.25 / np.linalg.norm(centres, axis=1, keepdims=True)
    return Words(np.zeros(width, np.float32), axes, centres, turned_axes(axes.shape[1]), np.zeros(NUM_SIGNS + 1))


def turned_axes(num_axes: int) -> np.ndarray:
    """(P, 64) float32 orthogonal axes, as far as there are so many, that mix all of the shortened ones."""
    rng = np.random.default_rng([num_axes, 13])
    parts = [np.linalg.qr(rng.normal(size=(num_axes, num_axes)))[0] for _ in range(-(-NUM_SIGNS // num_axes))]
    out: np.ndarray = np.concatenate(parts, axis=1)[:, :NUM_SIGNS].astype(np.float32)
    return out
