#!/usr/bin/env python
"""Which pairs retrieval proposes among rooms that look alike, and what asking costs.

    python -m tools.bench.retrieve --cache /tmp/rooms --scenes 30 60 120 300
    python -m tools.bench.retrieve --cache /tmp/rooms --scenes 30 --cost 10 100 300 1000
    python -m tools.bench.retrieve --cache /tmp/small --size 120 90 --gaussians 6000 --scenes 100 300 1000

The floors of a building: 31 rooms in a row each, of five decorations (--decorations) that repeat exactly, with the
furniture standing elsewhere in every room. Capture k of a floor walks rooms k and k + 1 (20 frames, 15,000 Gaussians
laid on their depth, not trained, in a frame of its own), and is described under the default settings; made once, and
kept under --cache, which holds captures of one kind (3 to 4 CPU s each; --size and --gaussians make smaller ones,
1.8 CPU s each, of which the rooms take 1). Of N captures, N - N / 30 pairs share a room: these are to be found. --seed
draws another building.

For each N it prints, of up to 60 of the captures, each asking an index of all N as a newcomer does: the share of its
true neighbours among the first 5, 10, top_k and 15 of its list, and by votes alone; pairs a scene and the share of
them that is right, as they are tried where nothing else holds (a capture has two neighbours here, fewer than
`retrieve.max_edges_per_scene`); recall where all N ask at once; with --older the same of votes of all nodes for all, as
it was before there was an index.

--cost prints, for an index as it lies in a map: segments, bytes, CPU s of one newcomer's lookup (reading included), of
putting it into the index, and how much memory asking takes. Beyond the captures that are there it is filled with copies
whose codes and positions have noise: that tells what asking costs, and nothing of what is found.
"""

# Thread counts must be set before numpy comes in.
# ruff: noqa: E402
from __future__ import annotations

import os

from tools.harness import argument_parser, timed

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import argparse
import pickle
import sys
import tempfile
import time
import tracemalloc
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from gsmap.retrieve import Params, SceneNodes, look_up, new_segment, select_nodes
from gsmap.store import Store
from gsmap.types import SceneGraph
from gsmap.types.segments import merged, to_merge

ROOMS = 31
A_FLOOR = ROOMS - 1


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--cache", type=Path, required=True, help="keep described captures here")
    parser.add_argument("--scenes", type=int, nargs="*", default=[30, 60, 120, 300])
    parser.add_argument("--cost", type=int, nargs="*", default=[])
    parser.add_argument("--older", action="store_true", help="votes of all for all as well")
    parser.add_argument("--seed", type=int, default=31, help="of the building")
    parser.add_argument("--decorations", type=int, default=5, help="of its rooms; the fewer, the more look alike")
    parser.add_argument("--gaussians", type=int, default=15_000, help="of a capture")
    parser.add_argument("--size", type=int, nargs=2, default=(200, 150), help="of a frame, pixels")
    args = parser.parse_args()
    args.cache.mkdir(parents=True, exist_ok=True)
    params = Params()
    graphs = [described(args, k) for k in range(max([*args.scenes, *(n for n in args.cost if n <= 300), 0]))]
    voters = [select_nodes(graph, f"{k:032x}", params.nodes_per_scene) for k, graph in enumerate(graphs)]
    for count in args.scenes:
        report(graphs[:count], voters[:count], params, older=args.older)
    for count in args.cost:
        cost(voters, count, params)


def described(args: argparse.Namespace, number: int) -> SceneGraph:
    """The graph of a capture, made with the rest of its floor where it is not there yet."""
    floor, k = divmod(number, A_FLOOR)
    path = args.cache / f"{floor:02d}_{k:02d}.pickle"
    if not path.exists():
        make_floor(args, floor)
    graph: SceneGraph = pickle.loads(path.read_bytes())[0]
    return graph


def make_floor(args: argparse.Namespace, floor: int) -> None:
    from gsmap.describe import describe
    from gsmap_synthetic.capture import film, unused_doors, walk
    from gsmap_synthetic.make import fit_frames, put_in_own_frame
    from gsmap_synthetic.streets import make_street

    place = make_street(args.seed, rooms=ROOMS, decorations=args.decorations, floor=floor, texel_m=0.03)
    for k in range(A_FLOOR):
        path, seed = args.cache / f"{floor:02d}_{k:02d}.pickle", 1000 * floor + k
        poses = walk(place, (k, k + 1), 20, seed=seed)
        frames = film(place, poses, size_px=tuple(args.size), shut=unused_doors(place, (k, k + 1)), name="f")
        gaussians = fit_frames(frames, steps=0, num_gaussians=args.gaussians, seed=seed)
        capture = put_in_own_frame(gaussians, frames, path.stem, np.random.default_rng([args.seed, floor, k, 8]))
        graph = describe(path.stem, capture.gaussians, capture.cameras, scale_policy="auto")
        partial = path.with_suffix(f".{os.getpid()}")
        partial.write_bytes(pickle.dumps((graph, capture.gaussians, capture.cameras, capture.T_scene_world)))
        partial.rename(path)
    print(f"floor {floor} made: {time.process_time():.0f} CPU s so far", file=sys.stderr, flush=True)


def are_neighbours(a: str, b: str) -> bool:
    (floor, k), (other, m) = (map(int, name.split("_")) for name in (a, b))
    return floor == other and abs(k - m) == 1


def report(graphs: Sequence[SceneGraph], voters: Sequence[SceneNodes], params: Params, *, older: bool) -> None:
    names = [graph.scene_id for graph in graphs]
    index = [new_segment(voters)]
    rng = np.random.default_rng(0)
    asking = sorted(rng.choice(len(voters), min(60, len(voters)), replace=False))
    begin = time.process_time()
    found = [look_up([voters[k]], index, params)[0] for k in asking]
    seconds = (time.process_time() - begin) / len(asking)
    ranks, by_votes, right, tried = [], [], 0, 0
    for k, said in zip(asking, found, strict=True):
        order = [one.scene for one in said]
        voted = [one.scene for one in sorted(said, key=lambda one: -one.votes)]
        first = order[: params.top_k]
        tried += len(first)
        right += sum(are_neighbours(names[k], other) for other in first)
        for other in names:
            if are_neighbours(names[k], other):
                ranks.append(order.index(other) if other in order else 10**9)
                by_votes.append(voted.index(other) if other in voted else 10**9)
    shares = {n: np.mean(np.array(ranks) < n) for n in (5, 10, params.top_k, 15)}
    print(
        f"{len(names):4d} captures, a newcomer: "
        + ", ".join(f"{share:.3f} in the first {n}" for n, share in shares.items())
        + f" (by votes {np.mean(np.array(by_votes) < params.top_k):.3f}); {tried / len(asking):.1f} pairs, "
        f"{right / tried:.0%} right, {seconds:.3f} CPU s",
        flush=True,
    )
    begin = time.process_time()
    every = [said for k in range(0, len(voters), 16) for said in look_up(voters[k : k + 16], index, params)]
    seconds = (time.process_time() - begin) / len(voters)
    pairs = {
        frozenset((name, one.scene)) for name, said in zip(names, every, strict=True) for one in said[: params.top_k]
    }
    say("all at once", names, pairs, seconds)
    if older:
        pairs, took = timed(votes_of_all, graphs)
        say("all for all", names, pairs, took / len(names))


def say(what: str, names: Sequence[str], pairs: set[frozenset[str]], seconds: float) -> None:
    true = {frozenset((a, b)) for a in names for b in names if a < b and are_neighbours(a, b)}
    print(
        f"     {what}: recall {len(true & pairs) / len(true):.3f}, {len(pairs) / len(names):.1f} pairs a scene, "
        f"{len(true & pairs) / len(pairs):.0%} right, {seconds:.3f} CPU s a scene",
        flush=True,
    )


def votes_of_all(graphs: Sequence[SceneGraph], top_k: int = 10, most: int = 20) -> set[frozenset[str]]:
    """Pairs as they were found before: every node votes for the most similar ones of its type, of all scenes."""
    votes = np.zeros((len(graphs), len(graphs)))
    budget = max(16, min(400, 60_000 // len(graphs)))
    layers = defaultdict(list)
    for i, graph in enumerate(graphs):
        for name in ("landmarks", "objects"):
            layers[graph.layers[name].descriptor_id].append((i, graph.layers[name]))
    for mine in layers.values():
        rows = [np.argsort(-layer.weights, kind="stable")[:budget] for _, layer in mine]
        scene = np.concatenate([np.full(len(r), i) for (i, _), r in zip(mine, rows, strict=True)])
        kinds = np.concatenate([layer.types[r] for (_, layer), r in zip(mine, rows, strict=True)])
        vectors = np.concatenate([layer.embeddings[r] for (_, layer), r in zip(mine, rows, strict=True)])
        for kind in np.unique(kinds):
            pool = np.flatnonzero(kinds == kind)
            for chunk in np.array_split(pool, len(pool) ** 2 // 20_000_000 + 1):
                similarity = vectors[chunk] @ vectors[pool].T
                similarity[scene[chunk][:, None] == scene[pool]] = -1.0
                k = min(most, len(pool))
                best = np.argpartition(-similarity, k - 1, axis=1)[:, :k]
                weight = np.take_along_axis(similarity, best, axis=1)
                weight = np.maximum(weight - np.maximum(weight.min(1, keepdims=True), 0.0), 0.0)
                np.add.at(votes, (np.repeat(scene[chunk], k), scene[pool][best].ravel()), weight.ravel())
    names = [graph.scene_id for graph in graphs]
    return {
        frozenset((names[i], names[j]))
        for i, row in enumerate(votes)
        for j in np.argsort(-row, kind="stable")[:top_k]
        if row[j] > 0 and i != j
    }


def cost(voters: Sequence[SceneNodes], count: int, params: Params) -> None:
    """What an index of so many scenes costs the next one, as it lies in a map."""
    rng = np.random.default_rng(count)
    asking = _copy(voters[0], "f" * 32, rng)
    with tempfile.TemporaryDirectory() as folder, Store.create(Path(folder) / "map.gsmap") as store:
        key = "0" * 32
        for start in range(0, count, 64):
            batch = [
                _copy(voters[k % len(voters)], f"{k:032x}", rng if k >= len(voters) else None)
                for k in range(start, min(count, start + 64))
            ]
            put(store, key, batch)
        look_up([asking], store.indexes.segments(key), params)  # imports, and pages of the disk
        tracemalloc.start()
        look_up([asking], store.indexes.segments(key), params)
        memory = tracemalloc.get_traced_memory()[1] / 1e6
        tracemalloc.stop()
        begin = time.process_time()
        look_up([asking], store.indexes.segments(key), params)
        asked = time.process_time() - begin
        segments = store.indexes.segments(key)
        size = sum(file.size_bytes for segment in segments for file in segment._files)
        begin = time.process_time()
        put(store, key, [asking])
        kept = time.process_time() - begin
        print(
            f"{count:5d} scenes: {len(segments)} segments, {size / 1e6:.1f} MB; a newcomer asks {asked:.3f} CPU s, is "
            f"put in {kept:.3f} CPU s; asking takes {memory:.0f} MB of memory",
            flush=True,
        )


def put(store: Store, key: str, new: Sequence[SceneNodes]) -> None:
    segments = store.indexes.segments(key)
    old = [segments[k] for k in to_merge([len(segment.members) for segment in segments], len(new))]
    whole = merged([*old, new_segment(new)])
    members = [member for member in whole.members if member is not None]
    store.indexes.save_segment(key, members, whole.arrays, [segment.id for segment in old])


def _copy(voters: SceneNodes, scene: str, rng: np.random.Generator | None) -> SceneNodes:
    """The same scene under another id; with noise where there is a generator."""
    member = replace(voters.member, scene=scene, graph=scene)
    if rng is None:
        return replace(voters, member=member)
    kept = voters.index_nodes
    codes = np.clip(kept.codes + rng.integers(-12, 13, kept.codes.shape), -127, 127).astype(np.int8)
    positions = (kept.positions + rng.normal(size=kept.positions.shape) * 0.3).astype(np.float16)
    return replace(voters, member=member, index_nodes=replace(kept, codes=codes, positions=positions))


if __name__ == "__main__":
    main()
