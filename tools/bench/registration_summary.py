"""Summarize the errors of many registered pairs, as the benchmarks print them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gsmap.evaluate.registration import PoseError


@dataclass(frozen=True)
class RegistrationSummary:
    """Statistics of many pairs.

    Args:
        num_pairs: pairs with a true pose.
        num_estimated: pairs with an estimated pose.
        mean_rre_deg, mean_rte, mean_rse: plain means over all estimated pairs, including failures (as in GaussReg).
        median_rre_deg, median_centroid_m, worst_rre_deg, worst_centroid_m: medians and maxima over the estimated pairs.
        recall: share of all pairs within each threshold; pairs without an estimate count as missed.
    """

    num_pairs: int
    num_estimated: int
    mean_rre_deg: float
    mean_rte: float
    mean_rse: float
    median_rre_deg: float
    median_centroid_m: float
    worst_rre_deg: float
    worst_centroid_m: float
    recall: dict[str, float]


def summarise(errors: Sequence[PoseError | None]) -> RegistrationSummary:
    """Compute means, medians and recall of many pairs; None represents a pair without an estimate.

    Recall is computed at RRE 5 and 10 degrees, RTE 0.1 and 0.2, and RSE 0.1 and 0.2 (as in GaussReg), and for angle and
    distance together: ``coarse`` (5 degrees, 0.3 m) and ``fine`` (1 degree, 5 cm).
    """
    found = [e for e in errors if e is not None]
    columns = np.array([[e.rre_deg, e.rte, e.rse, e.centroid_m] for e in found]).reshape(-1, 4)
    rre, rte, rse, metres = columns.T

    def share(ok: np.ndarray) -> float:
        return float(ok.sum()) / len(errors) if len(errors) else np.nan

    def over(function: Callable[[np.ndarray], Any], values: np.ndarray) -> float:
        return float(function(values)) if len(values) else np.nan

    return RegistrationSummary(
        num_pairs=len(errors),
        num_estimated=len(found),
        mean_rre_deg=over(np.mean, rre),
        mean_rte=over(np.mean, rte),
        mean_rse=over(np.mean, rse),
        median_rre_deg=over(np.median, rre),
        median_centroid_m=over(np.median, metres),
        worst_rre_deg=over(np.max, rre),
        worst_centroid_m=over(np.max, metres),
        recall={
            "rre_5_deg": share(rre < 5),
            "rre_10_deg": share(rre < 10),
            "rte_0.1": share(rte < 0.1),
            "rte_0.2": share(rte < 0.2),
            "rse_0.1": share(rse < 0.1),
            "rse_0.2": share(rse < 0.2),
            "coarse": share((rre < 5) & (metres < 0.3)),
            "fine": share((rre < 1) & (metres < 0.05)),
        },
    )
