"""Localize: the features of every scene's views, made where they are missing, and photographs found by them."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeVar

import numpy as np

from gsmap import localize as localizing
from gsmap import retrieve
from gsmap.engine import SetAside, run_jobs
from gsmap.errors import ConfigError, CorruptError, GsmapError, NotFoundError, ReadOnlyError
from gsmap.geometry.metric_scale import in_metres
from gsmap.localize import PlacedFeatures, ViewIndex, new_segment, view_index
from gsmap.map import models
from gsmap.map.indexing import AT_ONCE, PATIENCE, SceneIndex
from gsmap.map.jobs import features_of_scene
from gsmap.map.metres import map_metres
from gsmap.map.settings import Settings
from gsmap.map.sharing import SharedJobs, noting
from gsmap.methods import RecipeKey, family
from gsmap.methods.extractor import Extractor
from gsmap.store import Store
from gsmap.types import Gaussians, PoseGraph, Scene
from gsmap.types.localization import Photo, Placement, SceneFeatures
from gsmap.types.progress import StageProgress
from gsmap.types.segments import InMemory

_Said = TypeVar("_Said")

_KEPT = 12  # scenes whose arrays stay in memory while photographs come: about a gigabyte


@dataclass(frozen=True)
class Near:
    """Where a person thinks that the photographs were taken.

    Args:
        scene: only places that this scene (id) shows; None where a point is given.
        point: (3,) map, unit of the map.
        radius: around it, in the same unit.
    """

    scene: str | None = None
    point: tuple[float, float, float] | None = None
    radius: float = 0.0


def parse_near(store: Store, text: str) -> Near:
    """``SCENE``, or ``X,Y,Z,R``.

    Raises:
        ConfigError: neither four numbers with a radius above 0, nor a scene.
        NotFoundError: no such scene.
    """
    return near_of(text, lambda name: store.scenes.get(name).id)


def near_of(text: str, id_of: Callable[[str], str]) -> Near:
    """The same, where scenes are told by ``id_of`` their names."""
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        return Near(id_of(text))
    if len(numbers) != 4 or not np.isfinite(numbers).all() or numbers[3] <= 0:
        raise ConfigError(f"near is a scene, or X,Y,Z,R with a radius above 0, got {text!r}", code="invalid_point")
    return Near(None, (numbers[0], numbers[1], numbers[2]), numbers[3])


class Localizer:
    """The scenes of a map, ready for photographs; arrays are read when a photograph asks for them.

    Args:
        store: of the map.
        settings: in force.
        progress: told of features that are made.

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
            component: metre.metres_per_unit
            for component, metre in map_metres(store, settings, PoseGraph(poses)).items()
        }
        self.keys = feature_keys(store, list(self.scenes.values()), settings)
        self._held: dict[str, SceneFeatures] = {}
        ensure(store, list(self.scenes.values()), self.keys, settings, progress, self._held)
        self.placed = {
            scene: PlacedFeatures(
                scene,
                in_metres(poses[scene].S_map_scene, self.metres.get(poses[scene].component, 1.0)),
                poses[scene].component,
                poses[scene].covariance,
                partial(self._gaussians, scene),
                partial(self._features, scene),
            )
            for scene in self.scenes
        }
        self._used: list[str] = []
        self._eyes: dict[str, localizing.Eyes] = {}
        self.index = self._index(progress)
        specs = models.specs(store)
        method = family("extractor").get(self.params.extractor)
        self.extractor: Extractor = method.make(specs, self.params.extractors[self.params.extractor])

    def _scene_index(self) -> SceneIndex:
        """The index of the scenes that have features: a scene whose job was given up has none."""
        kept = self.store.view_features.kept(self.keys.values())
        return SceneIndex(
            self.store,
            localizing.index_recipe(),
            {retrieve.index_recipe(self.settings.retrieve)},
            {scene: key.digest for scene, key in self.keys.items() if key.digest in kept or scene in self._held},
            self._segment,
        )

    def _index(self, progress: StageProgress) -> ViewIndex:
        """The index of all views, brought up to date; scenes that cannot be put in are put in memory."""
        index = self._scene_index()
        for left in reversed(range(PATIENCE)):
            try:
                if self.store.catalog.writable and not self._held:
                    kept = index.brought_up_to_date(lambda told: progress("localize", 0.0, f"{told} of views"))
                else:
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
        return new_segment(found, self.params.features.indexed)

    def _asked(self, near: Near | None, ask: Callable[[ViewIndex], _Said]) -> _Said:
        """What is said by the index; once more where others have changed it meanwhile, or it was damaged."""
        try:
            return ask(self.index if near is None else localizing_near(self, near))
        except (NotFoundError, CorruptError) as error:
            self.index = self._renewed(error)
        return ask(self.index if near is None else localizing_near(self, near))

    def _renewed(self, error: GsmapError) -> ViewIndex:
        """The index as it is now, where that may help.

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
        """Note that arrays of a scene are in memory; let go of those that were read longest ago."""
        self._used = [one for one in self._used if one != scene] + [scene]
        while len(self._used) > _KEPT:
            self.placed[self._used.pop(0)].drop()

    def eyes(self, scene: str) -> localizing.Eyes:
        """What a scene's own cameras saw, for those that photos are compared with."""
        if scene not in self._eyes:
            cameras = self.store.scenes.cameras(scene)
            own = None if cameras is None or cameras.synthesised else cameras
            self._eyes[scene] = localizing.open_eyes(self.placed[scene], own, self.params.differences)
        return self._eyes[scene]

    def localize(self, photo: Photo, near: Near | None = None) -> Placement:
        """Find one photograph."""
        options = (self.placed, self.extractor, self.params, self.metres)
        found = self._asked(near, lambda index: localizing.localize_photo(photo, index, *options))
        return _within(found, near)

    def localize_together(self, photos: Sequence[Photo], near: Near | None = None) -> list[Placement]:
        """Find photographs of one place that overlap."""
        options = (self.placed, self.extractor, self.params, self.metres)
        found = self._asked(near, lambda index: localizing.localize_together(photos, index, *options))
        return [_within(one, near) for one in found]


def _within(found: Placement, near: Near | None) -> Placement:
    """The placement, or that it is not where it was to be.

    A person who says where photographs are from rules out what is elsewhere.
    """
    if near is None or near.point is None or found.T_map_camera is None:
        return found
    far = float(np.linalg.norm(found.T_map_camera[:3, 3] - near.point))
    if far <= near.radius:
        return found
    reason = f"it was taken {far:.3g} from there, farther than {near.radius:g}"
    return replace(found, reason=reason, T_map_camera=None, covariance=None)


def localizing_near(localizer: Localizer, near: Near) -> ViewIndex:
    """The views of scenes that reach to where photographs are thought to be from."""
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


def _overlap(localizer: Localizer, around: PlacedFeatures, scene: str) -> bool:
    """Whether the middle of a scene lies within the box of another, or the other way round."""
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
    """What names the features of each scene under these settings, by scene id.

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
    """Make the features that are missing; they are kept in the map, or in ``held`` where it cannot be written."""
    kept = store.view_features.kept(keys.values())
    missing = [scene for scene in scenes if keys[scene.id].digest not in kept]
    if not missing:
        return
    params, specs = settings.localize, models.specs(store)
    jobs = {keys[scene.id].digest: (store.location, scene.id, specs, params) for scene in missing}
    names = {keys[scene.id].digest: scene.name for scene in missing}
    if not store.catalog.writable:
        running = run_jobs(features_of_scene, iter(jobs.values()), settings.engine)
        for count, (number, found) in enumerate(running):
            if not isinstance(found, SetAside):
                held[missing[number].id] = found
            progress("localize", (count + 1) / len(jobs), f"{missing[number].name}: read-only, made for this run alone")
        return

    def done(wanted: Collection[str]) -> set[str]:
        return store.view_features.kept(wanted)

    about = {keys[scene.id].digest: (scene.id,) for scene in missing}
    shared = SharedJobs(store, "localize", "views", jobs, about, done, progress)
    results = shared.results(lambda arguments: run_jobs(features_of_scene, arguments, settings.engine))
    there = len(scenes) - len(missing)
    with noting(lambda: f"the views of {there + shared.num_kept()} of {len(scenes)} scenes are kept"), closing(results):
        for key, found in results:
            try:
                store.view_features.save(found, keys[found.scene])
            except ReadOnlyError:
                held[found.scene] = found
            shared.saved(key, f"{names[key]}: {found.num_features} features of {found.num_views} views")


def localize(
    localizer: Localizer, photos: Sequence[Photo], near: Near | None, progress: StageProgress
) -> Iterator[tuple[Placement, float]]:
    """Each photo's place and the seconds that it took, in order."""
    for number, photo in enumerate(photos):
        began = time.monotonic()
        found = localizer.localize(photo, near)
        progress("localize", (number + 1) / len(photos), photo.name)
        yield found, time.monotonic() - began


def localize_all(localizer: Localizer, photos: Sequence[Photo], near: Near | None) -> Iterator[tuple[Placement, float]]:
    """Each photo's place with the help of the others, and its share of the seconds that they took."""
    began = time.monotonic()
    found = localizer.localize_together(photos, near)
    seconds = (time.monotonic() - began) / max(len(photos), 1)
    return iter([(one, seconds) for one in found])
