"""The content of the page, and its conversion to the JSON that `gsmap.view.contract` defines.

This module reads no files; `gsmap.view.page_source` loads what the page requests.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from gsmap.geometry.boxes import box_around, box_corners
from gsmap.geometry.directions import median_direction
from gsmap.geometry.uncertainty import largest_sigma, middle_covariance_m2
from gsmap.types import Scene, ScenePose, Sim3
from gsmap.types.plain import fields_of, plain
from gsmap.types.scene import SceneFacts
from gsmap.view.contract import (
    ChangeEntry,
    EdgeEntry,
    MapSummary,
    Overview,
    PhotoEntry,
    RevisionEntry,
    SceneEntry,
)

UNPLACED_UP = (0.0, -1.0, 0.0)
"""Up direction assumed for a scene whose up direction is unknown, as frames of trainers are right, down, front."""


@dataclass(frozen=True, eq=False)
class ViewScene:
    """A scene on the page.

    Args:
        scene: The scene.
        key: Key of its current content, in addresses and in the cache.
        pose: Estimated pose; None if the scene is not placed, and a component of its own.
        up: (3,) direction opposite to gravity in the scene frame; None if unknown.
        prior: Description of its pose prior and its number in the history of priors, or None for both.
        one_pair: The scene is tentative only because single pairs place it, which nothing contradicts.
    """

    scene: Scene
    key: str
    pose: ScenePose | None
    up: np.ndarray | None = None
    prior: tuple[str | None, int | None] = (None, None)
    one_pair: bool = False

    @property
    def S_map_scene(self) -> Sim3:
        return self.pose.S_map_scene if self.pose is not None else Sim3.identity()


@dataclass(frozen=True, eq=False)
class ViewMap:
    """The content of the page at one time.

    Args:
        title: Name of the map.
        scenes: Scenes of the map.
        edges: Edges between these scenes, the most doubtful first.
        revisions, changes, photos: Further content of the map.
        state: Opaque text that differs after every change of the map.
        revision: Revision of the poses; None before the first.
        metres_per_unit: Metres per map unit of each component.
        scale_sigma: Standard deviation of its logarithm; a component of unknown scale is missing.
        merged: Components with merged tiles.
        compared: Pairs (older, newer) of indices of scenes that were compared for changes.
        uncompared: Pairs that ``gsmap changes`` would compare.
        has_objects: The map has objects.
        stale: The poses are outdated, because edges or priors changed after the revision.
    """

    title: str
    scenes: Sequence[ViewScene] = ()
    edges: Sequence[EdgeEntry] = ()
    revisions: Sequence[RevisionEntry] = ()
    changes: Sequence[ChangeEntry] = ()
    photos: Sequence[PhotoEntry] = ()
    state: str = ""
    revision: int | None = None
    metres_per_unit: Mapping[int, float] = field(default_factory=dict)
    scale_sigma: Mapping[int, float] = field(default_factory=dict)
    merged: frozenset[int] = frozenset()
    compared: Sequence[list[int]] = ()
    uncompared: Sequence[list[int]] = ()
    has_objects: bool = False
    stale: bool = False

    def components(self) -> list[int]:
        """Return the component of each scene; each scene without a pose gets a new component of its own."""
        last = 1 + max((s.pose.component for s in self.scenes if s.pose is not None), default=-1)
        return [s.pose.component if s.pose else last + i for i, s in enumerate(self.scenes)]


@dataclass(frozen=True, eq=False)
class ViewExtent:
    """Extent of the scenes of an overview in the map frame, without outliers.

    Args:
        corners: (8, 3) corners of an upright box around each scene, the lower four first.
        frame: (8, 3) corners of an upright box around all scenes, in the same order.
        outline: (K, 3) points around their floor, closer than the box.
        box: (2, 3) box along the axes of the map around all scenes.
        size: Length, width and height of ``frame``.
        has_ceiling: Most of the floor has something above it.
    """

    corners: tuple[np.ndarray, ...]
    frame: np.ndarray
    outline: np.ndarray
    box: np.ndarray
    size: tuple[float, float, float]
    has_ceiling: bool


@dataclass(frozen=True)
class ViewOverview:
    """An overview of a component: the coarsest levels of its scenes in one file.

    Args:
        uri: Address of the file.
        scenes: Indices of its scenes in the map's list.
        counts: Number of Gaussians of each scene.
        pending: Number of scenes that the overview still lacks.
        extent: Extent of its scenes; None if the overview is empty.
    """

    uri: str
    scenes: tuple[int, ...] = ()
    counts: tuple[int, ...] = ()
    pending: int = 0
    extent: ViewExtent | None = None


@dataclass(frozen=True, eq=False)
class ServerState:
    """Content that a server or a static page adds to the content of a map.

    Args:
        actions: The page offers reviews and edits.
        boxes: Bounding boxes (2, 3) of scenes by key, scene frame, without floaters; default: the scene's bounds.
        overviews: Overviews by component.
        live: A server computes further content on request.
        drawn: Changes with pictures on a static page.
    """

    actions: bool = False
    boxes: Mapping[str, np.ndarray] = field(default_factory=dict)
    overviews: Mapping[int, ViewOverview] = field(default_factory=dict)
    live: bool = True
    drawn: frozenset[str] = frozenset()


def summary(view: ViewMap, served: ServerState) -> MapSummary:
    """Return the content of ``map.json``, which has the lists of the page."""
    components = view.components()
    boxes = [served.boxes.get(entry.key, entry.scene.bounds) for entry in view.scenes]
    corners = [entry.S_map_scene.apply(box_corners(box)) for entry, box in zip(view.scenes, boxes, strict=True)]
    for overview in served.overviews.values():
        if overview.extent is not None:
            for index, upright in zip(overview.scenes, overview.extent.corners, strict=True):
                corners[index] = upright
    members: dict[int, list[int]] = {}
    for index, component in enumerate(components):
        members.setdefault(component, []).append(index)
    return {
        "schema": 1,
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
                "scale_sigma": view.scale_sigma.get(component),
                "box": _box(served.overviews.get(component), [corners[i] for i in members[component]]).tolist(),
                "plan": f"plans/{component}.json" if served.live and view.revision is not None else None,
                "overview": _overview(served.overviews.get(component)),
                "merged": f"merged/{component}/tileset.json" if component in view.merged else None,
            }
            for component in sorted(members)
        ],
        "scenes": [
            _scene(entry, component, box, entry_corners, view.metres_per_unit.get(component, 1.0))
            for entry, component, box, entry_corners in zip(view.scenes, components, boxes, corners, strict=True)
        ],
        "edges": list(view.edges),
        "revisions": list(view.revisions),
        "changes": [
            one if served.live or one["id"] in served.drawn else {**one, "pictures": None} for one in view.changes
        ],
        "compared": list(view.compared),
        "uncompared": list(view.uncompared),
        "photos": list(view.photos),
        "counts": {"gaussians": sum(entry.scene.num_gaussians for entry in view.scenes)},
        "graph": "graph.json" if view.has_objects else None,
        "history": "history.json" if served.live else None,
    }


def up_of(scenes: Sequence[ViewScene]) -> list[float]:
    """Return the up direction of a component, the median over its scenes.

    Default: z of the map, or `UNPLACED_UP` for a single scene without edges.
    """
    ups = [entry.S_map_scene.rotation @ entry.up for entry in scenes if entry.up is not None]
    if (up := median_direction(np.array(ups))) is not None:
        return [float(value) for value in up]
    is_alone = len(scenes) == 1 and (scenes[0].pose is None or scenes[0].pose.status == "isolated")
    return list(UNPLACED_UP) if is_alone else [0.0, 0.0, 1.0]


def _scene(
    entry: ViewScene, component: int, box: np.ndarray, corners: np.ndarray, metres_per_unit: float
) -> dict[str, Any]:
    pose, scene, middle = entry.pose, entry.scene, box.mean(0)
    covariance_m2 = None if pose is None else middle_covariance_m2(pose, middle, metres_per_unit)
    sigma_m = ellipsoid = None
    if covariance_m2 is not None:
        sigma_m = largest_sigma(covariance_m2)
        ellipsoid = (covariance_m2 / metres_per_unit**2).tolist()
    placed: SceneEntry = {
        "component": component,
        "status": "one pair" if entry.one_pair else pose.status if pose is not None else "not placed",
        "S_map_scene": entry.S_map_scene.matrix().tolist(),
        "box": box.tolist(),
        "corners": corners.tolist(),
        "sigma_m": sigma_m,
        "ellipsoid": ellipsoid,
        "middle": entry.S_map_scene.apply(middle[None])[0].tolist(),
        "tileset": f"scenes/{entry.key}/tileset.json",
        "extras": f"scenes/{scene.id}/extras.json",
        "tags": list(scene.tags),
        "prior": entry.prior[0],
        "prior_number": entry.prior[1],
    }
    return {name: plain(value) for name, value in fields_of(scene, SceneFacts).items()} | placed


def _overview(one: ViewOverview | None) -> Overview | None:
    if one is None:
        return None
    extent = one.extent
    return {
        "uri": one.uri,
        "pending": one.pending,
        "scenes": list(one.scenes),
        "counts": list(one.counts),
        "frame": None if extent is None else extent.frame.tolist(),
        "outline": None if extent is None else extent.outline.tolist(),
        "size": None if extent is None else list(extent.size),
        "has_ceiling": extent is not None and extent.has_ceiling,
    }


def _box(overview: ViewOverview | None, corners: Sequence[np.ndarray]) -> np.ndarray:
    """Return the box of a component: of its Gaussians in the map frame, or of the boxes of its scenes."""
    if overview is not None and overview.extent is not None and not overview.pending:
        return overview.extent.box
    return box_around(np.concatenate(corners))
