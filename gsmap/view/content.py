"""Content of the page as `gsmap/view/page/src/contract.ts` defines it, and its conversion to JSON.

Nothing here reads anything: `gsmap.view.page_source` says what is loaded when the page asks for it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from gsmap.geometry.boxes import box_around, box_corners
from gsmap.geometry.uncertainty import middle_covariance_m2
from gsmap.types import Scene, ScenePose, Sim3

SCHEMA = 1
UNPLACED_UP = (0.0, -1.0, 0.0)
"""Against gravity in the frame of a scene of which nothing is known: trainers' frames are right, down, front."""


@dataclass(frozen=True, eq=False)
class ViewScene:
    """One scene.

    Args:
        key: names its present content, in addresses and in the cache.
        pose: None where nothing placed it; it is then a component of its own.
        up: (3,) against gravity in its frame; None where nobody knows.
        prior: what was told of where it lies, in words; None where nothing was.
        prior_number: which of what was ever told that is.
    """

    scene: Scene
    key: str
    pose: ScenePose | None
    up: np.ndarray | None = None
    prior: str | None = None
    prior_number: int | None = None

    @property
    def S_map_scene(self) -> Sim3:
        return self.pose.S_map_scene if self.pose is not None else Sim3.identity()


@dataclass(frozen=True)
class ViewEdge:
    """One pair that was tried.

    Args:
        target, source: scene ids.
        status: ``accepted``, ``rejected`` or ``no_match``, a review included.
        used: what the last optimize made of it: True, False or ``"tentative"``; None before.
        undecided: whether nothing could tell if it is right.
        review: a person's standing word, ``confirm`` or ``reject``, and what they noted of it.
        probability: that it is right; None where unknown.
        doubt: how much a person is needed, 0 to 1.
    """

    target: str
    source: str
    status: str
    reason: str = ""
    used: bool | str | None = None
    undecided: bool = False
    review: str | None = None
    note: str = ""
    probability: float | None = None
    overlap: float = 0.0
    num_inliers: int = 0
    doubt: float = 0.0


@dataclass(frozen=True)
class ViewRevision:
    """One answer of the optimiser; ``is_kept``: whether its poses are still there."""

    id: int
    created_at: str
    num_scenes: int
    num_edges_used: int
    is_kept: bool = True


@dataclass(frozen=True, eq=False)
class ViewChange:
    """Change between two scenes (ids).

    Args:
        box: (2, 3) map frame.
        note: of the review.
    """

    id: str
    kind: str
    component: int
    box: np.ndarray
    before: str
    after: str
    at: str | None
    confidence: float
    status: str
    note: str = ""


@dataclass(frozen=True, eq=False)
class ViewPhoto:
    """A photograph that was localised.

    Args:
        T_map_camera: (4, 4) pose.
        intrinsics_px: (4,) fx, fy, cx, cy.
        size_px: width and height.
    """

    file: str
    component: int
    T_map_camera: np.ndarray
    intrinsics_px: np.ndarray
    size_px: tuple[int, int]
    captured_at: str | None = None


@dataclass(frozen=True, eq=False)
class ViewMap:
    """A map at one moment.

    Args:
        state: another one whenever the map has changed.
        revision: whose poses these are; None before the first.
        metres_per_unit: of each component of the poses.
        merged: components of which merged tiles were given.
        has_objects: whether anything is told of objects.
        stale: whether `gsmap optimize` would see anything that these poses have not.
    """

    title: str
    scenes: Sequence[ViewScene] = ()
    edges: Sequence[ViewEdge] = ()
    revisions: Sequence[ViewRevision] = ()
    changes: Sequence[ViewChange] = ()
    photos: Sequence[ViewPhoto] = ()
    state: str = ""
    revision: int | None = None
    metres_per_unit: Mapping[int, float] = field(default_factory=dict)
    merged: frozenset[int] = frozenset()
    has_objects: bool = False
    stale: bool = False

    def components(self) -> list[int]:
        """The island of every scene; scenes that nothing placed come after the others, one each."""
        last = 1 + max((s.pose.component for s in self.scenes if s.pose is not None), default=-1)
        return [s.pose.component if s.pose else last + i for i, s in enumerate(self.scenes)]


@dataclass(frozen=True)
class ViewOverview:
    """The coarsest levels of an island's scenes in one file.

    Args:
        scenes: by their place in the map's list.
        counts: Gaussians of each.
        pending: scenes that are not in it yet.
        heights: of floor and ceiling of each, along the component's up: nearly all of it lies between.
        size: length, width and height of it all, map units; None while nothing is in it.
    """

    uri: str
    scenes: tuple[int, ...] = ()
    counts: tuple[int, ...] = ()
    pending: int = 0
    heights: tuple[tuple[float, float], ...] = ()
    size: tuple[float, float, float] | None = None


@dataclass(frozen=True, eq=False)
class ServerState:
    """State that a server or a static page adds to a map: its answers, and its levels of detail.

    Args:
        actions: true if reviews are allowed.
        boxes: (2, 3) of what a scene shows, without floaters, scene frame, by key; the scene's bounds elsewhere.
        overviews: by component.
        live: true for a server, which computes more on request; false for a static page.
        drawn: ids of the changes with pictures on a static page.
    """

    actions: bool = False
    boxes: Mapping[str, np.ndarray] = field(default_factory=dict)
    overviews: Mapping[int, ViewOverview] = field(default_factory=dict)
    live: bool = True
    drawn: frozenset[str] = frozenset()


def summary(view: ViewMap, served: ServerState) -> dict[str, Any]:
    """``map.json``: everything the page lists."""
    components = view.components()
    at = {entry.scene.id: index for index, entry in enumerate(view.scenes)}
    boxes = [served.boxes.get(entry.key, entry.scene.bounds) for entry in view.scenes]
    corners = [entry.S_map_scene.apply(box_corners(box)) for entry, box in zip(view.scenes, boxes, strict=True)]
    members: dict[int, list[int]] = {}
    for index, component in enumerate(components):
        members.setdefault(component, []).append(index)
    edges = [edge for edge in view.edges if edge.target in at and edge.source in at]
    edges.sort(key=lambda edge: -edge.doubt)
    return {
        "schema": SCHEMA,
        "state": view.state,
        "title": view.title,
        "actions": served.actions,
        "revision": view.revision,
        "stale": view.stale,
        "components": [
            {
                "component": component,
                "num_scenes": len(members[component]),
                "up": up_of([view.scenes[i] for i in members[component]]),
                "metres_per_unit": view.metres_per_unit.get(component, 1.0),
                "box": box_around(np.concatenate([corners[i] for i in members[component]])).tolist(),
                "overview": _overview(served.overviews.get(component)),
                "merged": f"merged/{component}/tileset.json" if component in view.merged else None,
            }
            for component in sorted(members)
        ],
        "scenes": [
            _scene(entry, component, box, entry_corners, view.metres_per_unit.get(component, 1.0))
            for entry, component, box, entry_corners in zip(view.scenes, components, boxes, corners, strict=True)
        ],
        "edges": [_edge(edge, at) for edge in edges],
        "revisions": [
            {
                "id": one.id,
                "created_at": one.created_at,
                "num_scenes": one.num_scenes,
                "num_edges_used": one.num_edges_used,
                "poses": f"revisions/{one.id}.json" if one.is_kept else None,
            }
            for one in view.revisions
        ],
        "changes": [
            {
                "id": one.id,
                "kind": one.kind,
                "component": one.component,
                "box": one.box.tolist(),
                "before": at[one.before],
                "after": at[one.after],
                "at": one.at,
                "confidence": _number(one.confidence) or 0.0,
                "status": one.status,
                "note": one.note,
                "pictures": f"changes/{one.id}.jpg" if served.live or one.id in served.drawn else None,
            }
            for one in view.changes
            if one.before in at and one.after in at
        ],
        "photos": [
            {
                "file": one.file,
                "component": one.component,
                "T_map_camera": one.T_map_camera.tolist(),
                "intrinsics": one.intrinsics_px.tolist(),
                "size": list(one.size_px),
                "captured_at": one.captured_at,
            }
            for one in view.photos
        ],
        "counts": {"gaussians": sum(entry.scene.num_gaussians for entry in view.scenes)},
        "graph": "graph.json" if view.has_objects else None,
        "history": "history.json" if served.live else None,
    }


def up_of(scenes: Sequence[ViewScene]) -> list[float]:
    """Against gravity in the frame of an island, by what most of its scenes say; where none does, z of the map, or what
    trainers use."""
    told = [entry.S_map_scene.rotation @ entry.up for entry in scenes if entry.up is not None]
    middle = np.median(np.array(told), axis=0) if told else np.zeros(3)
    size = float(np.linalg.norm(middle))
    if size > 1e-3:
        return [float(value) for value in middle / size]
    is_alone = len(scenes) == 1 and (scenes[0].pose is None or scenes[0].pose.status == "isolated")
    return list(UNPLACED_UP) if is_alone else [0.0, 0.0, 1.0]


def _scene(
    entry: ViewScene, component: int, box: np.ndarray, corners: np.ndarray, metres_per_unit: float
) -> dict[str, Any]:
    pose, scene, middle = entry.pose, entry.scene, box.mean(0)
    covariance_m2 = None if pose is None else middle_covariance_m2(pose, middle, metres_per_unit)
    sigma_m = ellipsoid = None
    if covariance_m2 is not None:
        sigma_m = float(np.sqrt(max(0.0, float(np.linalg.eigvalsh(covariance_m2)[-1]))))
        ellipsoid = (covariance_m2 / metres_per_unit**2).tolist()
    return {
        "id": scene.id,
        "name": scene.name,
        "num_gaussians": scene.num_gaussians,
        "num_cameras": scene.num_cameras,
        "captured_at": scene.captured_at,
        "component": component,
        "status": pose.status if pose is not None else "not placed",
        "S_map_scene": entry.S_map_scene.matrix().tolist(),
        "box": box.tolist(),
        "corners": corners.tolist(),
        "sigma_m": sigma_m,
        "ellipsoid": ellipsoid,
        "middle": entry.S_map_scene.apply(middle[None])[0].tolist(),
        "tileset": f"scenes/{entry.key}/tileset.json",
        "extras": f"scenes/{scene.id}/extras.json",
        "tags": list(scene.tags),
        "prior": entry.prior,
        "prior_number": entry.prior_number,
    }


def _edge(edge: ViewEdge, at: Mapping[str, int]) -> dict[str, Any]:
    return {
        "target": at[edge.target],
        "source": at[edge.source],
        "status": edge.status,
        "used": edge.used,
        "undecided": edge.undecided,
        "review": edge.review,
        "note": edge.note,
        "reason": edge.reason,
        "probability": _number(edge.probability),
        "overlap": _number(edge.overlap) or 0.0,
        "num_inliers": edge.num_inliers,
        "doubt": edge.doubt,
        "detail": f"edges/{edge.target}-{edge.source}.json",
    }


def _overview(one: ViewOverview | None) -> dict[str, Any] | None:
    if one is None:
        return None
    told = {"uri": one.uri, "pending": one.pending, "scenes": list(one.scenes), "counts": list(one.counts)}
    size = None if one.size is None else list(one.size)
    return told | {"heights": [list(pair) for pair in one.heights], "size": size}


def _number(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else float(value)
