"""Which proposers are asked for a pair, in which order, and with which scale."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from gsmap.errors import MissingDependencyError
from gsmap.methods import family
from gsmap.register import verdict
from gsmap.register.metric import MetricScene, working_unit_m
from gsmap.register.params import Params
from gsmap.register.scene_view import SceneView
from gsmap.register.stopwatch import Stopwatch
from gsmap.types.registration import Proposal

POOR_NODES = 500  # a scene graph none of whose layers has this many nodes is poor
# A voted log scale is taken for 0, for refinement, below this plus the spread over the root of the number of
# correspondences.
_UNIT_LOG_SCALE = 0.005
_UNIT_LOG_SCALE_SPREAD = 0.05


class Proposing:
    """Rounds of proposals for one pair, each made when it is asked for.

    Args:
        notes: what a person should know is added here.
    """

    def __init__(self, target: SceneView, source: SceneView, params: Params, watch: Stopwatch) -> None:
        self.target, self.source, self.params, self.watch = target, source, params, watch
        self.policies = {target.scale_policy, source.scale_policy}
        self.notes: list[str] = []

    def rounds(self) -> Iterator[list[Proposal]]:
        """Rigid poses, unless a scene's unit is unknown; then poses with a voted scale, unless both scenes are known
        to be in metres; then what rests on no vertical, should one be wrong; then, where the graphs are poor, what the
        fallback proposes."""
        params = self.params
        if "unknown" not in self.policies:
            yield self._asked(params.proposer, "match", with_scale=False)
        if self.policies != {"known"} and family("proposer").get(params.proposer).SCALES:
            proposals = self._asked(params.proposer, "match", with_scale=True)
            yield proposals if "unknown" in self.policies else [in_metres(p) for p in proposals]
        yield self._unlevelled()
        if self._wants_fallback():
            yield self._asked(params.fallback_proposer, "fallback", with_scale=False)

    def _wants_fallback(self) -> bool:
        poor = num_nodes(self.target, self.source) < POOR_NODES
        wanted = {"never": False, "always": True, "auto": poor}[self.params.fallback]
        return wanted and "unknown" not in self.policies

    def _unlevelled(self) -> list[Proposal]:
        """What the landmarks of two scenes propose when neither vertical is believed: only significant cliques, for
        most pairs that come so far share nothing. Empty where a vertical is unknown, for then none was used."""
        target, source = unlevelled(self.target), unlevelled(self.source)
        if target is None or source is None:
            return []
        with_scale = "unknown" in self.policies
        found = self._asked(self.params.proposer, "match", with_scale=with_scale, views=(target, source))
        return [p for p in found if verdict.is_significant(p, self.params.verdict)]

    def _asked(
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
                self.notes.append(f"{error}: the proposer {name} was to be asked, and could not be")
                return []
        return found


def unlevelled(view: SceneView) -> SceneView | None:
    """A scene by its gravity-free landmarks alone, as if its vertical were unknown; None where it is, or has none."""
    free = {
        name.replace("landmarks_gravity_free", "landmarks"): layer
        for name, layer in view.graph.layers.items()
        if name.startswith("landmarks_gravity_free")
    }
    return (
        replace(view, graph=replace(view.graph, layers=free, up=None)) if free and view.graph.up is not None else None
    )


def in_metres(proposal: Proposal) -> Proposal:
    """The proposal as one between two scenes in metres, where its scale is 1 within what its correspondences can tell;
    what the scale is remains to be measured."""
    spread = _UNIT_LOG_SCALE + _UNIT_LOG_SCALE_SPREAD / np.sqrt(max(proposal.num_inliers, 1))
    near = abs(np.log(proposal.S_target_source.scale)) <= spread
    return replace(proposal, with_scale=False) if near else proposal


def num_nodes(*views: SceneView) -> int:
    """Nodes of the largest layer of the poorest graph."""
    return min(max((len(layer) for layer in view.graph.layers.values()), default=0) for view in views)
