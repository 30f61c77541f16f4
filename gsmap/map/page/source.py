"""Provide a map to the page of `gsmap.view`; every request reads one state of the catalog."""

from __future__ import annotations

import threading
from collections.abc import Collection, Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gsmap.errors import ConfigError, NotFoundError
from gsmap.geometry.transforms import transform_poses
from gsmap.map import reports
from gsmap.map.changes.compare import ComparisonPlan, missing_comparisons, plan_comparisons
from gsmap.map.changes.rows import change_row, changes_report, parse_change_id
from gsmap.map.localization.photos import photo_rows
from gsmap.map.metric_scales import map_metres
from gsmap.map.objects.map_objects import MapObjects, compute_objects, history_report, objects_report
from gsmap.map.page.pairs import pair_detail
from gsmap.map.pictures.comparison_pictures import PairRenderer, num_views, pair_views
from gsmap.map.pictures.floor_plans import MAX_GAUSSIANS, MAX_SCENES, box_of, plan_of_component, read_scene
from gsmap.map.pictures.object_pictures import ObjectPictures
from gsmap.map.report.edge_entries import edge_entries
from gsmap.map.reports.common import up_directions
from gsmap.map.reports.one_pair import is_one_pair, scenes_by_one_pair
from gsmap.map.snapshot_read import snapshot_read
from gsmap.map.stages.optimize import pose_basis
from gsmap.methods import text_digest
from gsmap.report.top import data_address
from gsmap.store import Store, cache
from gsmap.types import GaussianSource, PoseGraph, Prior, Scene
from gsmap.types.plain import canonical
from gsmap.types.world import ImagePoint
from gsmap.view import ViewMap, ViewScene, contract
from gsmap.view.content import up_of
from gsmap.view.contract import (
    FloorPlan,
    GraphEntry,
    PlacedPairDetail,
    PlaceHistory,
    RevisionPoses,
    SceneExtras,
    entry_of,
)
from gsmap.view.page_source import Action, PairPictures
from gsmap.view.pair_picture import looks_at
from gsmap.view.trees import VERSION, TreeParams

if TYPE_CHECKING:
    from gsmap.map.settings import Settings

_NODES = 2_000  # of a layer of a scene graph that are sent, by weight
_CAMERAS = 300  # of a scene that are sent, evenly along its capture
_PICTURE_PX = 640  # longer side of the pictures of a pair or a change
_PLAN_PX = 640  # longer side of the picture under a floor plan
_CAMERA_M = 0.1  # how long a camera is drawn


class MapPageSource:
    """The map that a page shows.

    Args:
        store: the store of the map.
        settings: the settings in force.
        actions: actions that the page may request.
        tiles: folder of exported 3D Tiles to show beside the scenes.

    Raises:
        ConfigError, InputError: that folder holds no 3D Tiles of this map.
    """

    def __init__(
        self,
        store: Store,
        settings: Settings,
        actions: Mapping[str, Action] | None = None,
        tiles: Path | None = None,
    ) -> None:
        self._store, self._settings = store, settings
        self.actions: Mapping[str, Action] = actions or {}
        self._lock = threading.Lock()
        self._read: tuple[str | None, ViewMap] | None = None
        self._objects: tuple[str | None, MapObjects] | None = None
        self._objects_lock = threading.Lock()
        self._drawer: tuple[MapObjects, ObjectPictures] | None = None
        self._tiles = tiles
        self._merged = {} if tiles is None else merged_tilesets(store, tiles)

    def state(self) -> str:
        return self.content().state

    def content(self) -> ViewMap:
        signature = self._store.catalog.signature()
        with self._lock:
            if self._read is None or signature is None or self._read[0] != signature:
                self._read = signature, view_of(self._store, self._settings, frozenset(self._merged))
            return self._read[1]

    def source(self, scene: str) -> GaussianSource:
        if self._store.scenes.removed_at(scene) is not None:
            raise NotFoundError(f"scene {scene} was removed", code="scene_removed")
        return self._store.scenes.source(scene)

    def extras(self, scene: str) -> SceneExtras:
        """Return nodes and cameras of a scene in the map frame."""
        entry = self._entry(scene)
        S = entry.S_map_scene
        graph, cameras = self._store.graphs.load(scene), self._store.scenes.cameras(scene)
        layers = {}
        for name, layer in (graph.layers if graph else {}).items():
            weightiest = np.argsort(-layer.weights, kind="stable")[:_NODES]
            layers[name] = S.apply(layer.positions[weightiest]).tolist()
        frusta: list[list[list[float]]] = []
        if not cameras.synthesised:
            metres = 1.0 if entry.pose is None else self.content().metres_per_unit.get(entry.pose.component, 1.0)
            some = cameras.evenly(_CAMERAS)
            for pose, (fx, fy, cx, cy), (width, height) in zip(
                some.T_frame_camera, some.intrinsics_px, some.sizes_px, strict=True
            ):
                pixels = ((0, 0), (width, 0), (width, height), (0, height))
                rays = np.array([[(u - cx) / fx, (v - cy) / fy, 1] for u, v in pixels])
                local = np.vstack([np.zeros((1, 3)), rays * (_CAMERA_M / (S.scale * metres))])
                frusta.append(S.apply(local @ pose[:3, :3].T + pose[:3, 3]).tolist())
        return {"layers": layers, "cameras": frusta}

    def revision(self, number: int) -> RevisionPoses:
        graph = self._store.revisions.get(number)
        if graph is None:
            raise NotFoundError(f"there is no revision {number}", code="revision_not_found")
        at = self._places()
        return {
            "number": number,
            "scenes": [
                {
                    "scene": at[pose.scene],
                    "component": pose.component,
                    "status": pose.status,
                    "S_map_scene": pose.S_map_scene.matrix().tolist(),
                }
                for pose in graph.poses.values()
                if pose.scene in at
            ],
        }

    def plan(self, component: int) -> FloorPlan:
        """Return the floor plan of a component, drawn as in the report."""
        view = self.content()
        inside = {
            place: entry
            for place, entry in enumerate(view.scenes)
            if entry.pose is not None and entry.pose.component == component
        }
        if not inside:
            raise NotFoundError(f"the map has no component {component}", code="component_not_found")
        whole = sum(entry.scene.num_gaussians for entry in inside.values()) <= MAX_GAUSSIANS
        entries = list(inside.values())
        arrays = [
            read_scene(self._store, entry.scene, whole=whole) if k < MAX_SCENES else box_of(entry.scene)
            for k, entry in enumerate(entries)
        ]
        plan, _ = plan_of_component(
            [entry.scene.name for entry in entries],
            [entry.pose for entry in entries if entry.pose is not None],
            arrays,
            (),
            np.array(up_of(entries)),
            view.metres_per_unit.get(component, 1.0),
            _PLAN_PX,
        )
        if plan is None:
            raise NotFoundError(f"the content of component {component} cannot be located", code="no_plan")
        low, span = plan.bounds[0], plan.bounds[1] - plan.bounds[0]

        def place_on_page(points: np.ndarray) -> list[list[float]]:
            share = (points - low) / span
            found: list[list[float]] = np.column_stack([share[:, 0], 1 - share[:, 1]]).round(4).tolist()
            return found

        # Rows of a projection: share of the width, and of the height from the top, of a point (x, y, z, 1) of the map.
        along = plan.R_plan_map[:2] * plan.metres_per_unit / span[:, None]
        rows = np.column_stack([along * [[1], [-1]], [-low[0] / span[0], 1 + low[1] / span[1]]])
        return {
            "picture": data_address(plan.picture) if plan.picture else None,
            "size_m": span.tolist(),
            "P_plan_map": rows.tolist(),
            "scenes": [
                {"scene": place, "at": at, "outlines": [place_on_page(ring) for ring in rings]}
                for place, at, rings in zip(inside, place_on_page(plan.middles), plan.footprints, strict=True)
            ],
        }

    # --- pairs and changes -------------------------------------------------------------------------------------------

    def edge(self, target: str, source: str) -> PlacedPairDetail:
        a, b = self._entry(target), self._entry(source)
        at = self._places()
        detail = pair_detail(
            self._store, self._settings, a.scene, b.scene, a.S_map_scene, has_buttons=bool(self.actions)
        )
        return {**detail, "target": at[target], "source": at[source]}

    def pair_cameras(self, target: str, source: str) -> tuple[str, ...]:
        stored = self._store.registrations.get(target, source)
        if stored is None or stored.registration.S_target_source is None:
            return ()
        ends = [self._entry(scene).scene for scene in (stored.registration.target, stored.registration.source)]
        if sum(scene.num_gaussians for scene in ends) > self._settings.view.picture_gaussians:
            return ()
        return tuple(f"view {k + 1}" for k in range(num_views([scene.num_cameras for scene in ends])))

    def pair_pictures(self, target: str, source: str) -> PairPictures:
        stored, names = self._store.registrations.get(target, source), self.pair_cameras(target, source)
        if stored is None or not names:
            raise NotFoundError(
                "this pair has no pose by which both scenes could be drawn, or is too large to be drawn here",
                code="no_pose_of_pair",
            )
        seen = pair_views(self._store, stored.registration)
        looks = [looks_at(seen.target, seen.source, one.resized(_PICTURE_PX), seen.unit_m) for one in seen.cameras]
        a, b, difference = zip(*looks, strict=True) if looks else ((), (), ())
        return PairPictures(names[: len(looks)], a, b, difference)

    def change_pictures(self, change: str) -> tuple[np.ndarray, np.ndarray]:
        row = change_row(self._store, parse_change_id(change))
        if row.box_m is None:
            raise NotFoundError(
                f"{change} has no position: its newer capture has no pose; run gsmap update", code="change_unplaced"
            )
        return PairRenderer(self._store, row.older, row.newer).views(row, _PICTURE_PX)

    # --- objects -----------------------------------------------------------------------------------------------------

    def graph(self) -> GraphEntry:
        known = self._known()
        report = objects_report(known)
        boxes = {thing.id: thing.box for thing in known.objects}
        return {
            "objects": [
                {
                    **entry_of(row, contract.ObjectEntry),
                    "name": row.name or "",
                    "label": row.label or "",
                    "box": boxes[row.id].tolist(),
                    "picture": f"objects/{row.id}.jpg",
                }
                for row in report.objects
            ],
            "changes": {
                one["id"]: room
                for one in self.content().changes
                if (room := known.room_of_box(one["component"], np.array(one["box"]))) is not None
            },
            "relations": [entry_of(row, contract.RelationEntry) for row in report.relations],
            "rooms": [entry_of(row, contract.RoomEntry) for row in report.rooms],
        }

    def object_picture(self, id: str) -> np.ndarray:
        known = self._known()
        with self._objects_lock:
            if self._drawer is None or self._drawer[0] is not known:
                self._drawer = known, ObjectPictures(self._store, known)
            drawer = self._drawer[1]
        return drawer.draw(id)

    def history(self, at: str, component: int) -> PlaceHistory:
        known, places = self._known(), self._places()
        inside = {thing.id for thing in known.objects if thing.component == component}
        report = history_report(known, at, None)
        return {
            "rows": [
                {**entry_of(row, contract.HistoryRow), "scene": places[row.scene]}
                for row in report.sightings
                if row.object in inside and row.scene in places
            ]
        }

    def merged(self, component: int) -> Path:
        if component not in self._merged:
            raise NotFoundError(f"the page was started without merged tiles of component {component}", code="no_tiles")
        return self._merged[component]

    # -----------------------------------------------------------------------------------------------------------------

    def _known(self) -> MapObjects:
        """Return the annotated objects of the map, cached for one state of the catalog."""
        with self._objects_lock:
            signature = self._store.catalog.signature()  # before reading, as other processes may write meanwhile
            if self._objects is None or signature is None or self._objects[0] != signature:
                self._objects = signature, compute_objects(self._store, self._settings, lambda *_: None)
            return self._objects[1]

    def _places(self) -> dict[str, int]:
        return {entry.scene.id: place for place, entry in enumerate(self.content().scenes)}

    def _entry(self, scene: str) -> ViewScene:
        found = next((entry for entry in self.content().scenes if entry.scene.id == scene), None)
        if found is None:
            raise NotFoundError(f"there is no scene {scene}", code="scene_not_found")
        return found


@snapshot_read
def view_of(store: Store, settings: Settings, merged: frozenset[int] = frozenset()) -> ViewMap:
    """Return the scenes at their newest poses, with edges, changes and photos, without reading arrays."""
    placed = store.revisions.get()
    poses = placed.poses if placed else {}
    graphs = store.graphs.list()
    living = store.scenes.list()
    ups = up_directions(graphs, living)
    metres = map_metres(store, placed)
    told = {}
    for number, prior in store.priors.numbered():
        pose = poses.get(prior.scene)
        metre = None if pose is None else metres.get(pose.component)
        told[prior.scene] = prior_words(prior, 1.0 if metre is None else metre.metres_per_unit), number
    alone = scenes_by_one_pair(store) if placed else set()
    scenes = [
        ViewScene(
            scene,
            content_key(scene, TreeParams()),
            poses.get(scene.id),
            ups.get(scene.id),
            told.get(scene.id, (None, None)),
            scene.id in alone,
        )
        for scene in living
    ]
    at = {entry.scene.id: place for place, entry in enumerate(scenes)}
    newest, given = store.revisions.newest(), pose_basis(store, settings)
    asked = plan_comparisons(store, settings) if placed else None
    missing = missing_comparisons(store, asked, settings) if asked else []
    found = ViewMap(
        Path(store.location).name,
        scenes,
        _edges(store, placed, at),
        [
            {
                **entry_of(row, contract.RevisionEntry),
                "poses": f"revisions/{row.number}.json" if row.dropped_at is None else None,
            }
            for row in reports.revision_rows(store)
        ],
        _changes(store, settings, asked, at),
        _photos(store, placed, at),
        revision=store.revisions.newest_number(),
        metres_per_unit={component: metre.metres_per_unit for component, metre in metres.items()},
        scale_sigma={component: metre.sigma for component, metre in metres.items() if not metre.is_rough},
        compared=_indices((pair for pair in asked.pairs if pair not in missing), at) if asked else [],
        uncompared=_indices(missing, at),
        merged=merged,
        has_objects=placed is not None and bool(graphs),
        stale=bool(given.scenes) and (newest is None or newest.key != given.key.digest),
    )
    return replace(found, state=text_digest(canonical([found, store.objects.facts()]))[:24])


def _indices(pairs: Iterable[tuple[str, str]], at: Mapping[str, int]) -> list[list[int]]:
    return [[at[a], at[b]] for a, b in pairs if a in at and b in at]


def prior_words(prior: Prior, metres_per_unit: float) -> str:
    """Describe a prior with its uncertainty: ``pose, 0.05 m, 2°``."""
    turn, place = prior.sigmas[:3], prior.sigmas[3:6] * prior.S_map_scene.scale * metres_per_unit
    known = [
        f"{place.max():.2g} m" if np.isfinite(place).all() else "",
        f"{np.degrees(turn.max()):.2g}°" if np.isfinite(turn).all() else "",
        "" if prior.up is None else f"vertical {np.degrees(prior.up_sigma_rad):.2g}°",
    ]
    what = "pose" if known[0] and known[1] else "position" if known[0] else "direction"
    return ", ".join([what, *filter(None, known)])


def content_key(scene: Scene, tree: TreeParams) -> str:
    """Return the key of a scene's levels of detail. It begins with the scene's id, and changes when the scene is
    thinned or its levels are computed in another way.
    """
    thinned = "" if scene.thinning is None else f"-t{text_digest(scene.thinning.thinned_at)[:8]}"
    return f"{scene.id}{thinned}-v{VERSION}-{text_digest(canonical(tree))[:8]}"


def _edges(store: Store, placed: PoseGraph | None, at: Mapping[str, int]) -> list[contract.EdgeEntry]:
    outcomes, out = placed.outcomes if placed else {}, list[contract.EdgeEntry]()
    for entry, stored in edge_entries(store, placed):
        row, outcome = entry.row, outcomes.get((entry.row.target, entry.row.source))
        if not at.keys() >= {row.target, row.source}:
            continue
        words = [] if row.review is None else store.registrations.reviews(row.target, row.source)
        out.append(
            {
                **entry_of(row, contract.EdgeEntry),
                "target": at[row.target],
                "source": at[row.source],
                "used": row.used if placed else None,
                "one_pair": outcome is not None and is_one_pair(outcome),
                "note": words[-1].note if words else "",
                "probability": entry.probability,
                "overlap": row.overlap if np.isfinite(row.overlap) else 0.0,
                "doubt": entry.doubt,
                "registration": stored.number,
                "detail": f"edges/{row.target}-{row.source}.json",
            }
        )
    return sorted(out, key=lambda edge: -edge["doubt"])


def _changes(
    store: Store, settings: Settings, asked: ComparisonPlan | None, at: Mapping[str, int]
) -> list[contract.ChangeEntry]:
    """Return the stored changes, without comparing scenes."""
    if asked is None:
        return []
    report = changes_report(store, settings, asked, min_confidence=settings.change.min_confidence)
    return [
        {
            **entry_of(row, contract.ChangeEntry),
            "older": at[row.older],
            "newer": at[row.newer],
            "confidence": row.confidence if np.isfinite(row.confidence) else 0.0,
            "note": _note_of(store, row.id),
            "pictures": [f"changes/{row.id}-{side}.jpg" for side in ("before", "after")],
        }
        for row in report.changes
        if row.box is not None and row.component is not None and at.keys() >= {row.older, row.newer}
    ]


def _note_of(store: Store, change: str) -> str:
    words = store.changes.reviews(parse_change_id(change))
    return words[-1].note if words and words[-1].review != "withdraw" else ""


def _photos(store: Store, placed: PoseGraph | None, living: Collection[str]) -> list[contract.PhotoEntry]:
    """Return the photos stored in the map and the photos localized for control points."""
    found: dict[tuple[str, str], ImagePoint] = {}
    for one in store.world.survey().images:
        if one.camera_covariance is not None and one.scene in living and placed and one.scene in placed.poses:
            found.setdefault((one.scene, one.image), one)
    out = []
    for one in found.values():
        assert placed is not None
        pose = placed.poses[one.scene]
        T = transform_poses(one.T_scene_camera, pose.S_map_scene)
        width, height = np.maximum(1, np.round(2 * one.intrinsics_px[2:])).astype(int).tolist()
        entry: contract.PhotoEntry = {
            "file": one.image,
            "component": pose.component,
            "T_map_camera": T.tolist(),
            "intrinsics_px": one.intrinsics_px.tolist(),
            "size_px": [width, height],
            "captured_at": None,
        }
        out.append(entry)
    rows = (row for row in photo_rows(store) if row.component is not None and row.scene in living)
    return out + [entry_of(row, contract.PhotoEntry) for row in rows]


def cache_folder() -> Path:
    """Return the folder of cached levels of detail, in the user's cache folder (`gsmap.store.cache`)."""
    return cache.folder() / "view"


def merged_tilesets(store: Store, out: Path) -> dict[int, Path]:
    """Return the folder of each component of an export that has 3D Tiles.

    Raises:
        ConfigError, InputError: it is no export of this map, or has none.
    """
    from gsmap.export.manifest import Manifest
    from gsmap.export.tileset import FILE_NAME

    if not out.is_dir():
        raise NotFoundError(f"no folder of exported tiles at {out}", code="folder_not_found")
    manifest = Manifest.load(out, store.id)
    folders = {tile.component: out / tile.path.split("/")[0] for tile in manifest.tiles.values() if tile.path}
    found = {component: folder for component, folder in folders.items() if (folder / FILE_NAME).is_file()}
    if not found:
        raise ConfigError(f"{out} has no 3D Tiles: run gsmap export MAP {out} --format 3dtiles", code="no_tiles")
    return found
