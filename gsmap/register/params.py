"""How a pair is registered."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, get_args

from gsmap.errors import ConfigError
from gsmap.methods import MethodParams, family
from gsmap.register import covariance, evidence, metres, surface, verdict, view_cache
from gsmap.register.refiners import colored_icp

Fallback = Literal["auto", "never", "always"]


@dataclass(frozen=True)
class SamePose:
    """Which poses count as one: both would be refined to one answer.

    Args:
        rotation_deg: rotations that differ by less are the same.
        distance_m: the same for where the middle of the source's content comes to lie.
        log_scale: the same for the logarithm of the scale.
    """

    rotation_deg: float = 3.0
    distance_m: float = 0.3
    log_scale: float = 0.02


@dataclass(frozen=True)
class Snap:
    """When a voted scale is near enough 1 for two scenes that may be in metres to be taken so while they are refined.

    Args:
        log_scale: logarithms of scales smaller than this are near enough ...
        log_scale_spread: ... plus this over the square root of the number of correspondences.
    """

    log_scale: float = 0.005
    log_scale_spread: float = 0.05


def _coarse() -> MethodParams:
    rough = colored_icp.Params((0.4, 0.15), max_points=(3000, 6000), tolerance=0.02, last_tolerance=0.01)
    return MethodParams("refiner", (("colored_icp", rough),))


def _fine() -> MethodParams:
    return MethodParams("refiner", (("colored_icp", colored_icp.Params((0.06, 0.03), max_points=(10_000, 40_000))),))


@dataclass(frozen=True)
class Params:
    """How a pair is registered.

    Args:
        proposer: proposes poses; ``graph``: by the maximum clique of compatible correspondences.
        fallback_proposer: is asked for poses where that one suggests nothing sure.
        fallback: when: ``auto`` where a graph is poor, ``never``, ``always``.
        poor_nodes: a graph none of whose layers has this many nodes is poor.
        proposers: settings of each proposer.
        max_poses: poses that are refined and judged at most in each round of proposals (rigid, scaled, without a
            vertical, fallback), and rivals at most of an accepted pose that is not significant by itself.
        min_explained: share, in [0, 1], of the correspondences that agree with a proposed pose that must agree with the
            refined one; with fewer the proposed pose is judged in its place. 0 always judges the refined pose.
        prescreen_log_nfa: a clique that the background model explains this easily (log10 of the number of false
            alarms) is not looked into.
        coarse_refiner: brings a proposed pose near enough to be looked at (``none``: it stays as it is).
        coarse_refiners: settings of each refiner for that pass.
        refiner: refines what passes the prescreen: ``colored_icp``, ``gicp``, ``icp`` (as Graph-GSReg), ``none``.
        scale_refiner: takes the place of a coarse or fine refiner that cannot refine the scale, for pairs of unknown
            scale.
        refiners: settings of each refiner.
        polisher: a refiner whose pose is kept only where local colours then agree better; ``photometric`` lays renders
            over each other, which wins nothing where scenes share most views, and misleads where they share few.
        same_pose: which poses count as one.
        snap: when a pair with a voted scale is refined in the scenes' own metres, not in guessed ones.
        surface: which Gaussians are surface.
        views: how scenes are seen through their cameras.
        prescreen: the comparison under the roughly refined pose that decides whether to go on.
        evidence: the comparison under the refined pose.
        covariance: how well the pose is known.
        metres: what a measured scale says of two sources that may both be in metres.
        verdict: the bars that a pose must clear.
    """

    proposer: str = "graph"
    fallback_proposer: str = "kiss_matcher"
    fallback: Fallback = "auto"
    poor_nodes: int = 500
    proposers: MethodParams = field(default_factory=lambda: MethodParams("proposer"))
    max_poses: int = 3
    min_explained: float = 0.5
    prescreen_log_nfa: float = 6.0
    coarse_refiner: str = "colored_icp"
    coarse_refiners: MethodParams = field(default_factory=_coarse)
    refiner: str = "colored_icp"
    scale_refiner: str = "colored_icp"
    refiners: MethodParams = field(default_factory=_fine)
    polisher: str = "none"
    same_pose: SamePose = field(default_factory=SamePose)
    snap: Snap = field(default_factory=Snap)
    surface: surface.Params = field(default_factory=surface.Params)
    views: view_cache.Params = field(default_factory=view_cache.Params)
    prescreen: evidence.Params = field(default_factory=lambda: evidence.Params(num_cameras=3, max_points=4000))
    evidence: evidence.Params = field(default_factory=evidence.Params)
    covariance: covariance.Params = field(default_factory=covariance.Params)
    metres: metres.Params = field(default_factory=metres.Params)
    verdict: verdict.Params = field(default_factory=verdict.Params)

    def __post_init__(self) -> None:
        if self.fallback not in get_args(Fallback):
            raise ConfigError(
                f"fallback must be one of {', '.join(get_args(Fallback))}, got {self.fallback!r}", code="invalid_choice"
            )
        for name in (self.proposer, self.fallback_proposer):
            family("proposer").get(name)
        for name in (self.coarse_refiner, self.refiner, self.scale_refiner, self.polisher):
            family("refiner").get(name)
        if not family("refiner").get(self.scale_refiner).SCALES:
            raise ConfigError(
                f"scale_refiner must be one that can refine the scale, {self.scale_refiner!r} cannot",
                code="setting_mismatch",
            )
