"""Settings of the pose-graph optimization, in a module of their own that loads no solver."""

from __future__ import annotations

from dataclasses import dataclass

from gsmap.settings.ranges import require_range


@dataclass(frozen=True)
class Params:
    """Settings of `gsmap.optimize.optimize`.

    Args:
        gate_probability: Quantile in (0, 1) of the chi-square distribution up to which the residual of an edge or of a
            cycle of edges is consistent; larger accepts larger residuals.
        marginals: Compute the marginal covariance of every scene pose; if off, the solve is faster.
        max_growth: Largest fraction, at least 0, by which a large map may grow after a full solve before it is solved
            in full again; until then, new scenes are placed one by one. 0 always solves in full, and larger solves in
            full less often.
        max_full_scenes: Largest number of scenes, at least 0, of a map that is always solved in full, so that its poses
            do not depend on the order in which scenes were added; larger is slower and more accurate.
        max_marginal_scenes: Largest number of scenes, at least 0, of a component whose covariances are computed; a
            larger value computes covariances of larger components, in 1 ms per scene at 1,000 scenes and 8 ms per scene
            at 10,000.
        min_large_component: Smallest number of scenes, at least 1, of a large component; a single edge suffices to
            attach a smaller component, so a larger value attaches more scenes by single edges.
        min_bridge_edges: Smallest number of scene pairs, at least 1, whose edges must agree to join two large
            components, unless one edge is confirmed; larger joins fewer components.
        min_wrong_probability: Smallest probability in (0, 1) of being wrong at which an edge, or a set of edges, of a
            contradictory loop is rejected; if no edge reaches it, all suspects stay undecided, so larger leaves more
            edges undecided.
        max_look_alike: Probability in (0, 1) that both captures of an edge show two places that look alike, above which
            the edge is doubtful. Larger trusts more edges between places that look alike, and more edges between
            captures of a place that changed much.
        same_visit_h: Longest time in hours, at least 0, between two captures of one visit, during which nothing is
            expected to change; larger refuses more doubtful edges.
        max_tilt_deg: Largest tilt in degrees, at least 0, that a component may keep after the solve; a component with
            more tilt is turned upright, so larger turns fewer components.
        max_unchanged_sigmas: Largest motion of a scene, in standard deviations of its pose, at least 0, at which the
            scene keeps its pose of the previous revision; larger keeps more poses, and 0 keeps a pose only if no more
            than rounding moved it.
    """

    gate_probability: float = 0.999
    marginals: bool = True
    max_growth: float = 0.1
    max_full_scenes: int = 500
    max_marginal_scenes: int = 3000
    min_large_component: int = 3
    min_bridge_edges: int = 3
    min_wrong_probability: float = 0.9
    max_look_alike: float = 0.01
    same_visit_h: float = 6.0
    max_tilt_deg: float = 5.0
    max_unchanged_sigmas: float = 1e-3

    def __post_init__(self) -> None:
        require_range(self, "(0, 1)", "gate_probability", "min_wrong_probability", "max_look_alike")
        require_range(self, "[0, inf]", "max_growth", "max_full_scenes", "max_marginal_scenes")
        require_range(self, "[0, inf]", "same_visit_h", "max_tilt_deg", "max_unchanged_sigmas")
        require_range(self, "[1, inf]", "min_large_component", "min_bridge_edges")
