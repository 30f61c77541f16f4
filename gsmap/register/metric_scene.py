"""Scale a scene, or a pair of scenes, to the working metres in which poses are refined and verified.

All lengths of refinement, evidence and covariance are meant for rooms. *Working metres* make both scenes look like
rooms. They equal metres for scenes that are viewed from as near as rooms are; for a courtyard that is viewed from 7 m
one working metre is four metres, whether or not the scenes' unit is known.
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
    """A scene whose unit is ``unit_m`` working metres."""

    view: SceneView
    unit_m: float

    @property
    def graph(self) -> SceneGraph:
        return self.view.graph

    def surface(self) -> Surface:
        """Return the scene's surface in working metres."""
        return self.view.surface(self.unit_m)

    def views(self) -> Views:
        """Return the scene's views and the working metres per unit of the scene; None without cameras."""
        cache = self.view.views
        return None if cache is None else (cache, self.unit_m)


@dataclass(frozen=True, eq=False)
class MetricPair:
    """Both scenes in the target's working metres, the source scaled by the proposal: the remaining pose is nearly
    rigid.

    Args:
        scale: scale of the proposed pose.
        correspondences: correspondences of the proposal, in working metres; None where chance explains them.
    """

    target: MetricScene
    source: MetricScene
    scale: float
    correspondences: Correspondences | None = None

    @classmethod
    def of(cls, target: SceneView, source: SceneView, proposal: Proposal, params: Params) -> MetricPair:
        """Scale two scenes for the refinement and verification of a proposal."""
        scale = proposal.S_target_source.scale
        unit_m = working_unit_m(target, source, with_scale=proposal.with_scale)
        if proposal.with_scale and source.scale_policy == "known":
            unit_m = source.graph.working_m / scale  # the source is in metres, the target's unit is estimated
        pair = cls(MetricScene(target, unit_m), MetricScene(source, unit_m * scale), scale)
        return (
            replace(pair, correspondences=pair.correspondences_of(proposal))
            if verdict.has_low_nfa(proposal, params.verdict)
            else pair
        )

    @property
    def policies(self) -> set[str]:
        """Scale policies of both scenes (`SceneView.scale_policy`)."""
        return {self.target.view.scale_policy, self.source.view.scale_policy}

    def correspondences_of(self, proposal: Proposal) -> Correspondences | None:
        """Return the correspondences of a proposal in working metres; None where it has none."""
        if proposal.support is None:
            return None
        target, source = proposal.support.points
        return target * self.target.unit_m, source * self.source.unit_m

    def to_metres(self, S_target_source: Sim3) -> Sim3:
        """Convert a pose from the scenes' own units to working metres."""
        S = S_target_source
        return Sim3(S.rotation, S.translation * self.target.unit_m, S.scale / self.scale)

    def to_scene_units(self, pose: Sim3) -> Sim3:
        """Convert a pose from working metres to the scenes' own units."""
        return Sim3(pose.rotation, pose.translation / self.target.unit_m, pose.scale * self.scale)


def working_unit_m(target: SceneView, source: SceneView, *, with_scale: bool) -> float:
    """Return working metres per target unit; if both scenes have the same unit, the geometric mean of both scenes'
    values."""
    if _is_metre(target, with_scale) or (target.scale_policy == source.scale_policy == "known"):
        return float(np.sqrt(target.graph.working_m * source.graph.working_m))
    return target.graph.working_m if target.scale_policy == "known" else target.graph.unit_m


def own_working_m(view: SceneView) -> float:
    """Return the working metres per unit of a single scene; where the unit is unknown, by the estimated unit."""
    return view.graph.working_m if view.scale_policy == "known" else view.graph.unit_m


def target_unit_m(target: SceneView, *, with_scale: bool) -> float:
    """Return metres per target unit: 1 where the unit is known to be or may be the metre, otherwise the estimated
    value."""
    return 1.0 if _is_metre(target, with_scale) or target.scale_policy == "known" else target.graph.unit_m


def _is_metre(target: SceneView, with_scale: bool) -> bool:
    """Return whether the target's unit may be the metre: its graph has landmarks of metric size."""
    return not with_scale and "landmarks" in target.graph.layers
