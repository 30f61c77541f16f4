"""Levels of detail of scenes and overviews of components, from the cache or made in the background."""

from __future__ import annotations

import contextlib
import hashlib
import threading
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np

from gsmap.errors import GsmapError, InputError, NotFoundError
from gsmap.formats import spz
from gsmap.geometry.boxes import upright_size
from gsmap.geometry.transforms import transform_gaussians
from gsmap.types import Gaussians, GaussianSource
from gsmap.types.progress import Progress
from gsmap.view.content import ViewMap, ViewOverview, ViewScene, up_of
from gsmap.view.making import Maker, PendingResult
from gsmap.view.page_source import PageSource
from gsmap.view.tree_cache import TreeCache
from gsmap.view.trees import Sketch, TreeParams, sketch, write_tree

_SPZ_BYTES = 19  # of a Gaussian of SH degree 0 before it is compressed, and grids that are not quite full
_OVERVIEW_BYTES = 5e6  # of the first picture of an island, in which every scene has a share
OVERVIEW_GAUSSIANS = 32_768  # of one scene in it, at most
_STEP = 8  # between the sizes of sketches, so that few of them are kept of a scene
_LEAST = 16
_FIRST = -1.0  # rank of what everybody waits for: before any tree
_ISLANDS_KEPT = 8  # whose sketches are in memory
_TRIES = 3
_STRAYS = 0.02  # share of a sketch below the floor of its scene, above the ceiling, and beyond each side
_FILES_KEPT = 4  # overviews as bytes

_T = TypeVar("_T")


def sketch_size(num_scenes: int) -> int:
    """Gaussians of a scene in the overview of an island of so many."""
    share = _OVERVIEW_BYTES / _SPZ_BYTES / max(1, num_scenes)
    size = OVERVIEW_GAUSSIANS
    while size > share and size > _LEAST:
        size = max(_LEAST, size // _STEP)
    return size


def overview_file(parts: Sequence[tuple[ViewScene, Sketch]]) -> bytes:
    """An SPZ of sketches, one after the other, in the map frame, its numbers as they are."""
    placed = [transform_gaussians(one.gaussians, entry.S_map_scene) for entry, one in parts]
    return spz.pack("overview.spz", Gaussians.concatenate(placed))


def extent_of(
    parts: Sequence[tuple[ViewScene, Sketch]], up: Sequence[float]
) -> tuple[tuple[tuple[float, float], ...], tuple[float, float, float]]:
    """Return floor and ceiling of each scene along a direction of the map, and length, width and height of all scenes,
    without a few outliers on every side."""
    points = [entry.S_map_scene.apply(one.gaussians.means) for entry, one in parts]
    ends = [np.quantile(one @ np.asarray(up), (_STRAYS, 1 - _STRAYS)).tolist() for one in points]
    return tuple((low, high) for low, high in ends), upright_size(np.concatenate(points), np.asarray(up), _STRAYS)


@dataclass(eq=False)
class _Island:
    """The sketches of one component that are at hand, and those of them that the page was told of."""

    size: int
    sketches: dict[str, Sketch] = field(default_factory=dict)
    told: frozenset[str] = frozenset()
    looked: set[str] = field(default_factory=set)
    told_of: ViewOverview | None = None


class Levels:
    """Trees and overviews of one map, for all who look at it.

    Args:
        page_source: to the map.
        cache: where they are kept.
        workers: threads that make them.
        tree: sizes of the levels.
    """

    def __init__(
        self, page_source: PageSource, cache: TreeCache, workers: int = 2, tree: TreeParams | None = None
    ) -> None:
        self._page_source, self._cache, self._tree = page_source, cache, tree or TreeParams()
        self._maker = Maker(workers)
        self._lock = threading.RLock()
        self._islands: OrderedDict[int, _Island] = OrderedDict()
        self._files: OrderedDict[str, tuple[tuple[ViewScene, Sketch], ...] | bytes] = OrderedDict()

    def close(self) -> None:
        self._maker.close()

    # --- trees -------------------------------------------------------------------------------------------------------

    def tree(self, entry: ViewScene, rank: float = 0.0) -> Path | PendingResult:
        """The folder of a scene's tree, or how far it is.

        Args:
            rank: of those that are asked for, the lowest is made first.

        Raises:
            GsmapError: why it cannot be made.
        """
        if (found := self._cache.tree(entry.key)) is not None:
            return found
        work = partial(self._make_tree, entry.scene.id, entry.key)
        return self._maker.ask(f"tree {entry.key}", work, rank=max(0.0, rank))

    def tile(self, entry: ViewScene, uri: str) -> bytes:
        """The bytes of a tile of a tree.

        Raises:
            NotFoundError: there is none of that name now; asking for the tree makes it again.
        """
        data = self._cache.tile(entry.key, uri)
        if data is None:
            raise NotFoundError(
                f"{entry.scene.name} has no tile {uri} now: ask for its tileset again", code="content_outdated"
            )
        return data

    def read(self, entry: ViewScene, read: Callable[[Path], _T]) -> _T:
        """Read from the folder of a scene's tree, which is made in this thread if missing.

        Args:
            read: again where the tree made room for another one meanwhile.

        Raises:
            GsmapError: why it cannot be made.
        """
        for _ in range(_TRIES):
            found = self._cache.tree(entry.key)
            if found is None:
                self._make_tree(entry.scene.id, entry.key, lambda fraction, text: None)
                found = self._cache.tree(entry.key)
            with contextlib.suppress(FileNotFoundError):
                if found is not None:
                    return read(found)
        raise NotFoundError(
            f"the levels of detail of {entry.scene.name} are gone again: raise view.cache_gib", code="content_outdated"
        )

    def _make_tree(self, scene: str, key: str, progress: Progress) -> None:
        if self._cache.tree(key) is not None:  # another process was faster
            return
        source = self._page_source.source(scene)
        self._cache.make_tree(key, lambda folder: write_tree(folder, source, self._tree, progress))
        self._forget_if_gone(scene)

    def _forget_if_gone(self, scene: str) -> None:
        """Discard levels of a scene that was purged while they were made."""
        try:
            self._page_source.source(scene)
        except NotFoundError:
            self._cache.forget(scene)
            raise

    # --- overviews ---------------------------------------------------------------------------------------------------

    def boxes(self) -> dict[str, np.ndarray]:
        """(2, 3) of what scenes show, by key, of those that were looked at."""
        with self._lock:
            return {key: one.box for island in self._islands.values() for key, one in island.sketches.items()}

    def overviews(self, view: ViewMap) -> tuple[dict[int, ViewOverview], str]:
        """The overview of every component, as far as it is known, and the `state` of that; those of the largest are
        made without being asked."""
        out, islands = {}, members(view)
        with self._lock:
            for component, inside in islands.items():
                if component == min(islands) or component in self._islands:
                    out[component] = self._overview(component, inside)
                else:
                    out[component] = ViewOverview(f"overviews/{component}/none.spz", pending=len(inside))
            return out, self.state()

    def look_at(self, view: ViewMap, scene: str) -> None:
        """Have the overview of a scene's island made, too: somebody is there."""
        place = next((i for i, entry in enumerate(view.scenes) if entry.scene.id == scene), None)
        if place is not None:
            component = view.components()[place]
            with self._lock:
                if component not in self._islands:
                    self._overview(component, members(view)[component])

    def overview(self, view: ViewMap, component: int, name: str) -> bytes | PendingResult:
        """The file of an overview by its name, or how far it is.

        Raises:
            NotFoundError: no such component, or the overview is another by now.
        """
        inside = members(view).get(component)
        if inside is None:
            raise NotFoundError(f"there is no component {component}", code="component_not_found")
        with self._lock:
            told = self._overview(component, inside)
            if name == "none":
                done = len(inside) - told.pending
                return PendingResult(done / len(inside), told.pending)
            parts = self._files.get(name)
            if parts is None:
                raise NotFoundError("this overview is another by now: ask for map.json again", code="content_outdated")
            if not isinstance(parts, bytes):
                parts = self._files[name] = overview_file(parts)
            self._files.move_to_end(name)
            return parts

    def state(self) -> str:
        """Another text whenever the page is to be told of another overview."""
        with self._lock:
            told = [f"{component} {len(island.told)}" for component, island in self._islands.items()]
        return " ".join(sorted(told))

    def whole(
        self, inside: Mapping[int, ViewScene], size: int | None = None
    ) -> tuple[bytes, ViewOverview, dict[str, np.ndarray]]:
        """The overview of an island, made in this thread; and the boxes of its scenes, by key.

        Args:
            size: Gaussians of each at most; by default what fits.
        """
        size = size or sketch_size(len(inside))
        parts, places, boxes = [], [], {}
        for place, entry in inside.items():
            try:
                made = self._cache.sketch(entry.key, size) or self._make_sketch(entry.scene.id, entry.key, size)
            except InputError:  # nothing of it can be seen
                continue
            parts.append((entry, made))
            places.append(place)
            boxes[entry.key] = made.box
        if not parts:
            raise InputError("nothing of it can be seen", code="no_opaque_gaussians")
        counts = tuple(len(one.gaussians) for _, one in parts)
        heights, sides = extent_of(parts, up_of(list(inside.values())))
        return overview_file(parts), ViewOverview("", tuple(places), counts, 0, heights, sides), boxes

    def _overview(self, component: int, inside: Mapping[int, ViewScene]) -> ViewOverview:
        """Return the overview of one component as far as it exists, and request the rest."""
        size = sketch_size(len(inside))
        island = self._islands.get(component)
        if island is None or island.size != size:
            island = self._islands[component] = _Island(size)
        self._islands.move_to_end(component)
        while len(self._islands) > _ISLANDS_KEPT:
            self._islands.popitem(last=False)
        keys, failed = {entry.key for entry in inside.values()}, 0
        island.sketches = {key: one for key, one in island.sketches.items() if key in keys}
        for entry in inside.values():
            if entry.key in island.sketches:
                continue
            if entry.key not in island.looked:
                island.looked.add(entry.key)
                if (kept := self._cache.sketch(entry.key, size)) is not None:
                    island.sketches[entry.key] = kept
                    continue
            work = partial(self._add_sketch, component, entry.scene.id, entry.key, size)
            try:
                self._maker.ask(f"sketch {entry.key} {size}", work, rank=_FIRST, lasting=True)
            except GsmapError:  # the page says why when it asks for its tree
                failed += 1
        self._tell(island, len(keys) - failed)
        parts = tuple((entry, island.sketches[e]) for entry in inside.values() if (e := entry.key) in island.told)
        pending = max(0, len(inside) - len(parts) - failed)
        if not parts:
            return ViewOverview(f"overviews/{component}/none.spz", pending=pending)
        name = _digest(parts)
        if name not in self._files:
            self._files[name] = parts
            while len(self._files) > _FILES_KEPT:
                self._files.popitem(last=False)
        places = tuple(place for place, entry in inside.items() if entry.key in island.told)
        counts = tuple(len(one.gaussians) for _, one in parts)
        uri = f"overviews/{component}/{name}.spz"
        if island.told_of is None or island.told_of.uri != uri:
            heights, sides = extent_of(parts, up_of(list(inside.values())))
            island.told_of = ViewOverview(uri, places, counts, pending, heights, sides)
        island.told_of = replace(island.told_of, scenes=places, pending=pending)
        return island.told_of

    def _tell(self, island: _Island, num_scenes: int) -> None:
        """Have the page ask again once all are there, and whenever twice as many are: not for every one of hundreds."""
        found = island.sketches.keys()
        if len(found) >= num_scenes or len(found) >= 2 * len(island.told & found):
            island.told = frozenset(found)
        else:
            island.told &= found

    def _add_sketch(self, component: int, scene: str, key: str, size: int, progress: Progress) -> None:
        made = self._make_sketch(scene, key, size)
        with self._lock:
            island = self._islands.get(component)
            if island is not None and island.size == size:
                island.sketches[key] = made
                self._tell(island, len(island.looked))

    def _make_sketch(self, scene: str, key: str, size: int) -> Sketch:
        source: GaussianSource = self._page_source.source(scene)
        made = sketch(source, size)
        self._cache.keep_sketch(key, size, made)
        self._forget_if_gone(scene)
        return made


def members(view: ViewMap) -> dict[int, dict[int, ViewScene]]:
    """The scenes of every component by their place in the list."""
    out: dict[int, dict[int, ViewScene]] = {}
    for place, (component, entry) in enumerate(zip(view.components(), view.scenes, strict=True)):
        out.setdefault(component, {})[place] = entry
    return out


def _digest(parts: Sequence[tuple[ViewScene, Sketch]]) -> str:
    """Names an overview by what is in it and where it lies."""
    out = hashlib.sha256()
    for entry, one in parts:
        out.update(f"{entry.key} {len(one.gaussians)}".encode())
        out.update(np.ascontiguousarray(entry.S_map_scene.matrix()).tobytes())
    return out.hexdigest()[:24]
