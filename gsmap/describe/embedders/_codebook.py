"""Codebooks that depend on no data."""

from __future__ import annotations

import numpy as np


def random_codebook(seed: int, words: int, dim: int) -> np.ndarray:
    """(words, dim) unit vectors in random directions: a codebook that depends on no data."""
    directions = np.random.default_rng(seed).normal(size=(words, dim))
    return (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)
