"""Objects of the map from its captures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gsmap import render
from gsmap.methods import RecipeKey, text_digest
from gsmap.objects.fuse import Node, Placed, fuse
from gsmap.objects.looks import Eyes, glance, judge
from gsmap.types import MapObject, Segments, Sighting, SightingState, Sim3
from gsmap.types.plain import plain
from gsmap.types.progress import Progress, silent

VERSION = 1


@dataclass(frozen=True)
class Params:
    """Settings of objects: the association of segments, visibility tests and rooms.

    Args:
        min_gaussians: Smallest number of Gaussians, at least 0, of a segment that becomes an object; larger drops small
            objects.
        min_overlap: Smallest fraction in [0, 1] of the smaller of two segments that must lie in the cells of the larger
            for both to be one object; larger splits objects more often.
        max_views: Largest number of views of a scene, at least 1 and evenly spread, in which objects are looked up;
            larger leaves fewer objects unobserved and takes more time.
        longest_side_px: Longest side in pixels, at least 1, of these views; larger resolves smaller objects and takes
            more time.
        min_room_area_m2: Smallest floor area of a room in square metres, at least 0; larger drops closets.
    """

    min_gaussians: int = 40
    min_overlap: float = 0.45
    max_views: int = 32
    longest_side_px: int = 128
    min_room_area_m2: float = 1.5


def recipe_key(params: Params | None = None) -> RecipeKey:
    """What names the objects of a component; what they are made of is added by whoever knows it."""
    return RecipeKey("objects", "fused", {"objects": VERSION}, plain(params or Params()), render.backend())


@dataclass(frozen=True, eq=False)
class Capture:
    """A placed capture, as objects are made of it.

    Args:
        scene: id.
        S_map_scene: where it lies.
        things: of its graph.
    """

    scene: str
    S_map_scene: Sim3
    things: Segments


def make_objects(
    captures: Sequence[Capture],
    component: int,
    eyes: Callable[[Capture], Eyes],
    *,
    metres: float = 1.0,
    moved: Sequence[tuple[Node, Node]] = (),
    parted: Sequence[tuple[Node, int]] = (),
    looked: Callable[[int, Node], tuple[SightingState, float] | None] = lambda capture, node: None,
    could_see: Callable[[Capture, np.ndarray], bool] = lambda capture, points: True,
    params: Params | None = None,
    progress: Progress = silent,
) -> list[MapObject]:
    """The objects of one component of the map, the largest first.

    A capture is opened once, whatever the number of others, and only where it has to be asked for an object that others
    show at a place that its cameras can see: its cost is that of its own things and of the objects at its place.

    Args:
        captures: of the component, oldest first.
        eyes: what a capture sees; asked at most once for each.
        metres: per unit of the map.
        moved: things (capture and thing by index) that are one though they stood elsewhere.
        parted: things, each with the index of a capture that is known not to show it where it stood.
        looked: state and share of what a capture (by index) was found to show of a thing of another when it was asked
            before; None where it has to be asked.
        could_see: whether any camera of a capture can see some of these points, its frame and unit; without rendering.
    """
    params = params or Params()
    placed = [_placed(capture, metres) for capture in captures]
    groups = fuse(placed, moved, parted, params.min_overlap)
    gone = set(parted)
    kept = []
    for group in groups:
        rows = {c: np.flatnonzero(placed[c].things == t) for c, t in group}
        places = {c: (placed[c].points[mine] / metres, placed[c].lab[mine]) for c, mine in rows.items()}
        members = max(np.count_nonzero(captures[c].things.members == t) for c, t in group)
        if members >= params.min_gaussians:
            kept.append((group, places))
    sightings: list[dict[int, Sighting]] = [
        {c: Sighting(captures[c].scene, "seen", t, np.array([at[c][0].min(0), at[c][0].max(0)])) for c, t in group}
        for group, at in kept
    ]
    for c, capture in enumerate(captures):
        progress(c / max(len(captures), 1), f"looking for {len(kept)} objects in capture {c + 1} of {len(captures)}")
        # Of which capture each is known where it stood when it is looked for: the nearest in time.
        of = [min((o for o in at if o != c), key=lambda o: (abs(o - c), o), default=c) for _, at in kept]
        points = [places[o][0] for (_, places), o in zip(kept, of, strict=True)]
        S_scene_map, unit = capture.S_map_scene.inverse(), metres * capture.S_map_scene.scale
        said: dict[int, tuple[SightingState, float]] = {}
        asking = []
        for i, mine in enumerate(sightings):
            if c in mine:
                continue
            before = looked(c, (of[i], sightings[i][of[i]].thing))
            if before is not None:
                said[i] = before
            elif could_see(capture, S_scene_map.apply(points[i])):
                asking.append(i)
            else:
                sightings[i][c] = Sighting(capture.scene, "unseen", -1, None, 0.0)
        if asking:
            seen = eyes(capture)
            own = [places[o][1] for (_, places), o in zip(kept, of, strict=True)]
            # The exposure: by what is certainly there, else by all that has a surface where it should.
            sure = [i for i, mine in enumerate(sightings) if c in mine] or asking
            glances = {i: glance(seen, S_scene_map.apply(points[i]), unit) for i in dict.fromkeys([*sure, *asking])}
            off = np.concatenate([(glances[i].colours - own[i])[glances[i].on] for i in sure])
            shift = np.median(off, axis=0) if len(off) else np.zeros(3)
            for i in asking:
                said[i] = judge(glances[i], points[i] * metres, own[i], shift)
        for i, (state, share) in said.items():
            asked = captures[of[i]].scene
            if any((node, c) in gone for node in kept[i][0]):
                state, asked = "absent", ""  # a person may take that back, so that it is not what was looked for
            box = np.array([points[i].min(0), points[i].max(0)]) if state == "seen" else None
            sightings[i][c] = Sighting(capture.scene, state, -1, box, share, asked)
    objects = []
    for (group, _), mine in zip(kept, sightings, strict=True):
        first, last = group[0], group[-1]
        own = captures[first[0]].things.positions[first[1]] * captures[first[0]].things.unit_m
        name = text_digest(f"{captures[first[0]].scene} {np.round(own, 1).tolist()}")[:8]
        box = mine[last[0]].box
        assert box is not None
        middle = captures[last[0]].S_map_scene.apply(captures[last[0]].things.positions[last[1]][None])[0]
        colour = captures[last[0]].things.colours[last[1]]
        objects.append(MapObject(name, component, box, middle, colour, tuple(mine[c] for c in range(len(captures)))))
    objects.sort(key=lambda thing: (-float(np.prod(thing.box[1] - thing.box[0])), thing.id))
    return _distinct(objects)


def _placed(capture: Capture, metres: float) -> Placed:
    """Some points of every thing, in metres of the map."""
    known = capture.things
    points = capture.S_map_scene.apply(known.samples) * metres
    return Placed(points, np.repeat(np.arange(len(known)), known.sample_counts), known.sample_colours, len(known))


def _distinct(objects: list[MapObject]) -> list[MapObject]:
    """Two whose ids are the same by chance get different ones."""
    taken: set[str] = set()
    out = []
    for thing in objects:
        name = thing.id
        while name in taken:
            name = text_digest(name)[:8]
        taken.add(name)
        out.append(thing if name == thing.id else replace(thing, id=name))
    return out
