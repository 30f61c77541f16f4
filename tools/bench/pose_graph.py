"""Measures the optimiser against gtsam's own solvers, PCM-style pruning and a clean-graph oracle.

    python -m tools.bench.pose_graph                       # N = 100, 1000; 10, 30, 50 % wrong edges; 3 seeds
    python -m tools.bench.pose_graph --scenes 10000 --wrong 0.3 --seeds 1 --limit-s 120
    python -m tools.bench.pose_graph --g2o FOLDER          # also the .g2o sets of a folder
    python -m tools.bench.pose_graph --twins 20            # also buildings with two wings that look the same
    python -m tools.bench.pose_graph --json out.json

Worlds are those of the tests (`tests/optimize/made_worlds.py`): scenes on a floor, five edges per scene between
neighbours, noise 0.5 deg and 5 cm, wrong edges between random scenes with random poses. ATE is in metres, over the
scenes each method places in its largest component (``placed``: their share); ``/oracle`` divides it by that of gtsam's
Levenberg-Marquardt from the true poses on the right edges alone, over the same scenes. ``bad`` counts wrong edges that
were used. CPU seconds are process time of the solve alone; each run has its own process and stops at ``--limit-s``.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from tools.harness import argument_parser, timed

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "optimize")]
METHODS = ("gsmap", "lm", "lm+cauchy", "gnc", "pcm", "oracle")


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--scenes", type=int, nargs="+", default=[100, 1000])
    parser.add_argument("--wrong", type=float, nargs="+", default=[0.1, 0.3, 0.5])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--methods", nargs="+", default=list(METHODS), choices=METHODS)
    parser.add_argument("--limit-s", type=int, default=60, help="CPU seconds for one run")
    parser.add_argument("--marginals", action="store_true", help="also compute covariances in gsmap's runs")
    parser.add_argument("--place", type=int, default=0, help="also place this many scenes one by one in 1000")
    parser.add_argument("--twins", type=int, default=0, help="also this many seeds of look-alike wings of each size")
    parser.add_argument(
        "--alike", type=float, nargs="+", default=[0.03, 0.08], help="shares of edges that look-alike wings add"
    )
    parser.add_argument("--g2o", type=Path, help="folder of .g2o files")
    parser.add_argument("--json", type=Path, help="write all rows here")
    parser.add_argument("--worker", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.worker:
        task = json.loads(args.worker)
        resource.setrlimit(resource.RLIMIT_CPU, (task["limit_s"], resource.RLIM_INFINITY))
        print(json.dumps(run_g2o(task) if "file" in task else run_place(task) if "place" in task else run(task)))
        return

    rows = []
    print("scenes  wrong     method    ATE m  /oracle  placed used bad   CPU s")
    for scenes in args.scenes:
        for share in args.wrong:
            found = {m: [] for m in args.methods}
            for method in args.methods:
                for seed in range(args.seeds):
                    task = {"scenes": scenes, "share": share, "seed": seed, "method": method}
                    row = spawn({**task, "limit_s": args.limit_s, "marginals": args.marginals})
                    found[method].append({**task, **row})
            rows += [row for group in found.values() for row in group]
            report(scenes, share, found)
    if args.place:
        row = spawn({"place": args.place, "limit_s": args.limit_s * 4})
        rows.append(row)
        if "median_ms" in row:
            speed = f"median {row['median_ms']:.1f} ms CPU, p90 {row['p90_ms']:.1f}, {row['full']} full solves"
            print(f"placing one scene in 1000: {speed}")
    if args.twins:
        rows += [run_twins(args.twins, share, seeing) for share in args.alike for seeing in (False, True)]
    for file in sorted(args.g2o.glob("*.g2o")) if args.g2o else []:
        row = {"file": file.name, **spawn({"file": str(file), "limit_s": args.limit_s})}
        rows.append(row)
        print(
            f"{file.name:>22}: error {row.get('error', float('nan')):.6g}, CPU {row.get('cpu_s', float('nan')):.2f} s"
        )
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1))


def spawn(task: dict) -> dict:
    command = [sys.executable, "-m", "tools.bench.pose_graph", "--worker", json.dumps(task)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode == 0:
        return json.loads(done.stdout.splitlines()[-1])
    late = done.returncode in (-24, -9)  # SIGXCPU
    return {"failed": "timeout" if late else done.stderr.strip().splitlines()[-1:]}


def report(scenes: int, share: float, found: dict[str, list[dict]]) -> None:
    def middle(method: str, key: str) -> float:
        values = [row[key] for row in found.get(method, ()) if key in row]
        return float(np.median(values)) if values else float("nan")

    for method, group in found.items():
        ratio = middle(method, "ratio")
        late = sum("failed" in row for row in group)
        note = f"  ({late} of {len(group)} failed: {next(r['failed'] for r in group if 'failed' in r)})" if late else ""
        print(
            f"{scenes:7d} {share:6.0%} {method:>10} {middle(method, 'ate_m'):8.3f} {ratio:8.3f} "
            f"{middle(method, 'placed'):7.1%} {middle(method, 'used_wrong'):8.0f} {middle(method, 'cpu_s'):7.2f}{note}",
            flush=True,
        )


def run(task: dict) -> dict:
    from made_worlds import city

    from gsmap.evaluate.registration import absolute_trajectory_error
    from gsmap.geometry.similarities import Similarities
    from gsmap.optimize import Params, optimize

    world = city(task["scenes"], task["share"], task["seed"])
    optimize(world.ids[:2], [])  # imports are not the solver's time
    begin = time.process_time()
    if task["method"] == "gsmap":
        answer = optimize(world.ids, world.edges, params=Params(marginals=task["marginals"]))
        seconds = time.process_time() - begin
        rows = world.placed(answer)
        poses = Similarities.stack([answer.poses[s].S_map_scene for s in world.ids])
        used_wrong = sum(answer.use(*key) == "used" for key in world.wrong_keys)
    else:
        poses, rows, used = peer(task["method"], world)
        seconds = time.process_time() - begin
        used_wrong = int((used & world.wrong).sum())
    resource.setrlimit(resource.RLIMIT_CPU, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    best, _, _ = peer("oracle", world) if task["method"] != "oracle" else (poses, rows, None)
    truth = world.truth.translations[rows]
    ate = absolute_trajectory_error(poses.translations[rows], truth)
    return {
        "ate_m": ate,
        "ratio": ate / absolute_trajectory_error(best.translations[rows], truth),
        "placed": len(rows) / len(world.ids),
        "used_wrong": used_wrong,
        "cpu_s": seconds,
    }


def peer(method: str, world):
    """gtsam's solvers on all edges, on those that two consistent triangles support (PCM's pairwise test), or, for the
    oracle, on the right ones from the true poses."""
    import gtsam

    from gsmap.geometry.similarities import Similarities
    from gsmap.optimize.cycles import count_cycle_support
    from gsmap.optimize.gtsam_solve import GAUGE_SIGMAS, from_gtsam, to_gtsam
    from gsmap.optimize.measurements import measurements
    from gsmap.optimize.robust import spanning_tree_init
    from gsmap.optimize.structure import component_labels

    m = measurements(world.ids, world.edges)
    n = m.num_scenes
    used = np.ones(len(m), dtype=bool)
    if method == "oracle":
        used = ~np.array([key in world.wrong_keys for key in m.keys])
    if method == "pcm":
        used = count_cycle_support(m, 0.999).agree >= 2
    labels = component_labels(m, np.flatnonzero(used))
    lead = labels == np.argmax(np.bincount(labels))
    used &= lead[m.targets]
    scenes, rows = np.flatnonzero(lead), np.flatnonzero(used)
    graph = gtsam.NonlinearFactorGraph()
    noise = gtsam.noiseModel.Gaussian.Information(m.information[0])
    if method == "lm+cauchy":
        noise = gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Cauchy.Create(1.0), noise)
    for k in rows.tolist():
        graph.push_back(
            gtsam.BetweenFactorPose3(int(m.targets[k]), int(m.sources[k]), to_gtsam(m.measured, k, 6), noise)
        )
    anchor = int(scenes[0])
    graph.push_back(gtsam.PriorFactorPose3(anchor, gtsam.Pose3(), gtsam.noiseModel.Diagonal.Sigmas(GAUGE_SIGMAS[:6])))
    if method == "oracle":
        start = gtsam.Values()
        for k in scenes.tolist():
            start.insert(k, to_gtsam(world.truth, k, 6))
    elif method in ("lm", "pcm"):
        start = gtsam.InitializePose3.initialize(graph)
    else:
        cost = np.random.default_rng(0).random(len(rows)) + 0.1  # any spanning tree
        tree = spanning_tree_init(m, rows, cost, Similarities.identity(n))
        start = gtsam.Values()
        for k in scenes.tolist():
            start.insert(k, to_gtsam(tree, k, 6))
    params = gtsam.LevenbergMarquardtParams.CeresDefaults()
    params.setMaxIterations(100)
    if method == "gnc":
        settings = gtsam.GncLMParams(params)
        settings.setKnownInliers([len(rows)])
        values = gtsam.GncLMOptimizer(graph, start, settings).optimize()
    else:
        values = gtsam.LevenbergMarquardtOptimizer(graph, start, params).optimize()
    return Similarities.identity(n).replaced(scenes, from_gtsam(values, scenes, 6)), scenes, used


def run_place(task: dict) -> dict:
    from made_worlds import city

    from gsmap.optimize import optimize

    world = city(1000 + task["place"], 0.1, 0)
    ids = set(world.ids[:1000])
    answer = optimize(world.ids[:1000], [e for e in world.edges if e.target in ids and e.source in ids])
    seconds, full = [], 0
    for count in range(1001, len(world.ids) + 1):
        ids.add(world.ids[count - 1])
        edges = [e for e in world.edges if e.target in ids and e.source in ids]
        answer, took = timed(optimize, world.ids[:count], edges, previous=answer)
        seconds.append(took)
        full += answer.provenance.method == "batch"
    return {
        "median_ms": 1e3 * float(np.median(seconds)),
        "p90_ms": 1e3 * float(np.percentile(seconds, 90)),
        "full": full,
    }


def run_twins(seeds: int, share: float, seeing: bool) -> dict:
    """Two wings that look the same, and a share of edges says so; true edges lead round from one to the other.

    With ``seeing`` every edge comes with what its captures disagree in, drawn as measured on a street of like rooms
    (`tools.bench.alike`, seed 7): log-normal about .056 for right edges and .157 for wrong ones. Worlds where
    fewer than three true edges tie the wings somewhere on the way are left out: nothing is known there.
    """
    from made_worlds import twin_wings, ways_round

    from gsmap.optimize import Params, optimize

    row = {"share": share, "seeing": seeing, "worlds": 0, "folded": 0, "used_wrong": 0, "placed": []}
    for scenes in (150, 300, 1000):
        for door_m in (None, 8.0, 4.0):
            for seed in range(seeds):
                world = twin_wings(scenes, share, seed, door_m)
                if seeing:
                    world.edges = disagreeing(world, seed)
                if ways_round(world) < 3:
                    continue
                answer = optimize(world.ids, world.edges, params=Params(marginals=False))
                row["worlds"] += 1
                row["folded"] += world.worst_island_m(answer) > 0.5
                row["used_wrong"] += any(answer.outcomes[key].use == "used" for key in world.wrong_keys)
                row["placed"].append(len(world.placed(answer)) / scenes)
    row["placed"] = float(np.mean(row["placed"]))
    edges = f"{share:.0%} of the edges, {'disagreeing as in streets' if seeing else 'nothing seen of them'}"
    print(
        f"look-alike wings, {edges}: {row['folded']} of {row['worlds']} worlds have a component off by more than "
        f"0.5 m, {row['used_wrong']} use a wrong edge, {row['placed']:.0%} of the scenes lie in the largest component",
        flush=True,
    )
    return row


def disagreeing(world, seed: int) -> list:
    """The edges with the probability that their captures show two places."""
    from dataclasses import replace

    middle = np.where(world.wrong, 0.0157, 0.0056)
    values = middle * np.exp(np.random.default_rng(seed).normal(0, 0.2, len(middle)))
    return [replace(edge, look_alike=float(v)) for edge, v in zip(world.edges, values, strict=True)]


def run_g2o(task: dict) -> dict:
    from gsmap.geometry.similarities import Similarities
    from gsmap.optimize import Params, optimize
    from gsmap.optimize.measurements import measurements
    from gsmap.optimize.robust import chi_squares
    from tools.pose_graph_files import read_g2o

    graph = read_g2o(Path(task["file"]))
    answer, seconds = timed(optimize, list(graph.poses), graph.edges, params=Params(marginals=False))
    poses = Similarities.stack([p.S_map_scene for p in answer.poses.values()])
    error = chi_squares(measurements(list(graph.poses), graph.edges), poses).sum() / 2
    return {"error": float(error), "cpu_s": seconds}


if __name__ == "__main__":
    main()
