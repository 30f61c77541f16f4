#!/usr/bin/env python
"""A street of a thousand captures that come one at a time: what each costs the map, and whether the map is right.

    python -m tools.bench.street --cache FOLDER --captures 1000      # goes on where it was stopped
    python -m tools.bench.street --cache FOLDER --report             # the tables of what was measured so far
    python -m tools.bench.street --cache FOLDER --solves 150 --full-scenes 100    # only its solves, from 150 captures

The street is two rows of rooms back to back, every room with walls and furniture of its own, with doors along each row
and from row to row at every eighth room. A capture walks from a room into the next one; every second one walks, the
other way round, where an earlier one did. So loops of 18 rooms follow one another. Each capture is small
(``--gaussians`` laid on the depth of ``--frames`` pictures, not trained) and has a frame of its own. It is ingested and
``update`` is run, with the settings that a map has, before the next one is made. The street is made sixteen columns of
rooms at a time, so that a capture costs the same wherever it lies; a column where two pieces meet is lit a little
differently in each.

Of each capture it keeps the CPU seconds of ingesting it, of its own share (describing it, registering its pairs: what
the jobs take), and of all else that ``update`` does. What is right is told from the truth: an edge is wrong if it puts
the source's middle more than .5 m or 5 degrees off; two scenes of a component are folded together if the map has their
middles within 2 m where they are more than 6 m apart. Poses are judged beside the surest scene of their component.
"""

# Thread counts must be set before numpy comes in.
# ruff: noqa: E402
from __future__ import annotations

import os

from tools.harness import argument_parser, say

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "GSMAP_WORKERS"):
    os.environ[_name] = "1"

import argparse
import gc
import json
import resource
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from scipy.stats import chi2

import gsmap.map
from gsmap.cli import COLLECT_AFTER
from gsmap.evaluate.calibration import nees_of_edge, nees_of_pose, relative_covariance
from gsmap.evaluate.registration import pose_error
from gsmap.map import reports
from gsmap.map.stages import describe, optimize, register
from gsmap.store.graphs import Graphs
from gsmap.types import Sim3
from gsmap_synthetic import make_captures
from gsmap_synthetic.make import DemoCapture
from gsmap_synthetic.place import Place, build_place
from gsmap_synthetic.plan import WALL_M, Door, Room
from tools.bench.spent import spent, statements

COLUMNS, RUNG = 16, 8  # columns of rooms made at once, and from one door between the rows to the next
_ROOM_M = np.array([4.2, 3.8])
_PITCH_M = _ROOM_M + WALL_M
_KINDS = ("living room", "kitchen", "bedroom", "study", "bathroom")
_WRONG_M, _WRONG_DEG, _BESIDE_M, _APART_M = 0.5, 5.0, 2.0, 6.0

Walk = tuple[tuple[int, int], tuple[int, int]]
"""Two rooms, each (row, column)."""


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--cache", type=Path, required=True, help="the map, and what was measured, are kept here")
    parser.add_argument("--captures", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=97, help="of the street")
    parser.add_argument("--gaussians", type=int, default=3000, help="of a capture")
    parser.add_argument("--frames", type=int, default=14, help="of a capture")
    parser.add_argument("--size", type=int, nargs=2, default=(96, 72), help="of a frame, pixels")
    parser.add_argument("--report", action="store_true", help="make nothing more")
    parser.add_argument("--solves", type=int, metavar="N", help="only time solving N captures, N + 1, ...")
    parser.add_argument("--full-scenes", type=int, default=500, help="of --solves: optimize.max_full_scenes")
    args = parser.parse_args()
    gc.set_threshold(COLLECT_AFTER)  # as the command line does
    args.cache.mkdir(parents=True, exist_ok=True)
    if args.solves:
        print_solves(args)
        return
    if not args.report:
        grow(args)
    rows = measured(args.cache)
    if rows:
        print_costs(rows)
        with gsmap.map.open(args.cache / "map.gsmap") as m:
            for name, value in judged(m, rows).items():
                print(f"{name:64} {value}")


# --- the street -----------------------------------------------------------------------------------------------------


def walks(piece: int, seed: int) -> list[Walk]:
    """The walks through a piece of the street, in the order in which they are captured."""
    rng = np.random.default_rng([seed, piece, 1])
    new: list[Walk] = []
    for column in range(piece * COLUMNS, (piece + 1) * COLUMNS):
        if column % RUNG == 0:
            new.append(((0, column), (1, column)))
        new += [((row, column), (row, column + 1)) for row in (0, 1)]
    out: list[Walk] = []
    for k, walk in enumerate(new):
        a, b = new[int(rng.integers(k + 1))]
        out += [walk, (b, a)]
    return out


def build_piece(piece: int, seed: int) -> tuple[Place, dict[tuple[int, int], int]]:
    """The rooms of a piece, with one column more at either end, which lights and shuts them as the whole street does.

    Returns:
        The place, the piece's first column at x = 0, and the number of each room in it.
    """
    first = piece * COLUMNS
    columns = range(max(first - 1, 0), first + COLUMNS + 2)
    numbers, rooms, doors = {}, [], []
    for column in columns:
        for row in (0, 1):
            low = _PITCH_M * [column - first, row]
            rng = np.random.default_rng([seed, column, row, 2])
            numbers[row, column] = len(rooms)
            rooms.append(Room(_KINDS[rng.integers(5)], np.r_[low, low + _ROOM_M], int(rng.integers(1 << 30))))
    for (row, column), number in numbers.items():
        rng = np.random.default_rng([seed, column, row, 3])
        low = _PITCH_M * [column - first, row]
        if (row, column + 1) in numbers:
            at = low + np.array([_PITCH_M[0] - WALL_M / 2, rng.uniform(0.9, _ROOM_M[1] - 0.9)])
            doors.append(Door(number, numbers[row, column + 1], at, 1.0, False))
        if row == 0 and column % RUNG == 0:
            at = low + np.array([rng.uniform(0.9, _ROOM_M[0] - 0.9), _PITCH_M[1] - WALL_M / 2])
            doors.append(Door(number, numbers[1, column], at, 1.0, True))
    return build_place(seed, rooms, doors, texel_m=0.03), numbers


def captures(args: argparse.Namespace, start: int) -> Iterator[tuple[int, Walk, DemoCapture, Sim3, float]]:
    """Number, walk, capture, its true ``S_street_scene``, and the CPU seconds that making it took, from a number on."""
    number, piece = 0, 0
    while True:
        mine, place, since = walks(piece, args.seed), None, time.process_time()
        for i, walk in enumerate(mine):
            if number >= start:
                if place is None:
                    place, numbers = build_piece(piece, args.seed)
                route = [numbers[room] for room in walk]
                made = make_captures(
                    int(np.random.default_rng([args.seed, piece, i, 4]).integers(1 << 30)),
                    1,
                    first=number,
                    steps=0,
                    num_frames=args.frames,
                    num_gaussians=args.gaussians,
                    size_px=tuple(args.size),
                    routes=[route],
                    place=place,
                )
                ahead = Sim3(np.eye(3), [piece * COLUMNS * _PITCH_M[0], 0.0, 0.0])
                took, since = time.process_time() - since, time.process_time()
                yield number, walk, made[0], ahead @ Sim3.from_matrix(made[0].T_scene_world).inverse(), took
                since = time.process_time()
            number += 1
        piece += 1


# --- one capture after the other ------------------------------------------------------------------------------------

PARTS = [
    ("describing", describe, "describe_scene"),
    ("pairs", register, "register_scenes"),
    ("looking up", register, "look_up_scenes"),
    ("solving", optimize.solver, "optimize"),
    ("keeping still", optimize.solver, "keep_unchanged_poses"),
    ("naming poses", optimize, "pose_basis"),
    ("reading edges", optimize, "_edges"),
    ("report", reports, "update_report"),
    ("loading graphs", Graphs, "load"),
]


def grow(args: argparse.Namespace) -> None:
    done = len(measured(args.cache))
    with gsmap.map.open_or_create(args.cache / "map.gsmap") as m, (args.cache / "rows.jsonl").open("a") as file:
        for number, walk, capture, truth, making in captures(args, done):
            if number >= args.captures:
                return
            row: dict[str, Any] = {"walk": walk, "S_street_scene": truth.matrix().tolist(), "making": making}
            start = time.process_time()
            m.ingest(capture.gaussians, cameras=capture.cameras, name=f"walk-{number:04d}")
            row["ingest"] = time.process_time() - start
            with spent(PARTS) as parts, statements(m.store.catalog.engine) as counts:
                start = time.process_time()
                m.update()
                row["update"] = time.process_time() - start
            row |= parts.seconds | {f"{part}, times": times for part, times in parts.times.items()}
            row["SQL"] = counts["sql"]
            row["peak MB"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
            print(json.dumps(row), file=file, flush=True)
            if (number + 1) % 25 == 0:
                say(f"{number + 1} captures")


def measured(folder: Path) -> list[dict[str, Any]]:
    """What was kept of each capture, in their order."""
    path = folder / "rows.jsonl"
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def print_costs(rows: list[dict[str, Any]]) -> None:
    """Medians over windows that end where the map has so many captures."""
    parts = ("describing", "pairs", "looking up", "solving", "keeping still", "naming poses", "reading edges", "report")
    ends = [n for n in (10, 30, 100, 200, 300, 400, 500, 600, 700, 800, 900, 1000) if n <= len(rows)]
    if not ends or ends[-1] < len(rows):
        ends.append(len(rows))
    table: dict[str, list[float]] = {}
    for end in ends:
        window = rows[max(0, end - max(8, end // 10)) : end]

        def middle(value: Callable[[dict[str, Any]], float], of: list[dict[str, Any]] = window) -> float:
            return float(np.median([value(row) for row in of]))

        def own(row: dict[str, Any]) -> float:
            return float(row.get("describing", 0.0) + row.get("pairs", 0.0) + row.get("loading graphs", 0.0))

        column = {
            "ingest and update, CPU s": middle(lambda row: row["ingest"] + row["update"]),
            "update without its own share, CPU s": middle(lambda row: row["update"] - own(row)),
            "own share: describing and its pairs, CPU s": middle(own),
        }
        column |= {f"  {part}, CPU s": middle(lambda row, p=part: row.get(p, 0.0)) for part in parts}
        column |= {
            "pairs tried": middle(lambda row: row.get("pairs, times", 0)),
            "a pair, CPU s": middle(lambda row: row.get("pairs", 0.0) / max(row.get("pairs, times", 0), 1)),
            "solved so many times": middle(lambda row: row.get("solving, times", 0)),
            "SQL statements": middle(lambda row: row["SQL"]),
            "peak memory, MB": window[-1]["peak MB"],
            "making the capture, CPU s": middle(lambda row: row["making"]),
        }
        for name, value in column.items():
            table.setdefault(name, []).append(value)
    print(f"{'captures in the map':48}" + "".join(f"{end:>9,}" for end in ends))
    for name, values in table.items():
        print(f"{name:48}" + "".join(f"{value:>9.4g}" for value in values))


def print_solves(args: argparse.Namespace) -> None:
    """Solve the street's edges again as its captures came, from ``--solves`` of them on."""
    with gsmap.map.open(args.cache / "map.gsmap", "r") as m:
        given, params = optimize.pose_inputs(m.store, m.settings), m.settings.optimize
    params = replace(params, max_full_scenes=args.full_scenes)
    answer, seconds, methods = None, [], Counter[str]()
    for count in range(args.solves, len(given.scenes) + 1):
        some = set(given.scenes[:count])
        edges = [edge for edge in given.edges if {edge.target, edge.source} <= some]
        start = time.process_time()
        found = optimize.solver.optimize(given.scenes[:count], edges, (), answer, params)
        answer = optimize.solver.keep_unchanged_poses(found, answer, edges, params)
        seconds.append(time.process_time() - start)
        methods[answer.provenance.method] += 1
    assert answer is not None
    print(f"{len(seconds)} solves ({dict(methods)}): {np.mean(seconds[1:]):.3f} CPU s in the mean after the first")
    print(f"scenes {dict(Counter(pose.status for pose in answer.poses.values()))}")
    print(f"edges {dict(Counter(outcome.use for outcome in answer.outcomes.values()))}")


# --- is it right ----------------------------------------------------------------------------------------------------


def judged(m: gsmap.map.Map, rows: list[dict[str, Any]]) -> dict[str, str]:
    """What the truth says of the map's edges and newest poses."""
    scenes = {scene.id: scene for scene in m.scenes()}
    of_name = {f"walk-{k:04d}": row for k, row in enumerate(rows)}
    known = {s: of_name[scene.name] for s, scene in scenes.items() if scene.name in of_name}
    truth = {s: Sim3.from_matrix(np.array(row["S_street_scene"])) for s, row in known.items()}
    middles = {s: scenes[s].bounds.mean(0) for s in truth}
    seen = {s: {tuple(room) for room in row["walk"]} for s, row in known.items()}
    out: dict[str, str] = {}

    edges = [e for e in m.edge_rows() if {e.target, e.source} <= set(truth)]
    kinds: Counter[tuple[bool, bool]] = Counter()
    found, edges_off, edges_inside = set(), [], 0
    for edge in edges:
        if edge.status != "accepted" or edge.S_target_source is None:
            continue
        true = truth[edge.target].inverse() @ truth[edge.source]
        error = pose_error(edge.S_target_source, true, middles[edge.source])
        right = error.centroid_m <= _WRONG_M and error.rre_deg <= _WRONG_DEG
        kinds[right, edge.used] += 1
        if right:
            found.add(frozenset((edge.target, edge.source)))
            edges_off.append(error.centroid_m)
            if edge.information is not None:
                told = nees_of_edge(edge.S_target_source, edge.information, true)
                edges_inside += bool(told.value <= chi2.ppf(0.9973, told.dof))
    by_room: dict[tuple[int, int], list[str]] = {}
    for s, rooms in seen.items():
        for room in rooms:
            by_room.setdefault(room, []).append(s)
    share = {frozenset((a, b)) for same in by_room.values() for a in same for b in same if a != b}
    out["pairs tried"] = f"{len(edges)}, {len(edges) / len(truth):.1f} a capture"
    out["right edges: used, not used"] = f"{kinds[True, True]}, {kinds[True, False]}"
    out["wrong edges: used, not used"] = f"{kinds[False, True]}, {kinds[False, False]}"
    out["right edges: off from the truth, m"] = quantiles(edges_off)
    out["right edges within 3 of their sigma (99.7 % if honest)"] = f"{edges_inside} of {len(edges_off)}"
    out["pairs that share a room: all, accepted and right"] = f"{len(share)}, {len(share & found)}"

    graph = m.store.revisions.get()
    assert graph is not None
    poses = {s: pose for s, pose in graph.poses.items() if s in truth}
    statuses = Counter(pose.status for pose in poses.values())
    out["scenes"] = ", ".join(f"{count} {status}" for status, count in sorted(statuses.items()))
    components: dict[int, list[str]] = {}
    for s, pose in poses.items():
        components.setdefault(pose.component, []).append(s)
    sizes = sorted((len(members) for members in components.values()), reverse=True)
    out["components, by scenes"] = f"{len(sizes)}: {', '.join(map(str, sizes[:8]))}{' ...' if len(sizes) > 8 else ''}"

    folded, inside, off, beside, judged_poses = 0, 0, [], [], 0
    for members in components.values():
        placed = [s for s in members if poses[s].status != "isolated"]
        if len(placed) < 2:
            continue
        at = np.array([poses[s].S_map_scene.apply(middles[s]) for s in placed])
        really = np.array([truth[s].apply(middles[s]) for s in placed])
        near = cKDTree(at).query_pairs(_BESIDE_M, output_type="ndarray")
        folded += bool(
            len(near) and (np.linalg.norm(np.subtract(*really[near.T.reshape(2, -1)]), axis=1) > _APART_M).any()
        )
        anchor = max(placed, key=lambda s: -np.inf if poses[s].covariance is None else -np.trace(poses[s].covariance))
        for s in placed:
            estimated = poses[anchor].S_map_scene.inverse() @ poses[s].S_map_scene
            true = truth[anchor].inverse() @ truth[s]
            off.append(pose_error(estimated, true, middles[s]).centroid_m)
            if s == anchor or poses[s].covariance is None or poses[anchor].covariance is None:
                continue
            covariance = relative_covariance(estimated, poses[s].covariance, poses[anchor].covariance)
            if covariance is not None:
                error = nees_of_pose(estimated, covariance, true)
                judged_poses += 1
                inside += bool(error.value <= chi2.ppf(0.9973, error.dof))
        for a, b in (sorted(pair) for pair in share if pair <= set(placed)):
            estimated = poses[a].S_map_scene.inverse() @ poses[b].S_map_scene
            beside.append(pose_error(estimated, truth[a].inverse() @ truth[b], middles[b]).centroid_m)
    out["folded components"] = str(folded)
    out["off from the truth, seen from the component's anchor, m"] = quantiles(off)
    out["off from a capture that shares a room, m"] = quantiles(beside)
    out["poses within 3 of their sigma (99.7 % if honest)"] = f"{inside} of {judged_poses}"
    return out


def quantiles(values: list[float]) -> str:
    if not values:
        return "-"
    return "median {:.3f}, 95 % {:.3f}, worst {:.3f}".format(*np.quantile(values, [0.5, 0.95, 1.0]))


if __name__ == "__main__":
    main()
