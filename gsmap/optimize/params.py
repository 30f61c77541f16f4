"""Settings of the pose-graph optimization; importing them loads no solver."""

from __future__ import annotations

from dataclasses import dataclass

from gsmap.errors import ConfigError


@dataclass(frozen=True)
class Params:
    """Settings of `gsmap.optimize.optimize`.

    Args:
        gate_probability: Quantile in (0, 1) of the chi-square distribution up to which an edge or a cycle of edges is
            consistent; larger accepts edges that are further off.
        marginals: Compute the marginal covariance of every scene pose; without it the solve is quicker.
        max_growth: Fraction, at least 0, by which a large map may grow since its last full solve while new scenes are
            placed one by one; 0 always solves in full, and larger solves in full less often.
        max_full_scenes: Number of scenes, at least 0, up to which a map is always solved in full, so that its poses do
            not depend on the order in which the scenes came; larger is slower and more accurate.
        max_marginal_scenes: Number of scenes, at least 0, up to which a component gets covariances; they take 1 ms a
            scene at 1,000 scenes and 8 ms at 10,000.
        min_large_component: Number of scenes, at least 1, from which a component is large: smaller ones may be
            attached by a single edge, and a larger value attaches more scenes by single edges.
        min_bridge_edges: Number of agreeing edges, at least 1, over as many scene pairs, that it takes to join two
            large components without a confirmed edge; larger joins fewer components.
        min_wrong_probability: Probability in (0, 1) from which one edge, or set of edges, of a contradictory loop is
            rejected; below it all suspects are left undecided, so larger leaves more edges undecided.
        max_disagreement: Fraction in (0, 1) of the surface seen by both captures of an edge that may disagree before
            the edge is doubtful; larger trusts edges between places that look alike. Unchanged places with doors shut
            between captures reach 0.064, look-alikes with different furniture begin at 0.145.
        same_visit_h: Hours, at least 0, within which two captures count as one visit, between which nothing changes;
            larger refuses more edges between captures that disagree.
        max_tilt_deg: Tilt in degrees, at least 0, up to which a component is not turned upright after the solve;
            larger turns fewer components.
        max_unchanged_sigmas: Standard deviations, at least 0, up to which a scene keeps the pose of the previous
            revision; larger keeps more poses, and 0 keeps a pose only where rounding moved it.
    """

    gate_probability: float = 0.999
    marginals: bool = True
    max_growth: float = 0.1
    max_full_scenes: int = 500
    max_marginal_scenes: int = 3000
    min_large_component: int = 3
    min_bridge_edges: int = 3
    min_wrong_probability: float = 0.9
    max_disagreement: float = 0.1
    same_visit_h: float = 6.0
    max_tilt_deg: float = 5.0
    max_unchanged_sigmas: float = 1e-3

    def __post_init__(self) -> None:
        for name in ("gate_probability", "min_wrong_probability", "max_disagreement"):
            if not 0 < getattr(self, name) < 1:
                raise ConfigError(f"{name} must lie between 0 and 1, got {getattr(self, name)}", code="out_of_range")
        for name in (
            "max_growth",
            "max_full_scenes",
            "max_marginal_scenes",
            "same_visit_h",
            "max_tilt_deg",
            "max_unchanged_sigmas",
        ):
            if not getattr(self, name) >= 0:
                raise ConfigError(f"{name} must be at least 0, got {getattr(self, name)}", code="out_of_range")
        for name in ("min_large_component", "min_bridge_edges"):
            if not getattr(self, name) >= 1:
                raise ConfigError(f"{name} must be at least 1, got {getattr(self, name)}", code="out_of_range")
