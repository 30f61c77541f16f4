"""Registering one pair of scenes: the recipe."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import numpy as np

from gsmap.errors import ConfigError
from gsmap.geometry.rotations import angle_between
from gsmap.register import agreement as agreement_
from gsmap.register import covariance as covariance_
from gsmap.register import dense, propose, surface, verdict
from gsmap.register.agreement import Agreement
from gsmap.register.propose import Proposal
from gsmap.register.refiners import coloured, gicp
from gsmap.register.scene_view import SceneView
from gsmap.register.sight import Sight
from gsmap.types import Registration, Sim3

METHOD_VERSION = 6

Progress = Callable[[float, str], None]


@dataclass(frozen=True)
class Params:
    """How a pair is registered.

    Args:
        kinds: of nodes, that propose.
        refiner: ``coloured`` (point-to-plane and colour; scale too), ``gicp`` (rigid only) or ``none``.
        photometric: also lay renders over each other, and keep that where local colours then agree better. Off: it
            wins nothing where scenes share most views, and misleads where they share few.
        fallback: ``auto`` asks the surfaces where the graphs are poor or suggest nothing sure, ``never``, ``always``.
        poor_nodes: a graph none of whose layers has this many nodes is poor.
        max_poses: poses that are refined and judged at most.
        hopeless_log_nfa: a clique that chance explains this easily is not looked into.
        coarse, glance: the first, rough refinement and the look that decides whether to go on.
    """

    kinds: tuple[str, ...] = ("landmarks", "objects")
    refiner: str = "coloured"
    photometric: bool = False
    fallback: str = "auto"
    poor_nodes: int = 500
    max_poses: int = 3
    hopeless_log_nfa: float = 6.0
    propose: propose.Params = field(default_factory=propose.Params)
    surface: surface.Params = field(default_factory=surface.Params)
    coarse: coloured.Params = field(default_factory=lambda: coloured.Params((0.4, 0.15), max_points=(3000, 6000)))
    glance: agreement_.Params = field(default_factory=lambda: agreement_.Params(num_cameras=3, max_points=4000))
    coloured: coloured.Params = field(default_factory=lambda: coloured.Params((0.06,), max_points=(20_000,)))
    gicp: gicp.Params = field(default_factory=gicp.Params)
    dense: dense.Params = field(default_factory=dense.Params)
    agreement: agreement_.Params = field(default_factory=agreement_.Params)
    covariance: covariance_.Params = field(default_factory=covariance_.Params)
    verdict: verdict.Params = field(default_factory=verdict.Params)

    def __post_init__(self) -> None:
        if self.refiner not in ("coloured", "gicp", "none"):
            raise ConfigError(f"refiner must be coloured, gicp or none, got {self.refiner!r}")
        if self.fallback not in ("auto", "never", "always"):
            raise ConfigError(f"fallback must be auto, never or always, got {self.fallback!r}")


@dataclass(frozen=True, eq=False)
class _Judged:
    """A proposal after refinement, with its evidence."""

    proposal: Proposal
    agreement: Agreement
    covariance: np.ndarray | None
    flaw: str


class _Clock:
    """Wall seconds by step."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {"match": 0.0, "refine": 0.0, "verdict": 0.0}

    @contextmanager
    def step(self, name: str) -> Iterator[None]:
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start


def register_pair(
    target: SceneView, source: SceneView, params: Params | None = None, progress: Progress | None = None
) -> Registration:
    """Where ``source`` lies in ``target``, if that can be told.

    The graphs propose poses (`propose`); each is refined on the surfaces and judged by what the scenes say of each
    other under it (`agreement`, `verdict`). Where no graph convinces, the surfaces propose as well (`dense`). The first
    pose that is accepted wins, unless its rival is accepted too: then nothing is.

    Returns:
        `Registration`: ``accepted`` with pose and information; ``rejected`` with the best pose and what speaks against
        it; ``no_match`` with the reason. Never raises for scenes that do not match.
    """
    params = params or Params()
    report = progress or (lambda fraction, text: None)
    clock = _Clock()
    pair = _Pair(target, source, params, clock)
    report(0.0, "matching")
    centre = np.median(source.gaussians.means, axis=0) if len(source.gaussians) else np.zeros(3)
    judged: list[_Judged] = []
    for proposals in (pair.graph_proposals, pair.scaled_proposals, pair.dense_proposals):
        for proposal in proposals():
            hopeless = proposal.log_nfa > params.hopeless_log_nfa
            known = any(_same_pose(proposal, j.proposal, centre, target.graph.unit_m) for j in judged)
            if hopeless or known or len(judged) >= params.max_poses:
                continue
            report(0.2 + 0.7 * len(judged) / params.max_poses, f"judging a pose by {proposal.method}")
            judged.append(pair.judge(proposal))
            if not judged[-1].flaw and verdict.is_significant(judged[-1].proposal, params.verdict):
                break
        if any(not j.flaw for j in judged):
            break
    report(1.0, "done")
    return _conclude(pair, judged, centre)


class _Pair:
    """Two scenes, and everything computed of them once."""

    def __init__(self, target: SceneView, source: SceneView, params: Params, clock: _Clock) -> None:
        self.target, self.source, self.params, self.clock = target, source, params, clock
        self.policies = {target.scale_policy, source.scale_policy}

    def graph_proposals(self) -> list[Proposal]:
        """Rigid poses by each kind of node, unless a scene's scale is unknown."""
        return [] if "unknown" in self.policies else self._by_kinds(with_scale=False)

    def scaled_proposals(self) -> list[Proposal]:
        """Poses with a voted scale, unless both scenes are known to be in metres; near 1 it snaps unless unknown."""
        if self.policies == {"known"}:
            return []
        proposals = self._by_kinds(with_scale=True)
        return proposals if "unknown" in self.policies else [_snapped(p) for p in proposals]

    def _by_kinds(self, with_scale: bool) -> list[Proposal]:
        found: list[Proposal] = []
        with self.clock.step("match"):
            for kind in self.params.kinds:
                found += propose.propose(
                    self.target.graph, self.source.graph, kind, self.params.propose, with_scale=with_scale
                )
        return sorted(found, key=lambda p: p.log_nfa)

    def dense_proposals(self) -> list[Proposal]:
        """A rigid pose by the surfaces, where the graphs are poor."""
        nodes = min(_most_nodes(self.target), _most_nodes(self.source))
        wanted = {"never": False, "always": True, "auto": nodes < self.params.poor_nodes}[self.params.fallback]
        if not wanted or "unknown" in self.policies:
            return []
        with self.clock.step("fallback"):
            unit_m = self._target_unit_m(with_scale=False)
            found = dense.match_surfaces(
                self.target.surface(unit_m, self.params.surface),
                self.source.surface(unit_m, self.params.surface),
                self.params.dense,
            )
        if found is None:
            return []
        pose = Sim3(found[0].rotation, found[0].translation / unit_m)
        return [Proposal("dense", pose, with_scale=False, num_inliers=found[1])]

    def _target_unit_m(self, with_scale: bool) -> float:
        """Metres per target unit: 1 where metres are plausible and nothing else is asked for, else the guess."""
        graph = self.target.graph
        metric = not with_scale and "landmarks" in graph.layers  # made under the scene's own unit
        return 1.0 if metric or self.target.scale_policy == "known" else graph.unit_m

    def judge(self, proposal: Proposal) -> _Judged:
        """Refine a proposal and hold it against everything both scenes know."""
        params, S = self.params, proposal.S_target_source
        if proposal.flaw:
            return _Judged(proposal, Agreement(), None, proposal.flaw)
        # Both surfaces go to target metres, the source with the proposed scale, so what remains is nearly rigid.
        unit_t = self._target_unit_m(proposal.with_scale)
        if proposal.with_scale and self.source.scale_policy == "known":
            unit_t = 1.0 / S.scale  # the source knows what a metre is, the target only guesses
        unit_s = unit_t * S.scale
        with self.clock.step("refine"):
            target = self.target.surface(unit_t, params.surface)
            source = self.source.surface(unit_s, params.surface)
            pose = Sim3(S.rotation, S.translation * unit_t)
            if params.refiner != "none":
                pose = coloured.refine(target, source, pose, params.coarse, with_scale=proposal.with_scale)
        with self.clock.step("verdict"):
            sights = self._sights(unit_t, unit_s)
            seen = agreement_.measure(target, source, pose, sights, params.glance)
            # A clique beyond chance is worth a full look, whatever three cameras say of a rough pose.
            sure = verdict.is_significant(proposal, params.verdict)
            flaw = "" if sure else verdict.hopeless(seen, params.verdict)
        covariance = sigmas = None
        if not flaw:
            with self.clock.step("refine"):
                if params.refiner == "gicp" and not proposal.with_scale:
                    pose = gicp.refine(target, source, pose, params.gicp)
                elif params.refiner != "none":
                    pose = coloured.refine(target, source, pose, params.coloured, with_scale=proposal.with_scale)
            with self.clock.step("verdict"):
                seen = agreement_.measure(target, source, pose, sights, params.agreement)
            if params.photometric and self.target.cameras:
                with self.clock.step("photometric"):
                    tried = self._photometric(pose, S.scale, unit_t, proposal.with_scale)
                    better = agreement_.measure(target, source, tried, sights, params.agreement)
                    if better.colour_correlation > seen.colour_correlation:
                        pose, seen = tried, better
            with self.clock.step("verdict"):
                known = covariance_.pose_covariance(
                    target, source, pose, params.covariance, with_scale=proposal.with_scale
                )
                if known is not None:
                    covariance, sigmas = covariance_.in_scene_units(known[0], unit_s), known[1]
        proposal = replace(
            proposal, S_target_source=Sim3(pose.rotation, pose.translation / unit_t, pose.scale * S.scale)
        )
        flaw = flaw or verdict.judge(proposal, seen, sigmas, params.verdict)
        return _Judged(proposal, seen, covariance, flaw)

    def _sights(self, unit_t: float, unit_s: float) -> tuple[tuple[Sight, float] | None, tuple[Sight, float] | None]:
        """What each scene's cameras see of it, with metres per unit."""
        target, source = (view.sight(self.params.agreement.image_size_px) for view in (self.target, self.source))
        return target and (target, unit_t), source and (source, unit_s)

    def _photometric(self, pose: Sim3, scale: float, unit_m: float, with_scale: bool) -> Sim3:
        """A pose between metres, refined on renders of the scenes in their own units."""
        from gsmap.register.refiners import photometric

        own = Sim3(pose.rotation, pose.translation / unit_m, pose.scale * scale)
        own = photometric.refine(
            self.target.gaussians, self.source.gaussians, self.target.cameras, own, unit_m=unit_m, with_scale=with_scale
        )
        return Sim3(own.rotation, own.translation * unit_m, own.scale / scale)


def _most_nodes(view: SceneView) -> int:
    return max((len(layer) for layer in view.graph.layers.values()), default=0)


def _snapped(proposal: Proposal) -> Proposal:
    """The proposal made rigid where its scale is 1 within what its correspondences can tell."""
    S = proposal.S_target_source
    if abs(np.log(S.scale)) > 0.005 + 0.05 / np.sqrt(max(proposal.num_inliers, 1)):
        return proposal
    return replace(proposal, S_target_source=Sim3(S.rotation, S.translation), with_scale=False)


def _same_pose(a: Proposal, b: Proposal, centre: np.ndarray, unit_m: float) -> bool:
    """Both would be refined to one answer."""
    S, Q = a.S_target_source, b.S_target_source
    return bool(
        abs(np.log(S.scale / Q.scale)) < 0.02
        and np.degrees(angle_between(S.rotation, Q.rotation)) < 3.0
        and np.linalg.norm(S.apply(centre) - Q.apply(centre)) * unit_m < 0.3
    )


def _conclude(pair: _Pair, judged: list[_Judged], centre: np.ndarray) -> Registration:
    """The answer: one accepted pose, the best one with what speaks against it, or nothing."""
    target, source = pair.target.id, pair.source.id
    target_unit_m = pair.target.graph.unit_m
    if not judged:
        poor = min(_most_nodes(pair.target), _most_nodes(pair.source))
        reason = f"no pose that more nodes support than chance would (the poorer graph has {poor})"
        return Registration(target, source, "no_match", reason, seconds=pair.clock.seconds)
    accepted = [j for j in judged if not j.flaw]
    best = accepted[0] if accepted else min(judged, key=_rank)
    reason = best.flaw
    status = "accepted" if accepted else "rejected"
    if any(not _same_pose(best.proposal, j.proposal, centre, target_unit_m) for j in accepted):
        status, reason = "no_match", "ambiguous: two different poses both fit"
    elif not accepted and not (best.proposal.log_nfa < pair.params.verdict.max_log_nfa):
        status, reason = "no_match", f"no match that chance would not explain ({reason})"
    p, a = best.proposal, best.agreement
    information = None
    if status == "accepted":
        information = np.linalg.inv(best.covariance)
        information = 0.5 * (information + information.T)
    return Registration(
        target,
        source,
        status,
        reason,
        p.S_target_source if status != "no_match" else None,
        information,
        p.num_inliers,
        p.num_correspondences,
        a.overlap,
        p.method,
        p.exact,
        pair.clock.seconds,
        {
            "log_nfa": p.log_nfa,
            "runner_up": p.runner_up,
            "contradiction": a.contradiction,
            "num_seen": float(a.num_seen),
            "num_coinciding": float(a.num_coinciding),
            "colour_correlation": a.colour_correlation,
            "colour_t": a.colour_t,
        },
    )


def _rank(judged: _Judged) -> tuple[float, float]:
    """Rejected poses by how much speaks for them."""
    return (-judged.agreement.colour_correlation * judged.agreement.num_coinciding, judged.proposal.log_nfa)
