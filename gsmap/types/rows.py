"""What the map answers: one frozen dataclass for every row and report.

Each is defined once. Its fields are what Python reads and, by the same names, the keys of the JSON that ``--json``
prints; ``columns`` says which of them a table shows, and under which headings; ``Args:`` says what each means
(``docs/json.md`` is made from that).

Ids and names go together under the same keys everywhere: ``scene`` and ``scene_name``, ``target`` and ``target_name``,
``source`` and ``source_name``. Only `SceneRow`, which is the scene, calls them ``id`` and ``name``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, ClassVar

import numpy as np

from gsmap.types.plain import plain
from gsmap.types.sim3 import Sim3

SCHEMA = 1
"""The number under ``schema`` in everything that ``--json`` prints; raised when a key goes or changes its meaning."""


class Row:
    """What all rows and reports can do; each is a frozen dataclass, and two are equal where their JSON is."""

    columns: ClassVar[Mapping[str, str]] = {}
    """The heading of each field (or property) that a table shows, in order."""

    def to_json(self) -> dict[str, Any]:
        """Every field as JSON can hold it: poses are 4x4 matrices, arrays lists, NaN and infinity null."""
        return {field.name: _json(getattr(self, field.name)) for field in fields(self)}  # type: ignore[arg-type]

    def cells(self) -> list[Any]:
        """The values of a table's line, in the order of ``columns``."""
        return [getattr(self, name) for name in self.columns]

    def __eq__(self, other: object) -> bool:
        return type(self) is type(other) and isinstance(other, Row) and self.to_json() == other.to_json()

    __hash__ = None  # type: ignore[assignment]


def _json(value: Any) -> Any:
    if isinstance(value, Row):
        return value.to_json()
    if isinstance(value, Sim3):
        return _json(value.matrix())
    if isinstance(value, Mapping):
        return {str(key): _json(item) for key, item in value.items()}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [_json(item) for item in value]
    value = plain(value)
    return None if isinstance(value, float) and not math.isfinite(value) else value


# --- scenes ----------------------------------------------------------------------------------------------------------


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
        "position": "position",
        "size": "size",
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
        translation_sigma_m: largest standard deviation of its translation, map unit; null where it is not known.
        covariance: (7, 7) covariance of its pose over [rotation (3, rad), translation (3), log scale] on the scene
            side; null where it is not known.
        prior: what is known of its pose from outside; null where nothing is.
        up: (3,) direction against gravity in its frame; null where it could not be told.
        unit_m: guess of metres per scene unit, good to a factor of about 2; null before it is described.
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
        S_world_scene: its pose in the world; null where the map does not know the world's frame.
        covariance: (7, 7) over [rotation (3, rad), translation (3), log scale] on the scene side; null where it is not
            known.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "scene_name": "scene",
        "component": "component",
        "status": "status",
        "position": "position",
        "scale": "scale",
    }

    scene: str
    scene_name: str
    component: int
    status: str
    S_map_scene: Sim3
    S_world_scene: Sim3 | None = None
    covariance: np.ndarray | None = None

    @property
    def position(self) -> np.ndarray:
        """(3,) where the scene's origin lies."""
        return self.S_map_scene.translation

    @property
    def scale(self) -> float:
        """Map units per unit of the scene."""
        return self.S_map_scene.scale


# --- pairs -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, kw_only=True)
class PairRef(Row):
    """Two scenes by id and name.

    Args:
        target: id of the scene in whose frame the other is placed.
        target_name: its name.
        source: id of the other.
        source_name: its name.
    """

    columns: ClassVar[Mapping[str, str]] = {"pair": "pair"}

    target: str
    target_name: str
    source: str
    source_name: str

    @property
    def pair(self) -> str:
        """``TARGET:SOURCE`` by name, as the command line takes it."""
        return f"{self.target_name}:{self.source_name}"


@dataclass(frozen=True, eq=False, kw_only=True)
class EdgeRow(PairRef):
    """The current edge of one pair that was tried.

    Args:
        status: ``accepted``, ``rejected`` (a pose was found and contradicted), ``no_match``, or ``never registered``
            where the pair has no edge; what a person's review says counts before what registration found.
        reason: why it is not accepted, or why the last optimize did not use it; empty where there is nothing to say.
        S_target_source: how the source lies in the target; null where no pose was found.
        scale: of that pose; null as above.
        information: (7, 7) over [rotation (3, rad), translation (3), log scale] applied on the source side,
            translation in the source's unit; null where no pose was found.
        num_inliers: size of the accepted set of correspondences.
        num_correspondences: candidates it was chosen from.
        overlap: share of the smaller scene's surface that coincides, in [0, 1].
        seconds: wall seconds spent in ``match``, ``refine`` and ``verdict``.
        used: whether the last optimize used it: true, false, or ``"tentative"`` (no cycle confirms it).
        undecided: whether nothing could tell if it is right: another group of edges contradicts it.
        review: a person's standing word: ``confirm`` or ``reject``; null where there is none.
        proposer: what proposed the pose (``graph:landmarks``, ``graph:objects``, ``kiss_matcher``), or ``manual`` where
            a person measured it; empty where none was found.
        registered_at: when it was registered, ISO 8601 with zone.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "pair": "pair",
        "status": "status",
        "used": "used",
        "overlap": "overlap",
        "num_inliers": "inliers",
        "scale": "scale",
        "reason": "reason",
    }

    status: str
    reason: str
    S_target_source: Sim3 | None
    scale: float | None
    information: np.ndarray | None
    num_inliers: int
    num_correspondences: int
    overlap: float
    seconds: Mapping[str, float]
    used: bool | str
    undecided: bool = False
    review: str | None = None
    proposer: str = ""
    registered_at: str | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class PairEventRow(Row):
    """Something that happened to a pair.

    Args:
        at: when, ISO 8601 with zone.
        what: the status that registration found, or a person's word: ``confirm``, ``reject`` or ``withdraw``.
        reason: why.
    """

    columns: ClassVar[Mapping[str, str]] = {"at": "at", "what": "what", "reason": "reason"}

    at: str
    what: str
    reason: str


@dataclass(frozen=True, eq=False, kw_only=True)
class PairReport(EdgeRow):
    """Everything known of one pair.

    Args:
        exact: whether the clique search proved its answer largest.
        evidence: the figures that the verdict rests on, by name.
        residual_chi2: chi-square of the edge under the newest poses (7 degrees of freedom); null where it has none.
        notes: what a person should know of how it was registered.
        history: every registration and review of the pair, oldest first.
    """

    columns: ClassVar[Mapping[str, str]] = EdgeRow.columns

    exact: bool = True
    evidence: Mapping[str, float]
    residual_chi2: float | None = None
    notes: tuple[str, ...] = ()
    history: tuple[PairEventRow, ...] = ()


# --- revisions -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, kw_only=True)
class RevisionRow(Row):
    """One answer of the optimiser.

    Args:
        number: from 1.
        created_at: when, ISO 8601 with zone.
        scenes: how many scenes it has.
        components: how many connected components they form.
        edges_used: how many edges it used.
        edges_tentative: how many of its edges no cycle confirms.
        edges_refused: how many edges it did not use.
        undecided: the edges that nothing could decide.
        solver: ``batch`` (everything solved anew) or ``incremental`` (new scenes placed in the answer before).
        contradicted_priors: scenes whose prior the edges outweighed.
        settings: what the optimiser was set to.
        notes: what a person should know of it.
        note: why it was made.
        key: digest of everything that it was made from.
        dropped_at: when `gsmap prune` let it go; null while it can be exported.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "number": "revision",
        "created_at": "created",
        "scenes": "scenes",
        "components": "components",
        "edges_used": "used",
        "edges_tentative": "tentative",
        "edges_refused": "refused",
        "solver": "solver",
    }

    number: int
    created_at: str
    scenes: int
    components: int
    edges_used: int
    edges_tentative: int
    edges_refused: int
    undecided: tuple[PairRef, ...] = ()
    solver: str = "batch"
    contradicted_priors: tuple[SceneRef, ...] = ()
    settings: Mapping[str, Any]
    notes: tuple[str, ...] = ()
    note: str = ""
    key: str = ""
    dropped_at: str | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class PoseChangeRow(Row):
    """How one scene differs between two revisions.

    Args:
        scene: id.
        scene_name: name.
        change: ``added``, ``removed``, ``moved`` or ``same``.
        rotation_deg: angle turned; null where the scene is in only one of the two.
        translation_m: how far the scene's middle went, map unit; null as above.
        scale_ratio: new scale by old; null as above.
        component_before: its component in the older revision; null where it is absent.
        component_after: its component in the newer revision; null where it is absent.
        status_before: its status in the older revision; null where it is absent.
        status_after: its status in the newer revision; null where it is absent.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "scene_name": "scene",
        "change": "change",
        "rotation_deg": "rotation, deg",
        "translation_m": "translation, m",
        "scale_ratio": "scale ratio",
        "component_after": "component",
        "status_after": "status",
    }

    scene: str
    scene_name: str
    change: str
    rotation_deg: float | None
    translation_m: float | None
    scale_ratio: float | None
    component_before: int | None
    component_after: int | None
    status_before: str | None
    status_after: str | None


@dataclass(frozen=True, eq=False, kw_only=True)
class UpdateReport(Row):
    """What an update took in, and the map as it is then.

    Args:
        ingested: the captures given.
        scenes: all scenes of the map.
        edges: the current edge of every pair that was tried.
        revision: the newest revision; null where there is none.
    """

    ingested: tuple[IngestRow, ...]
    scenes: tuple[SceneRow, ...]
    edges: tuple[EdgeRow, ...]
    revision: RevisionRow | None


# --- exports ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, kw_only=True)
class TileRow(Row):
    """One tile of an export.

    Args:
        out: the folder exported to.
        path: of the tile's file, relative to ``out``.
        component: the connected component that it belongs to.
        bounds: (2, 3) lowest and highest corner, map frame.
        num_gaussians: how many Gaussians it holds.
        scenes: the scenes it was made from.
        merge: the merger.
        recipe: how it was merged: ``stage``, ``method``, ``version`` of every piece that took part, ``settings``,
            ``backend``.
        truncated: whether a time budget cut its optimisation short.
        sha256: of the file.
        notes: what a person should know of how it was made.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "out": "folder",
        "path": "file",
        "component": "component",
        "merge": "merge",
        "num_gaussians": "Gaussians",
        "truncated": "truncated",
    }

    out: str
    path: str
    component: int
    bounds: np.ndarray
    num_gaussians: int
    scenes: tuple[SceneRef, ...]
    merge: str
    recipe: Mapping[str, Any]
    truncated: bool
    sha256: str
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False, kw_only=True)
class ExportReport(Row):
    """What an export did.

    Args:
        out: the folder exported to.
        tiles: the tiles that are in the folder now.
        recomputed: how many of them were made.
        reused: how many were unchanged.
        removed: how many files were taken away.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "out": "folder",
        "recomputed": "made",
        "reused": "unchanged",
        "removed": "removed",
    }

    out: str
    tiles: tuple[TileRow, ...]
    recomputed: int
    reused: int
    removed: int


# --- the map as a whole ----------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, kw_only=True)
class TodoRow(Row):
    """Something that is stale or wants a person.

    Args:
        what: ``undescribed`` scenes; ``stale_graphs``, made by other settings or another version; ``unregistered``
            scenes, never tried with another one; ``stale_edges``; ``unsolved`` (scenes, edges, reviews or priors are
            newer than the poses); ``stale_poses``; ``dirty_tiles`` of an export; ``tentative`` scenes; ``undecided``
            edges; ``contradicted_priors``; ``isolated`` scenes.
        count: how many; 1 for ``unsolved`` and ``stale_poses``.
        verb: the command that helps.
        meaning: the same in words.
    """

    columns: ClassVar[Mapping[str, str]] = {"count": "count", "meaning": "what", "verb": "helps"}

    what: str
    count: int
    verb: str
    meaning: str


@dataclass(frozen=True, eq=False, kw_only=True)
class MapStatus(Row):
    """What is stale or wants a person, most urgent first.

    Args:
        todo: what is to be done; empty where all is well.
        scenes: how many scenes the map has.
        components: connected components of the newest poses.
        islands: the same number under an older name.
        tentative: scenes that rest on edges which no cycle confirms.
        revision: number of the newest revision; null before the first.
        metres_per_unit: metres in a unit of the map; null where no scene's scale is known.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "scenes": "scenes",
        "components": "components",
        "tentative": "tentative",
        "revision": "revision",
        "metres_per_unit": "metres per unit",
    }

    todo: tuple[TodoRow, ...]
    scenes: int
    components: int
    islands: int
    tentative: int
    revision: int | None
    metres_per_unit: float | None


@dataclass(frozen=True, eq=False, kw_only=True)
class SettingRow(Row):
    """One setting.

    Args:
        name: dotted, as ``--set`` takes it.
        value: what it is in this map.
        default: what it is where nobody changes it.
        unit: of the value; empty where it has none.
        doc: what it means.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "name": "setting",
        "value": "value",
        "default": "default",
        "unit": "unit",
        "doc": "meaning",
    }

    name: str
    value: Any
    default: Any
    unit: str
    doc: str


@dataclass(frozen=True, eq=False, kw_only=True)
class ModelRow(Row):
    """One ONNX model of the map.

    Args:
        kind: ``sam-encoder``, ``sam-decoder`` or ``clip``.
        name: what the map calls it.
        sha256: of the file.
        preset: how pixels are scaled for it.
        path: where the file is.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "kind": "kind",
        "name": "name",
        "preset": "preset",
        "sha256": "sha256",
        "path": "file",
    }

    kind: str
    name: str
    sha256: str
    preset: str | None
    path: str


@dataclass(frozen=True, eq=False, kw_only=True)
class CheckReport(Row):
    """What reading every byte of the map found.

    Args:
        ok: whether nothing is wrong.
        problems: one line each.
        orphans: folders that an interrupted step left; no harm, `gsmap prune` removes them.
        num_groups: how many groups of arrays were read.
        num_bytes: how many bytes were read.
    """

    columns: ClassVar[Mapping[str, str]] = {"num_groups": "groups", "num_bytes": "bytes", "ok": "ok"}

    ok: bool
    problems: tuple[str, ...]
    orphans: tuple[str, ...]
    num_groups: int
    num_bytes: int


@dataclass(frozen=True, eq=False, kw_only=True)
class PruneReport(Row):
    """What was reclaimed, or would be.

    Args:
        dry_run: whether nothing was deleted.
        scene_names: names of removed scenes whose arrays go.
        revisions: numbers of revisions that can no longer be exported.
        num_graphs: graphs that go.
        num_orphans: folders left by interrupted work that go.
        num_bytes: bytes on disk that this frees.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "num_graphs": "graphs",
        "num_orphans": "left over",
        "num_bytes": "bytes",
    }

    dry_run: bool
    scene_names: tuple[str, ...]
    revisions: tuple[int, ...]
    num_graphs: int
    num_orphans: int
    num_bytes: int


@dataclass(frozen=True, eq=False, kw_only=True)
class InitReport(Row):
    """The map that was made.

    Args:
        map: its folder.
        catalog: URL of the database that holds its catalog, without a password; null where the folder holds it.
    """

    columns: ClassVar[Mapping[str, str]] = {"map": "map", "catalog": "catalog"}

    map: str
    catalog: str | None


@dataclass(frozen=True, eq=False, kw_only=True)
class MigrateReport(Row):
    """The schema of a map.

    Args:
        map: its folder.
        before: the schema it had; null where it had none.
        after: the schema it has now.
    """

    columns: ClassVar[Mapping[str, str]] = {"map": "map", "before": "before", "after": "after"}

    map: str
    before: str | None
    after: str | None


@dataclass(frozen=True, eq=False, kw_only=True)
class ConvertReport(Row):
    """The file that was written.

    Args:
        input: the file read.
        output: the file written.
        num_gaussians: how many Gaussians it holds.
        sh_degree: degree of their spherical harmonics as they were read.
    """

    columns: ClassVar[Mapping[str, str]] = {"output": "file", "num_gaussians": "Gaussians", "sh_degree": "SH degree"}

    input: str
    output: str
    num_gaussians: int
    sh_degree: int


@dataclass(frozen=True, eq=False, kw_only=True)
class ViewReport(Row):
    """The page that is being served.

    Args:
        url: where it is, on this machine only.
    """

    columns: ClassVar[Mapping[str, str]] = {"url": "page"}

    url: str


# --- against the truth -----------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False, kw_only=True)
class PoseErrorRow(PairRef):
    """The error of one relative pose.

    Args:
        rre_deg: relative rotation error.
        centroid_m: distance between where the estimated and the true pose put the source's middle, in metres through
            the truth's scale.
        rte: relative translation error by the length of the true one, after GaussReg.
        rse: relative scale error.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "pair": "pair",
        "rre_deg": "RRE, deg",
        "centroid_m": "centroid, m",
        "rte": "RTE",
        "rse": "RSE",
    }

    rre_deg: float
    centroid_m: float
    rte: float
    rse: float


@dataclass(frozen=True, eq=False, kw_only=True)
class EdgeErrorRow(PoseErrorRow):
    """An accepted edge that no person rejected, against the truth.

    Args:
        true_overlap: the smaller of both directions' share of opaque, not huge Gaussians that lie within 8 cm of the
            other capture's by the true poses, in [0, 1].
        used: whether the newest poses use it: true, false, or ``"tentative"`` (no cycle confirms it).
        right: whether it is within the bars, ``max_rre_deg`` and ``max_rte_m`` of the report.
        nees: its squared error over its covariance; null where it has no information.
        nees_dof: degrees of freedom of that; 6 where edge and truth are rigid, else 7.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "pair": "pair",
        "true_overlap": "true overlap",
        "used": "used",
        "right": "right",
        "rre_deg": "RRE, deg",
        "centroid_m": "centroid, m",
        "rte": "RTE",
        "rse": "RSE",
        "nees": "NEES",
        "nees_dof": "dof",
    }

    true_overlap: float
    used: bool | str
    right: bool
    nees: float | None = None
    nees_dof: int | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class BandRow(Row):
    """The pairs of captures whose true overlap lies in a band.

    Args:
        overlap_from: lower end, which belongs to the band.
        overlap_to: upper end, which does not unless it is 1.
        num_pairs: pairs of scenes with a truth; in the lowest band most may share nothing, and count as missed.
        num_accepted: accepted edges among them.
        num_right: those of them that are right.
        recall: right edges by pairs; null where there is no pair.
        precision: right edges by accepted ones; null where there is none.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "band": "true overlap",
        "num_pairs": "pairs",
        "num_accepted": "accepted",
        "num_right": "right",
        "recall": "recall",
        "precision": "precision",
    }

    overlap_from: float
    overlap_to: float
    num_pairs: int
    num_accepted: int
    num_right: int
    recall: float | None
    precision: float | None

    @property
    def band(self) -> str:
        """In words."""
        return f"{100 * self.overlap_from:.3g} to {100 * self.overlap_to:.3g} %"


@dataclass(frozen=True, eq=False, kw_only=True)
class ComponentErrorRow(Row):
    """The newest poses of one component against the truth.

    Args:
        component: its index.
        scene_names: the living scenes that it ties together.
        num_cameras: cameras of those that have a truth.
        alignment: ``rigid`` where the truth says that the scenes are in metres, else ``similarity``.
        ate_m: root mean square error of the camera centres after one alignment; null where it would say nothing.
        ate_reason: why it is null; empty where it is not.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "component": "component",
        "scene_names": "scenes",
        "num_cameras": "cameras",
        "alignment": "alignment",
        "ate_m": "ATE, m",
        "ate_reason": "why none",
    }

    component: int
    scene_names: tuple[str, ...]
    num_cameras: int
    alignment: str
    ate_m: float | None
    ate_reason: str = ""


@dataclass(frozen=True, eq=False, kw_only=True)
class NeesRow(Row):
    """How honest covariances are: squared errors over them (NEES).

    Args:
        of: ``edges`` (from their information), or ``poses`` (each relative to the scene that holds its frame).
        dof: degrees of freedom: 6 where both the pose and the truth are rigid, else 7.
        num: how many there are.
        median: of the squared errors over their covariances.
        expected_median: what honest covariances have.
        within_3_sigma: the share no larger than what honest ones exceed as rarely as a normal error does 3 sigma.
        expected_within_3_sigma: what honest covariances have.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "of": "NEES of",
        "num": "count",
        "dof": "dof",
        "median": "median",
        "expected_median": "expected",
        "within_3_sigma": "within 3 sigma",
        "expected_within_3_sigma": "expected ",
    }

    of: str
    dof: int
    num: int
    median: float
    expected_median: float
    within_3_sigma: float
    expected_within_3_sigma: float


@dataclass(frozen=True, eq=False, kw_only=True)
class ImageErrorRow(Row):
    """How well a scene's own photographs are reproduced.

    Args:
        scene: id.
        scene_name: name.
        num_images: how many photographs were compared.
        alone_psnr_db: by the scene alone.
        alone_ssim: by the scene alone.
        alone_lpips: by the scene alone; null where no LPIPS network was given.
        union_psnr_db: by the union of it and the scenes of its component whose boxes meet its own; null where it has no
            place.
        union_ssim: by that union; null as above.
        union_lpips: by that union; null as above, or where no LPIPS network was given.
        tiles_psnr_db: by the exported tiles that it has a part in; null where none were given or it is in none.
        tiles_ssim: by those tiles; null as above.
        tiles_lpips: by those tiles; null as above, or where no LPIPS network was given.
        tiles_cover: share of its opaque Gaussians that lie within those tiles, in [0, 1]: where an export holds only a
            part of it, photographs show what the tiles cannot; null as above.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "scene_name": "scene",
        "num_images": "images",
        "alone_psnr_db": "PSNR alone, dB",
        "alone_ssim": "SSIM alone",
        "alone_lpips": "LPIPS alone",
        "union_psnr_db": "PSNR union, dB",
        "union_ssim": "SSIM union",
        "union_lpips": "LPIPS union",
        "tiles_psnr_db": "PSNR tiles, dB",
        "tiles_ssim": "SSIM tiles",
        "tiles_lpips": "LPIPS tiles",
        "tiles_cover": "in tiles",
    }

    scene: str
    scene_name: str
    num_images: int
    alone_psnr_db: float
    alone_ssim: float
    alone_lpips: float | None = None
    union_psnr_db: float | None = None
    union_ssim: float | None = None
    union_lpips: float | None = None
    tiles_psnr_db: float | None = None
    tiles_ssim: float | None = None
    tiles_lpips: float | None = None
    tiles_cover: float | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class EvaluationReport(Row):
    """A map against ground truth.

    Args:
        num_scenes: living scenes of the map.
        num_placed: those that the newest poses place; see ``status`` of `SceneRow`.
        num_tentative: those beside them that are tied to others by edges which no cycle confirms.
        edges: each accepted edge that no person rejected, as it was registered.
        pairs: each pair of scenes of one component, by the newest poses.
        images: renders against photographs; empty where no photographs were given.
        edges_in_use: how many of ``edges`` the newest poses use.
        edges_without_truth: accepted edges that could not be judged.
        false_edges: edges that the newest poses use and that are wrong.
        max_rre_deg: an edge whose ``rre_deg`` is larger is wrong.
        max_rte_m: an edge whose ``centroid_m`` is larger is wrong.
        bands: recall and precision of ``edges`` by true overlap.
        components: what the newest poses tie together, against the truth.
        nees: how honest the covariances of edges and poses are.
        edges_median_rre_deg: over ``edges``; null where there are none.
        edges_median_centroid_m: as above.
        edges_median_rte: as above.
        edges_median_rse: as above.
        edges_worst_rre_deg: as above.
        edges_worst_centroid_m: as above.
        pairs_median_rre_deg: over ``pairs``; null where there are none.
        pairs_median_centroid_m: as above.
        pairs_median_rte: as above.
        pairs_median_rse: as above.
        pairs_worst_rre_deg: as above.
        pairs_worst_centroid_m: as above.
        ate_m: root mean square error of the camera centres over all ``components`` that have one; null where none has.
            Isolated scenes never count: aligned alone, each would be right.
        ate_reason: why there is none; empty where there is one.
        notes: what a person should know: scenes that could not be judged, poses that are out of date.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "verdict": "verdict",
        "edges_verdict": "edges in use",
        "edges_median_rre_deg": "edges: median RRE, deg",
        "edges_median_centroid_m": "edges: median centroid, m",
        "edges_median_rte": "edges: median RTE",
        "edges_median_rse": "edges: median RSE",
        "edges_worst_rre_deg": "edges: worst RRE, deg",
        "edges_worst_centroid_m": "edges: worst centroid, m",
        "pairs_median_rre_deg": "pairs: median RRE, deg",
        "pairs_median_centroid_m": "pairs: median centroid, m",
        "pairs_median_rte": "pairs: median RTE",
        "pairs_median_rse": "pairs: median RSE",
        "pairs_worst_rre_deg": "pairs: worst RRE, deg",
        "pairs_worst_centroid_m": "pairs: worst centroid, m",
        "ate_m": "ATE, m",
        "notes_text": "notes",
    }

    num_scenes: int
    num_placed: int
    num_tentative: int
    edges: tuple[EdgeErrorRow, ...] = ()
    pairs: tuple[PoseErrorRow, ...] = ()
    images: tuple[ImageErrorRow, ...] = ()
    edges_in_use: int
    edges_without_truth: int
    false_edges: tuple[PairRef, ...] = ()
    max_rre_deg: float
    max_rte_m: float
    bands: tuple[BandRow, ...] = ()
    components: tuple[ComponentErrorRow, ...] = ()
    nees: tuple[NeesRow, ...] = ()
    edges_median_rre_deg: float | None = None
    edges_median_centroid_m: float | None = None
    edges_median_rte: float | None = None
    edges_median_rse: float | None = None
    edges_worst_rre_deg: float | None = None
    edges_worst_centroid_m: float | None = None
    pairs_median_rre_deg: float | None = None
    pairs_median_centroid_m: float | None = None
    pairs_median_rte: float | None = None
    pairs_median_rse: float | None = None
    pairs_worst_rre_deg: float | None = None
    pairs_worst_centroid_m: float | None = None
    ate_m: float | None = None
    ate_reason: str = ""
    notes: tuple[str, ...] = ()

    @property
    def verdict(self) -> str:
        """How many scenes have a place, and the ATE or why there is none, in words."""
        placed = f"{self.num_placed} of {self.num_scenes} placed"
        if self.num_tentative:
            placed += f", {self.num_tentative} tentative"
        return f"{placed}, no ATE: {self.ate_reason}" if self.ate_m is None else f"{placed}, ATE {self.ate_m:.3g} m"

    @property
    def edges_verdict(self) -> str:
        """How many edges in use are wrong, and which, in words."""
        bars = f"beyond {self.max_rre_deg:g} deg or {self.max_rte_m:g} m"
        if not self.edges_in_use:
            return "none that the truth could judge"
        names = ": " + ", ".join(edge.pair for edge in self.false_edges) if self.false_edges else ""
        return f"{len(self.false_edges)} of {self.edges_in_use} false, {bars}{names}"

    @property
    def notes_text(self) -> str:
        """In one line."""
        return "; ".join(self.notes)


@dataclass(frozen=True, eq=False, kw_only=True)
class DemoReport(Row):
    """What the demo made.

    Args:
        map: the map's folder.
        picture: a picture of the map.
        scenes: the captures.
        edges: what ties them.
        tiles: the merged tiles.
        truth: how close the map comes to the truth.
    """

    columns: ClassVar[Mapping[str, str]] = {"map": "map", "picture": "picture"}

    map: str
    picture: str
    scenes: tuple[SceneRow, ...]
    edges: tuple[EdgeRow, ...]
    tiles: tuple[TileRow, ...]
    truth: EvaluationReport
