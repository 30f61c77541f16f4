"""Run the proposers of a pair in rounds: rigid, with scale, without gravity, and the fallback."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from gsmap.errors import MissingDependencyError
from gsmap.methods import family
from gsmap.register import verdict
from gsmap.register.metric_scene import MetricScene, working_unit_m
from gsmap.register.params import Params
from gsmap.register.scene_view import SceneView
from gsmap.register.timing import Stopwatch
from gsmap.types.registration import Proposal

POOR_NODES = 500  # a scene graph is poor if none of its layers has this many nodes
# For refinement a voted log scale counts as 0 if it is below this plus the spread divided by the square root of the
# number of correspondences.
_UNIT_LOG_SCALE = 0.005
_UNIT_LOG_SCALE_SPREAD = 0.05


class ProposalRounds:
    """Rounds of pose proposals for one pair; each round is computed when the iteration reaches it.

    Attributes:
        notes: messages for the user, such as missing packages.
    """

    def __init__(self, target: SceneView, source: SceneView, params: Params, watch: Stopwatch) -> None:
        self.target, self.source, self.params, self.watch = target, source, params, watch
        self.policies = {target.scale_policy, source.scale_policy}
        self.notes: list[str] = []

    def rounds(self) -> Iterator[list[Proposal]]:
        """Yield the proposals of each round.

        Rigid poses, unless a scene's unit is unknown; poses with a voted scale, unless both scenes are in metres; poses
        that do not use gravity, as an up vector may be wrong; and poses by the fallback proposer where a graph has few
        nodes.
        """
        params = self.params
        if "unknown" not in self.policies:
            yield self._proposals_of(params.proposer, "match", with_scale=False)
        if self.policies != {"known"} and family("proposer").get(params.proposer).SCALES:
            proposals = self._proposals_of(params.proposer, "match", with_scale=True)
            yield proposals if "unknown" in self.policies else [snap_scale(p) for p in proposals]
        yield self._without_gravity()
        if self._uses_fallback():
            yield self._proposals_of(params.fallback_proposer, "fallback", with_scale=False)

    def _uses_fallback(self) -> bool:
        poor = num_nodes(self.target, self.source) < POOR_NODES
        wanted = {"never": False, "always": True, "auto": poor}[self.params.fallback]
        return wanted and "unknown" not in self.policies

    def _without_gravity(self) -> list[Proposal]:
        """Propose poses from gravity-free landmarks. Only significant cliques are kept, because most pairs that reach
        this round share no surface. Empty if a scene's gravity is unknown, because then earlier rounds did not use it.
        """
        target, source = without_gravity(self.target), without_gravity(self.source)
        if target is None or source is None:
            return []
        with_scale = "unknown" in self.policies
        found = self._proposals_of(self.params.proposer, "match", with_scale=with_scale, views=(target, source))
        return [p for p in found if verdict.is_significant(p, self.params.verdict)]

    def _proposals_of(
        self, name: str, step: str, *, with_scale: bool, views: Sequence[SceneView] | None = None
    ) -> list[Proposal]:
        unit_m = working_unit_m(self.target, self.source, with_scale=with_scale)
        target, source = (MetricScene(view, unit_m) for view in views or (self.target, self.source))
        with self.watch.step(step):
            try:
                found: list[Proposal] = (
                    family("proposer")
                    .get(name)
                    .propose(target, source, self.params.proposers[name], with_scale=with_scale)
                )
            except MissingDependencyError as error:
                self.notes.append(f"the proposer {name} was skipped: {error}")
                return []
        return found


def without_gravity(view: SceneView) -> SceneView | None:
    """Return a copy of a scene with its gravity-free landmarks alone; None if its gravity is unknown or it has no such
    landmarks."""
    free = {
        name.replace("landmarks_gravity_free", "landmarks"): layer
        for name, layer in view.graph.layers.items()
        if name.startswith("landmarks_gravity_free")
    }
    return (
        replace(view, graph=replace(view.graph, layers=free, up=None)) if free and view.graph.up is not None else None
    )


def snap_scale(proposal: Proposal) -> Proposal:
    """Mark a proposal as one between scenes in metres if its scale is 1 within the error of its correspondences."""
    spread = _UNIT_LOG_SCALE + _UNIT_LOG_SCALE_SPREAD / np.sqrt(max(proposal.num_inliers, 1))
    near = abs(np.log(proposal.S_target_source.scale)) <= spread
    return replace(proposal, with_scale=False) if near else proposal


def num_nodes(*views: SceneView) -> int:
    """Return the number of nodes of each scene graph's largest layer; of several graphs, the smallest number."""
    return min(max((len(layer) for layer in view.graph.layers.values()), default=0) for view in views)
