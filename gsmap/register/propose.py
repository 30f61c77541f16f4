"""Poses that a pair of scene graphs suggests."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from gsmap.register import consistency, correspondences, scale
from gsmap.register.clique import maximum_clique
from gsmap.register.correspondences import Correspondences
from gsmap.register.pose import fit_pose
from gsmap.register.significance import Chance, agreeing
from gsmap.types import NodeLayer, SceneGraph, Sim3

_RIVAL = 0.6  # a clique that disagrees with the best is a rival from this share of its size on

_FEW_VOTERS = 500  # candidates; fewer make no noise to speak of


@dataclass(frozen=True)
class Params:
    """Args:
    landmarks, objects: how nodes of each kind are paired.
    consistency: how pairs are tested against each other; its sigma is that of landmarks.
    objects_sigma_m: the same for objects, whose centres are less well defined.
    scale: the vote, where the scale is not known.
    num_scales: scales tried of those voted for, over all pairs of layers.
    min_vote, objects_min_vote: where hundreds of candidates vote and gravity is known, a scale that stands out less
        is noise (measured: landmarks of places apart mostly stay below 3.3, overlapping ones start at 7.2; weight-free
        objects of places apart stay below 1.3).
    step_limit: of a clique search, about two nanoseconds each.
    min_inliers: fewer agreeing correspondences propose nothing.
    """

    landmarks: correspondences.Params = field(default_factory=correspondences.Params)
    objects: correspondences.Params = field(default_factory=lambda: correspondences.Params(top_k=5))
    consistency: consistency.Params = field(default_factory=consistency.Params)
    objects_sigma_m: float = 0.05
    scale: scale.Params = field(default_factory=scale.Params)
    num_scales: int = 6
    min_vote: float = 3.5
    objects_min_vote: float = 1.5
    step_limit: int = 2_000_000
    min_inliers: int = 5


@dataclass(frozen=True, eq=False)
class Proposal:
    """A pose to be refined and judged.

    Args:
        method: which evidence suggested it (``landmarks``, ``objects``, ``dense``).
        S_target_source: the pose, in the scenes' own units.
        with_scale: the scale was estimated; otherwise it is exactly 1.
        num_inliers, num_correspondences, exact: of the clique.
        log_nfa: log10 of the number of false alarms; NaN where nothing was counted.
        runner_up: size of the best clique that disagrees, as a share of this one; 0 where none comes near, NaN
            where none was sought.
        flaw: why the pose cannot be used, or empty.
    """

    method: str
    S_target_source: Sim3
    with_scale: bool
    num_inliers: int
    num_correspondences: int = 0
    exact: bool = True
    log_nfa: float = float("nan")
    runner_up: float = float("nan")
    flaw: str = ""


def propose(
    target: SceneGraph,
    source: SceneGraph,
    kind: str,
    params: Params | None = None,
    *,
    with_scale: bool = False,
) -> list[Proposal]:
    """The best pose by one kind of node and, where a rival comes near it, the rival; best first.

    Candidates, consistency graph, maximum clique, closed-form pose. With an unknown scale every pair of the kind's
    layers (each made under another guess of the metre) votes, and the scales most voted for are tried.
    """
    params = params or Params()
    fields = [
        _Field(a, b, target, source, kind, params, with_scale) for a, b in _layers(target, source, kind, with_scale)
    ]
    fields = [f for f in fields if len(f.matches) >= params.min_inliers]
    if with_scale:
        votes = [(score, i, s) for i, f in enumerate(fields) for s, score in f.vote()]
        votes = sorted(votes, reverse=True)[: params.num_scales]
        trials = [(i, s) for score, i, s in votes if score > 0.5 * votes[0][0]]
    else:
        trials = [(i, 1.0) for i in range(len(fields))]
    found = [(p, i, s) for i, s in trials if (p := fields[i].solve(fields[i].matches, s)) is not None]
    if not found:
        return []
    best, i, s = min(found, key=lambda f: (f[0].log_nfa, -f[0].num_inliers))
    if with_scale and not best.flaw:
        # The vote is good to a percent; at the scale its own clique implies more correspondences agree.
        s = best.S_target_source.scale * fields[i].units_m[0] / fields[i].units_m[1]
        again = fields[i].solve(fields[i].matches, s)
        if again is not None and again.num_inliers > best.num_inliers:
            best = again
    # The rival: the best clique once everything that agrees with this pose, within a metre, is out of the way.
    at_least = int(np.ceil(_RIVAL * best.num_inliers))
    rival = fields[i].solve(fields[i].disagreeing(best.S_target_source), s, at_least)
    if rival is None:
        return [replace(best, runner_up=0.0)]
    share = rival.num_inliers / best.num_inliers
    return [replace(best, runner_up=share), replace(rival, runner_up=1.0 / share)]


def _layers(target: SceneGraph, source: SceneGraph, kind: str, with_scale: bool) -> list[tuple[NodeLayer, NodeLayer]]:
    """Pairs of layers of one kind that may be compared: the metric ones, or all guesses of the metre."""

    def of(graph: SceneGraph, other: SceneGraph) -> list[NodeLayer]:
        turned = kind == "landmarks" and graph.up is not None and other.up is None
        own = "landmarks_gravity_free" if turned else kind
        guesses = [layer for name, layer in graph.layers.items() if name.startswith(f"{own}:")]
        plain = [graph.layers[own]] if own in graph.layers else []
        return (guesses or plain) if with_scale else plain

    compared = [(a, b) for a in of(target, source) for b in of(source, target)]
    pairs = [(a, b) for a, b in compared if a.descriptor_id == b.descriptor_id and len(a) and len(b)]
    if not with_scale:
        return pairs
    # Guesses come in fixed steps, so several pairs stand for one relative scale: keep the one with most nodes.
    chosen: dict[float, tuple[NodeLayer, NodeLayer]] = {}
    for a, b in sorted(pairs, key=lambda pair: -min(len(pair[0]), len(pair[1]))):
        chosen.setdefault(round(float(np.log(a.unit_m / b.unit_m)), 3), (a, b))
    return list(chosen.values())


class _Field:
    """Two layers, their candidate correspondences, and how a clique of those becomes a proposal."""

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
        self.a, self.b, self.kind, self.params, self.with_scale = a, b, kind, params, with_scale
        sigma = params.objects_sigma_m if kind == "objects" else params.consistency.sigma_m
        self.test = replace(params.consistency, sigma_m=sigma)
        self.radius_m = max(4.0 * np.sqrt(2.0) * sigma, 0.15)
        # A rigid pose needs one metre for both scenes, whatever each was guessed to be.
        common = float(np.sqrt(a.unit_m * b.unit_m))
        self.units_m = (a.unit_m, b.unit_m) if with_scale else (common, common)
        self.ups = (target.up, source.up)
        matching = params.objects if kind == "objects" else params.landmarks
        self.matches = correspondences.correspondences(a, b, matching, units_m=self.units_m, ups=self.ups)

    @cached_property
    def chance(self) -> Chance:
        points = self.b.positions * self.units_m[1]
        heights = None if self.ups[0] is None or self.ups[1] is None else points @ self.ups[1]
        return Chance(self.a, self.b, points, self.matches, source_heights=heights)

    def vote(self) -> list[tuple[float, float]]:
        """Scales worth a trial and how far each stands out, best first."""
        scales = scale.vote_scales(self.matches, self.params.scale)
        if len(self.matches) < _FEW_VOTERS or self.matches.target_heights is None:
            return scales
        noise = self.params.objects_min_vote if self.kind == "objects" else self.params.min_vote
        return [(s, score) for s, score in scales if score >= noise]

    def solve(self, among: Correspondences, at_scale: float, at_least: int = 0) -> Proposal | None:
        """The pose of the largest clique among some of the correspondences, if it has so many members."""
        at_least = max(at_least, self.params.min_inliers)
        if len(among) < at_least:
            return None
        sigma = self.test.sigma_m
        rows = consistency.consistency_graph(among, self.test, scale=at_scale)
        clique = maximum_clique(rows, self.params.step_limit, more_than=at_least - 1)
        if len(clique) < at_least:
            return None
        members = among[clique.members]
        fit = fit_pose(members.target, members.source, with_scale=self.with_scale, sigma_m=sigma)
        pose = fit.S_target_source
        inliers = among[agreeing(among, pose, self.radius_m)]
        if not fit.flaw and len(inliers) > len(clique):
            pose = fit_pose(inliers.target, inliers.source, with_scale=self.with_scale, sigma_m=sigma).S_target_source
        return Proposal(
            self.kind,
            self._in_scene_units(pose),
            self.with_scale,
            len(clique),
            len(self.matches),
            clique.exact,
            self.chance.log10_nfa(pose, self.radius_m),
            flaw=fit.flaw,
        )

    def disagreeing(self, S_target_source: Sim3, beyond_m: float = 1.0) -> Correspondences:
        """The correspondences that a pose leaves farther apart than this."""
        moved = S_target_source.apply(self.matches.source / self.units_m[1]) * self.units_m[0]
        return self.matches[np.linalg.norm(moved - self.matches.target, axis=1) > beyond_m]

    def _in_scene_units(self, pose: Sim3) -> Sim3:
        """A pose between metres as one between the scenes' own units."""
        own = pose.scale * self.units_m[1] / self.units_m[0] if self.with_scale else 1.0
        return Sim3(pose.rotation, pose.translation / self.units_m[0], own)
