"""Objects of the map: made from its graphs, told as rows, and written for other programs."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from gsmap.durable import write_text_whole
from gsmap.errors import ConfigError, NotFoundError
from gsmap.map.dates import parsed
from gsmap.map.metres import map_metres
from gsmap.map.one_state import of_one_state
from gsmap.map.photos import with_photos
from gsmap.map.settings import Settings
from gsmap.objects import (
    Capture,
    Eyes,
    changed_thing,
    graphml,
    make_objects,
    object_graph,
    open_eyes,
    permanence,
    relations,
)
from gsmap.objects.fuse import Node
from gsmap.store import Store
from gsmap.types import MapObject, Scene, SceneGraph
from gsmap.types.progress import StageProgress
from gsmap.types.rows import SCHEMA, HistoryReport, ObjectRow, ObjectsReport, RelationRow, SightingRow

FORMATS = ("json", "graphml")

_ID = re.compile(r"[0-9a-f]{4,8}")
_NEAR_M = 0.1  # a point so near to a box is in it: it was read off a picture


@dataclass(frozen=True, eq=False)
class Known:
    """The objects of a map and what is needed to tell of them.

    Args:
        objects: of all components.
        scenes: the placed captures by id.
        notes: who tells nothing, and why.
        metres: per unit of the map, by component.
        photos: photographs that the map keeps, by digest: (file, date).
    """

    objects: list[MapObject]
    scenes: dict[str, Scene]
    notes: tuple[str, ...]
    metres: dict[int, float]
    photos: Mapping[str, tuple[str, str | None]] = field(default_factory=dict)

    @property
    def dates(self) -> dict[str, str | None]:
        """Of captures and photographs, by id."""
        of_photos = {photo: when for photo, (_, when) in self.photos.items()}
        return {scene.id: scene.captured_at for scene in self.scenes.values()} | of_photos

    def name_of(self, who: str) -> str:
        """Of a capture or a photograph."""
        return self.scenes[who].name if who in self.scenes else self.photos[who][0]


@of_one_state
def known_objects(
    store: Store, settings: Settings, progress: StageProgress, graphs: Mapping[str, SceneGraph] | None = None
) -> Known:
    """The objects of every component by the newest poses; nothing is written.

    Args:
        graphs: by scene, what the captures are taken to show; no capture is then asked whether it looked where others
            show something. By default the newest graph of each, and all are asked.

    Raises:
        NotFoundError: the map has no poses yet.
    """
    placed = store.revisions.get()
    if placed is None:
        raise NotFoundError(
            "the map has no poses yet, so that things of captures are not known to be one: run gsmap update"
        )
    scenes = {scene.id: scene for scene in store.scenes.list() if scene.id in placed.poses}
    captures: dict[int, list[Capture]] = {}
    without = []
    for scene in sorted(scenes.values(), key=_when):
        graph = store.graphs.load(scene.id) if graphs is None else graphs.get(scene.id)
        pose = placed.poses[scene.id]
        if graph is None and graphs is not None:
            continue  # whoever chose them says why
        if graph is None or graph.things is None:
            without.append(scene.name)
        else:
            captures.setdefault(pose.component, []).append(Capture(scene.id, pose.S_map_scene, graph.things))
    notes = []
    if without:
        shown = ", ".join(without[:5]) + (f" and {len(without) - 5} more" if len(without) > 5 else "")
        notes.append(
            f"nobody knows the things of {shown}: gsmap describe MAP SCENE tells them, where describe.things is on"
        )
    undated = [scene.name for scene in scenes.values() if scene.captured_at is None]
    if undated and len(scenes) > 1:
        notes.append(
            f"{len(undated)} of {len(scenes)} captures have no date: they come last, and half-lives leave them out"
        )

    def eyes(capture: Capture) -> Eyes:
        if graphs is not None or scenes[capture.scene].thinning is not None:
            return Eyes((), (), ())  # what is left of it does not show what it looked at
        gaussians, cameras = store.scenes.gaussians(capture.scene), store.scenes.cameras(capture.scene)
        return open_eyes(gaussians, cameras, settings.objects.look)

    metres = {component: one.metres_per_unit for component, one in map_metres(store, settings, placed).items()}
    objects: list[MapObject] = []
    for i, component in enumerate(sorted(captures)):

        def told(fraction: float, text: str, part: int = i) -> None:
            progress("objects", (part + fraction) / len(captures), text)

        mine = captures[component]
        moved, parted = _told(store, mine)
        objects += make_objects(
            mine,
            component,
            eyes,
            metres=metres[component],
            moved=moved,
            parted=parted,
            params=settings.objects,
            progress=told,
        )
    kept = store.photos.list() if graphs is None else []
    if kept:
        at = {scene: pose.S_map_scene for scene, pose in placed.poses.items()}
        objects = with_photos(
            objects, kept, scenes, at, metres, {scene: pose.component for scene, pose in placed.poses.items()}
        )
    progress("objects", 1.0, f"{len(objects)} objects")
    photos = {one.sighting.digest: (one.sighting.name, one.sighting.captured_at) for one in kept}
    return Known(objects, scenes, tuple(notes), metres, photos)


def _when(scene: Scene) -> tuple[bool, float, str]:
    """Dated captures by their date; then the others, as they came."""
    if scene.captured_at is None:
        return True, 0.0, scene.ingested_at or ""
    return False, parsed(scene.captured_at).timestamp(), scene.ingested_at or ""


def _told(store: Store, captures: Sequence[Capture]) -> tuple[list[tuple[Node, Node]], list[tuple[Node, int]]]:
    """What changes say of things, but for those that a person rejected.

    Returns:
        Things that are one though they moved; and things, each with a capture that does not show it where it stood.
    """
    at = {capture.scene: i for i, capture in enumerate(captures)}
    moved: list[tuple[Node, Node]] = []
    parted: list[tuple[Node, int]] = []
    for comparison in store.changes.current():
        if comparison.older not in at or comparison.newer not in at or not comparison.changes:
            continue
        older, newer = at[comparison.older], at[comparison.newer]
        found = store.changes.load(comparison.number).changes
        for change, kept in zip(found, comparison.changes, strict=True):
            if kept.status == "rejected" or kept.kind not in ("appeared", "disappeared", "replaced", "moved"):
                continue
            before = older, changed_thing(captures[older].things.members, change.before)
            after = newer, changed_thing(captures[newer].things.members, change.after)
            if before[1] >= 0:
                parted.append((before, newer))
            if after[1] >= 0:
                parted.append((after, older))
            if kept.kind == "moved" and before[1] >= 0 and after[1] >= 0:
                moved.append((before, after))
    return moved, parted


# --- rows ------------------------------------------------------------------------------------------------------------


def objects_report(known: Known) -> ObjectsReport:
    """The scene graph of the map."""
    return ObjectsReport(
        objects=tuple(_row(thing, known) for thing in known.objects),
        relations=tuple(
            RelationRow(subject=one.source, relation=one.kind, other=one.target)
            for one in relations(known.objects, known.metres)
        ),
        notes=known.notes,
    )


def history_report(known: Known, place: str | None, box: Sequence[float] | None) -> HistoryReport:
    """What stood at a place: an object by its id (or how it begins), a point ``X,Y,Z``, or a box of six numbers.

    Raises:
        ConfigError: neither, both, or not what these look like.
        NotFoundError: no object is called so.
    """
    if (place is None) == (box is None):
        raise ConfigError("say which place: an object's id, a point X,Y,Z, or --box with six numbers")
    if place is not None and "," not in place:
        if not _ID.fullmatch(place):
            raise ConfigError(
                f"{place!r} is neither an object's id (gsmap graph lists them) nor a point such as 1.5,0,2"
            )
        chosen = [thing for thing in known.objects if thing.id.startswith(place)]
        if len(chosen) != 1:
            many = "several objects begin so" if chosen else "no object of the map is called so"
            raise NotFoundError(f"{place}: {many}; gsmap graph MAP lists them")
    else:
        area = _area(place, box)
        chosen = [
            thing
            for thing in known.objects
            if any(_meets(s.box, area, _NEAR_M / known.metres[thing.component]) for s in thing.sightings)
        ]
    rows = [
        SightingRow(
            object=thing.id,
            scene=sighting.scene,
            scene_name=known.name_of(sighting.scene),
            captured_at=known.dates[sighting.scene],
            state=sighting.state,
            box=sighting.box,
            box_m=None if sighting.box is None else sighting.box * known.metres[thing.component],
            looked=sighting.looked,
        )
        for thing in chosen
        for sighting in thing.sightings
    ]
    notes = known.notes if chosen else (*known.notes, "no thing was ever told apart there")
    return HistoryReport(objects=tuple(_row(thing, known) for thing in chosen), sightings=tuple(rows), notes=notes)


def _area(place: str | None, box: Sequence[float] | None) -> np.ndarray:
    """(2, 3) corners."""
    try:
        numbers = (
            [float(part) for part in place.split(",")] if place is not None else [float(part) for part in box or ()]
        )
    except ValueError as error:
        raise ConfigError(f"a point is three numbers such as 1.5,0,2, got {place!r}") from error
    if len(numbers) != (3 if place is not None else 6) or not np.isfinite(numbers).all():
        raise ConfigError("a point is three numbers X,Y,Z, a box six: its lowest and its highest corner")
    corners = np.array(numbers).reshape(-1, 3)
    if (corners[0] > corners[-1]).any():
        raise ConfigError("a box is its lowest corner, then its highest")
    return np.array([corners[0], corners[-1]])


def _meets(box: np.ndarray | None, area: np.ndarray, near: float) -> bool:
    return box is not None and bool((box[0] <= area[1] + near).all() and (box[1] >= area[0] - near).all())


def _row(thing: MapObject, known: Known) -> ObjectRow:
    stays = permanence(thing, known.dates)
    seen = [known.dates[sighting.scene] for sighting in thing.sightings if sighting.state == "seen"]
    return ObjectRow(
        id=thing.id,
        component=thing.component,
        position=thing.position,
        size=thing.box[1] - thing.box[0],
        colour=thing.colour.astype(np.float64),
        seen=stays.seen,
        looks=stays.looks,
        there=thing.there,
        first_seen=seen[0],
        last_seen=seen[-1],
        half_life_days=stays.half_life_days,
    )


# --- other programs --------------------------------------------------------------------------------------------------


def as_networkx(known: Known) -> Any:
    """A `networkx.MultiDiGraph`, see `gsmap.objects.object_graph`."""
    return object_graph(known.objects, known.dates, known.metres)


def write_graph(known: Known, out: str | os.PathLike[str], format: str) -> Path:
    """Write the scene graph of the map, whole or not at all.

    Raises:
        ConfigError: another format than ``json`` (what ``--json`` prints) and ``graphml``.
    """
    if format not in FORMATS:
        raise ConfigError(f"the graph is written as {' or '.join(FORMATS)}, got {format!r}")
    path = Path(out)
    if format == "json":
        write_text_whole(path, json.dumps({"schema": SCHEMA, **objects_report(known).to_json()}, indent=1))
        return path
    write_text_whole(path, graphml(as_networkx(known)))
    return path
