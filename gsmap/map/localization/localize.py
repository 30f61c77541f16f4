"""Localize stage: compute missing view features, then localize photos with them."""

from __future__ import annotations

import logging
import time
import weakref
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeVar

import numpy as np

from gsmap import localize as localizing
from gsmap.engine import QuarantinedJob, run_jobs
from gsmap.errors import ConfigError, CorruptError, DiskFullError, GsmapError, NotFoundError, ReadOnlyError
from gsmap.geometry.metric_scale import in_metres
from gsmap.localize import MapScene, ViewIndex, new_segment, view_index
from gsmap.map import models
from gsmap.map.jobs import staged, store_of
from gsmap.map.metric_scales import map_metres
from gsmap.map.scene_index import AT_ONCE, PATIENCE, SceneIndex
from gsmap.map.settings import Settings
from gsmap.map.shared_jobs import SharedJobs, note_interruption
from gsmap.methods import RecipeKey, family
from gsmap.methods.extractor import Extractor
from gsmap.reason_codes import reason
from gsmap.store import Store
from gsmap.store.array_groups import StagedResult
from gsmap.types import Gaussians, PoseGraph, Scene
from gsmap.types.localization import LocalizationResult, Photo, SceneFeatures
from gsmap.types.model import ModelSpec
from gsmap.types.progress import StageProgress
from gsmap.types.segments import InMemory
from gsmap.types.source import ChunkSource

_Said = TypeVar("_Said")
_log = logging.getLogger("gsmap.map")

_KEPT = 12  # scenes whose arrays stay in memory while photographs come: about a gigabyte


@dataclass(frozen=True)
class SearchRegion:
    """The region of the map in which the photos are expected.

    Args:
        scene: restrict to places that this scene (id) shows; None if a point is given.
        point: (3,) point of the map, map unit.
        radius: radius around it, map unit.
    """

    scene: str | None = None
    point: tuple[float, float, float] | None = None
    radius: float = 0.0


def parse_near(store: Store, text: str) -> SearchRegion:
    """Parse ``SCENE`` or ``X,Y,Z,R``.

    Raises:
        ConfigError: neither four numbers with a radius above 0, nor a scene.
        NotFoundError: no such scene.
    """
    return near_of(text, lambda name: store.scenes.get(name).id)


def near_of(text: str, id_of: Callable[[str], str]) -> SearchRegion:
    """Parse ``SCENE`` or ``X,Y,Z,R`` with a function that resolves scene names."""
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        return SearchRegion(id_of(text))
    if len(numbers) != 4 or not np.isfinite(numbers).all() or numbers[3] <= 0:
        raise ConfigError(
            f"--near must be a scene, or X,Y,Z,R with a radius above 0, got {text!r}", code="invalid_point"
        )
    return SearchRegion(None, (numbers[0], numbers[1], numbers[2]), numbers[3])


class Localizer:
    """The placed scenes of a map, ready to localize photos, with arrays that are loaded on demand.

    Args:
        store: the store of the map.
        settings: the settings in force.
        progress: progress of feature extraction.

    Raises:
        NotFoundError: the map holds nothing that has a place.
    """

    def __init__(self, store: Store, settings: Settings, progress: StageProgress) -> None:
        self.store, self.settings, self.params = store, settings, settings.localize
        poses = store.revisions.poses()
        self.scenes = {scene.id: scene for scene in store.scenes.list() if scene.id in poses}
        if not self.scenes:
            empty = "is empty: add captures" if not store.scenes.list() else "has no poses yet: run"
            raise NotFoundError(
                f"{store.location} {empty} (gsmap update {store.location}), and localise then", code="no_placed_scene"
            )
        self.metres = {
            component: metre.metres_per_unit for component, metre in map_metres(store, PoseGraph(poses)).items()
        }
        self.keys = feature_keys(store, list(self.scenes.values()), settings)
        self._held: dict[str, SceneFeatures] = {}
        ensure(store, list(self.scenes.values()), self.keys, settings, progress, self._held)
        arrays = weakref.proxy(self)  # no cycle of references, so that the arrays are freed together with the localizer
        self.placed = {
            scene: MapScene(
                scene,
                in_metres(poses[scene].S_map_scene, self.metres.get(poses[scene].component, 1.0)),
                poses[scene].component,
                poses[scene].covariance,
                partial(Localizer._gaussians, arrays, scene),
                partial(Localizer._features, arrays, scene),
                partial(Localizer._chunks, arrays, scene),
            )
            for scene in self.scenes
        }
        self._used: list[str] = []
        self._capture_views: dict[str, localizing.CaptureViews] = {}
        self.index = self._index(progress)
        specs = models.specs(store)
        method = family("extractor").get(self.params.extractor)
        self.extractor: Extractor = method.make(specs, self.params.extractors[self.params.extractor])

    def _scene_index(self) -> SceneIndex:
        """Return the index of the scenes with features; scenes of quarantined jobs have no features."""
        kept = self.store.view_features.stored_keys(self.keys.values())
        return SceneIndex(
            self.store,
            localizing.index_recipe(),
            self.settings.index_recipes(),
            {scene: key.digest for scene, key in self.keys.items() if key.digest in kept or scene in self._held},
            self._segment,
        )

    def _index(self, progress: StageProgress) -> ViewIndex:
        """Return the updated index of all views; scenes that cannot be stored are indexed in memory."""
        index = self._scene_index()
        for left in reversed(range(PATIENCE)):
            try:
                kept = None
                if self.store.catalog.writable and not self._held:
                    with suppress(DiskFullError, ReadOnlyError):
                        kept = index.update(lambda told: progress("localize", 0.0, f"{told} of views"))
                if kept is None:
                    kept = index.segments()
                missing = index.missing(kept)
                parts = [missing[start : start + AT_ONCE] for start in range(0, len(missing), AT_ONCE)]
                return view_index([*kept, *(self._segment(part) for part in parts)])
            except NotFoundError:  # another process made segments one while they were read
                if not left:
                    raise
            except CorruptError:
                if not (left and self.store.catalog.writable and index.forget_damaged()):
                    raise
        raise AssertionError("unreachable")

    def _segment(self, scenes: Sequence[str]) -> InMemory:
        found = []
        for scene in scenes:
            found.append((self.placed[scene].features, self.keys[scene].digest))
            self.placed[scene].drop()
        return new_segment(found)

    def _query(self, near: SearchRegion | None, ask: Callable[[ViewIndex], _Said]) -> _Said:
        """Query the index; if it was changed or damaged meanwhile, repair it and query once more."""
        try:
            return ask(self.index if near is None else localizing_near(self, near))
        except (NotFoundError, CorruptError) as error:
            self.index = self._renewed(error)
        return ask(self.index if near is None else localizing_near(self, near))

    def _renewed(self, error: GsmapError) -> ViewIndex:
        """Reload the index after an error if that may help.

        Raises:
            GsmapError: the error, where it will not.
        """
        damaged = isinstance(error, CorruptError)
        if damaged and not (self.store.catalog.writable and self._scene_index().forget_damaged()):
            raise error
        return self._index(lambda *told: None)

    def _gaussians(self, scene: str) -> Gaussians:
        self._use(scene)
        return self.store.scenes.gaussians(scene)

    def _chunks(self, scene: str) -> ChunkSource:
        self._use(scene)
        return self.store.scenes.chunks(scene)

    def _features(self, scene: str) -> SceneFeatures:
        self._use(scene)
        held = self._held.get(scene)
        found = held if held is not None else self.store.view_features.load(scene, self.keys[scene])
        if found is None:
            raise NotFoundError(
                f"the features of scene {self.scenes[scene].name} were dropped meanwhile: try again",
                code="changed_meanwhile",
            )
        return found

    def _use(self, scene: str) -> None:
        """Mark a scene's arrays as used, and drop the least recently used arrays."""
        self._used = [one for one in self._used if one != scene] + [scene]
        while len(self._used) > _KEPT:
            self.placed[self._used.pop(0)].drop()

    def capture_views(self, scene: str) -> localizing.CaptureViews:
        """Return the depth views of a scene's own cameras, rendered on first use."""
        if scene not in self._capture_views:
            cameras = self.store.scenes.cameras(scene)
            own = None if cameras is None or cameras.synthesised else cameras
            self._capture_views[scene] = localizing.render_capture_views(self.placed[scene], own)
        return self._capture_views[scene]

    def localize(self, photo: Photo, near: SearchRegion | None = None) -> LocalizationResult:
        """Localize one photo."""
        options = (self.placed, self.extractor, self.params, self.metres)
        found = self._query(near, lambda index: localizing.localize_photo(photo, index, *options))
        return _within(found, near)

    def localize_together(self, photos: Sequence[Photo], near: SearchRegion | None = None) -> list[LocalizationResult]:
        """Localize overlapping photos of one place."""
        options = (self.placed, self.extractor, self.params, self.metres)
        found = self._query(near, lambda index: localizing.localize_together(photos, index, *options))
        return [_within(one, near) for one in found]


def _within(found: LocalizationResult, near: SearchRegion | None) -> LocalizationResult:
    """Return the result, which is refused if it lies outside the search region.

    A person who says where photographs are from rules out what is elsewhere.
    """
    if near is None or near.point is None or found.T_map_camera is None:
        return found
    far = float(np.linalg.norm(found.T_map_camera[:3, 3] - near.point))
    if far <= near.radius:
        return found
    why = reason("too_far", f"it was taken {far:.3g} from there, farther than {near.radius:g}")
    return replace(found, reason=why, T_map_camera=None, covariance=None)


def localizing_near(localizer: Localizer, near: SearchRegion) -> ViewIndex:
    """Return the index restricted to scenes that reach into the search region."""
    metres = localizer.metres
    if near.scene is not None:
        if near.scene not in localizer.placed:
            raise NotFoundError(
                f"scene {near.scene[:12]} has no place in the map yet: run gsmap update first", code="scene_unplaced"
            )
        around = localizer.placed[near.scene]
        return localizer.index.only({one for one in localizer.placed if _overlap(localizer, around, one)})
    assert near.point is not None
    wanted = set()
    for scene, placed in localizer.placed.items():
        unit = metres.get(placed.component, 1.0)
        inverse = placed.S_metric_scene.inverse()
        at, reach = inverse.apply(np.array(near.point) * unit), near.radius * unit * inverse.scale
        low, high = np.asarray(localizer.scenes[scene].bounds)
        if np.linalg.norm(np.maximum(np.maximum(low - at, at - high), 0)) <= reach:
            wanted.add(scene)
    return localizer.index.only(wanted)


def _overlap(localizer: Localizer, around: MapScene, scene: str) -> bool:
    """Return true if the centre of one scene lies in the box of the other."""
    other = localizer.placed[scene]
    if other.component != around.component:
        return False
    for one, two in ((around, other), (other, around)):
        low, high = np.asarray(localizer.scenes[one.scene].bounds)
        middle = np.asarray(localizer.scenes[two.scene].bounds).mean(0)
        at = one.S_metric_scene.inverse().apply(two.S_metric_scene.apply(middle))
        if ((at >= low) & (at <= high)).all():
            return True
    return False


def feature_keys(store: Store, scenes: Sequence[Scene], settings: Settings) -> dict[str, RecipeKey]:
    """Return the key of each scene's features by scene id; thinned scenes have other features.

    A scene that is kept compact shows less than it did: its features are others.

    Raises:
        ConfigError: the extractor needs a model that the map has not.
    """
    specs = models.specs(store)
    for kind in family("extractor").get(settings.localize.extractor).MODELS:
        if kind not in specs:
            raise ConfigError(
                f"extractor {settings.localize.extractor!r} needs a model of the kind {kind!r}: "
                f"gsmap models add {store.location} {kind} FILE.onnx",
                code="model_required",
            )
    recipe = localizing.recipe_key(settings.localize, specs)
    return {scene.id: recipe.of(scene.id, "" if scene.thinning is None else "thinned") for scene in scenes}


def ensure(
    store: Store,
    scenes: Sequence[Scene],
    keys: Mapping[str, RecipeKey],
    settings: Settings,
    progress: StageProgress,
    held: dict[str, SceneFeatures],
) -> None:
    """Make the missing features and store them, or keep them in ``held`` if the map cannot be written."""
    kept = store.view_features.stored_keys(keys.values())
    missing = [scene for scene in scenes if keys[scene.id].digest not in kept]
    if not missing:
        return
    params, specs = settings.localize, models.specs(store)
    jobs = {keys[scene.id].digest: (store.location, scene.id, specs, params, keys[scene.id]) for scene in missing}
    names = {keys[scene.id].digest: scene.name for scene in missing}

    def make_in_memory() -> None:
        left = [scene for scene in missing if scene.id not in held]
        arguments = [(*jobs[keys[scene.id].digest], None) for scene in left]
        running = run_jobs(features_of_scene, iter(arguments), settings.engine)
        for count, (number, found) in enumerate(running):
            if not isinstance(found, QuarantinedJob):
                held[left[number].id] = found
            progress("localize", (count + 1) / len(left), f"{left[number].name}: not stored, made for this run alone")

    if not store.catalog.writable:
        make_in_memory()
        return

    def done(wanted: Collection[str]) -> set[str]:
        return store.view_features.stored_keys(wanted)

    about = {keys[scene.id].digest: (scene.id,) for scene in missing}
    there = len(scenes) - len(missing)
    try:
        with store.arrays.inbox() as inbox:
            staged = {key: (*arguments, inbox) for key, arguments in jobs.items()}
            shared = SharedJobs(store, "localize", "views", staged, about, done, progress)
            results = shared.results(lambda arguments: run_jobs(features_of_scene, arguments, settings.engine))
            with (
                note_interruption(lambda: f"the views of {there + shared.num_kept()} of {len(scenes)} scenes are kept"),
                closing(results),
            ):
                for key, found in results:
                    count = store.view_features.save(found, keys[about[key][0]])
                    shared.saved(key, f"{names[key]}: {count} features")
    except (DiskFullError, ReadOnlyError) as error:
        _log.warning("view features are computed for this run alone: %s", error)
        stored = store.view_features.stored_keys(jobs)
        missing = [scene for scene in missing if keys[scene.id].digest not in stored]
        make_in_memory()


def localize(
    localizer: Localizer, photos: Sequence[Photo], near: SearchRegion | None, progress: StageProgress
) -> Iterator[tuple[LocalizationResult, float]]:
    """Localize photos one by one; yield each result with its wall time."""
    for number, photo in enumerate(photos):
        began = time.monotonic()
        found = localizer.localize(photo, near)
        progress("localize", (number + 1) / len(photos), photo.name)
        yield found, time.monotonic() - began


def localize_all(
    localizer: Localizer, photos: Sequence[Photo], near: SearchRegion | None
) -> Iterator[tuple[LocalizationResult, float]]:
    """Localize photos together; yield each result with its share of the wall time."""
    began = time.monotonic()
    found = localizer.localize_together(photos, near)
    seconds = (time.monotonic() - began) / max(len(photos), 1)
    return iter([(one, seconds) for one in found])


def features_of_scene(
    path: str,
    scene_id: str,
    specs: Mapping[str, ModelSpec],
    params: localizing.Params,
    key: RecipeKey,
    inbox: str | None,
) -> SceneFeatures | StagedResult:
    """Extract the features of the views of one scene of the map at ``path``.

    Args:
        key: recipe of the features.
        inbox: see `staged`; None for features that are not stored.
    """
    store = store_of(path)
    scenes = store.scenes
    extractor = family("extractor").get(params.extractor).make(specs, params.extractors[params.extractor])
    gaussians, cameras = scenes.gaussians(scene_id), scenes.cameras(scene_id)
    found = localizing.scene_features(scene_id, gaussians, cameras, extractor, params.views)
    if inbox is None:
        return found
    return staged(store.view_features, found, key, inbox)
