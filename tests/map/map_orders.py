"""One map of the same captures in several orders, and how far two such maps differ."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

import gsmap.map
from gsmap.geometry.rotations import angle_between
from gsmap.map import Map
from gsmap.map.stages import register as register_stage
from gsmap.map.stages.describe import graph_keys
from gsmap.types import Cameras, Gaussians, Sim3
from gsmap_synthetic import make_captures


@dataclass(frozen=True)
class Outcome:
    """What a map says, without what its frames are: those are the oldest scene's.

    Args:
        accepted: (target, source, use in the pose graph) of the edges that were accepted, by name.
        refused: how many were not.
        islands: the names of each component's scenes.
        relative: where one scene of a component lies in another, by their names.
        corners: (8, 3) of each scene's box, in its frame.
        unit_m: metres per unit of each scene, as its graph guesses.
    """

    accepted: frozenset[tuple[str, str, str]]
    refused: int
    islands: frozenset[frozenset[str]]
    relative: dict[tuple[str, str], Sim3]
    corners: dict[str, np.ndarray]
    unit_m: dict[str, float]

    @classmethod
    def of(cls, m: Map) -> Outcome:
        scenes = {scene.id: scene for scene in m.scenes()}
        names = {scene.id: scene.name for scene in scenes.values()}
        graph = m.pose_graph()
        edges = [stored.registration for stored in m.store.registrations.current()]
        accepted = [edge for edge in edges if edge.status == "accepted"]
        islands: dict[int, list[str]] = {}
        for pose in graph.poses.values():
            islands.setdefault(pose.component, []).append(pose.scene)
        relative = {}
        for members in islands.values():
            for a, b in combinations(sorted(members, key=names.__getitem__), 2):
                relative[names[a], names[b]] = graph.poses[a].S_map_scene.inverse() @ graph.poses[b].S_map_scene
        return cls(
            frozenset((names[e.target], names[e.source], graph.use(e.target, e.source)) for e in accepted),
            len(edges) - len(accepted),
            frozenset(frozenset(names[s] for s in members) for members in islands.values()),
            relative,
            {names[s]: _corners(scene.bounds) for s, scene in scenes.items()},
            {names[s]: m.store.graphs.load(s).unit_m for s in scenes},
        )

    def same_edges(self, other: Outcome) -> bool:
        return (self.accepted, self.refused, self.islands) == (other.accepted, other.refused, other.islands)

    def apart(self, other: Outcome) -> tuple[float, float]:
        """Largest difference of two scenes' relative pose: mm at the corners of the one's box (in the other's unit,
        which is taken to metres), and degrees; infinite where the components differ."""
        if self.islands != other.islands:
            return np.inf, np.inf
        mm, deg = [0.0], [0.0]
        for (a, b), one in self.relative.items():
            two = other.relative[a, b]
            off = np.linalg.norm(one.apply(self.corners[b]) - two.apply(self.corners[b]), axis=1).max()
            mm.append(1e3 * self.unit_m[a] * float(off))
            deg.append(float(np.degrees(angle_between(one.rotation, two.rotation))))
        return max(mm), max(deg)


def _corners(bounds: np.ndarray) -> np.ndarray:
    return np.array([[bounds[i, 0], bounds[j, 1], bounds[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)])


@dataclass(frozen=True, eq=False)
class Described:
    """Captures in memory, by name, and a map in which each has its graph and nothing is registered."""

    captures: Mapping[str, tuple[Gaussians, Cameras]]
    map: Map

    @classmethod
    def of(cls, path: Path, captures: Mapping[str, tuple[Gaussians, Cameras]]) -> Described:
        m = gsmap.map.create(path)
        for name, (gaussians, cameras) in captures.items():
            m.ingest(gaussians, cameras=cameras, name=name)
        m.describe()
        return cls(captures, m)

    def ingest(self, m: Map, name: str) -> None:
        """One of the captures into another map, with the graph it has in this one."""
        gaussians, cameras = self.captures[name]
        m.ingest(gaussians, cameras=cameras, name=name)
        (scene,) = [scene for scene in m.scenes() if scene.name == name]
        (key,) = graph_keys(m.store, [scene], m.settings).values()
        graph = self.map.store.graphs.load(name, key)
        assert graph is not None, f"{name} is another scene here"
        m.store.graphs.save(graph, key)

    def in_order(self, order: Sequence[str], path: Path, *, one_by_one: bool) -> Outcome:
        """What a new map of the captures says, ingested in this order and registered anew.

        Args:
            order: names of the captures.
            one_by_one: update after each capture; else once, after all.
        """
        with gsmap.map.create(path) as m:
            for name in order:
                self.ingest(m, name)
                if one_by_one:
                    m.update()
            m.update()
            return Outcome.of(m)


@contextmanager
def walked_room(path: Path, visits: int) -> Iterator[Described]:
    """A map of one room walked through several times, its captures described: capture_a, capture_b, ..."""
    made = make_captures(0, visits, steps=0, num_frames=6, num_gaussians=4_000, size_px=(80, 60), routes=[[0]] * visits)
    found = Described.of(path, {one.name: (one.gaussians, one.cameras) for one in made})
    yield found
    found.map.close()


@contextmanager
def pairs_remembered() -> Iterator[Callable[[], AbstractContextManager[None]]]:
    """Register a pair once for all maps, in each direction: what is asked for is seen, not what it gives.

    Yields:
        A context in which pairs are registered anew all the same.
    """
    known: dict[tuple[Any, ...], Any] = {}
    run_jobs = register_stage.run_jobs
    anew = False

    def remembering(
        function: Any, jobs: Iterable[tuple[Any, ...]], params: Any, **how: Any
    ) -> Iterator[tuple[int, Any]]:
        asked: list[tuple[Any, ...]] = []

        def noted() -> Iterator[tuple[Any, ...]]:
            for job in jobs:  # taken one by one, as there is room
                asked.append(job[1:])
                yield job

        if anew:
            for i, edge in run_jobs(function, noted(), params, **how):
                known[asked[i]] = edge
                yield i, edge
            return
        for i, job in enumerate(noted()):
            if asked[i] not in known:
                ((_, known[asked[i]]),) = run_jobs(function, [job], params, **how)
            yield i, known[asked[i]]

    @contextmanager
    def registering_anew() -> Iterator[None]:
        nonlocal anew
        anew = True
        try:
            yield
        finally:
            anew = False

    with mock.patch.object(register_stage, "run_jobs", remembering):
        yield registering_anew
