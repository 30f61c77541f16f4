"""Rank objects for a query, by similarity of segments or by cosine similarity of embeddings."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gsmap.find.similarity import SegmentDescriptor, SimilarityModel, differences

_PRIOR, _WEIGHT = 0.05, 20  # share of objects that are of one kind, and the number of objects that it counts as
_STEPS = 20


def rank_by_similarity(
    query: Sequence[SegmentDescriptor], objects: Sequence[Sequence[SegmentDescriptor]]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the probability, for each object, that it is of the same kind as the query object.

    Captures may show only one side or a part of an object, so the best match of any observation of the query with any
    observation of the object counts.

    Args:
        query: observations of the query object.
        objects: observations of each object.

    Returns:
        The (N,) probabilities, see `calibrated`, and the (N,) index of each object's observation that matched best; 0
        and -1 for objects without observations.
    """
    model = SimilarityModel.load()
    owner = np.repeat(np.arange(len(objects)), [len(observations) for observations in objects])
    flat = [one for observations in objects for one in observations]
    odds = np.full(len(flat), -np.inf)
    for one in query:
        odds = np.maximum(odds, model.log_odds(differences(one, flat)))
    scores, best = best_per_owner(odds, owner, len(objects))
    first = np.concatenate([[0], np.cumsum([len(observations) for observations in objects])[:-1]]).astype(np.int64)
    return calibrated(scores), np.where(best < 0, -1, best - first)


def calibrated(log_odds: np.ndarray) -> np.ndarray:
    """Return (N,) probabilities from log-odds at a prior of 0.5, by the prior that the objects of this map suggest.

    Few objects of a place are of one kind, so most of those that score 0.87 at even odds are not. The prior is the mean
    of the probabilities that it leads to, found by iteration (Saerens et al. 2002, "Adjusting the outputs of a
    classifier to new a priori probabilities"), held near one in twenty where there are few objects.
    """
    prior = _PRIOR
    for _ in range(_STEPS):
        with np.errstate(over="ignore"):
            found: np.ndarray = 1.0 / (1.0 + np.exp(-log_odds) * (1.0 - prior) / prior)
        prior = (_PRIOR * _WEIGHT + float(found.sum())) / (_WEIGHT + len(found))
    return found


def cosine_similarities(query: np.ndarray, valid: np.ndarray, embeddings: np.ndarray) -> np.ndarray:
    """Return the (M,) cosines between a vector (F,) and vectors (M, F), over the entries in the mask ``valid`` (F,)."""
    a, b = np.where(valid, query, 0.0).astype(np.float64), np.where(valid, embeddings, 0.0).astype(np.float64)
    norms = np.linalg.norm(a) * np.linalg.norm(b, axis=1)
    out: np.ndarray = np.where(norms > 0, b @ a / np.where(norms > 0, norms, 1.0), -1.0)
    return out


def best_per_owner(scores: np.ndarray, owner: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the best score of each owner and the row of that score; -inf and -1 without any. Of equal scores the first
    counts."""
    order = np.lexsort((np.arange(len(scores)), -scores, owner))
    owners, first = np.unique(owner[order], return_index=True)
    best, row = np.full(count, -np.inf), np.full(count, -1, np.int64)
    best[owners], row[owners] = scores[order[first]], order[first]
    return best, row
