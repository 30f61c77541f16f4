"""Provide levels of detail of scenes and overviews of components, from a cache or computed in the background."""

from __future__ import annotations

import contextlib
import hashlib
import threading
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np

from gsmap.errors import GsmapError, InputError, NotFoundError
from gsmap.formats import spz
from gsmap.geometry.boxes import box_corners, robust_box, upright_box
from gsmap.geometry.transforms import transform_gaussians
from gsmap.types import Gaussians, GaussianSource
from gsmap.types.progress import Progress
from gsmap.view.content import ViewExtent, ViewMap, ViewOverview, ViewScene, up_of
from gsmap.view.making import Maker, PendingResult
from gsmap.view.page_source import PageSource
from gsmap.view.tree_cache import TreeCache
from gsmap.view.trees import Sketch, TreeParams, sketch, write_tree

_SPZ_BYTES = 19  # bytes of a Gaussian of SH degree 0 before compression
_OVERVIEW_BYTES = 5e6  # approximate maximum size of the overview of a component
OVERVIEW_GAUSSIANS = 32_768  # maximum number of Gaussians of one scene in an overview
_STEP = 8  # factor between sizes of sketches, so that each scene has few of them
_LEAST = 16
_FIRST = -1.0  # rank of overviews, before all trees
_COMPONENTS_KEPT = 8  # maximum number of components with sketches in memory
_TRIES = 3
_STRAYS = 0.02  # fraction of Gaussians left out below the floor, above the ceiling and at each side
_CEILING_AT = 0.72  # height from which on there are ceilings, as a fraction of the height from floor to ceiling
_FLAT = 0.01  # height as a fraction of the width below which a place is flat, without ceilings
_PER_CELL = 12  # average number of Gaussians in a cell of the plan by which ceilings are found
_OUTLINE_DIRECTIONS, _OUTLINE_SAMPLE = 16, 20_000  # level directions, and Gaussians, that make an outline
_FILES_KEPT = 4  # maximum number of overview files in memory

_T = TypeVar("_T")


def sketch_size(num_scenes: int) -> int:
    """Return the number of Gaussians per scene in the overview of a component of ``num_scenes`` scenes."""
    share = _OVERVIEW_BYTES / _SPZ_BYTES / max(1, num_scenes)
    size = OVERVIEW_GAUSSIANS
    while size > share and size > _LEAST:
        size = max(_LEAST, size // _STEP)
    return size


def overview_file(parts: Sequence[tuple[ViewScene, Sketch]]) -> bytes:
    """Pack sketches as one SPZ in the map frame, in order."""
    placed = [transform_gaussians(one.gaussians, entry.S_map_scene) for entry, one in parts]
    return spz.pack("overview.spz", Gaussians.concatenate(placed))


def extent_of(parts: Sequence[tuple[ViewScene, Sketch]], up: Sequence[float]) -> ViewExtent:
    """Return the extent of scenes in the map frame, without outliers.

    Args:
        up: (3,) direction opposite to gravity in the map frame.
    """
    points, axis = [entry.S_map_scene.apply(one.gaussians.means) for entry, one in parts], np.asarray(up, np.float64)
    every = np.concatenate(points)
    axes, bounds = upright_box(every, axis, _STRAYS)
    length, width, height = (bounds[1] - bounds[0]).tolist()
    return ViewExtent(
        corners=tuple(_corners(*upright_box(one, axis, _STRAYS)) for one in points),
        frame=_corners(axes, bounds),
        outline=_outline(every, axes, bounds[0, 2]),
        box=robust_box(every, None, _STRAYS),
        size=(length, width, height),
        has_ceiling=_has_ceiling(every @ axes.T, bounds),
    )


def _corners(axes: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    """Return the (8, 3) corners of an upright box, the lower four first."""
    corners: np.ndarray = box_corners(bounds) @ axes
    return corners


def _outline(points: np.ndarray, axes: np.ndarray, floor: float) -> np.ndarray:
    """Return points (K, 3) of the floor around all but the outliers in each of several level directions.

    Args:
        points: (N, 3).
        axes: (3, 3) rows along the length, the width and up.
        floor: Height of the floor.
    """
    points = points[:: max(1, len(points) // _OUTLINE_SAMPLE)] @ axes.T
    turns = np.linspace(0, 2 * np.pi, _OUTLINE_DIRECTIONS, endpoint=False)
    reach = points[:, :2] @ [np.cos(turns), np.sin(turns)]
    outside = _STRAYS * 4 / _OUTLINE_DIRECTIONS  # as many in all as beyond the four sides of the box
    inside = (reach <= np.quantile(reach, 1 - outside, axis=0, method="higher")).all(1)
    found = points[inside][np.unique(reach[inside].argmax(0))]
    found[:, 2] = floor
    outline: np.ndarray = found @ axes
    return outline


def _has_ceiling(points: np.ndarray, bounds: np.ndarray) -> bool:
    """Return whether most of the floor has something above it: a place seen from above then shows roofs, no rooms.

    Args:
        points: (N, 3), the third axis up.
        bounds: (2, 3) box around them.
    """
    low, size = bounds[0], np.maximum(bounds[1] - bounds[0], 1e-9)
    if size[2] < _FLAT * size[1]:
        return False
    share = (points - low) / size
    share = share[((share >= 0) & (share < 1)).all(1)]
    sides = max(1, int(np.sqrt(len(share) / _PER_CELL)))
    cells = (share[:, :2] * sides).astype(int) @ [sides, 1]
    covered = len(np.unique(cells[share[:, 2] > _CEILING_AT]))
    return bool(2 * covered > len(np.unique(cells)) > 1)


@dataclass(eq=False)
class _ComponentSketches:
    """The sketches of one component, and the keys of those in the overview that the page has."""

    size: int
    sketches: dict[str, Sketch] = field(default_factory=dict)
    published: frozenset[str] = frozenset()
    looked: set[str] = field(default_factory=set)
    overview: ViewOverview | None = None


class Levels:
    """The trees and overviews of one map.

    Args:
        page_source: Content of the map.
        cache: Cache of trees and sketches.
        workers: Number of threads that compute them.
        tree: Sizes of the levels.
    """

    def __init__(self, page_source: PageSource, cache: TreeCache, workers: int, tree: TreeParams | None = None) -> None:
        self._page_source, self._cache, self._tree = page_source, cache, tree or TreeParams()
        self._maker = Maker(workers)
        self._lock = threading.RLock()
        self._components: OrderedDict[int, _ComponentSketches] = OrderedDict()
        self._files: OrderedDict[str, tuple[tuple[ViewScene, Sketch], ...] | bytes] = OrderedDict()

    def close(self) -> None:
        self._maker.close()

    def paused(self) -> AbstractContextManager[None]:
        """Hold the computation of levels while this context is open: for what a person waits for."""
        return self._maker.paused()

    # --- trees -------------------------------------------------------------------------------------------------------

    def tree(self, entry: ViewScene, rank: float = 0.0) -> Path | PendingResult:
        """Return the folder of a scene's tree, or the progress of computing it.

        Args:
            entry: The scene.
            rank: Trees of lower rank are computed first.

        Raises:
            GsmapError: The tree cannot be computed.
        """
        if (found := self._cache.tree(entry.key)) is not None:
            return found
        work = partial(self._make_tree, entry.scene.id, entry.key)
        return self._maker.ask(f"tree {entry.key}", work, rank=max(0.0, rank))

    def tile(self, entry: ViewScene, uri: str) -> bytes:
        """Return the bytes of a tile.

        Raises:
            NotFoundError: The cache has no such tile any more; requesting the tree computes it again.
        """
        data = self._cache.tile(entry.key, uri)
        if data is None:
            raise NotFoundError(
                f"scene {entry.scene.name} has no tile {uri} any more: fetch its tileset again", code="content_outdated"
            )
        return data

    def read(self, entry: ViewScene, read: Callable[[Path], _T]) -> _T:
        """Read from the folder of a scene's tree, which is computed in this thread if missing.

        Args:
            entry: The scene.
            read: Function of the folder; called again if the cache evicted the tree meanwhile.

        Raises:
            GsmapError: The tree cannot be computed.
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
            f"the levels of detail of {entry.scene.name} do not fit into the cache: raise view.cache_gib",
            code="content_outdated",
        )

    def _make_tree(self, scene: str, key: str, progress: Progress) -> None:
        if self._cache.tree(key) is not None:  # another process was faster
            return
        source = self._page_source.source(scene)
        self._cache.make_tree(key, lambda folder: write_tree(folder, source, self._tree, progress))
        self._forget_if_gone(scene)

    def _forget_if_gone(self, scene: str) -> None:
        """Discard levels of a scene that was purged while they were computed."""
        try:
            self._page_source.source(scene)
        except NotFoundError:
            self._cache.forget(scene)
            raise

    # --- overviews ---------------------------------------------------------------------------------------------------

    def boxes(self) -> dict[str, np.ndarray]:
        """Return bounding boxes (2, 3) by scene key, for scenes with a sketch in memory."""
        with self._lock:
            return {key: one.box for group in self._components.values() for key, one in group.sketches.items()}

    def overviews(self, view: ViewMap) -> tuple[dict[int, ViewOverview], str]:
        """Return the overview of each component for which one exists, and their `state`.

        This starts the overview of the largest component.
        """
        out, inside_of = {}, members(view)
        with self._lock:
            for component, inside in inside_of.items():
                if component == min(inside_of) or component in self._components:
                    out[component] = self._overview(component, inside)
                else:
                    out[component] = ViewOverview(f"overviews/{component}/none.spz", pending=len(inside))
            return out, self.state()

    def look_at(self, view: ViewMap, scene: str) -> None:
        """Start computing the overview of a scene's component, as a user views the scene."""
        place = next((i for i, entry in enumerate(view.scenes) if entry.scene.id == scene), None)
        if place is not None:
            component = view.components()[place]
            with self._lock:
                if component not in self._components:
                    self._overview(component, members(view)[component])

    def overview(self, view: ViewMap, component: int, name: str) -> bytes | PendingResult:
        """Return the file of an overview by name, or the progress of computing it.

        Raises:
            NotFoundError: The component does not exist, or the overview has changed.
        """
        inside = members(view).get(component)
        if inside is None:
            raise NotFoundError(f"the map has no component {component}", code="component_not_found")
        with self._lock:
            overview = self._overview(component, inside)
            if name == "none":
                done = len(inside) - overview.pending
                return PendingResult(done / len(inside), overview.pending)
            parts = self._files.get(name)
            if parts is None:
                raise NotFoundError("this overview has changed: fetch map.json again", code="content_outdated")
            if not isinstance(parts, bytes):
                parts = self._files[name] = overview_file(parts)
            self._files.move_to_end(name)
            return parts

    def state(self) -> str:
        """Return a text that changes whenever the page has to load another overview."""
        with self._lock:
            parts = [f"{component} {len(group.published)}" for component, group in self._components.items()]
        return " ".join(sorted(parts))

    def whole(
        self, inside: Mapping[int, ViewScene], size: int | None = None
    ) -> tuple[bytes, ViewOverview, dict[str, np.ndarray]]:
        """Compute the overview of a component in this thread; return it with the bounding boxes of its scenes, by key.

        Args:
            inside: Scenes of the component by index.
            size: Maximum number of Gaussians per scene; default: by the number of scenes.
        """
        size = size or sketch_size(len(inside))
        parts, places, boxes = [], [], {}
        for place, entry in inside.items():
            try:
                made = self._cache.sketch(entry.key, size) or self._make_sketch(entry.scene.id, entry.key, size)
            except InputError:  # no opaque Gaussians
                continue
            parts.append((entry, made))
            places.append(place)
            boxes[entry.key] = made.box
        if not parts:
            raise InputError("the component has no opaque Gaussians", code="no_opaque_gaussians")
        counts = tuple(len(one.gaussians) for _, one in parts)
        extent = extent_of(parts, up_of(list(inside.values())))
        return overview_file(parts), ViewOverview("", tuple(places), counts, 0, extent), boxes

    def _overview(self, component: int, inside: Mapping[int, ViewScene]) -> ViewOverview:
        """Return the overview of a component with the sketches that exist, and request the missing sketches."""
        size = sketch_size(len(inside))
        group = self._components.get(component)
        if group is None or group.size != size:
            group = self._components[component] = _ComponentSketches(size)
        self._components.move_to_end(component)
        while len(self._components) > _COMPONENTS_KEPT:
            self._components.popitem(last=False)
        keys, failed = {entry.key for entry in inside.values()}, 0
        group.sketches = {key: one for key, one in group.sketches.items() if key in keys}
        for entry in inside.values():
            if entry.key in group.sketches:
                continue
            if entry.key not in group.looked:
                group.looked.add(entry.key)
                if (kept := self._cache.sketch(entry.key, size)) is not None:
                    group.sketches[entry.key] = kept
                    continue
            work = partial(self._add_sketch, component, entry.scene.id, entry.key, size)
            try:
                self._maker.ask(f"sketch {entry.key} {size}", work, rank=_FIRST, lasting=True)
            except GsmapError:  # the page reports the error when it requests the tree
                failed += 1
        self._publish(group, len(keys) - failed)
        parts = tuple((entry, group.sketches[e]) for entry in inside.values() if (e := entry.key) in group.published)
        pending = max(0, len(inside) - len(parts) - failed)
        if not parts:
            return ViewOverview(f"overviews/{component}/none.spz", pending=pending)
        name = _digest(parts)
        if name not in self._files:
            self._files[name] = parts
            while len(self._files) > _FILES_KEPT:
                self._files.popitem(last=False)
        places = tuple(place for place, entry in inside.items() if entry.key in group.published)
        counts = tuple(len(one.gaussians) for _, one in parts)
        uri = f"overviews/{component}/{name}.spz"
        if group.overview is None or group.overview.uri != uri:
            extent = extent_of(parts, up_of(list(inside.values())))
            group.overview = ViewOverview(uri, places, counts, pending, extent)
        group.overview = replace(group.overview, scenes=places, pending=pending)
        return group.overview

    def _publish(self, group: _ComponentSketches, num_scenes: int) -> None:
        """Publish the sketches when all exist or their number has doubled, so that the page reloads rarely."""
        found = group.sketches.keys()
        if len(found) >= num_scenes or len(found) >= 2 * len(group.published & found):
            group.published = frozenset(found)
        else:
            group.published &= found

    def _add_sketch(self, component: int, scene: str, key: str, size: int, progress: Progress) -> None:
        made = self._make_sketch(scene, key, size)
        with self._lock:
            group = self._components.get(component)
            if group is not None and group.size == size:
                group.sketches[key] = made
                self._publish(group, len(group.looked))

    def _make_sketch(self, scene: str, key: str, size: int) -> Sketch:
        source: GaussianSource = self._page_source.source(scene)
        made = sketch(source, size)
        self._cache.keep_sketch(key, size, made)
        self._forget_if_gone(scene)
        return made


def members(view: ViewMap) -> dict[int, dict[int, ViewScene]]:
    """Return the scenes of each component, by index in the list of scenes."""
    out: dict[int, dict[int, ViewScene]] = {}
    for place, (component, entry) in enumerate(zip(view.components(), view.scenes, strict=True)):
        out.setdefault(component, {})[place] = entry
    return out


def _digest(parts: Sequence[tuple[ViewScene, Sketch]]) -> str:
    """Return a digest of the content of an overview and of its scenes' poses."""
    out = hashlib.sha256()
    for entry, one in parts:
        out.update(f"{entry.key} {len(one.gaussians)}".encode())
        out.update(np.ascontiguousarray(entry.S_map_scene.matrix()).tobytes())
    return out.hexdigest()[:24]
