"""Find dynamic content: the Gaussians of objects that moved, appeared or disappeared.

A thing persists as far as it was looked for: one that was seen in every look is kept, whether there were ten or one.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from gsmap.errors import NotFoundError
from gsmap.methods import text_digest
from gsmap.store import Store
from gsmap.store.change_rows import Comparison
from gsmap.types import MapObject
from gsmap.types.plain import canonical

if TYPE_CHECKING:
    from gsmap.map.objects.map_objects import MapObjects
    from gsmap.map.settings import Settings

_OF_THINGS = ("appeared", "disappeared", "moved", "replaced")
"""Kinds of changes that concern objects; recoloured surfaces and other lighting are static content."""

_SAME_PLACE = 0.1  # of a thing that stayed, the box that one capture shows holds this much of that of the next


@dataclass(frozen=True)
class DynamicContent:
    """The segments and changes of one scene that are not static; see `gsmap.map.jobs.OmittedContent`.

    Args:
        graph: key of the graph with the segments; empty if there are none.
        things: segments of that graph.
        changes: number of a comparison, index of a change in it, and the scene's side, ``before`` or ``after``.
        told: identifiers of these comparisons, valid in any map.
    """

    graph: str
    things: tuple[int, ...]
    changes: tuple[tuple[int, int, str], ...]
    told: tuple[str, ...]

    @cached_property
    def digest(self) -> str:
        """Digest of the dynamic content; empty without dynamic content."""
        if not self.things and not self.changes:
            return ""
        return text_digest(canonical([self.graph, self.things, [change[1:] for change in self.changes], self.told]))

    def rows(self, store: Store, scene: str) -> np.ndarray:
        """Return a mask (N,) that is True for the dynamic Gaussians of a scene.

        Raises:
            NotFoundError: its segments or changes were pruned meanwhile.
        """
        out = np.zeros(store.scenes.get(scene).num_gaussians, bool)
        for number in dict.fromkeys(change[0] for change in self.changes):
            found = store.changes.load(number).changes
            for _, place, side in (change for change in self.changes if change[0] == number):
                out[found[place].before if side == "before" else found[place].after] = True
        graph = store.graphs.load(scene, self.graph) if self.graph else None
        if self.graph and graph is None:
            raise NotFoundError(
                f"the segments of scene {scene[:12]} were deleted meanwhile: run the same export again",
                code="changed_meanwhile",
            )
        if graph is not None and graph.segments is not None and len(graph.segments):
            from gsmap.objects.changed_segments import CHANGED  # naming what passes does without

            members = graph.segments.members
            of = np.bincount(members[members >= 0], minlength=len(graph.segments))
            changed = np.bincount(members[out & (members >= 0)], minlength=len(graph.segments))
            # Below that share the change is of a part, or of what stands by it.
            whole = np.flatnonzero(changed >= CHANGED * np.maximum(of, 1))
            out |= np.isin(members, np.union1d(whole, np.array(self.things, np.int64)))
        return out


def is_dynamic(thing: MapObject) -> bool:
    """Return true if an object moved or was observed to be absent."""
    if any(sighting.state == "absent" for sighting in thing.sightings):
        return True
    boxes = [sighting.box for sighting in thing.sightings if sighting.thing >= 0 and sighting.box is not None]
    return any(_shared(a, b) < _SAME_PLACE for a, b in pairwise(boxes))


def _shared(a: np.ndarray, b: np.ndarray) -> float:
    """Return the fraction of the smaller of two boxes (2, 3) that the larger contains; flat boxes count by their
    faces.
    """
    thin = 1e-3 * np.maximum(a[1] - a[0], b[1] - b[0]).max()
    a, b = (np.array([box[0] - thin, box[1] + thin]) for box in (a, b))
    both = np.clip(np.minimum(a[1], b[1]) - np.maximum(a[0], b[0]), 0, None).prod()
    return float(both / min((a[1] - a[0]).prod(), (b[1] - b[0]).prod()))


def find_dynamic_content(store: Store, known: MapObjects, standing: Sequence[Comparison]) -> dict[str, DynamicContent]:
    """Return the dynamic content of each placed scene, by scene id, reading only the catalog.

    Args:
        standing: the comparisons that hold (`gsmap.map.changes.compare.standing_comparisons`).
    """
    graphs = {graph.scene: graph.key for graph in store.graphs.list()}
    things: dict[str, set[int]] = {}
    for thing in (*known.objects, *known.building):  # what could not be split may have moved, too
        if is_dynamic(thing):
            for sighting in thing.sightings:
                if sighting.thing >= 0:
                    things.setdefault(sighting.scene, set()).add(sighting.thing)
    changes: dict[str, list[tuple[int, int, str]]] = {}
    told: dict[str, list[str]] = {}
    for one in standing:
        for change in one.changes:
            if change.status == "rejected" or change.kind not in _OF_THINGS:
                continue
            for scene, side, count in (
                (one.older, "before", change.num_before),
                (one.newer, "after", change.num_after),
            ):
                if count and scene in known.scenes:
                    changes.setdefault(scene, []).append((one.number, change.place, side))
                    told.setdefault(scene, []).append(f"{one.key} {one.created_at}")
    return {
        scene: DynamicContent(
            graphs.get(scene, "") if scene in things or scene in changes else "",
            tuple(sorted(things.get(scene, ()))),
            tuple(changes.get(scene, ())),
            tuple(dict.fromkeys(told.get(scene, ()))),
        )
        for scene in known.scenes
    }


def find_omitted(
    store: Store, settings: Settings, scenes: Collection[str], known: MapObjects | None = None
) -> tuple[dict[str, DynamicContent], tuple[str, ...]]:
    """Return the dynamic content of some of the placed scenes, and notes on it (`gsmap.map.stages.export.FindOmitted`).

    Args:
        known: objects of the map; default: the stored ones.
    """
    from gsmap.map.changes.compare import standing_comparisons  # both only for exports of static content
    from gsmap.map.objects.map_objects import load_objects

    known = load_objects(store, settings) if known is None else known
    found = find_dynamic_content(store, known, standing_comparisons(store, settings))
    passing = {scene: one for scene, one in found.items() if scene in scenes}
    return passing, tuple(_notes(known, passing))


def _notes(known: MapObjects, passing: Mapping[str, DynamicContent]) -> list[str]:
    """Return notes on the dynamic content that is left out."""
    every = [*known.objects, *known.building]
    gone = [thing for thing in every if is_dynamic(thing)]
    once = sum(thing.looks < 2 for thing in every)
    called = [thing.words.name or thing.words.label or thing.id for thing in gone]
    told = sum(len(one.changes) for one in passing.values())
    said = [
        f"{len(gone)} of {len(every)} objects are left out, since they moved or were observed to be "
        f"absent{': ' + ', '.join(called[:8]) if gone else ''}{' ...' if len(gone) > 8 else ''}"
    ]
    if told:
        said.append(f"also left out: the Gaussians of {told} changes")
    if once:
        said.append(f"{once} objects were observed only once and are kept")
    return said
