"""Draw objects of the map, each from the best view of the scenes that show most of it."""

from __future__ import annotations

import threading

import numpy as np

from gsmap.errors import NotFoundError
from gsmap.geometry.metric_scale import in_metres
from gsmap.map.objects.map_objects import MapObjects
from gsmap.map.pictures.comparison_pictures import posed_scene
from gsmap.store import Store
from gsmap.types import ObjectObservation
from gsmap.view.change_picture import draw_place
from gsmap.view.object_picture import BestView, SegmentedViews

_MAX_SCENES = 4  # number of scenes, those with most samples of an object, among which that of its picture is chosen


class ObjectPictures:
    """A renderer of the objects of a map, which keeps the scene that it read last. Thread-safe."""

    def __init__(self, store: Store, known: MapObjects) -> None:
        self._store, self._known = store, known
        self._graph = store.revisions.get()
        self._lock = threading.Lock()
        self._counts: dict[str, np.ndarray] = {}  # samples of each segment of a scene
        self._best: dict[str, list[BestView | None]] = {}  # best view of each segment of a scene
        self._read: tuple[str, SegmentedViews] | None = None

    def draw(self, ref: str, side_px: int = 400) -> np.ndarray:
        """Render an object by its id or name outlined in its surroundings, (H, W, 3) uint8.

        Raises:
            NotFoundError: no such object, or no placed scene shows it.
        """
        thing, graph = self._known.named(ref), self._graph
        shown = [
            one
            for one in thing.sightings
            if one.box is not None
            and graph is not None
            and one.scene in self._known.scenes
            and one.scene in graph.poses
        ]
        if not shown:
            raise NotFoundError(f"no scene shows {ref}", code="object_not_shown")
        metres = self._known.metres[thing.component]
        with self._lock:
            shown = sorted(shown, key=self._num_samples, reverse=True)[:_MAX_SCENES]
            views = [(self._best_view(one, metres), one) for one in shown]
            # A scene with more samples shows more of the object.
            view, best = max(
                views, key=lambda pair: 0.0 if pair[0] is None else pair[0].score * self._num_samples(pair[1])
            )
            scene = self._views(best.scene, metres)
            if view is not None:
                return scene.draw(best.thing, view, side_px)
            assert best.box is not None
            return draw_place(scene.scene, best.box * metres, side_px)

    def _best_view(self, sighting: ObjectObservation, metres: float) -> BestView | None:
        """Return the view that shows a scene's own segment of an object best; None without one."""
        if sighting.thing < 0:
            return None
        if sighting.scene not in self._best:
            self._best[sighting.scene] = self._views(sighting.scene, metres).best_views()
        views = self._best[sighting.scene]
        return views[sighting.thing] if sighting.thing < len(views) else None

    def _views(self, scene: str, metres: float) -> SegmentedViews:
        if self._read is None or self._read[0] != scene:
            assert self._graph is not None
            S = in_metres(self._graph.poses[scene].S_map_scene, metres)
            posed, stored = posed_scene(self._store, scene, S), self._store.graphs.load(scene)
            segments = None if stored is None else stored.segments
            members = np.full(len(posed.gaussians), -1) if segments is None else segments.members
            self._read = scene, SegmentedViews(posed, members)
        return self._read[1]

    def _num_samples(self, sighting: ObjectObservation) -> int:
        """Return the number of samples of a scene's own segment of an object; 0 without one."""
        if sighting.thing < 0:
            return 0
        if sighting.scene not in self._counts:
            graph = self._store.graphs.load(sighting.scene)
            segments = None if graph is None else graph.segments
            self._counts[sighting.scene] = np.zeros(0, int) if segments is None else segments.sample_counts
        counts = self._counts[sighting.scene]
        return int(counts[sighting.thing]) if sighting.thing < len(counts) else 0
