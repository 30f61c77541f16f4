"""Scenes in metres: what each unit is taken for, and what is computed under it.

These metres are *working metres*: under them both scenes look like rooms do, for which all lengths of refinement,
evidence and covariance are meant. Where scenes in metres are seen from as near as rooms are, they are metres; where a
court is seen from 7 m, one is four, whether or not the scenes' unit is known.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gsmap.methods.refiner import Correspondences
from gsmap.register import verdict
from gsmap.register.evidence import Views
from gsmap.register.params import Params
from gsmap.register.scene_view import SceneView
from gsmap.register.surface import Surface
from gsmap.types import SceneGraph, Sim3
from gsmap.types.registration import Proposal


@dataclass(frozen=True, eq=False)
class MetricScene:
    """One scene with its unit taken for ``unit_m`` metres."""

    view: SceneView
    unit_m: float

    @property
    def graph(self) -> SceneGraph:
        return self.view.graph

    def surface(self) -> Surface:
        """The scene's surface in metres."""
        return self.view.surface(self.unit_m)

    def views(self) -> Views:
        """The scene through its own cameras, and metres per unit; None without cameras."""
        cache = self.view.views
        return None if cache is None else (cache, self.unit_m)


@dataclass(frozen=True, eq=False)
class MetricPair:
    """Both scenes in the target's metres, the source with the proposed scale: what remains is nearly rigid.

    ``ties``: the correspondences that the proposal rests on, in these metres; None where chance explains them.
    """

    target: MetricScene
    source: MetricScene
    scale: float
    ties: Correspondences | None = None

    @classmethod
    def of(cls, target: SceneView, source: SceneView, proposal: Proposal, params: Params) -> MetricPair:
        """The frames in which a proposal is refined and judged."""
        scale = proposal.S_target_source.scale
        unit_m = working_unit_m(target, source, with_scale=proposal.with_scale)
        if proposal.with_scale and source.scale_policy == "known":
            unit_m = source.graph.working_m / scale  # the source knows what a metre is, the target only guesses
        pair = cls(MetricScene(target, unit_m), MetricScene(source, unit_m * scale), scale)
        return replace(pair, ties=pair.tied(proposal)) if verdict.is_rare(proposal, params.verdict) else pair

    @property
    def policies(self) -> set[str]:
        """How the units of both are known: `SceneView.scale_policy`."""
        return {self.target.view.scale_policy, self.source.view.scale_policy}

    def tied(self, proposal: Proposal) -> Correspondences | None:
        """The correspondences that a proposal rests on, in metres; None where there are none."""
        if proposal.support is None:
            return None
        target, source = proposal.support.points
        return target * self.target.unit_m, source * self.source.unit_m

    def to_metres(self, S_target_source: Sim3) -> Sim3:
        """A pose of the proposed scale, between the scenes' own units, as one between metres."""
        return Sim3(S_target_source.rotation, S_target_source.translation * self.target.unit_m)

    def to_scene_units(self, pose: Sim3) -> Sim3:
        """A pose between metres as one between the scenes' own units."""
        return Sim3(pose.rotation, pose.translation / self.target.unit_m, pose.scale * self.scale)


def working_unit_m(target: SceneView, source: SceneView, *, with_scale: bool) -> float:
    """Working metres per target unit; scenes that have one unit have one working metre, between both of theirs."""
    if _is_metre(target, with_scale) or (target.scale_policy == source.scale_policy == "known"):
        return float(np.sqrt(target.graph.working_m * source.graph.working_m))
    return target.graph.working_m if target.scale_policy == "known" else target.graph.unit_m


def own_working_m(view: SceneView) -> float:
    """Working metres per unit of a scene by itself: of a guess where the scale is not known."""
    return view.graph.working_m if view.scale_policy == "known" else view.graph.unit_m


def target_unit_m(target: SceneView, *, with_scale: bool) -> float:
    """Metres per target unit: 1 where metres are plausible and nothing else is asked for, else the guess."""
    return 1.0 if _is_metre(target, with_scale) or target.scale_policy == "known" else target.graph.unit_m


def _is_metre(target: SceneView, with_scale: bool) -> bool:
    """Whether the target's own unit is taken for the metre: its graph holds landmarks made under it."""
    return not with_scale and "landmarks" in target.graph.layers
