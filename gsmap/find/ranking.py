"""Places ranked by what is asked: by the likeness of things, or by the cosine of embeddings."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gsmap.find.likeness import Look, Model, differences


def by_likeness(
    asked: Sequence[Look], shown: Sequence[Sequence[Look]], model: Model | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """How probably each of some objects is of one kind with one that is asked for.

    Captures see things from one side, or in part: what counts is the best match of any sighting of the one with any of
    the other.

    Args:
        asked: what the captures show of the one that is asked for.
        shown: of each object what they show of it.

    Returns:
        (N,) probabilities where as many are of one kind as are not, and (N,) which sighting of each object matched; 0
        and -1 where nothing is known of it.
    """
    model = model or Model.load()
    owner = np.repeat(np.arange(len(shown)), [len(looks) for looks in shown])
    flat = [look for looks in shown for look in looks]
    odds = np.full(len(flat), -np.inf)
    for look in asked:
        odds = np.maximum(odds, model.log_odds(differences(look, flat)))
    scores, best = best_of(odds, owner, len(shown))
    first = np.concatenate([[0], np.cumsum([len(looks) for looks in shown])[:-1]]).astype(np.int64)
    with np.errstate(over="ignore"):
        return 1.0 / (1.0 + np.exp(-scores)), np.where(best < 0, -1, best - first)


def cosines(asked: np.ndarray, told: np.ndarray, embeddings: np.ndarray) -> np.ndarray:
    """(M,) cosine of one vector (F,) with each of some (M, F), over the entries that are told of it (F,) bool."""
    a, b = np.where(told, asked, 0.0).astype(np.float64), np.where(told, embeddings, 0.0).astype(np.float64)
    norms = np.linalg.norm(a) * np.linalg.norm(b, axis=1)
    out: np.ndarray = np.where(norms > 0, b @ a / np.where(norms > 0, norms, 1.0), -1.0)
    return out


def best_of(scores: np.ndarray, owner: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The best score of each of ``count`` owners (-inf for one without any), and its row (-1); equals: the first."""
    order = np.lexsort((np.arange(len(scores)), -scores, owner))
    owners, first = np.unique(owner[order], return_index=True)
    best, row = np.full(count, -np.inf), np.full(count, -1, np.int64)
    best[owners], row[owners] = scores[order[first]], order[first]
    return best, row
