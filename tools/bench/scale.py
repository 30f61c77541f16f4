"""What an update, and a look at a map, cost as the map grows: CPU seconds, SQL statements, graphs loaded, bytes.

    python -m tools.bench.scale                               # maps of 10, 100 and 1,000 scenes
    python -m tools.bench.scale --scenes 10 100 1000 10000 --updates 100 --cache FOLDER
    python -m tools.bench.scale --scenes 10 1000 10000 --updates 0 --lookup --maps FOLDER
    python -m tools.bench.scale --verbs                       # what every verb costs on these maps
    python -m tools.bench.scale --diagonal 4000               # only exports a street of 16 km along the diagonal

The maps are filled, not made: a street on which every capture sees what its neighbours see. All rows are real (scenes,
graphs, ten registrations a scene of which two or three are accepted, a real solve), and so is all that reads them; what
is made up is stated here. Two captures are really ingested, described and registered with each other; the scenes of a
map share their arrays and, copied under keys of their own, their registration. So a catalog here lacks the rows of
`files` that scenes of their own would have (a line says how many bytes those are). The scene's own share, describing
and registering it, does not grow with the map; here its results are made, and the line "own share" says what they cost.
"""

# Thread counts must be set before numpy comes in.
# ruff: noqa: E402
from __future__ import annotations

import os

from tools.harness import argument_parser, print_table, timed

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "GSMAP_WORKERS"):
    os.environ[_name] = "1"

import argparse
import gc
import json
import resource
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import numpy as np

import gsmap.map
from gsmap.cli import COLLECT_AFTER
from gsmap.export import plan_tiles
from gsmap.geometry.rotations import exp_so3
from gsmap.types import Cameras, Gaussians, PoseGraph, ScenePose, Sim3
from tools.bench.spent import Spent, spent
from tools.make.large_maps import TRIED, Filled, Pattern, filled, kept, pattern, verbs


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--scenes", nargs="+", type=int, default=[10, 100, 1000])
    parser.add_argument(
        "--updates", type=int, default=20, help="one-scene updates before the catalog is weighed, 0: not"
    )
    parser.add_argument("--tiles", nargs="+", type=int, default=[100, 1000, 10_000])
    parser.add_argument("--lookup", action="store_true", help="also let the map say which pairs to try")
    parser.add_argument("--verbs", action="store_true", help="only what every verb costs")
    parser.add_argument("--diagonal", type=int, metavar="N", help="only export N small captures along the diagonal")
    parser.add_argument("--cache", type=Path, help="keep the two real captures here")
    parser.add_argument("--maps", type=Path, help="keep filled maps here: 10,000 scenes take minutes to fill")
    options = parser.parse_args()
    gc.set_threshold(COLLECT_AFTER)  # as the command line does
    if options.diagonal:
        exporting(options.diagonal)
        return
    with tempfile.TemporaryDirectory() as scratch:
        made = pattern(options.cache or Path(scratch) / "pattern")
        print(f"own share of one scene: describe {made.describe_s:.2f} CPU s, a pair {made.register_s:.2f} CPU s")
        rows = []
        for num in options.scenes:
            with opened(Path(scratch) / f"{num}.gsmap", num, made, options) as one:
                if options.verbs:
                    rows.append(of_verbs(one, Path(scratch) / f"{num}-verbs"))
                else:
                    rows.append(measured(one, made, options))
                more = one.num_scenes - num
            if options.updates and not options.verbs:
                with filled(Path(scratch) / f"{num}-at-once.gsmap", num, made) as one:
                    for _ in range(more):
                        one.add()
                    one.map.update()
                    rows[-1]["catalog MB, made at once"] = one.catalog_bytes() / 1e6
            print(json.dumps({"scenes": num} | rows[-1]), flush=True)
        table(options.scenes, rows)
        if options.verbs:
            return
    print("plan_tiles (tiles of 10 m, reach 11 m), CPU s")
    for name, place in (("street along an axis", _straight), ("street along the diagonal", _diagonal)):
        print(
            f"  {name}: " + ", ".join(f"{num} scenes {planning(num, place):.2f}" for num in options.tiles), flush=True
        )


def opened(path: Path, num: int, made: Pattern, options: argparse.Namespace) -> AbstractContextManager[Filled]:
    """A filled map, or a copy of one that is kept."""
    if options.maps is None:
        return filled(path, num, made, asked=options.lookup)
    options.maps.mkdir(parents=True, exist_ok=True)
    name = f"{num}-asked" if options.lookup else f"{num}"
    return kept(options.maps / name, num, made, path, asked=options.lookup)


def of_verbs(one: Filled, scratch: Path) -> dict[str, float]:
    """CPU seconds, SQL statements and peak memory of every verb, with objects that are up to date but for one scene."""
    scratch.mkdir()
    row: dict[str, float] = {}
    for _ in range(2):  # the frame of the first solve is not that of the later ones
        one.add()
        one.map.update()
        with counted(one) as count:
            one.map.objects()
    row |= {f"graph, few known, {name}": value for name, value in count.items() if name != "graphs"}
    for name, call in verbs(one, scratch).items():
        gc.collect()
        with counted(one) as count:
            call()
        row |= {f"{name}, {k}": v for k, v in count.items() if k != "graphs"}
        print(f"  {name}: {count['CPU s']:.2f} CPU s, {count['SQL']} statements", flush=True)
    row["peak memory MB"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return {name: round(float(value), 4) for name, value in row.items()}


def measured(one: Filled, made: Pattern, options: argparse.Namespace) -> dict[str, float]:
    """What a filled map costs, part by part."""
    m, row = one.map, {}
    with counted(one) as count:
        m.update()
    row |= {f"no-op {name}": value for name, value in count.items()}
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with counted(one) as count, parts() as steps:
        one.add()
        m.update()
    row |= {f"update {name}": value for name, value in count.items()} | {
        f"  {part} CPU s": seconds for part, seconds in steps.seconds.items()
    }
    row["update memory MB"] = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    scene = m.scenes()[-1].name
    looks: dict[str, Callable[[], Any]] = {
        "list revisions": m.revision_rows,
        "show SCENE": lambda: m.show_scene(scene),
        "show A:B": lambda: m.show_pair(one.some_pair()),
        "status": m.status,
    }
    for name, look in looks.items():
        with counted(one) as count:
            look()
        row |= {f"{name} {k}": v for k, v in count.items() if k != "graphs"}
    size = one.catalog_bytes()
    for _ in range(options.updates):
        one.add()
        m.update()
    row["bytes an update"] = (one.catalog_bytes() - size) / max(options.updates, 1)
    row["catalog MB"] = one.catalog_bytes() / 1e6
    if options.lookup:
        with one.standing_in(lookup=True):
            m.update()  # what came above had its pairs given, and has not asked
            one.add()
            # As a process of its own has it: nothing that was read above is in memory.
            with one.anew(), counted(one) as count:
                report = one.map.update()
            row |= {f"update, pairs looked up, {name}": value for name, value in count.items()}
            row["  pairs tried"] = len(report.edges)
            own = made.describe_s + TRIED * made.register_s
            row["  CPU s with the own share of one with ten pairs"] = own + count["CPU s"]
            with one.anew(), counted(one) as count:
                one.map.update()
            row |= {f"no-op, pairs looked up, {name}": value for name, value in count.items()}
        with one.anew(), counted(one) as count:
            one.map.status()
        row |= {f"status, map just opened, {name}": value for name, value in count.items()}
    m.prune(keep_revisions=1)
    row["catalog MB, pruned"] = one.catalog_bytes() / 1e6
    row["files rows MB of scenes with arrays of their own"] = one.num_scenes * made.file_rows_bytes / 1e6
    return {name: round(float(value), 4) for name, value in row.items()}


@contextmanager
def counted(one: Filled) -> Iterator[dict[str, float]]:
    """CPU seconds, SQL statements and graphs loaded inside."""
    out: dict[str, float] = {}
    with one.counting() as counts:
        start = time.process_time()
        yield out
        out["CPU s"] = time.process_time() - start
    out |= {"SQL": counts["sql"], "graphs": counts["graphs"]}


def parts() -> AbstractContextManager[Spent]:
    """CPU seconds of the steps of an update, each without those inside it."""
    from gsmap.map import reports
    from gsmap.map.stages import describe, optimize, register

    steps = [
        ("describe", describe, "describe"),
        ("look up and register", register, "register"),
        ("poses: what names them", optimize, "pose_basis"),
        ("poses: edges", optimize, "_edges"),
        ("poses: solve", optimize.solver, "optimize"),
        ("poses: place", optimize.solver, "grow"),
        ("poses: keep still", optimize.solver, "keep_unchanged_poses"),
        ("poses: load", optimize, "_inputs"),
        ("poses: save", optimize, "_optimize"),
        ("poses: save", optimize, "_grow"),
        ("report", reports, "update_report"),
    ]
    return spent(steps)


def table(scenes: Sequence[int], rows: Sequence[dict[str, float]]) -> None:
    """A line for each figure, with the exponent of its growth over the last decade."""
    lines = []
    for name in dict.fromkeys(name for row in rows for name in row):
        values = [row.get(name, float("nan")) for row in rows]
        grown = ""
        if len(values) > 1 and min(values[-2:]) > 0:
            grown = f"{np.log(values[-1] / values[-2]) / np.log(scenes[-1] / scenes[-2]):.2f}"
        lines.append([name, *(f"{value:,.6g}" for value in values), grown])
    print_table(["", *(f"{num:,}" for num in scenes), "exponent"], lines)


def _straight(i: int) -> list[float]:
    return [4.0 * i, 0.0, 0.0]


def _diagonal(i: int) -> list[float]:
    return [2.83 * i, 2.83 * i, 0.0]


def planning(num: int, place: Callable[[int], list[float]]) -> float:
    poses = {f"s{i:05d}": Sim3(exp_so3([0, 0, 0.1 * i]), place(i)) for i in range(num)}
    bounds = dict.fromkeys(poses, np.array([[-4.0, -4, -1], [4, 4, 3]]))
    return timed(plan_tiles, poses, bounds, tile_size_m=10.0, reach_m=11.0)[1]


def exporting(num: int) -> None:
    """Captures of 200 Gaussians each, 4 m apart along the diagonal, exported in tiles of 10 m."""
    rng, poses = np.random.default_rng(0), {}
    unseen = Cameras(np.zeros((0, 4, 4)), np.zeros((0, 4)), np.zeros((0, 2)))
    with tempfile.TemporaryDirectory() as scratch, gsmap.map.create(Path(scratch) / "map.gsmap") as m:
        for i in range(num):
            means = rng.uniform([-4.0, -4, -1], [4, 4, 3], (200, 3))
            own = Gaussians(means, np.tile([1.0, 0, 0, 0], (200, 1)), np.full((200, 3), -3.0), np.ones(200),
                            np.zeros((200, 1, 3)))  # fmt: skip
            scene, _ = m.store.scenes.add(own, unseen, name=f"s{i:05d}")
            poses[scene.id] = ScenePose(scene.id, Sim3(exp_so3([0, 0, 0.1 * i]), _diagonal(i)), 0, "placed")
        m.store.revisions.save(PoseGraph(poses))
        for again in (False, True):
            report, spent_s = timed(m.export, Path(scratch) / "tiles", merge="union", tile_size_m=10.0)
            held = sum(tile.num_gaussians for tile in report.tiles)
            print(
                f"{'again' if again else 'at once'}: {num} scenes over {4e-3 * num:.1f} km, {len(report.tiles)} tiles, "
                f"{held} of {200 * num} Gaussians, {spent_s:.1f} CPU s"
            )


if __name__ == "__main__":
    main()
