"""One vector for what a picture shows: VLAD (Jegou et al. 2010) of its local features, whitened and shortened.

Each feature, shortened by principal components, goes to its nearest word; the residuals of a word are added up and
normalised (Arandjelovic and Zisserman 2013), and the whole is projected to what tells pictures apart. Words and
projections are fitted on made places by ``tools/fit_localize.py`` and lie beside this file; for extractors that none
were fitted for, they are drawn at random, always the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files

import numpy as np

VERSION = 1

_FILE = "vocabulary.npz"
_WORDS, _SHORT, _LENGTH = 64, 32, 256


@dataclass(frozen=True, eq=False)
class Vocabulary:
    """How features become a vector.

    Args:
        mean: (D,) float32 of descriptors.
        axes: (D, P) float32 their principal axes.
        words: (K, P) float32.
        centre: (K P,) float32 of the vectors of pictures.
        whitening: (K P, S) float32.
    """

    mean: np.ndarray
    axes: np.ndarray
    words: np.ndarray
    centre: np.ndarray
    whitening: np.ndarray

    def residuals(self, descriptors: np.ndarray) -> np.ndarray:
        """(K P,) normalised residuals of a picture's descriptors (N, D); zeros of none."""
        short = (descriptors - self.mean) @ self.axes
        word = np.argmax(2 * short @ self.words.T - (self.words**2).sum(1), axis=1)
        sums = np.zeros_like(self.words)
        np.add.at(sums, word, short - self.words[word])
        sums /= np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-9)
        out: np.ndarray = sums.ravel() / max(float(np.linalg.norm(sums)), 1e-9)
        return out

    def summary(self, descriptors: np.ndarray) -> np.ndarray:
        """(S,) unit vector."""
        found = (self.residuals(descriptors) - self.centre) @ self.whitening
        out: np.ndarray = found / max(float(np.linalg.norm(found)), 1e-9)
        return out


def summarised(descriptors: np.ndarray) -> np.ndarray:
    """(S,) int8: what pictures are compared by, from the descriptors (N, D) of their features."""
    found = vocabulary(descriptors.shape[1]).summary(descriptors)
    # Parts of a unit vector of 256 are about a sixteenth: a quarter is four times that.
    out: np.ndarray = np.clip(np.round(found * 508), -127, 127).astype(np.int8)
    return out


@lru_cache(maxsize=4)
def vocabulary(width: int) -> Vocabulary:
    """The words for descriptors of so many numbers."""
    path = files("gsmap.localize") / _FILE
    if path.is_file():
        with path.open("rb") as file, np.load(file) as stored:
            if stored["mean"].shape == (width,):
                whitening = stored["whitening"].astype(np.float32) * stored["steps"]
                return Vocabulary(
                    *(stored[name].astype(np.float32) for name in ("mean", "axes", "words", "centre")), whitening
                )
    return random_vocabulary(width)


def random_vocabulary(width: int) -> Vocabulary:
    """Words and projections that fit any descriptors of so many numbers a little."""
    rng = np.random.default_rng([width, 7])
    axes = np.linalg.qr(rng.normal(size=(width, min(_SHORT, width))))[0].astype(np.float32)
    words = rng.normal(size=(_WORDS, axes.shape[1])).astype(np.float32)
    words *= 0.5 / np.linalg.norm(words, axis=1, keepdims=True)
    whitening = rng.normal(size=(words.size, _LENGTH)).astype(np.float32)
    return Vocabulary(np.zeros(width, np.float32), axes, words, np.zeros(words.size, np.float32), whitening)
