"""The result of registering one pair of scenes."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from gsmap.errors import InputError
from gsmap.types.sim3 import Sim3

STATUSES = ("accepted", "rejected", "no_match")


@dataclass(frozen=True, eq=False)
class Registration:
    """What is known of how ``source`` lies in ``target``.

    Args:
        target, source: scene ids.
        status: ``accepted`` (use it), ``rejected`` (a pose was found and contradicted), ``no_match`` (no pose).
        reason: one short sentence for people; empty when accepted without remark.
        S_target_source: the pose; None unless one was found. Never identity for "I don't know".
        information: (7, 7) float64 SPD over the tangent [rot_rad (3), trans (3), log_scale] applied on the source
            side (``S = S_hat * Exp(xi)``, gtsam's order, translation in the source's unit); a rigid edge carries a
            stiff scale row.
        num_inliers: size of the accepted set of correspondences.
        num_correspondences: candidates it was chosen from.
        overlap: share of the smaller scene's surface that coincides, in [0, 1].
        proposer: which proposal won (``landmarks``, ``objects``, ``kiss_matcher``), or ``manual``: a person's own
            measurement.
        exact: whether the clique search proved its answer largest.
        seconds: wall seconds by step (``match``, ``refine``, ``verdict``).
        evidence: the figures the verdict rests on, by name (logNFA, runner-up ratio, ...).
        notes: what a person should know (a package that was missing, a covariance that was guessed, ...).
    """

    target: str
    source: str
    status: str
    reason: str = ""
    S_target_source: Sim3 | None = None
    information: np.ndarray | None = None
    num_inliers: int = 0
    num_correspondences: int = 0
    overlap: float = 0.0
    proposer: str = ""
    exact: bool = True
    seconds: dict[str, float] = field(default_factory=dict)
    evidence: dict[str, float] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.status not in STATUSES:
            raise InputError(f"registration status must be one of {', '.join(STATUSES)}, got {self.status!r}")
        if self.status == "accepted" and (self.S_target_source is None or self.information is None):
            raise InputError("an accepted registration needs a pose and an information matrix")

    @property
    def scale(self) -> float | None:
        return None if self.S_target_source is None else self.S_target_source.scale
