"""Warp captures that no rigid pose aligns: for an export all onto one that keeps its shape, for a comparison one onto
the other."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

import numpy as np

from gsmap.errors import InputError
from gsmap.geometry.warps import Warp
from gsmap.map.jobs import load_view
from gsmap.map.settings import Settings
from gsmap.map.stages.describe import graph_keys, without_graph
from gsmap.methods import text_digest
from gsmap.store import Store
from gsmap.texts import counted, few
from gsmap.types import PoseGraph, Registration, Scene, ScenePose, Sim3
from gsmap.types.plain import canonical, plain
from gsmap.types.registration import DEFORMATION_NOTES


@dataclass(frozen=True, eq=False)
class _Edge:
    """A used edge: its registration, and whether no rigid pose aligns its scenes."""

    registration: Registration
    is_deformed: bool

    @property
    def with_scale(self) -> bool:
        """Return True if the scale of the pose was measured."""
        S = self.registration.S_target_source
        return S is not None and S.scale != 1.0

    @property
    def ends(self) -> tuple[str, str]:
        return self.registration.target, self.registration.source


@dataclass(frozen=True)
class DeformedPair:
    """A pair of scenes of which no rigid pose may align all.

    Args:
        graphs: digest of the key of each scene's graph, by scene id; scenes without a graph are left out.
        with_scale: the scale of the relative pose was measured.
    """

    graphs: Mapping[str, str]
    with_scale: bool

    def inputs(self) -> list[str]:
        """Return what a warp depends on besides the pose, for the key of a result."""
        from gsmap.register import VERSION  # imported for deformed captures alone: planning needs no registration

        return [f"warped {VERSION}", *(f"graph {scene} {self.graphs[scene]}" for scene in sorted(self.graphs))]

    def fit(self, store: Store, target: str, source: str, S_target_source: Sim3) -> tuple[Sim3, Warp | None] | None:
        """Fit the pose and, if it needs one, the warp of the source (`gsmap.register.deformation.warp_onto`); None
        where a graph is missing or the overlap is too small."""
        if len(self.graphs) < 2:
            return None
        from gsmap.register.deformation import warp_onto

        views = [load_view(store, scene, self.graphs[scene]) for scene in (target, source)]
        return warp_onto(views[0], views[1], S_target_source, with_scale=self.with_scale)


@dataclass(frozen=True, eq=False)
class WarpedCaptures:
    """Captures that are warped for a merge.

    Args:
        poses: new poses of scenes, by id; the other scenes keep theirs.
        warps: warps of scenes in their frames and units, which come before the poses.
        notes: remarks for the user.
    """

    poses: Mapping[str, ScenePose]
    warps: Mapping[str, Warp]
    notes: tuple[str, ...]

    def digests(self) -> dict[str, str]:
        """Return a digest of each scene's warp, rounded to about a ten-thousandth of its radius."""
        found = {}
        for scene, warp in self.warps.items():
            parts = (warp.centre / warp.radius, 3), (warp.strain, 4), (warp.bend, 4)
            rounded = [np.round(part, decimals) + 0.0 for part, decimals in parts]  # no -0.0
            found[scene] = text_digest(canonical([f"{warp.radius:.4g}", *plain(rounded)]))[:32]
        return found


def warp_captures(
    store: Store, settings: Settings, graph: PoseGraph, placed: Mapping[str, ScenePose], scenes: Mapping[str, Scene]
) -> WarpedCaptures:
    """Warp the captures of each component that has edges which no rigid pose aligns.

    Nothing in a pair tells which of two captures is bent. The capture with most overlap with captures that agree with
    it keeps its shape (then: with most overlap at all, with most Gaussians). The others follow along a spanning tree of
    the edges, those that agree first, then by overlap: each is warped onto the capture before it. A capture that agrees
    with an unchanged one keeps its shape and its pose.
    """
    edges = _used_edges(store, graph, placed)
    components = {placed[edge.ends[0]].component for edge in edges if edge.is_deformed}
    if not components:
        return WarpedCaptures({}, {}, ("no capture is stretched or bent: --nonrigid changes nothing",))
    edges = [edge for edge in edges if placed[edge.ends[0]].component in components]
    members = sorted({end for edge in edges for end in edge.ends})
    keys = graph_keys(store, [scenes[scene] for scene in members], settings)
    if missing := without_graph(store, keys):
        name = scenes[missing[0]].name
        raise InputError(f"scene {name} has no graph: run gsmap describe MAP {name!r} first", code="no_graph")
    from gsmap.register.deformation import warp_onto

    poses, warps, notes = dict[str, ScenePose](), dict[str, Warp](), list[str]()
    for component in sorted(components):
        anchor, tree = _spanning_tree([edge for edge in edges if placed[edge.ends[0]].component == component], scenes)
        notes.append(f"component {component}: capture {scenes[anchor].name} keeps its shape")
        for parent, child, edge in tree:
            if not edge.is_deformed and parent not in poses:
                continue
            before = poses.get(parent, placed[parent]).S_map_scene
            target, source = (load_view(store, scene, keys[scene].digest) for scene in (parent, child))
            found = warp_onto(
                target,
                source,
                before.inverse() @ placed[child].S_map_scene,
                with_scale=edge.with_scale,
                target_warp=warps.get(parent),
            )
            names = scenes[child].name, scenes[parent].name
            if found is None:
                notes.append(f"capture {names[0]} keeps its shape: it shares too little with {names[1]}")
                continue
            S_parent_child, warp = found
            if warp is None and parent not in poses:
                notes.append(f"capture {names[0]} keeps its shape: under the poses of the map it fits {names[1]}")
                continue
            poses[child] = replace(placed[child], S_map_scene=before @ S_parent_child)
            if warp is not None:
                warps[child] = warp
                notes.append(f"capture {names[0]} is warped onto {names[1]}")
    return WarpedCaptures(poses, warps, tuple(notes))


def deformed_pairs(
    store: Store, settings: Settings, graph: PoseGraph, pairs: Collection[tuple[str, str]]
) -> dict[tuple[str, str], DeformedPair]:
    """Return the pairs of scenes that no rigid pose may align: their own edge is named as stretched or bent, or they
    have none and no path of other edges joins them."""
    if not pairs or not store.registrations.current_with_note(*DEFORMATION_NOTES):
        return {}
    edges = {frozenset(edge.ends): edge for edge in _used_edges(store, graph, graph.poses)}
    shapes = {scene: {scene} for scene in graph.poses}
    for edge in edges.values():
        target, source = (shapes[end] for end in edge.ends)
        if not edge.is_deformed and target is not source:
            target |= source
            shapes |= dict.fromkeys(source, target)
    own = {pair: edges.get(frozenset(pair)) for pair in pairs}
    deformed = {graph.poses[edge.ends[0]].component for edge in edges.values() if edge.is_deformed}
    found = {
        pair: edge
        for pair, edge in own.items()
        if (edge.is_deformed if edge else graph.poses[pair[0]].component in deformed and pair[1] not in shapes[pair[0]])
    }
    scenes = [store.scenes.get(scene) for scene in sorted({scene for pair in found for scene in pair})]
    keys = graph_keys(store, scenes, settings)
    lacking = without_graph(store, keys)
    graphs = {scene: key.digest for scene, key in keys.items() if scene not in lacking}
    return {
        pair: DeformedPair({scene: graphs[scene] for scene in pair if scene in graphs}, bool(edge and edge.with_scale))
        for pair, edge in found.items()
    }


def rigid_note(
    store: Store, graph: PoseGraph, placed: Mapping[str, ScenePose], scenes: Mapping[str, Scene]
) -> tuple[str, ...]:
    """Return a note on the pairs that no rigid pose aligns, for a merge that warps nothing."""
    if not store.registrations.current_with_note(*DEFORMATION_NOTES):
        return ()
    edges = [edge for edge in _used_edges(store, graph, placed) if edge.is_deformed]
    if not edges:
        return ()
    names = few(sorted(":".join(scenes[end].name for end in edge.ends) for edge in edges))
    return (
        f"no rigid pose aligns all of {counted(len(edges), 'pair')} ({names}), since a capture is bent or stretched: "
        "surfaces are double, or missing from the older capture; --nonrigid warps it",
    )


def _used_edges(store: Store, graph: PoseGraph, placed: Mapping[str, ScenePose]) -> list[_Edge]:
    found = (one.registration for one in store.registrations.current_usable(placed))
    return [
        _Edge(one, any(note.startswith(DEFORMATION_NOTES) for note in one.notes))
        for one in found
        if graph.use(one.target, one.source) != "unused"
        and placed[one.target].component == placed[one.source].component
    ]


def _spanning_tree(edges: list[_Edge], scenes: Mapping[str, Scene]) -> tuple[str, list[tuple[str, str, _Edge]]]:
    """Return the capture that keeps its shape, and (parent, child, edge) for every other capture of a component."""
    agreeing, total = dict[str, float](), dict[str, float]()
    for edge in edges:
        for end in edge.ends:
            overlap = float(np.nan_to_num(edge.registration.overlap))
            agreeing[end] = agreeing.get(end, 0.0) + overlap * (not edge.is_deformed)
            total[end] = total.get(end, 0.0) + overlap
    anchor = max(total, key=lambda scene: (agreeing[scene], total[scene], scenes[scene].num_gaussians, scene))
    order = sorted(edges, key=lambda e: (e.is_deformed, -float(np.nan_to_num(e.registration.overlap)), e.ends))
    reached, tree = {anchor}, list[tuple[str, str, _Edge]]()
    while crossing := next((e for e in order if len(reached.intersection(e.ends)) == 1), None):
        parent, child = crossing.ends if crossing.ends[0] in reached else crossing.ends[::-1]
        reached.add(child)
        tree.append((parent, child, crossing))
    return anchor, tree
