"""Export stage: choose scenes, poses and merger; `gsmap.export` and `gsmap.merge` make the tiles."""

from __future__ import annotations

import logging
import shlex
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from gsmap.durable import remove_file
from gsmap.engine import run_jobs
from gsmap.errors import ConfigError, DiskFullError, GsmapError, InputError, NotFoundError, ReadOnlyError
from gsmap.export import ExportResult, PlannedTile, TileRecipe, dirty_reason, export_tiles, plan_tiles
from gsmap.export.lock import folder_lock
from gsmap.export.pyramid import TreeLayout, is_stale, remove_tree_files
from gsmap.export.streamed_sog import StreamedSog, write_streams
from gsmap.export.tileset import Tiles3D, write_tilesets, write_whole_map
from gsmap.geometry.transforms import transform_cameras
from gsmap.geometry.warps import Warp
from gsmap.map.date_filter import end_of_date, is_until, undated_note
from gsmap.map.georeferenced_components import GeoreferencedComponent, georeferenced_components, world_notes
from gsmap.map.jobs import OmittedContent, TileMaker
from gsmap.map.metric_scales import map_metres, metre_notes
from gsmap.map.rejected_changes import places_near, rejected_places
from gsmap.map.settings import Settings
from gsmap.map.shared_jobs import note_interruption
from gsmap.map.stages.nonrigid import rigid_note, warp_captures
from gsmap.merge import merger, photos_m, reach_m, recipe_key, uses_dates, with_prefer, with_steps
from gsmap.merge.reference_view_cache import ReferenceViewCache
from gsmap.methods import text_digest
from gsmap.store import Store
from gsmap.store.photos import StoredPhoto
from gsmap.texts import escaped
from gsmap.types import Cameras, PoseGraph, Scene, ScenePose, Tile
from gsmap.types.merging import UnchangedPlace
from gsmap.types.metric_scale import MetricScale
from gsmap.types.plain import canonical, plain
from gsmap.types.progress import Progress

_log = logging.getLogger("gsmap.export")

FindOmitted = Callable[[Store, Settings, Collection[str]], tuple[Mapping[str, OmittedContent], tuple[str, ...]]]
"""A function that returns the content of scenes (ids) to leave out of an export of static content, and notes on it."""


@dataclass(frozen=True)
class Request:
    """The options of an export; see `gsmap.Map.export`.

    Args:
        merge: merger; None for the one in the settings.
        steps: optimization steps per tile; None for the merger's setting.
        prefer: preferred capture where captures disagree; None for the merger's setting.
        as_of: use only scenes dated at or before this.
        static: export static content only.
        up: vertical axis of the files; None for the format's default.
        nonrigid: warp captures that are stretched or bent onto those they overlap with.
    """

    format: str = "spz"
    tile_size_m: float | None = None
    bbox: Sequence[float] | None = None
    merge: str | None = None
    revision: int | None = None
    component: int | None = None
    steps: int | None = None
    budget_s: float | None = None
    provenance: bool = False
    uncompressed: bool = False
    prefer: str | None = None
    as_of: str | None = None
    static: bool = False
    up: str | None = None
    nonrigid: bool = False

    def options(self) -> list[str]:
        """Return the command-line options of ``gsmap export`` for this request."""
        words: list[str] = []
        for one in fields(self):
            value = getattr(self, one.name)
            if value != one.default:
                values = [] if value is True else value if one.name == "bbox" else [value]
                option = one.name.removesuffix("_m").removesuffix("_s").replace("_", "-")  # without the unit
                words += [f"--{option}", *(shlex.quote(str(item)) for item in values)]
        return words


_TILES_SHARE = 0.8  # of an export's time, where a tree is written over the tiles


@dataclass(frozen=True, eq=False)
class ExportPlan:
    """The tiles of an export, and the instructions to make each tile.

    Args:
        revision: revision of the poses.
        scenes: exported scenes by id.
        method, params: the merger and its settings.
        recipe: recipe of every tile.
        tiles: planned tiles of the folder.
        notes: remarks for the user.
        metres: metric scale of each component.
        world: georeferenced components.
        passing: content to leave out of each scene.
        photos: reference photos by component and tile name.
        warps: warps of scenes that are merged in another shape, each with an upper limit of how far it moves a point.
        unchanged: places of rejected changes near a tile, by scene id, by component and tile name.
    """

    revision: int | None
    scenes: dict[str, Scene]
    method: str
    params: Any
    recipe: TileRecipe
    tiles: list[PlannedTile]
    notes: tuple[str, ...] = ()
    metres: Mapping[int, MetricScale] = field(default_factory=dict)
    world: Mapping[int, GeoreferencedComponent] = field(default_factory=dict)
    passing: Mapping[str, OmittedContent] = field(default_factory=dict)
    photos: Mapping[tuple[int, str], Sequence[StoredPhoto]] = field(default_factory=dict)
    warps: Mapping[str, tuple[Warp, float]] = field(default_factory=dict)
    unchanged: Mapping[tuple[int, str], Mapping[str, Sequence[UnchangedPlace]]] = field(default_factory=dict)


def plan(store: Store, request: Request, settings: Settings, find_omitted: FindOmitted | None = None) -> ExportPlan:
    """Plan the tiles of an export from the catalog; warps are fitted to the surfaces of scenes.

    Args:
        find_omitted: needed for an export of static content.
    """
    method = request.merge or settings.merge.method
    params = settings.merge.mergers[method]
    if request.steps is not None:
        params = with_steps(method, params, request.steps)
    if request.prefer is not None:
        params = with_prefer(method, params, request.prefer)
    recipe = TileRecipe(
        recipe_key(method, params),
        request.format,
        request.provenance,
        request.budget_s,
        request.uncompressed,
        up=request.up,
    )
    _check(request, recipe)
    revision = store.revisions.newest_number() if request.revision is None else request.revision
    graph, placed = _placed(store, revision, request.component)
    metres = map_metres(store, graph)
    living = {scene.id: scene for scene in store.scenes.list()}
    scenes = {scene: living.get(scene) or store.scenes.get(scene) for scene in placed}  # older poses name removed ones
    notes: tuple[str, ...] = ()
    if request.as_of is not None:
        scenes, notes = _as_of(scenes, request.as_of)
        placed = {scene: placed[scene] for scene in scenes}
    bounds = {scene: found.bounds for scene, found in scenes.items()}
    warps: dict[str, tuple[Warp, float]] = {}
    if request.nonrigid:
        warped = warp_captures(store, settings, graph, placed, scenes)
        placed, notes = {**placed, **warped.poses}, notes + warped.notes
        warps = {scene: (warp, warp.largest_motion(bounds[scene])) for scene, warp in warped.warps.items()}
        bounds |= {scene: np.array([[-far], [far]]) + bounds[scene] for scene, (_, far) in warps.items()}
        recipe = replace(recipe, warps=warped.digests())
    else:
        notes += rigid_note(store, graph, placed, scenes)
    rejected: dict[str, list[UnchangedPlace]] = {}
    if uses_dates(method, params):
        recipe = recipe.with_dates({scene: found.captured_at for scene, found in scenes.items()})
        from gsmap.map.undated_overlaps import undated_notes  # imported here, as status does not need it

        notes += undated_notes(store, scenes.values())
        rejected = rejected_places(store.changes.current(), scenes, placed, metres)
    passing: Mapping[str, OmittedContent] = {}
    if request.static:
        assert find_omitted is not None
        passing, told = find_omitted(store, settings, scenes)
        recipe = replace(recipe, without={scene: one.digest for scene, one in passing.items() if one.digest})
        notes += told
    exported = {pose.component for pose in placed.values()}
    metres = {component: metre for component, metre in metres.items() if component in exported}
    notes += metre_notes(metres)
    world = georeferenced_components(graph, exported)
    if recipe.is_tileset:
        for one in world.values():
            one.on_globe()
    notes += world_notes(world, request.format, recipe.up)
    tiles = plan_tiles(
        {scene: pose.S_map_scene for scene, pose in placed.items()},
        bounds,
        tile_size_m=request.tile_size_m,
        num_gaussians={scene: found.num_gaussians for scene, found in scenes.items()},
        components={scene: pose.component for scene, pose in placed.items()},
        bbox=None if request.bbox is None else np.reshape(np.asarray(request.bbox, float), (2, 3)),
        reach_m=reach_m(method, params),
        metres_per_unit={component: metre.metres_per_unit for component, metre in metres.items()},
        max_tiles=settings.export.max_tiles,
    )
    photos = _photos(store, tiles, photos_m(method, params), request.as_of)
    recipe = replace(recipe, photos={tile: _digest(kept) for tile, kept in photos.items()})
    around_m = reach_m(method, params) + merger(method).looking_m(params)
    near = {(tile.component, tile.name): places_near(rejected, tile, around_m) for tile in tiles if rejected}
    unchanged = {tile: places for tile, places in near.items() if places}
    recipe = replace(recipe, unchanged={tile: _digest_places(places) for tile, places in unchanged.items()})
    return ExportPlan(
        revision, scenes, method, params, recipe, tiles, notes, metres, world, passing, photos, warps, unchanged
    )


def _photos(
    store: Store, tiles: Sequence[PlannedTile], within_m: float | None, as_of: str | None
) -> dict[tuple[int, str], list[StoredPhoto]]:
    """Return the stored photos that may show each tile, in an order that does not depend on when they were added.

    Args:
        within_m: distance from a tile's bounds within which cameras count; None if the merger takes no photos.
    """
    if within_m is None:
        return {}
    kept = sorted(store.photos.list(), key=lambda photo: photo.sighting.digest)
    if as_of is not None:
        until = end_of_date(as_of)
        kept = [photo for photo in kept if is_until(photo.sighting.captured_at, until)]
    out = {}
    for tile in tiles if kept else ():
        far = within_m / tile.metres_per_unit
        box = np.array([tile.bounds[0] - far, tile.bounds[1] + far])
        near = [photo for photo in kept if _stands_in(box, photo, tile)]
        if near:
            out[tile.component, tile.name] = near
    return out


def _stands_in(box: np.ndarray, photo: StoredPhoto, tile: PlannedTile) -> bool:
    one = photo.sighting
    if one.scene not in tile.poses:
        return False
    at = tile.poses[one.scene].apply(one.T_scene_camera[:3, 3])
    return bool(((at >= box[0]) & (at <= box[1])).all())


def _digest(kept: Sequence[StoredPhoto]) -> str:
    """Return a digest of photos as stored: pixels, poses and uncertainties."""
    rows = [
        [photo.picture, one.scene, one.T_scene_camera, one.covariance, one.intrinsics_px, one.size_px]
        for photo, one in ((photo, photo.sighting) for photo in kept)
    ]
    return text_digest(canonical(plain(rows)))[:32]


def _digest_places(places: Mapping[str, Sequence[UnchangedPlace]]) -> str:
    """Return a digest of boxes in the frames of their comparisons; poses are compared apart (`dirty_reason`)."""
    rows = {scene: [[place.box, place.margin_m] for place in found] for scene, found in places.items()}
    return text_digest(canonical(plain(rows)))[:32]


def export(
    store: Store,
    out: Path,
    request: Request,
    settings: Settings,
    progress: Progress,
    *,
    wait: bool = False,
    find_omitted: FindOmitted | None = None,
) -> tuple[ExportResult, tuple[str, ...]]:
    """Plan the tiles, make and write the dirty tiles, and record their recipes in the store.

    A map that was opened for reading, or whose disk is full, is exported too; then only the folder's own manifest says
    what was made.

    Args:
        wait: wait while another export runs in the folder.
        find_omitted: see `plan`.

    Returns:
        What was made, and what a person should know of what took part.

    Raises:
        BusyError: another export is at work in the folder.
    """
    planned = plan(store, request, settings, find_omitted)
    waited = False

    def waiting(text: str) -> None:
        nonlocal waited
        waited = True
        progress(0.0, text)

    with folder_lock(out, wait=wait, waiting=waiting), store.leases.announce("export", f"export {out.resolve()}"):
        if waited:
            planned = plan(store, request, settings, find_omitted)  # the map may have other poses now
        result, note = _export(store, out, request, planned, settings, progress)
        return result, (*planned.notes, *[note] * bool(note))


def _export(
    store: Store, out: Path, request: Request, planned: ExportPlan, settings: Settings, progress: Progress
) -> tuple[ExportResult, str]:
    """Export into a locked folder; return the result and a remark on its trees."""
    asked = plain(asdict(replace(request, merge=planned.method)))
    number: list[int] = []
    refused = "" if store.catalog.writable else f"{store.location} is read-only"
    num_made = 0

    def note(tile: Tile) -> None:
        if not number:
            number.append(store.exports.begin(out, revision=planned.revision, settings=asked))
        store.exports.add_tile(number[0], tile)

    def noted(tile: Tile) -> None:
        nonlocal num_made, refused
        num_made += 1
        if not tile.path or refused:  # nothing lies there, or nothing can be noted
            return
        try:
            note(tile)
        except (DiskFullError, ReadOnlyError) as error:
            refused = str(error)

    with note_interruption(lambda: f"{num_made} {'tile is' if num_made == 1 else 'tiles are'} made and kept"):
        result = export_tiles(
            planned.tiles,
            partial(make_content, store, planned, settings),
            out,
            map_id=store.id,
            recipe=planned.recipe,
            metres=planned.metres,
            world={component: one.to_json() for component, one in planned.world.items()},
            offsets={scene: found.origin.tolist() for scene, found in planned.scenes.items() if found.origin.any()},
            params=settings.export,
            run=lambda job, arguments: run_jobs(job, arguments, settings.engine),
            made=noted,
            progress=(lambda fraction, text: progress(_TILES_SHARE * fraction, text))
            if planned.recipe.is_tree
            else progress,
        )
    _put_aside(store, out, planned, result)
    layout: TreeLayout = Tiles3D(not request.uncompressed) if planned.recipe.is_tileset else StreamedSog()
    if planned.recipe.is_tree and is_stale(out, result.tiles, layout):
        in_metres_of = {component: metre.metres_per_unit for component, metre in planned.metres.items()}
        cameras, levels = partial(_cameras, store, planned), settings.export.levels
        progress(_TILES_SHARE, "levels of detail")
        if planned.recipe.is_tileset:
            packed = not request.uncompressed
            write_tilesets(
                out,
                result.tiles,
                in_metres_of,
                S_ecef_map={component: one.on_globe() for component, one in planned.world.items()},
                compressed=packed,
                cameras=cameras,
                levels=levels,
            )
        else:
            write_streams(out, result.tiles, cameras=cameras, levels=levels)
    tree_note = _finish_trees(out, planned, result)
    progress(1.0, "")
    if store.catalog.writable:
        refused = ""
        try:  # record what an interrupted or unrecorded export wrote
            known = {tile.path: tile for tile in store.exports.tiles(out)}
            for tile in result.tiles:
                same = known.pop(tile.path, None)
                if tile.path and (same is None or (same.key, same.sha256) != (tile.key, tile.sha256)):
                    note(tile)
            if known:
                store.exports.forget(out, known)
        except (DiskFullError, ReadOnlyError) as error:
            refused = str(error)
    if refused:
        _log.warning("%s: the map does not know all of this export, so gsmap status cannot watch %s", refused, out)
    return result, tree_note


def _finish_trees(out: Path, planned: ExportPlan, result: ExportResult) -> str:
    """Write the tileset of the whole folder; delete the trees of a format that the folder had before."""
    own = {"3dtiles": Tiles3D.file_name, "streamed-sog": StreamedSog.file_name}.get(planned.recipe.format)
    with_files = sorted({tile.component for tile in result.tiles if tile.path})
    for component in with_files:
        folder = f"component_{component}"
        others = [name for name in (Tiles3D.file_name, StreamedSog.file_name) if name != own]
        if own is None:
            remove_tree_files(out, folder, others)
        else:
            remove_file(out, folder, *others)
    if planned.recipe.is_tileset and with_files:
        return write_whole_map(out, with_files, planned.world.keys())
    remove_file(out, Tiles3D.file_name)
    return ""


def make_content(store: Store, planned: ExportPlan, settings: Settings, tile: PlannedTile, folder: str) -> TileMaker:
    """Return the job that makes the content of a tile."""
    thinned = {scene: one.thinning.thinned_at for scene, one in planned.scenes.items() if one.thinning is not None}
    about = [store.id, planned.recipe.merge_key(tile), {scene: thinned.get(scene) for scene in tile.poses}]
    return TileMaker(
        store.location,
        tile,
        planned.method,
        planned.params,
        budget_s=planned.recipe.budget_s,
        cache_key=text_digest(canonical(plain(about))),
        captured_at={scene: planned.scenes[scene].captured_at for scene in tile.poses},
        store=ReferenceViewCache(folder, settings.export.max_shared_bytes),
        passing={scene: planned.passing[scene] for scene in tile.poses if scene in planned.passing},
        unchanged=planned.unchanged.get((tile.component, tile.name), {}),
        warps={scene: planned.warps[scene] for scene in tile.poses if scene in planned.warps},
        photos=_by_scene(planned.photos.get((tile.component, tile.name), ())),
    )


def _by_scene(photos: Sequence[StoredPhoto]) -> dict[str, tuple[StoredPhoto, ...]]:
    scenes = {photo.sighting.scene for photo in photos}
    return {scene: tuple(photo for photo in photos if photo.sighting.scene == scene) for scene in scenes}


def _cameras(store: Store, planned: ExportPlan, component: int) -> Cameras | None:
    """Return the cameras of all scenes of a component, in the component's frame; None without cameras."""
    poses = {scene: S for tile in planned.tiles if tile.component == component for scene, S in tile.poses.items()}
    found = [transform_cameras(store.scenes.cameras(scene), S) for scene, S in sorted(poses.items())]
    found = [cameras for cameras in found if len(cameras)]
    if not found:
        return None
    return Cameras(
        np.concatenate([cameras.T_frame_camera for cameras in found]),
        np.concatenate([cameras.intrinsics_px for cameras in found]),
        np.concatenate([cameras.sizes_px for cameras in found]),
    )


def _put_aside(store: Store, out: Path, planned: ExportPlan, result: ExportResult) -> None:
    """Record the tiles of this folder that could not be made, in place of earlier records."""
    about = escaped(str(out.resolve()))
    now = {f"tile {planned.recipe.key(tile)}": (tile, reason) for tile, reason in result.set_aside}
    for tile, reason in now.values():
        _log.warning("tile component_%d/%s is quarantined: %s", tile.component, tile.name, reason)
    if not store.catalog.writable:
        return
    with suppress(DiskFullError, ReadOnlyError):
        if before := {one.what for one in store.quarantine.list() if one.about == about} - now.keys():
            store.quarantine.forget(before)
        for what, (tile, reason) in now.items():
            store.quarantine.add(what, about, f"component_{tile.component}/{tile.name}: {reason}")


def dirty_tiles(store: Store, settings: Settings, find_omitted: FindOmitted) -> dict[str, tuple[int, Request]]:
    """Return, for each export folder, the number of tiles that a repeated export would make or remove, and the row of
    the last export.

    Read from the catalog, which does not say which tiles are empty: new ones are not counted. Only warps of captures
    are fitted again. All tiles of static content count if the map's objects are out of date. A folder whose export
    named a revision stays as it is, whatever the map does.
    """
    newest = {export.target: export for export in store.exports.list()}
    found: dict[str, tuple[int, Request]] = {}
    known = {one.name for one in fields(Request)}
    for target in store.exports.targets():
        stored = newest[target].settings
        request = Request(**{key: value for key, value in stored.items() if key in known})
        old = {(tile.component, Path(tile.path).name.partition(".")[0]): tile for tile in store.exports.tiles(target)}
        try:
            planned = plan(store, request, settings, find_omitted)
        except GsmapError as error:  # what was exported then cannot be now: its verb will say why
            if error.code == "objects_outdated" and old:
                found[target] = len(old), request
            continue
        again = [
            tile
            for tile in planned.tiles
            if (made := old.get((tile.component, tile.name))) is not None
            and dirty_reason(tile, made, planned.recipe, settings.export.max_shift_m)
        ]
        gone = set(old) - {(tile.component, tile.name) for tile in planned.tiles}
        if again or gone:
            found[target] = len(again) + len(gone), request
    return found


def _check(request: Request, recipe: TileRecipe) -> None:
    """Raise an error for invalid options before reading any data."""
    if request.budget_s is not None and not request.budget_s > 0:
        raise ConfigError(
            f"the budget must be a positive number of seconds, got {request.budget_s}", code="invalid_budget"
        )
    if recipe.is_tree and request.tile_size_m is not None and not request.tile_size_m > 0:
        raise ConfigError(
            f"{recipe.format} is a tree of tiles: leave --tile-size out, or use {recipe.suffix} for one file",
            code="unsupported_output",
        )


def _placed(store: Store, revision: int | None, component: int | None) -> tuple[PoseGraph, dict[str, ScenePose]]:
    """Return a revision and the poses of the scenes to export."""
    graph = store.revisions.get(revision)
    if graph is None:
        raise NotFoundError("the map has no poses yet: run gsmap update or gsmap optimize first", code="no_poses")
    living = {s.id for s in store.scenes.list()} if revision == store.revisions.newest_number() else set(graph.poses)
    placed = {s: p for s, p in graph.poses.items() if s in living}
    if component is not None:
        placed = {s: p for s, p in placed.items() if p.component == component}
        if not placed:
            known = sorted({p.component for p in graph.poses.values()})
            raise NotFoundError(
                f"revision {revision} has no component {component}: it has {known}", code="component_not_found"
            )
    if not placed:
        raise InputError(
            "nothing to export: no scene has a place in the map yet; run gsmap update first", code="nothing_to_export"
        )
    return graph, placed


def _as_of(scenes: dict[str, Scene], as_of: str) -> tuple[dict[str, Scene], tuple[str, ...]]:
    """Return the scenes dated at or before a date, and a note on undated scenes."""
    until = end_of_date(as_of)
    found = {scene: one for scene, one in scenes.items() if is_until(one.captured_at, until)}
    note = undated_note(list(scenes.values()), as_of)
    if not found:
        raise NotFoundError(
            f"no capture with a place in the map is dated {as_of} or earlier{note and f'; {note}'}",
            code="no_placed_scene",
        )
    return found, (note,) if note else ()
