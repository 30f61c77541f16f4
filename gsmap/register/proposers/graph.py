"""Propose poses by matching scene graphs (Graph-GSReg): find the maximum clique of compatible correspondences."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from gsmap.methods.proposer import Proposal, Scene
from gsmap.register import a_contrario, consistency, context, correspondences, pose, scale_vote
from gsmap.register.clique import maximum_clique
from gsmap.register.correspondences import Correspondences
from gsmap.settings.ranges import require_range
from gsmap.types import NodeLayer, SceneGraph, Sim3

VERSION = 3
SCALES = True
PACKAGES = ()


_TOP_K = {"objects": 5}  # most similar nodes that each node is paired with; 1 for other kinds
_SIGMA_M = {"objects": 0.05}  # of positions; other kinds have the value of landmarks, whose centres are better defined
_NUM_SCALES = 6  # number of voted scales that are tried, over all pairs of layers
_MIN_VOTE_SHARE = 0.5  # of the best scale's score
# With fewer candidates the votes for a scale have next to no noise. With more candidates and known gravity, a scale
# below _MIN_VOTE counts as noise. Measured: landmarks of different places mostly stay below 3.3, landmarks of
# overlapping scenes start at 7.2; weight-free objects of different places stay below 1.3.
_NOISY_CANDIDATES = 500
_MIN_VOTE, _MIN_VOTE_OBJECTS = 3.5, 1.5
_MIN_INLIERS = 5  # with fewer compatible correspondences no pose is proposed
# Correspondences agree with a pose if their distance under it is below this many standard deviations, or below the
# radius.
_INLIER_SIGMAS = 4.0
_MIN_INLIER_RADIUS_M = 0.15
RIVAL_SHARE = 0.6  # a clique that disagrees with the best clique is a rival if it has at least this share of its size
_RIVAL_DISTANCE_M = 1.0  # correspondences that the best pose leaves farther apart disagree with it
# A rival may confuse nodes that are at least as similar as all but this share of the best pose's correspondences.
_TWIN_QUANTILE = 0.1
_MAX_TWINS = 2400  # the most similar pairs of such nodes
_RIVAL_SEARCHES = 3  # number of cliques among these pairs that are tried until one gives a pose


@dataclass(frozen=True)
class Params:
    """Pose proposals by matching two scene graphs.

    Args:
        kinds: Kinds of nodes from which poses are proposed, separately for each kind: ``landmarks``, ``objects`` or
            both.
        context: Context of objects.
        consistency: Pairwise test of correspondences.
        max_correspondences: Largest number of candidate correspondences, at least 4 and the most similar first, that
            are kept; a larger value finds more matches and is slower.
        step_limit: Largest number of steps of a clique search, at least 1 (a step takes about two nanoseconds); a
            search that reaches the limit returns the largest clique found so far, and a larger value completes more
            searches.
    """

    kinds: tuple[str, ...] = ("landmarks", "objects")
    context: context.Params = field(default_factory=context.Params)
    consistency: consistency.Params = field(default_factory=consistency.Params)
    max_correspondences: int = correspondences.MAX_CORRESPONDENCES
    step_limit: int = 2_000_000

    def __post_init__(self) -> None:
        require_range(self, "[4, inf]", "max_correspondences")
        require_range(self, "[1, inf]", "step_limit")


def propose(target: Scene, source: Scene, params: Params | None = None, *, with_scale: bool = False) -> list[Proposal]:
    """Propose the best pose by each kind of node, and its rival if there is one; the fewest false alarms first."""
    params = params or Params()
    found: list[Proposal] = []
    for kind in params.kinds:
        found += propose_by_kind(target.graph, source.graph, kind, params, with_scale=with_scale)
    return sorted(found, key=lambda proposal: proposal.log_nfa)


def propose_by_kind(
    target: SceneGraph, source: SceneGraph, kind: str, params: Params | None = None, *, with_scale: bool = False
) -> list[Proposal]:
    """Propose the best pose by one kind of node, and its rival if there is one; best first.

    Correspondences, compatibility graph, maximum clique, closed-form pose. If the scale is unknown, every pair of the
    kind's layers (a layer per estimate of the metre) votes for scales, and the scales with most votes are tried.
    """
    params = params or Params()
    pairs = comparable_layers(target, source, kind, with_scale=with_scale)
    matchers = [LayerMatcher(a, b, target, source, kind, params, with_scale) for a, b in pairs]
    matchers = [m for m in matchers if len(m.matches) >= _MIN_INLIERS]
    trials = _voted_scales(matchers) if with_scale else [(matcher, 1.0) for matcher in matchers]
    found = [(p, m, s) for m, s in trials if (p := m.pose_of_largest_clique(m.matches, s)) is not None]
    if not found:
        return []
    best, matcher, s = min(found, key=lambda f: (f[0].log_nfa, -f[0].num_inliers))
    if with_scale and not best.flaw:
        # The vote is accurate to a percent; at the scale that the clique implies more correspondences are compatible.
        s = best.S_target_source.scale * matcher.units_m[0] / matcher.units_m[1]
        again = matcher.pose_of_largest_clique(matcher.matches, s)
        if again is not None and again.num_inliers > best.num_inliers:
            best = again
    # The rival: the largest clique of correspondences that do not agree with this pose.
    at_least = int(np.ceil(RIVAL_SHARE * best.num_inliers))
    rival = matcher.pose_of_largest_clique(matcher.disagreeing(best.S_target_source, matcher.matches), s, at_least)
    share = 0.0 if rival is None else rival.num_inliers / best.num_inliers
    assert best.support is not None
    twin = best.support.rival(best.S_target_source, best.log_nfa)
    if twin is not None and 1.0 / twin.runner_up > share:
        rival, share = twin, 1.0 / twin.runner_up
    if rival is None:
        return [replace(best, runner_up=0.0)]
    return [replace(best, runner_up=share), replace(rival, runner_up=1.0 / share)]


def comparable_layers(
    target: SceneGraph, source: SceneGraph, kind: str, *, with_scale: bool
) -> list[tuple[NodeLayer, NodeLayer]]:
    """Return the pairs of comparable layers of one kind: metric layers, or layers for estimates of the metre."""

    def of(graph: SceneGraph, other: SceneGraph) -> list[NodeLayer]:
        gravity_free = kind == "landmarks" and graph.up is not None and other.up is None
        own = "landmarks_gravity_free" if gravity_free else kind
        guesses = [layer for name, layer in graph.layers.items() if name.startswith(f"{own}:")]
        metric = [layer for name, layer in graph.layers.items() if name == own or name.startswith(f"{own}@")]
        return (guesses or metric) if with_scale else metric

    compared = [(a, b) for a in of(target, source) for b in of(source, target)]
    pairs = [(a, b) for a, b in compared if a.descriptor_id == b.descriptor_id and len(a) and len(b)]
    if not with_scale:
        return pairs if kind == "objects" else _of_working_size(pairs, target, source)
    # Estimates come in fixed steps, so several pairs have the same relative scale; keep the pair with most nodes.
    chosen: dict[float, tuple[NodeLayer, NodeLayer]] = {}
    for a, b in sorted(pairs, key=lambda pair: -min(len(pair[0]), len(pair[1]))):
        chosen.setdefault(round(float(np.log(a.unit_m / b.unit_m)), 3), (a, b))
    return list(chosen.values())


def _of_working_size(
    pairs: list[tuple[NodeLayer, NodeLayer]], target: SceneGraph, source: SceneGraph
) -> list[tuple[NodeLayer, NodeLayer]]:
    """Return the pairs of layers of one size; if there are several sizes, those within an octave of both scenes'
    working metres."""
    pairs = [(a, b) for a, b in pairs if a.unit_m == b.unit_m]
    middle = 0.5 * np.log2(target.working_m * source.working_m)
    near = [pair for pair in pairs if abs(np.log2(pair[0].unit_m) - middle) < 1.0]
    return near or pairs


def _voted_scales(matchers: list[LayerMatcher]) -> list[tuple[LayerMatcher, float]]:
    """Return the scales with most votes over all pairs of layers, each with the matcher of its pair; best first."""
    votes = [(score, i, s) for i, matcher in enumerate(matchers) for s, score in matcher.vote()]
    votes = sorted(votes, reverse=True)[:_NUM_SCALES]
    return [(matchers[i], s) for score, i, s in votes if score > _MIN_VOTE_SHARE * votes[0][0]]


class LayerMatcher:
    """Two layers, their candidate correspondences, and the search for cliques among these.

    Args:
        a, b: the target's layer and the source's layer.
    """

    def __init__(
        self,
        a: NodeLayer,
        b: NodeLayer,
        target: SceneGraph,
        source: SceneGraph,
        kind: str,
        params: Params,
        with_scale: bool,
    ) -> None:
        if kind == "objects":
            a, b = context.add_context(a, b, params.context)
        self.a, self.b, self.kind, self.params, self.with_scale = a, b, kind, params, with_scale
        self.sigma_m = _SIGMA_M.get(kind, consistency.SIGMA_M)
        self.radius_m = max(_INLIER_SIGMAS * np.sqrt(2.0) * self.sigma_m, _MIN_INLIER_RADIUS_M)
        # A rigid pose needs one metre for both scenes.
        common = float(np.sqrt(a.unit_m * b.unit_m))
        self.units_m = (a.unit_m, b.unit_m) if with_scale else (common, common)
        self.ups = (target.up, source.up)
        self.matches = correspondences.match_nodes(
            a,
            b,
            top_k=_TOP_K.get(kind, 1),
            max_correspondences=params.max_correspondences,
            units_m=self.units_m,
            ups=self.ups,
        )

    @cached_property
    def background(self) -> a_contrario.BackgroundModel:
        points = self.b.positions * self.units_m[1]
        heights = None if self.ups[0] is None or self.ups[1] is None else points @ self.ups[1]
        return a_contrario.BackgroundModel(self.a, self.b, points, self.matches, source_heights=heights)

    def vote(self) -> list[tuple[float, float]]:
        """Return the scales to try, each with its significance, best first."""
        scales = scale_vote.vote_scales(self.matches)
        if len(self.matches) < _NOISY_CANDIDATES or self.matches.target_heights is None:
            return scales
        min_vote = _MIN_VOTE_OBJECTS if self.kind == "objects" else _MIN_VOTE
        return [(s, score) for s, score in scales if score >= min_vote]

    def compatibility_graph(self, among: Correspondences, at_scale: float) -> np.ndarray:
        """Return bit rows of the compatibility graph of some correspondences (`consistency.consistency_graph`)."""
        return consistency.consistency_graph(among, self.params.consistency, scale=at_scale, sigma_m=self.sigma_m)

    def pose_of_largest_clique(self, among: Correspondences, at_scale: float, at_least: int = 0) -> Proposal | None:
        """Fit a pose to the largest clique among correspondences; return None if the clique has fewer than ``at_least``
        members."""
        params = self.params
        at_least = max(at_least, _MIN_INLIERS)
        if len(among) < at_least:
            return None
        compatibility = self.compatibility_graph(among, at_scale)
        clique = maximum_clique(compatibility, params.step_limit, more_than=at_least - 1)
        if len(clique) < at_least:
            return None
        fit = self._fit(among[clique.members])
        S = fit.S_target_source
        inliers = among[a_contrario.find_inliers(among, S, self.radius_m)]
        if not fit.flaw and len(inliers) > len(clique):
            S = self._fit(inliers).S_target_source
        return Proposal(
            proposer=f"graph:{self.kind}",
            S_target_source=self._in_scene_units(S),
            with_scale=self.with_scale,
            num_inliers=len(clique),
            num_correspondences=len(self.matches),
            exact=clique.exact,
            log_nfa=self.background.log10_nfa(S, self.radius_m),
            flaw=fit.flaw,
            support=CliqueSupport(self, inliers if len(inliers) > len(clique) else among[clique.members], at_scale),
        )

    def with_similar_pairs(self, members: Correspondences) -> LayerMatcher:
        """Return a matcher whose candidates are all pairs that share a node with ``members`` and are about as similar
        as these."""
        out = copy(self)
        out.__dict__.pop("background", None)
        out.matches = correspondences.similar_pairs(
            self.a,
            self.b,
            members,
            _TWIN_QUANTILE,
            _MAX_TWINS,
            units_m=self.units_m,
            ups=self.ups,
        )
        return out

    def disagreeing(self, S_target_source: Sim3, among: Correspondences) -> Correspondences:
        """Return the correspondences that do not agree with a pose."""
        moved = S_target_source.apply(among.source / self.units_m[1]) * self.units_m[0]
        return among[np.linalg.norm(moved - among.target, axis=1) > _RIVAL_DISTANCE_M]

    def _fit(self, members: Correspondences) -> pose.PoseFit:
        return pose.fit_pose(
            members.target,
            members.source,
            with_scale=self.with_scale,
            sigma_m=self.sigma_m,
        )

    def in_metres(self, S_target_source: Sim3) -> Sim3:
        """Convert a pose from the scenes' own units to metres."""
        target_m, source_m = self.units_m
        S = S_target_source
        return Sim3(S.rotation, S.translation * target_m, S.scale * target_m / source_m)

    def _in_scene_units(self, S: Sim3) -> Sim3:
        """Convert a pose from metres to the scenes' own units."""
        own = S.scale * self.units_m[1] / self.units_m[0] if self.with_scale else 1.0
        return Sim3(S.rotation, S.translation / self.units_m[0], own)


@dataclass(frozen=True, eq=False)
class CliqueSupport:
    """The inliers of a clique's pose, and the matcher that found them.

    Implements `gsmap.types.registration.Support`.

    Args:
        scale: factor on the source at which the clique was found.
        equal: if this is a rival: log10 NFA and number of inliers of the pose that it rivals. The candidates of a rival
            are not independent, so its NFA is derived from that of the pose.
    """

    matcher: LayerMatcher
    members: Correspondences
    scale: float
    equal: tuple[float, int] | None = None

    @property
    def points(self) -> tuple[np.ndarray, np.ndarray]:
        """(K, 3) points of the target and (K, 3) of the source, each in its scene's own unit."""
        target_m, source_m = self.matcher.units_m
        return self.members.target / target_m, self.members.source / source_m

    def count(self, S_target_source: Sim3) -> tuple[int, float]:
        """Return the number of inliers of a pose (scenes' own units), and its log10 number of false alarms."""
        matcher, S = self.matcher, self.matcher.in_metres(S_target_source)
        inliers = int(a_contrario.find_inliers(matcher.matches, S, matcher.radius_m).sum())
        if self.equal is None:
            return inliers, matcher.background.log10_nfa(S, matcher.radius_m)
        log_nfa, others = self.equal
        return inliers, log_nfa * min(inliers / others, 1.0) if log_nfa < 0 else log_nfa

    def rival(self, S_target_source: Sim3, log_nfa: float, others: Sequence[Sim3] = ()) -> Proposal | None:
        """Return the largest rival of a pose among its own nodes; the rival's ``runner_up`` is the inverse of its
        relative size.

        A repetitive scene (a façade, a corridor, a stair) has many similar nodes. Candidates are only the most similar
        pairs, so a rival pose that is off by one period has no correspondences among them. Therefore the nodes of the
        pose's inliers are matched again, with all nodes that are as similar as their partners.

        Args:
            log_nfa: log10 NFA of the pose.
            others: poses that were found before.

        Returns:
            None where no rival has `RIVAL_SHARE` of the pose's inliers.
        """
        twins = self.matcher.with_similar_pairs(self.members)
        own = int(a_contrario.find_inliers(twins.matches, twins.in_metres(S_target_source), twins.radius_m).sum())
        left = twins.matches
        for S in (S_target_source, *others):
            left = twins.disagreeing(S, left)
        for _ in range(_RIVAL_SEARCHES if own else 0):
            rival = twins.pose_of_largest_clique(left, self.scale)
            if rival is None or not isinstance(rival.support, CliqueSupport):
                return None
            members = rival.support.members
            if not rival.flaw:
                support = replace(rival.support, equal=(log_nfa, own))
                inliers, equal_nfa = support.count(rival.S_target_source)
                share = inliers / own
                return (
                    replace(rival, log_nfa=equal_nfa, runner_up=1.0 / share, support=support)
                    if share >= RIVAL_SHARE
                    else None
                )
            # Façades are flat, so a mirrored clique of their nodes may be larger than a proper clique.
            left = left[~np.isin(left.target_ids, members.target_ids)]
        return None
