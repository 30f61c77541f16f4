"""Scenes, their graphs, priors and histories."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from gsmap.types.pose_graph import Prior
from gsmap.types.rows.base import Row, coordinates
from gsmap.types.scene import SceneFacts
from gsmap.types.sim3 import Sim3


@dataclass(frozen=True, eq=False, kw_only=True)
class SceneRef(Row):
    """A scene by id and name.

    Args:
        scene: scene id.
        scene_name: name; the last one of a removed scene.
    """

    columns: ClassVar[Mapping[str, str]] = {"scene_name": "scene"}

    scene: str
    scene_name: str


@dataclass(frozen=True, eq=False, kw_only=True)
class WorldPosition(Row):
    """The position of a scene in the world.

    Args:
        world: (3,) position of its origin in the CRS; null if the map is not georeferenced.
        crs: CRS of ``world``; null if the map is not georeferenced.
        heights: unit and zero of heights in the CRS, such as metres above the ellipsoid; null if the map is not
            georeferenced.
        offset: (3,) offset subtracted from the coordinates of its file if these exceed single precision, as map
            coordinates do; else zeros. ``S_map_scene`` maps the file's coordinates less this.
    """

    world: np.ndarray | None = None
    crs: str | None = None
    heights: str | None = None
    offset: np.ndarray = field(default_factory=lambda: np.zeros(3))

    @property
    def in_world(self) -> str | None:
        """World coordinates of the scene's origin as text."""
        return coordinates(self.world)


@dataclass(frozen=True, eq=False, kw_only=True)
class SceneRow(WorldPosition, SceneFacts):
    """A capture in the map.

    Args:
        num_nodes: number of nodes of its scene graph; null before it is described.
        component: index of its connected component by the newest poses, largest first; null before the first optimize.
        S_map_scene: pose in the frame of its component; null before the first optimize.
        status: ``ingested``, ``described``, or by the newest poses ``placed``, ``tentative`` (placed by edges without
            an agreeing cycle) or ``isolated``.
        one_pair: true if it is tentative only because single pairs place it, which nothing contradicts.
        tags: tags.
        note: newest note.
        metres_per_unit: metres per unit of its component's frame, see ``gsmap status``; null if unknown.
        metric: (3,) position of its origin, metres east, north, up of the world frame; null if the map is not
            georeferenced (``gsmap georeference``).
    """

    columns: ClassVar[Mapping[str, str]] = {
        "name": "scene",
        "id": "id",
        "standing": "status",
        "component": "component",
        "num_gaussians": "Gaussians",
        "num_nodes": "nodes",
        "captured_at": "captured",
        "tags": "tags",
        "metres_per_unit": "m per unit",
        "in_world": "world",
    }

    num_nodes: int | None
    component: int | None
    S_map_scene: Sim3 | None
    status: str
    one_pair: bool = False
    tags: tuple[str, ...] = ()
    note: str = ""
    metres_per_unit: float | None = None
    metric: np.ndarray | None = None

    @property
    def standing(self) -> str:
        """The status in a word of tables: ``one pair`` for a tentative scene that nothing puts in doubt."""
        return "one pair" if self.one_pair else self.status


@dataclass(frozen=True, eq=False, kw_only=True)
class LayerRow(Row):
    """A node layer of a scene graph.

    Args:
        layer: name (``objects``, ``landmarks``, ...).
        num_nodes: number of nodes.
        descriptor_id: digest of the embedder; layers with different digests are never compared.
        unit_m: metres per scene unit assumed for the layer.
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
    """A node of a scene graph.

    Args:
        layer: name of its layer.
        index: index in the layer.
        position: (3,) centre, scene frame and unit.
        size: (3,) edges of its axis-aligned box, scene unit.
        type: type; nodes match only within a type.
        weight: confidence or response, larger is better.
        num_views: number of rendered views that show it; 0 without rendering.
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
class SceneEdgeRow(SceneRef):
    """An edge of a scene.

    Args:
        scene: id of the scene at the other end.
        scene_name: name of the scene at the other end.
        status: as in `EdgeRow`.
        used: as in `EdgeRow`.
        use: `EdgeRow.use`.
        overlap: as in `EdgeRow`.
        num_inliers: as in `EdgeRow`.
        reason: as in `EdgeRow`.
        reason_code: as in `EdgeRow`.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "scene_name": "edge with",
        "status": "status",
        "use": "use",
        "overlap": "overlap",
        "num_inliers": "inliers",
        "reason": "reason",
    }

    status: str
    used: bool | str
    use: str
    overlap: float
    num_inliers: int
    reason: str
    reason_code: str = ""


@dataclass(frozen=True, eq=False, kw_only=True)
class PriorRow(Prior, Row):
    """The pose prior of a scene.

    Args:
        scene_name: name of the scene.
        outcome: ``used``, ``outweighed by the edges``, or ``not solved yet``.
    """

    columns: ClassVar[Mapping[str, str]] = {"scene_name": "scene", "outcome": "prior"}

    scene_name: str
    outcome: str


@dataclass(frozen=True, eq=False, kw_only=True)
class FactRow(Row):
    """An annotation of a scene.

    Args:
        at: time of the annotation, ISO 8601 with zone.
        fact: ``name``, ``captured_at``, ``note``, ``tag`` or ``untag``.
        value: text; empty if the previous value was removed.
        author: author or source (such as the EXIF of a frame); empty for an unnamed person.
    """

    columns: ClassVar[Mapping[str, str]] = {"at": "said at", "fact": "fact", "value": "value", "author": "by"}

    at: str
    fact: str
    value: str
    author: str = ""


@dataclass(frozen=True, eq=False, kw_only=True)
class SceneReport(SceneRow):
    """A scene with its pose, graph, edges and history.

    Args:
        origin: path it was read from.
        cameras_synthesised: true if gsmap synthesized the cameras because the capture had none.
        antialiased: true if it was trained with the 2D Mip filter.
        notes: remarks on how it was read and described.
        rotation_sigma_deg: largest standard deviation of its rotation; null if unknown.
        translation_sigma_m: largest standard deviation of its translation; null if unknown.
        covariance: (7, 7) covariance of its pose over [rotation (3, rad), translation (3), log scale] on the scene
            side; null where it is not known.
        prior: pose prior; null if there is none.
        up: (3,) up direction in its frame; null if unknown.
        unit_m: guess of metres per scene unit, good to a factor of about 2; null before it is described.
        metre_sigma: standard deviation of the logarithm of ``metres_per_unit``; null if unknown.
        metre_known_by: source of the metric scale, see ``gsmap status``; empty before the first optimize.
        metre_note: remark on the metric scale, or empty.
        layers: node layers of its graph.
        edges: its current edges.
        nodes: object nodes, and landmarks in its own unit.
        history: annotations, oldest first.
    """

    columns: ClassVar[Mapping[str, str]] = SceneRow.columns

    origin: str
    cameras_synthesised: bool
    antialiased: bool
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
class IngestRow(SceneRef):
    """The result of ingesting one capture.

    Args:
        scene_name: name, which differs from the requested one if that was taken.
        new: true if it was added; false if the map had the same content already.
        num_gaussians: number of Gaussians.
        notes: remarks on how it was read.
        captured_at: capture date, ISO 8601 with zone; null if unknown; the notes name its source.
        dated: true if the map had it already and its date changed.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "scene_name": "scene",
        "scene": "id",
        "num_gaussians": "Gaussians",
        "captured_at": "captured",
        "outcome": "outcome",
    }

    new: bool
    num_gaussians: int
    notes: tuple[str, ...] = ()
    captured_at: str | None = None
    dated: bool = False

    @property
    def outcome(self) -> str:
        """Description of the result."""
        if self.new:
            return "added"
        return (
            f"already in the map, now dated {self.captured_at}" if self.dated else "already in the map, nothing changed"
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class GraphRow(SceneRef):
    """The scene graph of one scene.

    Args:
        num_nodes: number of nodes of all layers.
        layers: node layers.
        up: (3,) up direction in the scene's frame; null if unknown.
        unit_m: estimated metres per scene unit; 1 if the scale is known.
        key: digest of its recipe and inputs.
        notes: remarks on it.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "scene_name": "scene",
        "num_nodes": "nodes",
        "layers_text": "layers",
        "notes": "notes",
    }

    num_nodes: int
    layers: tuple[LayerRow, ...]
    up: np.ndarray | None
    unit_m: float
    key: str
    notes: tuple[str, ...] = ()

    @property
    def layers_text(self) -> str:
        """Number of nodes of each layer as text."""
        return ", ".join(f"{layer.num_nodes} {layer.layer}" for layer in self.layers) or "no nodes"


@dataclass(frozen=True, eq=False, kw_only=True)
class PoseRow(WorldPosition, SceneRef):
    """The pose of a scene.

    Args:
        component: index of its connected component, largest first; components share no frame.
        status: ``placed``, ``tentative`` or ``isolated``, as in `SceneRow`.
        S_map_scene: pose in the frame of its component.
        S_world_scene: pose in the world frame (metres east, north, up); null if the map is not georeferenced.
        covariance: (7, 7) over [rotation (3, rad), translation (3), log scale] on the scene side; null if unknown.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "scene_name": "scene",
        "component": "component",
        "status": "status",
        "position": "position (map units)",
        "scale": "scale",
        "in_world": "world",
    }

    component: int
    status: str
    S_map_scene: Sim3
    S_world_scene: Sim3 | None = None
    covariance: np.ndarray | None = None

    @property
    def position(self) -> np.ndarray:
        """Position (3,) of the scene's origin."""
        return self.S_map_scene.translation

    @property
    def scale(self) -> float:
        """Map units per unit of the scene."""
        return self.S_map_scene.scale
