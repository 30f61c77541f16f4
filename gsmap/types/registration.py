"""The result of registering a pair of scenes, and the proposed poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from gsmap.errors import InputError
from gsmap.reason_codes import reason_code
from gsmap.types.sim3 import Sim3

STATUSES = ("accepted", "rejected", "no_match")
DEFORMATION_NOTES = "one capture is bent: ", "one capture is stretched: "
"""Beginnings of the notes on edges that no rigid pose aligns."""


class Support(Protocol):
    """The correspondences of a proposal, and all candidate correspondences, by which any pose of the pair is scored."""

    @property
    def points(self) -> tuple[np.ndarray, np.ndarray]:
        """Corresponding points of the target (K, 3) and the source (K, 3), each in the unit of its scene."""

    def count(self, S_target_source: Sim3) -> tuple[int, float]:
        """Return the number of inliers of a pose (in the scenes' own units) and the log10 of its number of false
        alarms.
        """

    def rival(self, S_target_source: Sim3, log_nfa: float, others: Sequence[Sim3] = ()) -> Proposal | None:
        """Return a rival pose with about as many inliers that differs from all of ``others``; None without one."""


@dataclass(frozen=True, eq=False)
class Proposal:
    """A proposed pose of a pair of scenes, before refinement and verification.

    Args:
        proposer: method and node layer, such as ``graph:landmarks``.
        S_target_source: the pose, in the scenes' own units.
        with_scale: true if the scale is free; else it is about 1, with both scenes in metres.
        num_inliers: number of inliers.
        num_correspondences: number of candidate correspondences; 0 if not counted.
        exact: true if the clique search proved its result largest.
        log_nfa: log10 of the number of false alarms; NaN if not counted.
        runner_up: size of the best set of inliers of a rival pose, relative to this one's; 0 if there is none, NaN if
            none was searched.
        flaw: reason why the pose cannot be used, or empty.
        support: the correspondences; None where there are none.
    """

    proposer: str
    S_target_source: Sim3
    with_scale: bool
    num_inliers: int
    num_correspondences: int = 0
    exact: bool = True
    log_nfa: float = float("nan")
    runner_up: float = float("nan")
    flaw: str = ""
    support: Support | None = None


@dataclass(frozen=True, eq=False)
class RegisteredPose:
    """The pose of a source scene in the frame of a target scene, as registration found it.

    Args:
        target, source: scene ids.
        status: ``accepted`` (use it), ``rejected`` (a pose was found and contradicted), ``no_match`` (no pose).
        reason: one short sentence; may be empty if accepted.
        S_target_source: the pose; None if none was found.
        information: (7, 7) float64 SPD over the tangent [rot_rad (3), trans (3), log_scale] applied on the source
            side (``S = S_hat * Exp(xi)``, gtsam's order, translation in the source's unit); that of a rigid edge says
            how surely its scale is 1.
        num_inliers: number of inliers.
        num_correspondences: number of candidate correspondences.
        overlap: fraction of the smaller scene's surface that coincides, in [0, 1].
        proposer: which method's pose it is, and what that rests on: ``graph:landmarks``, ``graph:objects``,
            ``kiss_matcher``; ``manual`` where a person measured it; empty where there is none.
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


@dataclass(frozen=True, eq=False)
class Registration(RegisteredPose):
    """The registration of a source scene in the frame of a target scene.

    Args:
        exact: true if the clique search proved its result largest.
        seconds: wall seconds by step (``match``, ``refine``, ``verdict``; ``fallback`` and ``polish`` where they ran).
        evidence: the figures that the verdict rests on, those of the best pose; empty where no pose was proposed. By
            name, all of them floats:

            ``log_nfa``: log10 of the number of false alarms of the correspondences under this pose (a-contrario; below
            -2 the background model is no explanation); NaN where the proposer counts none.
            ``runner_up``: size of the largest clique that disagrees with the pose, as a share of the pose's own; NaN
            where none was sought.
            ``free_space_violation``: share, in [0, 1], of the surface Gaussians of one scene that the cameras of the
            other could judge and that stand in front of what these saw; the larger of both directions; NaN without
            cameras.
            ``num_seen``: count of Gaussians so judged, the smaller of both directions.
            ``num_judged``: count of Gaussians so judged in the direction that ``free_space_violation`` is of.
            ``num_coinciding``: count of cells of the source's surface that lie on the target's.
            ``colour_correlation``: correlation, in [-1, 1], of local colours where both scenes show the same surface.
            ``colour_t``: its significance, in standard deviations over patches.
            ``probability``: that the pose is right, and not another that was judged, of all evidence together, as far
            as captures of made places tell (`gsmap.register.probability`); NaN where nothing was measured.
            ``similarity``: Fisher's transform of the correlation of the colours of both surfaces, cell by cell; NaN
            where they have too little in common.
            ``look_alike``: the probability that the pair shows two places that look alike, as ``probability`` takes
            into account; NaN if neither ``similarity`` nor ``free_space_violation`` is known.
            ``disagreement``: of the surface that both saw, as area, the share that is not the same in both: one looked
            through it, or shows another pattern on it; NaN without cameras.
            ``seen_m2``: that surface, in square metres.
            ``log_scale``: natural logarithm of the scale as the surfaces measure it: that of the pose only where
            the pose is not rigid; NaN where too little coincides to measure it.
            ``log_scale_sigma``: its standard deviation.
        notes: remarks on how it was computed (a package that is missing, ...).
    """

    exact: bool = True
    seconds: dict[str, float] = field(default_factory=dict)
    evidence: dict[str, float] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.status not in STATUSES:
            raise InputError(
                f"registration status must be one of {', '.join(STATUSES)}, got {self.status!r}", code="invalid_choice"
            )
        if self.status == "accepted" and (self.S_target_source is None or self.information is None):
            raise InputError(
                "an accepted registration needs a pose and an information matrix", code="invalid_registration"
            )

    @property
    def reason_code(self) -> str:
        """Code of the reason, a key of `gsmap.reason_codes.REASONS`; empty without a reason."""
        return reason_code(self.reason)

    @property
    def scale(self) -> float | None:
        return None if self.S_target_source is None else self.S_target_source.scale
