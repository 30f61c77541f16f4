"""Jobs that worker processes run: describe a scene, register a pair, make a tile."""

from __future__ import annotations

import os
from collections import OrderedDict
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

import numpy as np

from gsmap.errors import CorruptError, InputError, StoreError
from gsmap.geometry.metric_scale import in_metres, scale_gaussians
from gsmap.geometry.uncertainty import max_sigmas
from gsmap.geometry.warps import Warp, warp_cameras, warp_gaussians
from gsmap.methods import RecipeKey
from gsmap.store import Store, branches, remote_map, sqlite
from gsmap.store.array_groups import ArrayResults, StagedResult
from gsmap.store.photos import StoredPhoto
from gsmap.types import (
    Cameras,
    Gaussians,
    MergeResult,
    ReferencePhoto,
    Registration,
    SceneGraph,
)
from gsmap.types.model import ModelSpec
from gsmap.types.prepared_scene import PreparedScene
from gsmap.types.progress import Progress

# A job imports its room when it runs, since listing missing results does not need it.
if TYPE_CHECKING:
    from gsmap import describe as describing
    from gsmap import register as registering
    from gsmap.export import PlannedTile
    from gsmap.merge.reference_view_cache import ReferenceViewCache
    from gsmap.merge.tile import LazyScene
    from gsmap.register import SceneView
    from gsmap.types.merging import UnchangedPlace

Result = TypeVar("Result")

_MAX_PIXELS = 1 << 24  # of a kept photo: so few bytes can claim any number


def store_of(path: str) -> Store:
    """Open the map at a path and keep it open for later jobs."""
    return _opened(*_catalog_file(path))


@lru_cache(maxsize=1)
def _opened(location: str, inode: int) -> Store:
    return Store.open(location, "r")


def _catalog_file(path: str) -> tuple[str, int]:
    """Return the absolute location of a map and the inode of its catalog file. The inode distinguishes maps that were
    at the same path at different times; an open file keeps its inode.
    """
    location = path if remote_map.is_remote(path) else os.path.abspath(path)
    try:
        return location, (branches.locate(location).folder / sqlite.FILE).stat().st_ino
    except FileNotFoundError:  # its catalog is a database elsewhere
        return location, 0


_VIEW_BYTES = 1 << 30  # of the scenes that a worker keeps for its next pairs
_views: OrderedDict[tuple[str, str, str], SceneView] = OrderedDict()


def _view(path: str, scene_id: str, graph_key: str) -> SceneView:
    """Load a scene for registration, or return it from the cache. Pairs come ordered by scene, so that a small cache
    saves most reads."""
    key = (str(_catalog_file(path)), scene_id, graph_key)
    found = _views.pop(key, None)
    _views[key] = load_view(store_of(path), scene_id, graph_key) if found is None else found
    while len(_views) > 2 and sum(view.num_bytes for view in _views.values()) > _VIEW_BYTES:
        _views.popitem(last=False)
    return _views[key]


def load_view(store: Store, scene_id: str, graph_key: str) -> SceneView:
    """Load a described scene for registration, without its Gaussians, which are read when they are used."""
    from gsmap.register import SceneView
    from gsmap.register.recipe import prepared_key

    scenes, graph = store.scenes, store.graphs.load(scene_id, graph_key)
    assert graph is not None, f"scene {scene_id} was to be registered before it was described"
    try:
        prepared = store.prepared_scenes.load(scene_id, prepared_key().of(scene_id, graph_key))
    except CorruptError:
        prepared = None  # it is computed again; gsmap check reports the damage
    policy = scenes.get(scene_id).scale_policy
    return SceneView(scene_id, scenes.unread(scene_id), scenes.cameras(scene_id), graph, policy, prepared)


def staged(results: ArrayResults[Result], found: Result, key: RecipeKey, inbox: str) -> Result | StagedResult:
    """Stage the arrays of a result for the calling process, which then saves them by a row alone.

    Args:
        inbox: inbox of the calling process.

    Returns:
        The result itself where this process cannot write to the map: the calling process stores its arrays.
    """
    try:
        return results.stage(found, key, inbox)
    except (OSError, StoreError):
        return found


def describe_scene(
    path: str, scene_id: str, models: Mapping[str, ModelSpec], params: describing.Params, key: RecipeKey, inbox: str
) -> tuple[SceneGraph | StagedResult, PreparedScene | StagedResult]:
    """Build the scene graph of one scene of the map at ``path`` (`Store.location`), and prepare its registration.

    Args:
        key: recipe of the graph.
        inbox: see `staged`.
    """
    from gsmap import describe as describing
    from gsmap.geometry.threads import run_aside
    from gsmap.register.prepare import prepare
    from gsmap.register.recipe import prepared_key

    store = store_of(path)
    scenes = store.scenes
    policy = scenes.get(scene_id).scale_policy
    gaussians, cameras = scenes.unread(scene_id).degree_0(), scenes.cameras(scene_id)
    basis = describing.find_basis(gaussians, cameras, params, scale_policy=policy)
    with run_aside(lambda: prepare(scene_id, gaussians, cameras, basis.registration_m)) as prepared:
        graph = describing.describe(scene_id, gaussians, cameras, params, models, scale_policy=policy, basis=basis)
        own_key = prepared_key().of(scene_id, key.digest)
        return staged(store.graphs, graph, key, inbox), staged(store.prepared_scenes, prepared(), own_key, inbox)


def prepare_scene(path: str, scene_id: str, key: RecipeKey, inbox: str) -> PreparedScene | StagedResult:
    """Prepare a scene of the map at ``path`` that was described by an older release.

    Args:
        key: recipe of the prepared scene, of which the key of the graph is an input.
        inbox: see `staged`.
    """
    from gsmap.register.prepare import prepare, working_m_of

    store = store_of(path)
    graph, scenes = store.graphs.load(scene_id, key.inputs[1]), store.scenes
    assert graph is not None, f"scene {scene_id} was to be prepared before it was described"
    gaussians, cameras = scenes.unread(scene_id).degree_0(), scenes.cameras(scene_id)
    found = prepare(scene_id, gaussians, cameras, working_m_of(graph, scenes.get(scene_id).scale_policy))
    return staged(store.prepared_scenes, found, key, inbox)


def register_scenes(
    path: str, target: tuple[str, str], source: tuple[str, str], params: registering.Params
) -> Registration:
    """Register one pair of the map at ``path``; target and source are (scene id, key of its graph)."""
    from gsmap import register as registering

    return registering.register_pair(_view(path, *target), _view(path, *source), params)


class OmittedContent(Hashable, Protocol):
    """Content of one scene that an export leaves out; picklable."""

    @property
    def digest(self) -> str:
        """Digest of the content; empty without content."""

    def rows(self, store: Store, scene: str) -> np.ndarray:
        """Return a mask (N,) that is True for the Gaussians of the scene to leave out."""


def _read(path: str, scene_id: str, passing: OmittedContent | None, bounds: np.ndarray | None) -> Gaussians:
    """Read the Gaussians of a scene that reach into a box in the scene frame, without omitted content."""
    return store_of(path).scenes.gaussians(scene_id, bounds, _left_out(path, scene_id, passing))


def _read_within(path: str, scene_id: str, passing: OmittedContent | None, bounds: np.ndarray) -> Gaussians:
    """Read the Gaussians of a scene whose means lie in a box, without omitted content."""
    return store_of(path).scenes.gaussians_within(scene_id, bounds, _left_out(path, scene_id, passing))


def _left_out(path: str, scene_id: str, passing: OmittedContent | None) -> np.ndarray | None:
    return None if passing is None or not passing.digest else _without(path, scene_id, passing)


@lru_cache(maxsize=8)
def _without(path: str, scene_id: str, passing: OmittedContent) -> np.ndarray:
    """Return the rows to leave out; the answer is cached, as neighbouring tiles need the same scenes."""
    return passing.rows(store_of(path), scene_id)


def _warped(scene: LazyScene, warp: Warp, far: float) -> LazyScene:
    """Return a scene in the shape that a warp gives it, which moves no point farther than ``far``."""

    def load(bounds: np.ndarray | None) -> Gaussians:
        around = None if bounds is None else bounds + np.array([[-far], [far]])
        return warp_gaussians(scene.load(around), warp)

    return replace(
        scene,
        load=load,
        load_within=None,
        cameras=None if scene.cameras is None else warp_cameras(scene.cameras, warp),
        photos=tuple(replace(photo, camera=warp_cameras(photo.camera, warp)) for photo in scene.photos),
    )


def _kept(path: str, photo: StoredPhoto) -> ReferencePhoto:
    """Return a stored photo in the frame of its scene."""
    one = photo.sighting
    camera = Cameras(one.T_scene_camera[None], one.intrinsics_px[None], np.array([one.size_px]))
    return ReferencePhoto(camera, partial(_picture, path, photo.number), *max_sigmas(one.covariance))


def _picture(path: str, number: int) -> np.ndarray:
    """Return the stored image (H, W, 3) uint8 of a photo."""
    from gsmap.formats.pictures import open_picture

    try:
        data = store_of(path).photos.jpeg(number)
        with open_picture(f"photo p{number}", data=data, formats=["JPEG"], max_pixels=_MAX_PIXELS) as picture:
            return np.asarray(picture.convert("RGB"))
    except InputError as error:
        raise CorruptError(
            f"the stored image of photo p{number} is damaged ({error}): remove it (gsmap remove MAP p{number} "
            "--photo) and add it again",
            code="photo_damaged",
        ) from error


@dataclass(frozen=True, eq=False)
class TileMaker:
    """A picklable job that makes the content of a tile.

    Args:
        location: location of the map.
        tile: the planned tile.
        method, params: the merger and its settings.
        budget_s: maximum wall time in seconds.
        captured_at: date of each scene.
        store: cache of reference views for other tiles.
        passing: content to leave out, by scene id.
        photos: reference photos, by scene id.
        unchanged: places of rejected changes, by scene id.
        warps: warps of scenes, each with an upper limit of how far it moves a point, by scene id.
        cache_key: key of the merged tile among those of earlier exports (`gsmap.map.merged_tiles`).
    """

    location: str
    tile: PlannedTile
    method: str
    params: Any
    budget_s: float | None
    captured_at: Mapping[str, str | None]
    store: ReferenceViewCache
    passing: Mapping[str, OmittedContent] = field(default_factory=dict)
    photos: Mapping[str, Sequence[StoredPhoto]] = field(default_factory=dict)
    unchanged: Mapping[str, Sequence[UnchangedPlace]] = field(default_factory=dict)
    warps: Mapping[str, tuple[Warp, float]] = field(default_factory=dict)
    cache_key: str = ""

    def __call__(self, progress: Progress) -> MergeResult:
        """Return the merged tile in map units, of an earlier export if it is cached."""
        from gsmap.map import merged_tiles

        if not self.cache_key:
            return self._merge(progress)
        found = merged_tiles.load(self.cache_key)
        if found is None:
            found = self._merge(progress)
            merged_tiles.keep(self.cache_key, found, self.tile.poses)
        return found

    def _merge(self, progress: Progress) -> MergeResult:
        """Merge in metres and return the result in map units."""
        from gsmap.merge.overlap import clamp_inside
        from gsmap.merge.tile import LazyScene, merge_tile

        scenes, metres = store_of(self.location).scenes, self.tile.metres_per_unit
        lazy = [
            LazyScene(
                scene,
                in_metres(pose, metres),
                partial(_read, self.location, scene, self.passing.get(scene)),
                scenes.cameras(scene),
                self.captured_at[scene],
                self.store,
                "" if (left := self.passing.get(scene)) is None else left.digest,
                partial(_read_within, self.location, scene, self.passing.get(scene)),
                tuple(_kept(self.location, photo) for photo in self.photos.get(scene, ())),
                tuple(self.unchanged.get(scene, ())),
            )
            for scene, pose in self.tile.poses.items()
        ]
        lazy = [
            _warped(scene, *self.warps[scene.scene_id]) if scene.scene_id in self.warps else scene for scene in lazy
        ]
        bounds = self.tile.bounds if self.tile.is_cut else None
        found = merge_tile(
            lazy,
            self.method,
            self.params,
            bounds=None if bounds is None else bounds * metres,
            budget_s=self.budget_s,
            progress=progress,
        )
        if metres == 1.0:
            return found
        merged = scale_gaussians(found.gaussians, 1 / metres)
        return replace(found, gaussians=replace(merged, means=clamp_inside(merged.means, bounds)))
