"""Compute the probability that an aligned pair shows two places that look alike, rather than one place.

Walls, floors and pictures of two flats of one make agree exactly; only what stands in them differs, as in one flat that
was refurnished. Correspondences and overlap do not distinguish both. The surface that one capture has in the free space
of the other and the similarity of the colours of cells (`gsmap.register.repetition`) do: in a place that changed in
part, the rest agrees; in two flats of one make, no furniture does. A place that was refurnished entirely cannot be told
from another one, and counts as another.

The weights come from a logistic regression on synthetic flats and streets (`tools.fit.look_alike`).
"""

from __future__ import annotations

import numpy as np

from gsmap.register.evidence import PoseEvidence

PRIOR = 0.1
"""Share of pairs that show two places, among all pairs whose surfaces align, before any evidence."""

WEIGHTS = {(True, True): (17.0, -8.9, 3.4), (True, False): (8.7, -9.6), (False, True): (10.3, 3.8)}
"""Natural log-odds of two places, by which `features` are known: a constant and their weights."""

_LEAST = 0.003  # smaller shares in free space are noise of rendering


def features(similarity: float, free_space_violation: float) -> np.ndarray:
    """Return the (2,) pieces of evidence that the weights multiply; NaN where one is unknown."""
    return np.array([similarity, np.log(free_space_violation + _LEAST)])


def look_alike_probability(evidence: PoseEvidence, similarity: float) -> float:
    """Return the probability that an aligned pair shows two places; NaN if neither piece is known.

    Args:
        evidence: the evidence under the pose.
        similarity: similarity of both surfaces under the pose (`gsmap.register.repetition`); NaN if unknown.
    """
    pieces = features(similarity, evidence.free_space_violation)
    known = np.isfinite(pieces)
    weights = WEIGHTS.get((bool(known[0]), bool(known[1])))
    if weights is None:
        return float("nan")
    log_odds = np.log(PRIOR / (1 - PRIOR)) + weights[0] + pieces[known] @ np.array(weights[1:])
    return float(1 / (1 + np.exp(-log_odds)))
