"""Draw objects of the map, each from the scene that shows most of it."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Sequence

import numpy as np

from gsmap.errors import NotFoundError
from gsmap.geometry.metric_scale import in_metres
from gsmap.map.comparison_pictures import posed_scene
from gsmap.map.objects import MapObjects
from gsmap.store import Store
from gsmap.types import ObjectObservation
from gsmap.view.change_picture import draw_place
from gsmap.view.object_picture import SegmentedViews

_MOST_SCENES = 64  # of 3 MB of labels each


class ObjectPictures:
    """A renderer of the objects of a map, which keeps the scene that it read last. Thread-safe."""

    def __init__(self, store: Store, known: MapObjects) -> None:
        self._store, self._known = store, known
        self._lock = threading.Lock()
        self._counts: dict[str, np.ndarray] = {}  # samples of each segment of a scene
        self._shown: OrderedDict[str, Sequence[np.ndarray]] = OrderedDict()  # of the scenes drawn last
        self._read: tuple[str, SegmentedViews] | None = None

    def draw(self, ref: str, side_px: int = 400) -> np.ndarray:
        """Render an object by its id or name outlined in its surroundings, (H, W, 3) uint8.

        Raises:
            NotFoundError: no such object, or no placed scene shows it.
        """
        thing, graph = self._known.named(ref), self._store.revisions.get()
        shown = [
            one
            for one in thing.sightings
            if one.box is not None
            and graph is not None
            and one.scene in self._known.scenes
            and one.scene in graph.poses
        ]
        if not shown or graph is None:
            raise NotFoundError(f"no scene shows {ref}", code="object_not_shown")
        with self._lock:
            best = max(shown, key=self._num_samples)
            assert best.box is not None
            metres = self._known.metres[thing.component]
            if self._read is None or self._read[0] != best.scene:
                S = in_metres(graph.poses[best.scene].S_map_scene, metres)
                posed, stored = posed_scene(self._store, best.scene, S), self._store.graphs.load(best.scene)
                segments = None if stored is None else stored.segments
                members = np.full(len(posed.gaussians), -1) if segments is None else segments.members
                self._read = best.scene, SegmentedViews(posed, members, self._shown.get(best.scene))
            views = self._read[1]
            drawn = None
            if best.thing >= 0 and views.scene.cameras is not None:
                drawn = views.draw(best.thing, side_px)
                self._shown[best.scene] = views.shown
                self._shown.move_to_end(best.scene)
                while len(self._shown) > _MOST_SCENES:
                    self._shown.popitem(last=False)
            return draw_place(views.scene, best.box * metres, side_px) if drawn is None else drawn

    def _num_samples(self, sighting: ObjectObservation) -> int:
        """Return the number of samples of a scene's own segment of an object; 0 without one."""
        if sighting.thing < 0:
            return 0
        if sighting.scene not in self._counts:
            graph = self._store.graphs.load(sighting.scene)
            things = None if graph is None else graph.segments
            self._counts[sighting.scene] = np.zeros(0, int) if things is None else things.sample_counts
        counts = self._counts[sighting.scene]
        return int(counts[sighting.thing]) if sighting.thing < len(counts) else 0
