"""The settings of the optimiser; importing them loads no solver."""

from __future__ import annotations

from dataclasses import dataclass, field

from gsmap.errors import ConfigError


@dataclass(frozen=True)
class Joining:
    """When components may join.

    Modelling assumption: independent mistakes do not agree with each other, so agreeing edges are either right or come
    from a place that looks like another. It fails where one mistake is made several times over: scenes cut from one
    capture, or furniture of which there are many.

    Args:
        small_component: a component of fewer scenes than this may be attached by a single edge.
        bridge_edges: components that both have ``small_component`` scenes or more need this many agreeing edges, over
            as many pairs of scenes, or one that a person confirmed.
        rival_edges: edges that contradict the agreeing ones count as a place that looks alike if this many of them
            agree among themselves.
        rival_factor: such a rival must be outnumbered this many times before components that are not small join.
    """

    small_component: int = 3
    bridge_edges: int = 3
    rival_edges: int = 2
    rival_factor: int = 3

    def __post_init__(self) -> None:
        _at_least(self, 1, "small_component", "bridge_edges", "rival_edges", "rival_factor")


@dataclass(frozen=True)
class LinkDensityParams:
    """How probable it is that a link (a set of edges between two parts of a map) is wrong, by how dense it is.

    Args:
        alone_wrong: probability that a link of one edge is wrong, before its density is looked at.
        group_wrong: the same for a link of several edges that agree.
        near_lengths: scenes nearer than this many typical edges count as near each other.
        concentration: how little the density of true links varies: the weight of its Beta distribution, in pairs.
        sparser: links between places that look alike are taken to be this many times sparser than true ones.
    """

    alone_wrong: float = 0.3
    group_wrong: float = 0.01
    near_lengths: float = 1.25
    concentration: float = 20.0
    sparser: float = 3.0

    def __post_init__(self) -> None:
        _probability(self, "alone_wrong", "group_wrong")
        _positive(self, "near_lengths", "concentration")
        _at_least(self, 1, "sparser")


@dataclass(frozen=True)
class Aliasing:
    """What is done about groups of edges that agree with each other and contradict the map (perceptual aliasing).

    Args:
        sure: a link of a contradictory loop is called wrong if this probable.
        spare_ratio: where no link is surely wrong, those this many times less probable than the likeliest are spared.
        max_suspects: if more links than this are left, none is parted: the wrong one is not likely among them.
        well_supported: edges with this share of the typical support of their neighbours are taken to lie within a
            place, and are considered before the others of their group.
        cut_depth: the lightest cut of a loop and those beside it are its links, to this depth on either side.
        support_power: an edge weighs this power of its share of agreeing neighbours when a loop is cut.
        prior_support_power: the same where contradicting priors are cut apart.
        min_motion_lengths: a group matters if it asks for a motion of more than this many typical edges.
        group_lengths: edges that ask for motions within this many typical edges may be one group.
        max_disagreement: of the surface that both captures of an edge saw, the share that may disagree without doubt:
            places captured twice without change reach .064 where doors were shut between (made ones; .007 otherwise),
            look-alikes with the furniture standing elsewhere begin at .145. Doubtful edges tie nothing firmly.
        max_chance_alike: doubtful edges tie nothing at all where more than this share of the map's doubtful edges that
            others decide turned out to be of two places.
        same_visit_h: captures dated less than this many hours apart show one state of a place: where they disagree,
            they are of two.
        contested_ratio: scenes of which more than one edge in this many crosses a wrong link belong to neither side.
        link: how probable it is that a link is wrong.
    """

    sure: float = 0.9
    spare_ratio: float = 3.0
    max_suspects: int = 4
    well_supported: float = 0.5
    cut_depth: int = 5
    support_power: float = 3.0
    prior_support_power: float = 2.0
    min_motion_lengths: float = 2.0
    group_lengths: float = 1.0
    max_disagreement: float = 0.1
    max_chance_alike: float = 0.5
    same_visit_h: float = 6.0
    contested_ratio: int = 3
    link: LinkDensityParams = field(default_factory=LinkDensityParams)

    def __post_init__(self) -> None:
        _probability(self, "sure", "max_disagreement", "max_chance_alike")
        _at_least(self, 1, "spare_ratio", "cut_depth", "contested_ratio")
        _at_least(self, 0, "max_suspects", "same_visit_h")
        _positive(self, "well_supported", "support_power", "prior_support_power", "min_motion_lengths", "group_lengths")


@dataclass(frozen=True)
class Gauge:
    """How a component's frame is held, and which priors are believed.

    Args:
        rotation_sigma_rad, translation_sigma, log_scale_sigma: standard deviations with which the anchor scene is held
            where no prior decides (radians, its own unit, log scale).
        loose: a direction of the frame that priors know no better than this (radians, component sizes) is held by the
            anchor.
        outlier_sigmas: a prior is contradicted if it stays off by more than this many of its standard deviations,
        outlier_rotation_deg: and by more than this, or in position by more than a typical edge's length, so that drift
            is not mistaken for contradiction.
        outlier_draws: random triples of position priors that are tried as the frame of a component.
        prior_edges: a prior weighs as much as this many edges without a triangle when a cut is weighed against it,
        prior_factor: and is outweighed by a cut of more than this many times its weight.
    """

    rotation_sigma_rad: float = 1e-4
    translation_sigma: float = 1e-3
    log_scale_sigma: float = 1e-4
    loose: float = 10.0
    outlier_sigmas: float = 5.0
    outlier_rotation_deg: float = 10.0
    outlier_draws: int = 200
    prior_edges: float = 10.0
    prior_factor: float = 2.0

    def __post_init__(self) -> None:
        _positive(self, "rotation_sigma_rad", "translation_sigma", "log_scale_sigma", "loose", "outlier_sigmas")
        _positive(self, "outlier_rotation_deg", "prior_edges", "prior_factor")
        _at_least(self, 0, "outlier_draws")


@dataclass(frozen=True)
class Gravity:
    """How components are turned upright after the solve.

    Args:
        max_tilt_deg: a component tilted by no more than this stays as it is.
        min_agreement: length of the median of its scenes' unit up directions below which a component stays as it is,
            for its scenes do not agree on what is up.
    """

    max_tilt_deg: float = 5.0
    min_agreement: float = 0.5

    def __post_init__(self) -> None:
        _at_least(self, 0, "max_tilt_deg", "min_agreement")


@dataclass(frozen=True)
class SurveyParams:
    """How observations of the world are weighed against each other and against the edges.

    Args:
        gate_probability: an observation is an outlier if its chi-square against all others is beyond this quantile.
        drift_share: before the edges give way, a map may be bent by this share of its extent.
        draws: triples of places that are tried as the first guess, where there are too many to try all.
        max_rounds: of leaving out the worst observation and solving again.
        max_rotation_sigma_deg: a component whose rotation is known no better than this is not tied.
        max_log_scale_sigma: the same of its scale.
        min_redundancy: directions of an observation that others check by no more than this share are not tested.
        min_checks: where points, fixes and bars have fewer checks among them all, a remark says so.
    """

    gate_probability: float = 0.999
    drift_share: float = 0.03
    draws: int = 500
    max_rounds: int = 50
    max_rotation_sigma_deg: float = 5.0
    max_log_scale_sigma: float = 0.1
    min_redundancy: float = 1e-3
    min_checks: float = 2.5

    def __post_init__(self) -> None:
        _probability(self, "gate_probability", "min_redundancy")
        _positive(self, "drift_share", "max_rotation_sigma_deg", "max_log_scale_sigma")
        _at_least(self, 1, "draws", "max_rounds")
        _at_least(self, 0, "min_checks")


@dataclass(frozen=True)
class Limits:
    """Sizes beyond which something cheaper is done.

    Args:
        full_scenes: maps of no more scenes than this are always solved in full, in less time than one scene's pairs
            take to register, so that their poses do not depend on the order in which the scenes came.
        marginal_scenes: components of more scenes get no covariances (noted in the answer): gtsam's cost 1 ms a scene
            at 1,000 scenes, 8 ms at 10,000.
        exact_hops: shortest paths, in scenes times sources, beyond which hops between scenes are estimated from their
            distance.
        fill_blocks: blocks of fill beyond which linear systems are solved by conjugate gradients; only maps that fill
            a volume reach it, those that follow floors and streets stay far below.
    """

    full_scenes: int = 500
    marginal_scenes: int = 3000
    exact_hops: int = 20_000_000
    fill_blocks: int = 500_000

    def __post_init__(self) -> None:
        _at_least(self, 0, "full_scenes", "marginal_scenes", "exact_hops", "fill_blocks")


@dataclass(frozen=True)
class Params:
    """How the map is solved. A *gate* is the chi-square below which an edge or cycle is consistent.

    Args:
        gate_probability: quantile of the chi-square distribution at which the gate stands.
        gnc_start: width, in gates, at which the robust kernel of graduated non-convexity starts.
        gnc_shrink: it gets this many times narrower from one width to the next.
        restart: in gates; poses from which an accepted edge is off by more are no start for Gauss-Newton, and are
            found anew by chordal relaxation.
        contradiction: in gates; edges that people confirmed contradict each other if one of them is off by more after
            giving way to the others, and an edge contradicts those it makes a loop with if it is off by more.
        max_rounds: rounds of taking edges in and refining.
        max_failures: an edge that was let go this many times is not taken in again.
        marginals: compute a covariance per scene.
        growth: with a previous answer of the same recipe, and more than ``limits.full_scenes`` scenes, place new ones
            one by one until the map has grown by this share since the last full solve; 0 always solves in full.
        neighbourhood: hops around a new scene's neighbours that give way to it; the outermost scenes stay.
        joining: when components may join.
        aliasing: what is done about places that look alike.
        gauge: how frames are held, and which priors are believed.
        gravity: how components are turned upright.
        survey: how observations of the world are weighed.
        limits: sizes beyond which something cheaper is done.
        still_sigmas: a scene keeps its last pose where the new one is no further from it than this share of what its
            edges leave open; 0 keeps a pose only where rounding moved it.
        still_variance: the same of covariances, as a share of the variances, and of chi-squares of edges.
    """

    gate_probability: float = 0.999
    gnc_start: float = 16.0
    gnc_shrink: float = 4.0
    restart: float = 4.0
    contradiction: float = 10.0
    max_rounds: int = 30
    max_failures: int = 2
    marginals: bool = True
    growth: float = 0.1
    neighbourhood: int = 2
    joining: Joining = field(default_factory=Joining)
    aliasing: Aliasing = field(default_factory=Aliasing)
    gauge: Gauge = field(default_factory=Gauge)
    gravity: Gravity = field(default_factory=Gravity)
    survey: SurveyParams = field(default_factory=SurveyParams)
    limits: Limits = field(default_factory=Limits)
    still_sigmas: float = 1e-3
    still_variance: float = 1e-2

    def __post_init__(self) -> None:
        _probability(self, "gate_probability")
        _at_least(self, 1, "gnc_start", "max_failures", "neighbourhood")
        _at_least(self, 0, "max_rounds", "growth", "still_sigmas", "still_variance")
        _positive(self, "restart", "contradiction")
        if not self.gnc_shrink > 1:
            raise ConfigError(f"gnc_shrink must be above 1, got {self.gnc_shrink}")


def _probability(params: object, *names: str) -> None:
    for name in names:
        value = getattr(params, name)
        if not 0 < value < 1:
            raise ConfigError(f"{name} must lie between 0 and 1, got {value}")


def _at_least(params: object, least: float, *names: str) -> None:
    for name in names:
        value = getattr(params, name)
        if not value >= least:
            raise ConfigError(f"{name} must be at least {least}, got {value}")


def _positive(params: object, *names: str) -> None:
    for name in names:
        value = getattr(params, name)
        if not value > 0:
            raise ConfigError(f"{name} must be positive, got {value}")
