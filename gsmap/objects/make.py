"""Objects of the map from its captures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from gsmap.methods import text_digest
from gsmap.objects.fuse import Node, Placed, fuse
from gsmap.objects.fuse import Params as FuseParams
from gsmap.objects.looks import Eyes, glance, judge
from gsmap.objects.looks import Params as LookParams
from gsmap.types import MapObject, Sighting, Sim3, Things
from gsmap.types.progress import Progress, silent


@dataclass(frozen=True)
class Params:
    """How objects are made.

    Args:
        fuse: when things of two captures are one.
        look: how captures look for the things of others.
        min_points: a thing of fewer points makes no object by itself.
    """

    fuse: FuseParams = field(default_factory=FuseParams)
    look: LookParams = field(default_factory=LookParams)
    min_points: int = 40


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
    things: Things


def make_objects(
    captures: Sequence[Capture],
    component: int,
    eyes: Callable[[Capture], Eyes],
    *,
    metres: float = 1.0,
    moved: Sequence[tuple[Node, Node]] = (),
    parted: Sequence[tuple[Node, int]] = (),
    params: Params | None = None,
    progress: Progress = silent,
) -> list[MapObject]:
    """The objects of one component of the map, the largest first.

    Every capture is opened once, whatever the number of others: its cost is that of its own things and of the objects
    at its place.

    Args:
        captures: of the component, oldest first.
        eyes: what a capture sees; asked once for each capture that lacks an object of others.
        metres: per unit of the map.
        moved: things (capture and thing by index) that are one though they stood elsewhere.
        parted: things, each with the index of a capture that is known not to show it where it stood.
    """
    params = params or Params()
    placed = [_placed(capture, metres) for capture in captures]
    groups = fuse(placed, moved, parted, params.fuse)
    gone = set(parted)
    kept = []
    for group in groups:
        rows = {c: np.flatnonzero(placed[c].things == t) for c, t in group}
        places = {c: (placed[c].points[mine] / metres, placed[c].lab[mine]) for c, mine in rows.items()}
        members = max(np.count_nonzero(captures[c].things.members == t) for c, t in group)
        if members >= params.min_points:
            kept.append((group, places))
    sightings: list[dict[int, Sighting]] = [
        {c: Sighting(captures[c].scene, "seen", t, np.array([at[c][0].min(0), at[c][0].max(0)])) for c, t in group}
        for group, at in kept
    ]
    for c, capture in enumerate(captures):
        progress(c / max(len(captures), 1), f"looking for {len(kept)} objects in capture {c + 1} of {len(captures)}")
        if all(c in mine for mine in sightings):
            continue
        seen = eyes(capture)
        S_scene_map, unit = capture.S_map_scene.inverse(), metres * capture.S_map_scene.scale
        glances, own = [], []
        for _, places in kept:
            others = [other for other in places if other != c] or [c]
            nearest = min(others, key=lambda other: (abs(other - c), other))
            at, lab = places[nearest]
            glances.append(glance(seen, S_scene_map.apply(at), unit, params.look))
            own.append((at, lab))
        # The exposure: by what is certainly there, else by all that has a surface where it should.
        sure = [i for i, mine in enumerate(sightings) if c in mine] or list(range(len(kept)))
        off = np.concatenate([(glances[i].colours - own[i][1])[glances[i].on] for i in sure])
        shift = np.median(off, axis=0) if len(off) else np.zeros(3)
        for i, mine in enumerate(sightings):
            if c not in mine:
                at, lab = own[i]
                state, looked = judge(glances[i], at * metres, lab, shift, params.look)
                if any((node, c) in gone for node in kept[i][0]):
                    state = "absent"
                box = np.array([at.min(0), at.max(0)]) if state == "seen" else None
                mine[c] = Sighting(capture.scene, state, -1, box, looked)
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
