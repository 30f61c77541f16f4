"""Settings of pairwise registration."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, get_args

from gsmap.errors import ConfigError
from gsmap.methods import MethodParams, family
from gsmap.register import evidence, verdict
from gsmap.settings.ranges import require_range

Fallback = Literal["auto", "never", "always"]


@dataclass(frozen=True)
class Params:
    """Settings of pairwise registration.

    Args:
        proposer: Method that proposes poses; ``graph`` finds the maximum clique of compatible correspondences.
        fallback_proposer: Method that proposes poses where a scene graph has few nodes.
        fallback: Condition for using the fallback proposer: ``auto`` (if a scene graph has few nodes), ``never`` or
            ``always``.
        proposers: Settings of each proposer.
        max_poses: Largest number of poses, at least 1, that are refined and verified in each round of proposals, and
            again the largest number of rival poses per accepted pose, and of poses elsewhere under which the surfaces
            are about as similar; a larger value finds more matches and is slower.
        coarse_refiner: Method of the first refinement, which brings a proposed pose near enough to be verified;
            ``none`` skips it.
        refiner: Method of the final refinement: ``colored_icp``, ``gicp``, ``icp`` (as Graph-GSReg) or ``none``.
        refiners: Settings of each refiner.
        polisher: Refiner that runs last, or ``none``; its pose is kept only if local colours agree better after it.
            ``photometric`` aligns renders, which gains nothing where scenes share most views and misleads where they
            share few.
        num_cameras: Largest number of cameras of each scene, at least 1, from which a refined pose is verified; a
            larger value is slower and finds more violations of free space.
        verdict: Thresholds for accepting a pose.
    """

    proposer: str = "graph"
    fallback_proposer: str = "kiss_matcher"
    fallback: Fallback = "auto"
    proposers: MethodParams = field(default_factory=lambda: MethodParams("proposer"))
    max_poses: int = 3
    coarse_refiner: str = "colored_icp"
    refiner: str = "colored_icp"
    refiners: MethodParams = field(default_factory=lambda: MethodParams("refiner"))
    polisher: str = "none"
    num_cameras: int = evidence.NUM_CAMERAS
    verdict: verdict.Params = field(default_factory=verdict.Params)

    def __post_init__(self) -> None:
        require_range(self, "[1, inf]", "max_poses", "num_cameras")
        if self.fallback not in get_args(Fallback):
            raise ConfigError(
                f"fallback must be one of {', '.join(get_args(Fallback))}, got {self.fallback!r}", code="invalid_choice"
            )
        for name in (self.proposer, self.fallback_proposer):
            family("proposer").get(name)
        for name in (self.coarse_refiner, self.refiner, self.polisher):
            family("refiner").get(name)
