"""Explain a pair on the page: its steps with their thresholds, and matching landmarks."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from gsmap.map.pair_explanation import explain_pair
from gsmap.map.reports import pair_report
from gsmap.store import Store
from gsmap.types import NodeLayer, Scene, SceneGraph, Sim3
from gsmap.types.rows.pairs import ExplanationStep
from gsmap.view.contract import PairDetail, PairEvent, Step, entry_of

if TYPE_CHECKING:
    from gsmap.map.settings import Settings

_CORRESPONDENCES = 400  # shown of a pair
_SAME_M = 0.25  # landmarks of one thing lie so near to each other at most
_LAYERS = ("landmarks", "landmarks:1", "objects")


def pair_detail(
    store: Store, settings: Settings, a: Scene, b: Scene, S_map_target: Sim3, *, has_buttons: bool = False
) -> PairDetail:
    """Return the explanation of a pair, without its scenes and views.

    Args:
        S_map_target: the shown pose of the target.
        has_buttons: name the buttons of the page in place of commands.
    """
    said, pair = explain_pair(store, settings, a, b, has_buttons=has_buttons), pair_report(store, a, b)
    S = pair.S_target_source
    ends = (pair.target, pair.source)
    shared = [] if S is None else correspondences(store, ends, S, S_map_target)
    return {
        "S_target_source": None if S is None else S.matrix().tolist(),
        "steps": [{**entry_of(step, Step), "value": _text(step)} for step in said.steps],
        "advice": [said.advice] if said.advice else [],
        "correspondences": shared,
        "events": [entry_of(one, PairEvent) for one in pair.history],
    }


def correspondences(
    store: Store, pair: tuple[str, str], S_target_source: Sim3, S_map_target: Sim3
) -> list[list[list[float]]]:
    """Return pairs of landmarks, one per graph, that are mutually nearest and within 0.25 m under the edge's pose: the
    target's and the source's points, in the map frame by the target's pose.

    Those that registration chose its pose by are not kept; these are what bears it out.
    """
    layers = [_layer(store.graphs.load(scene)) for scene in pair]
    if layers[0] is None or layers[1] is None:
        return []
    own, other = layers[0].positions.astype(np.float64), S_target_source.apply(layers[1].positions.astype(np.float64))
    near, row = cKDTree(own).query(other)
    back = cKDTree(other).query(own)[1]
    rows = np.arange(len(other))
    same = rows[(back[row] == rows) & (near * layers[0].unit_m < _SAME_M)]
    same = same[np.argsort(near[same], kind="stable")][:_CORRESPONDENCES]
    pairs = np.stack([S_map_target.apply(own[row[same]]), S_map_target.apply(other[same])], axis=1)
    found: list[list[list[float]]] = pairs.tolist()
    return found


def _layer(graph: SceneGraph | None) -> NodeLayer | None:
    """Return the densest layer of nodes of a graph."""
    layers = {} if graph is None else graph.layers
    return next((layers[name] for name in _LAYERS if name in layers and len(layers[name])), None)


def _text(step: ExplanationStep) -> str:
    if step.value is None:
        return "–"
    return f"{step.value:.3g}" if isinstance(step.value, float) else str(step.value)
