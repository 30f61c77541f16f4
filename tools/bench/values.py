"""What merging two maps costs, and what of it is made again: nothing but the pairs across them.

    python -m tools.bench.values [--scenes 50] [--gaussians 300]

Graphs and edges are made up, but kept under the keys that the real recipes give them, so that `gsmap update` would
find them; how many jobs it would start is counted without running any.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from itertools import combinations
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

import gsmap
from gsmap.map import Map
from gsmap.map.stages.describe import graph_keys
from gsmap.methods import RecipeKey
from gsmap.register import recipe_key
from gsmap.types import Cameras, EdgeOutcome, Gaussians, PoseGraph, Registration, SceneGraph, ScenePose, Sim3
from tools.harness import argument_parser, timed


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--scenes", type=int, default=50, help="in each of the two maps")
    parser.add_argument("--gaussians", type=int, default=300, help="in each scene")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        for line in run(Path(folder), arguments.scenes, arguments.gaussians):
            print(line, flush=True)


def run(folder: Path, scenes: int, gaussians: int) -> Iterator[str]:
    """The figures, a line each."""
    for k, name in enumerate(("a", "b")):
        make_map(folder / name, scenes, gaussians, seed=k * scenes)
    with gsmap.map.open(folder / "a") as a:
        started = time.process_time()
        merged = a.merge(folder / "b")
        took = time.process_time() - started
        yield f"merged {merged.num_scenes} scenes into {scenes}: {took:.2f} s of CPU, {merged.num_bytes / 1e6:.1f} MB"
        yield f"with {merged.num_graphs} graphs, {merged.num_registrations} edges, {merged.num_revisions} revisions"
        graphs, across, within = jobs_of_update(a)
        yield f"graphs made again: {graphs}"
        yield f"pairs to register: {across} across the two maps, {within} within one of them"
        started = time.process_time()
        again = a.merge(folder / "b")
        new = again.num_scenes + again.num_graphs + again.num_registrations + again.num_facts + again.num_revisions
        yield f"merged again: {new} rows are new, {time.process_time() - started:.2f} s of CPU"
        started = time.process_time()
        branch = a.branch("what-if")
        took = time.process_time() - started
        yield f"a branch: {took:.2f} s of CPU, {branch.num_bytes / 1e6:.2f} MB of catalog, 0 bytes of arrays"
        back, took = timed(a.merge, f"{folder / 'a'}@what-if")
        yield f"merged back: {back.num_scenes} scenes are new, {took:.2f} s of CPU"


def make_map(path: Path, scenes: int, gaussians: int, seed: int) -> None:
    """A map whose scenes are described, registered with each other, and placed in a row."""
    with gsmap.map.create(path) as m:
        make_scenes(m, scenes, gaussians, seed)
        living = m.scenes()
        keys = graph_keys(m.store, living, m.settings)
        for scene in living:
            m.store.graphs.save(SceneGraph(scene.id), keys[scene.id])
        recipe = recipe_key(m.settings.register)
        outcomes = {}
        with m.store.transaction():
            for a, b in combinations(living, 2):
                key = recipe.of(keys[a.id].digest, keys[b.id].digest)
                _register(m, a.id, b.id, key)
                outcomes[a.id, b.id] = EdgeOutcome("used", 1.0)
        poses = {s.id: ScenePose(s.id, _step(k), 0, "placed", np.eye(7) * 1e-4) for k, s in enumerate(living)}
        m.store.revisions.save(PoseGraph(poses, outcomes))


def make_scenes(m: Map, scenes: int, gaussians: int = 50, seed: int = 0) -> None:
    """Add small scenes."""
    for k in range(seed, seed + scenes):
        m.store.scenes.add(_gaussians(gaussians, k), _cameras(), name=f"scene{k}", scale_policy="known")


def jobs_of_update(m: Map) -> tuple[int, int, int]:
    """How many graphs `gsmap update` would make, and how many pairs it would try across and within the two maps."""
    started: dict[str, list[Any]] = {"describe": [], "register": []}

    def collect(stage: str) -> Any:
        return lambda work, jobs, params: iter(started[stage].extend(jobs) or ())

    from gsmap.map.stages import describe, register

    first = {scene.id for scene in m.scenes()[: len(m.scenes()) // 2]}
    with mock.patch.object(describe, "run_jobs", collect("describe")):
        m.describe()
    with mock.patch.object(register, "run_jobs", collect("register")):
        m.register("all")
    across = sum((target[0] in first) != (source[0] in first) for _, target, source, _ in started["register"])
    return len(started["describe"]), across, len(started["register"]) - across


def _register(m: Map, a: str, b: str, key: RecipeKey) -> None:
    found = Registration(a, b, "accepted", S_target_source=_step(1), information=np.eye(7), proposer="graph:landmarks")
    m.store.registrations.save(found, key)


def _step(k: int) -> Sim3:
    return Sim3(np.eye(3), np.array([float(k), 0.0, 0.0]))


def _gaussians(count: int, seed: int) -> Gaussians:
    rng = np.random.default_rng(seed)
    return Gaussians(
        rng.uniform(-5, 5, (count, 3)),
        rng.normal(size=(count, 4)),
        rng.normal(size=(count, 3)) - 4,
        rng.normal(size=count),
        rng.normal(size=(count, 1, 3)),
    )


def _cameras() -> Cameras:
    pose = np.tile(np.eye(4), (3, 1, 1))
    return Cameras(pose, np.tile([100.0, 100, 32, 24], (3, 1)), np.tile([64, 48], (3, 1)), ("a", "b", "c"))


if __name__ == "__main__":
    main()
