"""Bring the objects and rooms of one component up to date: only what changed scenes touch is computed."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TypeVar

import numpy as np

from gsmap.errors import CorruptError, NotFoundError
from gsmap.geometry.boxes import box_around, box_corners
from gsmap.geometry.directions import level_frame
from gsmap.geometry.transforms import transform_gaussians
from gsmap.map.changes.visits import MAX_SHIFT_M
from gsmap.map.settings import Settings
from gsmap.methods import RecipeKey, text_digest
from gsmap.objects import (
    ComponentScenes,
    MatchedSegments,
    RenderedViews,
    SegmentedScene,
    SegmentRef,
    SurfacePoints,
    find_changed_segment,
    is_in_view,
    is_small,
    render_views,
    sample_surface,
    surface_rows,
    update_objects,
    update_rooms,
)
from gsmap.store import Store
from gsmap.store.change_rows import Comparison
from gsmap.store.objects import ObjectBoxes, ObjectSet, number_of
from gsmap.types import Cameras, Gaussians, MapObject, Room, Scene, SceneGraph, Segments, Sim3
from gsmap.types.progress import Progress

_SCENES_AT_ONCE = 64  # scenes that are associated at once, so that memory does not depend on the size of the map
_SCENES_KEPT = 96  # scenes whose segments, cameras and surfaces stay in memory
_MAX_UNIT_CHANGE = 0.01  # largest relative change of the metric scale with which earlier objects still count
_MAX_TURN_DEG = 0.5  # largest turn of the estimated up direction with which earlier rooms still count
_VIEW_MARGIN_M = 0.3  # an object so far behind the surfaces that a scene shows may be observed
_BLOCK_M = 50.0  # edge of the blocks of space by which scenes are associated together
_SHAPE = ("means", "quats", "log_scales", "logit_opacities")

_Value = TypeVar("_Value")


@dataclass(frozen=True, eq=False)
class Component:
    """A component of the map whose objects are wanted.

    Args:
        number: of the component.
        scenes: its described scenes by id, oldest first.
        poses: ``S_map_scene`` of each scene, in the same order.
        described: key of the newest graph of each scene; empty if graphs are given.
        unit: metres per map unit.
        compared: comparisons of its scenes that found changes and still hold.
        graphs: scene graphs to use instead of the stored ones; no scene is then rendered to look for objects.
    """

    number: int
    scenes: Mapping[str, Scene]
    poses: Mapping[str, Sim3]
    described: Mapping[str, str]
    unit: float
    compared: Sequence[Comparison] = ()
    graphs: Mapping[str, SceneGraph] | None = None

    @cached_property
    def told(self) -> dict[str, str]:
        """Text that identifies what each comparison says of segments, by ``OLDER:NEWER``."""
        return {
            f"{one.older}:{one.newer}": f"{one.key} {one.created_at} {[c.status == 'rejected' for c in one.changes]}"
            for one in self.compared
        }


def unmoved_poses(
    then: Mapping[str, Sim3], now: Mapping[str, Sim3], scenes: Mapping[str, Scene], unit: float
) -> dict[str, Sim3]:
    """Return the current poses of scenes that moved less than the threshold for visits."""
    out = {}
    for scene, pose in now.items():
        if scene in then:
            corners = box_corners(scenes[scene].bounds)
            off = np.linalg.norm(pose.apply(corners) - then[scene].apply(corners), axis=1).max() * unit
            if off <= MAX_SHIFT_M:
                out[scene] = pose
    return out


def update_component(
    store: Store,
    settings: Settings,
    wanted: Component,
    key: RecipeKey | None,
    sets: Sequence[ObjectSet],
    progress: Progress,
) -> tuple[ObjectSet, list[ObjectBoxes | None]]:
    """Compute the objects of a component from the earlier objects of its scenes and from what changed since.

    Args:
        key: recipe and inputs; None if graphs are given.
        sets: earlier object sets of the map.

    Returns:
        The objects, and for each object its box in the frame of each scene that has a segment of it, or None for an
        earlier object that stays as it is.
    """
    return _Update(store, settings, wanted, key, sets).run(progress)


@dataclass(eq=False)
class _Update:
    """The computation of `update_component`, with the scenes that it has loaded."""

    store: Store
    settings: Settings
    wanted: Component
    key: RecipeKey | None
    sets: Sequence[ObjectSet]
    _segments: OrderedDict[str, SegmentedScene | None] = field(default_factory=OrderedDict)
    _cameras: OrderedDict[str, Cameras] = field(default_factory=OrderedDict)
    _surfaces: OrderedDict[str, SurfacePoints] = field(default_factory=OrderedDict)
    _told: dict[int, MatchedSegments] = field(default_factory=dict)
    _extents: dict[str, np.ndarray] = field(default_factory=dict)

    def run(self, progress: Progress) -> tuple[ObjectSet, list[ObjectBoxes | None]]:
        old, wanted = self._earlier, self.wanted
        things = {scene: self._digest(scene) for scene in wanted.poses}
        changed = self._changed(things)
        same = {scene for scene in changed if self._is_same(scene, things)}  # but what is known of them changed
        shown = [scene for scene in wanted.poses if things[scene]]
        boxes = {scene: old.boxes[scene] for scene in shown if scene in old.boxes and scene not in changed}
        views = {scene: old.views[scene] for scene in shown if scene in old.views and scene not in changed - same}
        for scene in shown:
            if scene in changed:
                box, view = self._load(scene).box, None if scene in views else self._view_box(scene)
                boxes |= {} if box is None else {scene: box}
                views |= {} if view is None else {scene: view}
        up = self._up()
        scenes = ComponentScenes(shown, self._load, boxes, views)
        objects = self._update_objects(scenes, changed, same, up, progress)
        rooms, surfaces = list[Room](), dict[str, np.ndarray]()
        if self.key is not None:
            progress(1.0, "rooms")
            rooms, surfaces = self._update_rooms(changed, up)
        made = ObjectSet(
            "" if self.key is None else self.key.digest,
            "" if self.key is None else self.key.recipe,
            wanted.unit,
            self._poses,
            things,
            tuple(objects),
            up,
            tuple(rooms),
            dict(wanted.described),
            boxes,
            views,
            surfaces,
            wanted.told,
        )
        return made, [None if number_of(one.id) is not None else self._places(one) for one in objects]

    # --- what changed ------------------------------------------------------------------------------------------------

    @cached_property
    def _earlier(self) -> ObjectSet:
        """The earlier object set that has most of the scenes where they are now; an empty one without any."""
        none = ObjectSet("", "", self.wanted.unit, {}, {}, ())
        if self.key is None:
            return none
        usable = [
            one
            for one in self.sets
            if one.recipe == self.key.recipe and abs(one.metres / self.wanted.unit - 1) <= _MAX_UNIT_CHANGE
        ]
        found = max(usable, key=lambda one: len(self._unmoved(one)), default=none)
        return found if self._unmoved(found) else none

    def _unmoved(self, old: ObjectSet) -> dict[str, Sim3]:
        return unmoved_poses(old.poses, self.wanted.poses, self.wanted.scenes, self.wanted.unit)

    @cached_property
    def _poses(self) -> dict[str, Sim3]:
        """``S_map_scene`` of each scene: the earlier pose of a scene that did not move."""
        unmoved = self._unmoved(self._earlier)
        return {s: self._earlier.poses[s] if s in unmoved else pose for s, pose in self.wanted.poses.items()}

    def _digest(self, scene: str) -> str:
        """Return the digest of a scene's segments; empty without segments."""
        old = self._earlier
        if self.wanted.described and old.graphs.get(scene) == self.wanted.described[scene]:
            return old.things[scene]
        found = self._find(scene)
        return "" if found is None else text_digest(found.segments.extents.tobytes().hex())

    def _changed(self, things: Mapping[str, str]) -> set[str]:
        """Return the scenes that are new, moved, described anew or compared otherwise; all if their order changed."""
        old, new = self._earlier, self.wanted.told
        if [s for s in old.things if s in things] != [s for s in things if s in old.things]:
            return set(things)
        changed = {s for s in things if not self._is_same(s, things)}
        for pair in old.told.keys() | new.keys():
            if old.told.get(pair) != new.get(pair):
                changed.update(scene for scene in pair.split(":") if scene in things)
        return changed

    def _is_same(self, scene: str, things: Mapping[str, str]) -> bool:
        """Return True if a scene lies where it was and has the segments that it had."""
        return self._poses[scene] is self._earlier.poses.get(scene) and things[scene] == self._earlier.things[scene]

    # --- objects -----------------------------------------------------------------------------------------------------

    def _update_objects(
        self,
        scenes: ComponentScenes,
        changed: Collection[str],
        same: Collection[str],
        up: np.ndarray,
        progress: Progress,
    ) -> list[MapObject]:
        """Associate and observe objects, some neighbouring scenes after the other."""
        left = [old for scene, old in self._earlier.boxes.items() if scene in changed or scene not in scenes.boxes]
        new = [scene for scene in scenes.order if scene in changed]
        if len(new) > _SCENES_AT_ONCE:
            new.sort(key=lambda scene: self._block(scenes, scene))
        parts = [new[start : start + _SCENES_AT_ONCE] for start in range(0, len(new), _SCENES_AT_ONCE)] or [[]]
        objects: Sequence[MapObject] = self._earlier.objects
        later = set(new)
        for done, part in enumerate(parts):

            def told(fraction: float, text: str, done: int = done) -> None:
                progress((done + fraction) / len(parts), text)

            later -= set(part)
            objects = update_objects(
                scenes.without(later),
                self.wanted.number,
                self._render,
                earlier=objects,
                changed=part,
                same=same,
                touched=() if done else left,
                metres=self.wanted.unit,
                up=up,
                match=self._match,
                in_frustum=self._in_frustum,
                params=self.settings.objects,
                progress=told,
            )
        return list(objects)

    def _block(self, scenes: ComponentScenes, scene: str) -> tuple[int, ...]:
        """Return the block of space in which a scene lies, by which scenes are taken together."""
        box = scenes.boxes.get(scene)
        middle = self._poses[scene].translation if box is None else box.mean(0)
        return tuple(np.floor(middle * self.wanted.unit / _BLOCK_M).astype(int).tolist())

    def _in_frustum(self, capture: SegmentedScene, points: np.ndarray) -> bool:
        if self.wanted.scenes[capture.scene].thinning is not None:
            return False  # what is left of it does not show what its cameras saw; earlier observations stay
        return is_in_view(self._cameras_of(capture.scene), points, self.settings.objects.max_views)

    def _render(self, capture: SegmentedScene) -> RenderedViews:
        params, gaussians = self.settings.objects, self.store.scenes.gaussians(capture.scene)
        segments, cameras = self._segments_of(capture.scene), self._cameras_of(capture.scene)
        members = None if segments is None else segments.members
        return render_views(gaussians, cameras, params.max_views, params.longest_side_px, members)

    def _view_box(self, scene: str) -> np.ndarray | None:
        """Return a box (2, 3) around what a scene's cameras can observe; None if it is not searched for objects.

        What is left of a thinned scene does not show what its cameras saw.
        """
        if self.key is None or self.wanted.scenes[scene].thinning is not None:
            return None
        cameras = self._cameras_of(scene)
        if cameras.synthesised or not len(cameras):
            return None
        S, margin = self._poses[scene], _VIEW_MARGIN_M / self.wanted.unit
        low, high = box_around(S.apply(np.concatenate([self._surface_corners(scene), cameras.centers])))
        return np.array([low - margin, high + margin])

    def _surface_corners(self, scene: str) -> np.ndarray:
        """Return the corners (8, 3) of a box around the surfaces of a scene, in its frame."""
        from gsmap.register.recipe import prepared_key  # imports the registration, which other verbs do without

        try:
            graph = self.wanted.described[scene]
            prepared = self.store.prepared_scenes.load(scene, prepared_key().of(scene, graph))
        except CorruptError:
            prepared = None  # gsmap check reports the damage
        if prepared is None or not len(prepared.points):
            return box_corners(self.wanted.scenes[scene].bounds)
        return box_corners(box_around(prepared.points.astype(np.float64) / prepared.unit_m))

    def _match(self, scenes: Collection[str]) -> MatchedSegments:
        """Return what the comparisons of some scenes say of their segments."""
        moved: list[tuple[SegmentRef, SegmentRef]] = []
        parted: list[tuple[SegmentRef, str]] = []
        for one in self.wanted.compared:
            if one.older in scenes or one.newer in scenes:
                if one.number not in self._told:
                    self._told[one.number] = self._compared(one)
                moved += self._told[one.number].moved
                parted += self._told[one.number].parted
        return MatchedSegments(moved, parted)

    def _compared(self, one: Comparison) -> MatchedSegments:
        """Return object identities from changes that were not rejected."""
        moved, parted = [], []
        older, newer = self._segments_of(one.older), self._segments_of(one.newer)
        found = self.store.changes.load(one.number).changes
        for change, kept in zip(found, one.changes, strict=True):
            if kept.status == "rejected" or kept.kind not in ("appeared", "disappeared", "replaced", "moved"):
                continue
            before = -1 if older is None else find_changed_segment(older.members, change.before)
            after = -1 if newer is None else find_changed_segment(newer.members, change.after)
            if newer is not None and before >= 0:
                parted.append(((one.older, before), one.newer))
            if older is not None and after >= 0:
                parted.append(((one.newer, after), one.older))
            if kept.kind == "moved" and before >= 0 and after >= 0:
                moved.append(((one.older, before), (one.newer, after)))
        return MatchedSegments(moved, parted)

    def _places(self, thing: MapObject) -> ObjectBoxes:
        return {one.scene: self._extents_of(one.scene)[one.thing] for one in thing.sightings if one.thing >= 0}

    def _extents_of(self, scene: str) -> np.ndarray:
        if scene not in self._extents:
            self._load(scene)
        return self._extents[scene]

    # --- rooms -------------------------------------------------------------------------------------------------------

    def _up(self) -> np.ndarray:
        """Return the direction against gravity in the map frame: the earlier one, unless it turned."""
        if self.wanted.graphs is not None:
            ups = {scene: graph.up for scene, graph in self.wanted.graphs.items()}
        else:
            ups = {one.scene: None if one.up is None else np.array(one.up) for one in self.store.graphs.list()}
        turned = [self._poses[s].rotation @ one for s in self._poses if (one := ups.get(s)) is not None]
        total = np.sum(turned, axis=0) if turned else np.zeros(3)
        length = float(np.linalg.norm(total))
        up = total / length if length > 0 else np.array([0.0, 0, 1])
        if self._earlier.poses and up @ self._earlier.up >= np.cos(np.radians(_MAX_TURN_DEG)):
            return self._earlier.up
        return up

    def _update_rooms(self, changed: Collection[str], up: np.ndarray) -> tuple[list[Room], dict[str, np.ndarray]]:
        """Return the rooms, and the box (2, 3) of each scene's surfaces, in the level frame of ``up``, in metres."""
        old = self._earlier
        S_level_map = Sim3(level_frame(up), np.zeros(3), self.wanted.unit)
        earlier = dict(old.surfaces) if up is old.up and old.metres == self.wanted.unit else {}  # both are in metres
        boxes = {scene: earlier[scene] for scene in self._poses if scene in earlier and scene not in changed}
        new = [scene for scene in self._poses if scene not in earlier or scene in changed]
        for scene in new:
            box = self._surface(scene, S_level_map).box
            boxes |= {} if box is None else {scene: box}
        touched = [boxes[scene] for scene in new if scene in boxes]
        touched += [box for scene, box in earlier.items() if scene in changed or scene not in self._poses]
        is_new = not earlier or not boxes or is_small(earlier.values()) != is_small(boxes.values())
        rooms = update_rooms(
            {scene: boxes[scene] for scene in self._poses if scene in boxes},
            lambda scene: self._surface(scene, S_level_map),
            lambda scene: self._eyes(scene, S_level_map),
            self.settings.objects.min_room_area_m2,
            old.rooms,
            None if is_new else touched,
        )
        return rooms, boxes

    def _surface(self, scene: str, S_level_map: Sim3) -> SurfacePoints:
        def load() -> SurfacePoints:
            source = self.store.scenes.source(scene)
            rows = surface_rows(np.concatenate([np.zeros(0, np.float32), *source.columns("logit_opacities")]))
            columns = {name: _take(source.columns(name), rows) for name in _SHAPE}
            shape = Gaussians(**columns, sh=np.zeros((len(rows), 1, 3), np.float32))
            return sample_surface(transform_gaussians(shape, S_level_map @ self._poses[scene]))

        return _remember(self._surfaces, scene, load)

    def _eyes(self, scene: str, S_level_map: Sim3) -> np.ndarray:
        cameras = self._cameras_of(scene)
        if cameras.synthesised:
            return np.zeros((0, 3))
        return (S_level_map @ self._poses[scene]).apply(cameras.centers)

    # --- scenes ------------------------------------------------------------------------------------------------------

    def _segments_of(self, scene: str) -> Segments | None:
        given = self.wanted.graphs
        graph = self.store.graphs.load(scene) if given is None else given.get(scene)
        return None if graph is None else graph.segments

    def _find(self, scene: str) -> SegmentedScene | None:
        def load() -> SegmentedScene | None:
            segments = self._segments_of(scene)
            if segments is None:
                return None
            self._extents[scene] = segments.extents
            return SegmentedScene(scene, self._poses[scene], segments).without_members()

        return _remember(self._segments, scene, load)

    def _load(self, scene: str) -> SegmentedScene:
        found = self._find(scene)
        if found is None:
            raise NotFoundError(
                f"the segments of scene {scene[:12]} were deleted meanwhile: run the same command again",
                code="changed_meanwhile",
            )
        return found

    def _cameras_of(self, scene: str) -> Cameras:
        return _remember(self._cameras, scene, lambda: self.store.scenes.cameras(scene))


def _take(chunks: Iterable[np.ndarray], rows: np.ndarray) -> np.ndarray:
    """Return some rows, ascending, of an array that comes in chunks."""
    out, start = [], 0
    for chunk in chunks:
        first, last = np.searchsorted(rows, [start, start + len(chunk)])
        out.append(chunk[rows[first:last] - start])
        start += len(chunk)
    return np.concatenate(out)


def _remember(kept: OrderedDict[str, _Value], scene: str, load: Callable[[], _Value]) -> _Value:
    """Return a value from a cache of the scenes used last, or load it."""
    if scene not in kept:
        kept[scene] = load()
    kept.move_to_end(scene)
    while len(kept) > _SCENES_KEPT:
        kept.popitem(last=False)
    return kept[scene]
