"""Scenes: their rows, graphs, priors and histories."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from gsmap.types.rows.base import Row, coordinates
from gsmap.types.sim3 import Sim3


@dataclass(frozen=True, eq=False, kw_only=True)
class SceneRef(Row):
    """A scene by id and name.

    Args:
        scene: id.
        scene_name: name; that which it last had where it was removed.
    """

    columns: ClassVar[Mapping[str, str]] = {"scene_name": "scene"}

    scene: str
    scene_name: str


@dataclass(frozen=True, eq=False, kw_only=True)
class SceneRow(Row):
    """One capture in the map.

    Args:
        name: unique among the map's scenes.
        id: content digest; the same content has the same id in every map.
        num_gaussians: how many Gaussians it has.
        num_nodes: nodes of its scene graph; null before it is described.
        component: index of its connected component by the newest poses, largest first; null before the first optimize.
        S_map_scene: where it lies in the frame of its component; null before the first optimize.
        captured_at: when it was captured, ISO 8601 with zone; null where nobody knows.
        status: ``ingested``, ``described``, or by the newest poses ``placed``, ``tentative`` (it rests on edges that no
            cycle confirms) or ``isolated``.
        ingested_at: when it came into the map, ISO 8601 with zone.
        scale_policy: ``known`` (its unit is the metre), ``unknown`` or ``auto``.
        tags: labels that people gave it.
        note: what people noted of it.
        metres_per_unit: metres in a unit of the frame it is placed in, see ``gsmap status``; null where nothing tells.
        metric: (3,) where its origin lies, metres east, north, up of the world frame; null where the map is not tied to
            the world (``gsmap georeference``).
        world: (3,) the same in the map's CRS; null as above.
        crs: of that; null as above.
        heights: the unit and zero of the heights in it, such as metres above the ellipsoid; null as above.
        offset: (3,) what was taken off the coordinates of its file, where these are too large for single precision, as
            map coordinates are: a point of the scene's frame plus this is the file's own; else zeros.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "name": "scene",
        "id": "id",
        "status": "status",
        "component": "component",
        "num_gaussians": "Gaussians",
        "num_nodes": "nodes",
        "captured_at": "captured",
        "tags": "tags",
        "metres_per_unit": "m a unit",
        "in_world": "world",
    }

    name: str
    id: str
    num_gaussians: int
    num_nodes: int | None
    component: int | None
    S_map_scene: Sim3 | None
    captured_at: str | None
    status: str
    ingested_at: str | None = None
    scale_policy: str = "auto"
    tags: tuple[str, ...] = ()
    note: str = ""
    metres_per_unit: float | None = None
    metric: np.ndarray | None = None
    world: np.ndarray | None = None
    crs: str | None = None
    heights: str | None = None
    offset: np.ndarray = field(default_factory=lambda: np.zeros(3))

    @property
    def in_world(self) -> str | None:
        """World coordinates of its origin, for people."""
        return coordinates(self.world)


@dataclass(frozen=True, eq=False, kw_only=True)
class LayerRow(Row):
    """One layer of a scene graph.

    Args:
        layer: name (``objects``, ``landmarks``, ...).
        num_nodes: how many nodes it has.
        descriptor_id: what made its embeddings; layers of different ids are never compared.
        unit_m: metres per scene unit that it was made under.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "layer": "layer",
        "num_nodes": "nodes",
        "unit_m": "unit, m",
        "descriptor_id": "descriptor",
    }

    layer: str
    num_nodes: int
    descriptor_id: str
    unit_m: float


@dataclass(frozen=True, eq=False, kw_only=True)
class NodeRow(Row):
    """One node of a scene graph.

    Args:
        layer: its layer.
        index: its place in the layer.
        position: (3,) centre, scene frame and unit.
        size: (3,) edges of its axis-aligned box, scene unit.
        type: nodes match only within a type.
        weight: confidence or response, larger is better.
        num_views: how many rendered views saw it; 0 where nothing was rendered.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "layer": "layer",
        "index": "index",
        "position": "position (scene units)",
        "size": "size (scene units)",
        "type": "type",
        "weight": "weight",
        "num_views": "views",
    }

    layer: str
    index: int
    position: np.ndarray
    size: np.ndarray
    type: int
    weight: float
    num_views: int


@dataclass(frozen=True, eq=False, kw_only=True)
class SceneEdgeRow(Row):
    """An edge as one of its scenes sees it.

    Args:
        scene: id of the scene at the other end.
        scene_name: its name.
        status: as in `EdgeRow`.
        used: as in `EdgeRow`.
        overlap: as in `EdgeRow`.
        num_inliers: as in `EdgeRow`.
        reason: as in `EdgeRow`.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "scene_name": "edge with",
        "status": "status",
        "used": "used",
        "overlap": "overlap",
        "num_inliers": "inliers",
        "reason": "reason",
    }

    scene: str
    scene_name: str
    status: str
    used: bool | str
    overlap: float
    num_inliers: int
    reason: str


@dataclass(frozen=True, eq=False, kw_only=True)
class PriorRow(Row):
    """What is known of a scene's pose from outside.

    Args:
        scene: id.
        scene_name: name.
        S_map_scene: the expected pose.
        sigmas: (7,) standard deviations [rotation (3, rad), translation (3, the scene's unit), log scale]; null where
            nothing is known.
        up: (3,) direction against gravity in the scene's frame; null where nobody told.
        up_sigma_rad: standard deviation of that direction.
        outcome: ``used``, ``outweighed by the edges``, or ``not solved yet``.
    """

    columns: ClassVar[Mapping[str, str]] = {"scene_name": "scene", "outcome": "prior"}

    scene: str
    scene_name: str
    S_map_scene: Sim3
    sigmas: np.ndarray
    up: np.ndarray | None
    up_sigma_rad: float
    outcome: str


@dataclass(frozen=True, eq=False, kw_only=True)
class FactRow(Row):
    """Something that was said of a scene, kept in history.

    Args:
        at: when it was said, ISO 8601 with zone.
        fact: ``name``, ``captured_at``, ``note``, ``tag`` or ``untag``.
        value: what was said; empty where a date was taken back.
        author: who said it, or what did (such as the EXIF of a frame); empty where a person did and was not named.
    """

    columns: ClassVar[Mapping[str, str]] = {"at": "said at", "fact": "fact", "value": "value", "author": "by"}

    at: str
    fact: str
    value: str
    author: str = ""


@dataclass(frozen=True, eq=False, kw_only=True)
class SceneReport(SceneRow):
    """Everything known of one scene.

    Args:
        origin: where it was read from, for people.
        sh_degree: degree of its spherical harmonics.
        num_cameras: how many cameras it has.
        cameras_synthesised: whether gsmap invented the cameras because the capture had none.
        antialiased: whether it was trained with the 2D Mip filter.
        bounds: (2, 3) lowest and highest corner of the Gaussians' centres, scene frame.
        notes: what a person should know of how it was read and described.
        rotation_sigma_deg: largest standard deviation of its rotation; null where it is not known.
        translation_sigma_m: largest standard deviation of its translation; null where it is not known.
        covariance: (7, 7) covariance of its pose over [rotation (3, rad), translation (3), log scale] on the scene
            side; null where it is not known.
        prior: what is known of its pose from outside; null where nothing is.
        up: (3,) direction against gravity in its frame; null where it could not be told.
        unit_m: guess of metres per scene unit, good to a factor of about 2; null before it is described.
        metre_sigma: standard deviation of the logarithm of ``metres_per_unit``; null where nothing tells.
        metre_known_by: how it is known, see ``gsmap status``; empty before the first optimize.
        metre_note: what a person should know of it; empty where nothing.
        layers: the layers of its graph.
        edges: its current edges.
        nodes: the nodes of its graph that people browse: its objects, and its landmarks in its own unit.
        history: what people said of it, oldest first.
    """

    columns: ClassVar[Mapping[str, str]] = SceneRow.columns

    origin: str
    sh_degree: int
    num_cameras: int
    cameras_synthesised: bool
    antialiased: bool
    bounds: np.ndarray
    notes: tuple[str, ...] = ()
    rotation_sigma_deg: float | None = None
    translation_sigma_m: float | None = None
    covariance: np.ndarray | None = None
    prior: PriorRow | None = None
    up: np.ndarray | None = None
    unit_m: float | None = None
    metre_sigma: float | None = None
    metre_known_by: str = ""
    metre_note: str = ""
    layers: tuple[LayerRow, ...] = ()
    edges: tuple[SceneEdgeRow, ...] = ()
    nodes: tuple[NodeRow, ...] = ()
    history: tuple[FactRow, ...] = ()


@dataclass(frozen=True, eq=False, kw_only=True)
class IngestRow(Row):
    """What became of one capture that was given.

    Args:
        scene: id.
        scene_name: name, which may differ from the one asked for where that was taken.
        new: whether it was added; false where the map had the same content already.
        num_gaussians: how many Gaussians it has.
        notes: what a person should know of how it was read.
        captured_at: when it was captured, ISO 8601 with zone; null where nobody knows. Notes say where it came from.
        dated: whether the map had it already, and it has another date now.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "scene_name": "scene",
        "scene": "id",
        "num_gaussians": "Gaussians",
        "captured_at": "captured",
        "outcome": "outcome",
    }

    scene: str
    scene_name: str
    new: bool
    num_gaussians: int
    notes: tuple[str, ...] = ()
    captured_at: str | None = None
    dated: bool = False

    @property
    def outcome(self) -> str:
        """In words."""
        if self.new:
            return "added"
        return (
            f"already in the map, now dated {self.captured_at}" if self.dated else "already in the map, nothing changed"
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class GraphRow(Row):
    """The scene graph of one scene.

    Args:
        scene: id.
        scene_name: name.
        num_nodes: of all layers.
        layers: its layers.
        up: (3,) direction against gravity in the scene's frame; null where it could not be told.
        unit_m: guess of metres per scene unit; 1 where the scale is known.
        key: digest of everything that it was made from.
        notes: what a person should know of it.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "scene_name": "scene",
        "num_nodes": "nodes",
        "layers_text": "layers",
        "notes": "notes",
    }

    scene: str
    scene_name: str
    num_nodes: int
    layers: tuple[LayerRow, ...]
    up: np.ndarray | None
    unit_m: float
    key: str
    notes: tuple[str, ...] = ()

    @property
    def layers_text(self) -> str:
        """In words."""
        return ", ".join(f"{layer.num_nodes} {layer.layer}" for layer in self.layers) or "no nodes"


@dataclass(frozen=True, eq=False, kw_only=True)
class PoseRow(Row):
    """Where one scene lies.

    Args:
        scene: id.
        scene_name: name.
        component: index of its connected component, largest first; components share no frame.
        status: ``placed``, ``tentative`` or ``isolated``, as in `SceneRow`.
        S_map_scene: its pose in the frame of its component.
        S_world_scene: its pose in the world frame (metres east, north, up); null where the map is not tied to the
            world.
        world: (3,) where its origin lies in the CRS; null as above.
        crs: of that; null as above.
        heights: the unit and zero of the heights in it, such as metres above the ellipsoid; null as above.
        covariance: (7, 7) over [rotation (3, rad), translation (3), log scale] on the scene side; null where it is not
            known.
        offset: (3,) as in `SceneRow`: ``S_map_scene`` maps coordinates of the scene's file less this.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "scene_name": "scene",
        "component": "component",
        "status": "status",
        "position": "position (map units)",
        "scale": "scale",
        "in_world": "world",
    }

    scene: str
    scene_name: str
    component: int
    status: str
    S_map_scene: Sim3
    S_world_scene: Sim3 | None = None
    covariance: np.ndarray | None = None
    world: np.ndarray | None = None
    crs: str | None = None
    heights: str | None = None
    offset: np.ndarray = field(default_factory=lambda: np.zeros(3))

    @property
    def position(self) -> np.ndarray:
        """(3,) where the scene's origin lies."""
        return self.S_map_scene.translation

    @property
    def scale(self) -> float:
        """Map units per unit of the scene."""
        return self.S_map_scene.scale

    @property
    def in_world(self) -> str | None:
        """World coordinates of its origin, for people."""
        return coordinates(self.world)
