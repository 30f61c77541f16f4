"""A made city of many million Gaussians in one file: ingest, 3D Tiles, and one more capture; CPU seconds and memory.

    python -m tools.bench.city [--millions 100] [--sh-degree 0] [--merge union] [--tile-size 50] [--views N]
        [--folder DIR]

Every step runs in a process of its own, so that its peak memory is its own. The city is written as an INRIA .ply of one
scene (`gsmap_synthetic.city`), which is not counted. The capture that comes later is one block of 20 m, made anew.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import gsmap
from gsmap import formats
from gsmap.map import open_or_create
from gsmap.types import PoseGraph, ScenePose, Sim3
from gsmap_synthetic.city import BLOCK_M, PER_BLOCK, City
from tools.harness import argument_parser, cpu_s, peak_mb

STEPS = ("make", "ingest", "tiles", "unchanged", "one-more", "tiles again")


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--millions", type=float, default=100.0, help="Gaussians of the city")
    parser.add_argument("--sh-degree", type=int, default=0)
    parser.add_argument("--merge", default="union")
    parser.add_argument("--tile-size", type=float, default=50.0, help="metres")
    parser.add_argument("--views", type=int, help="that a level is fitted to; 0: merged only; by default as exports do")
    parser.add_argument("--folder", type=Path, help="where to work, and to stay; a temporary folder else")
    parser.add_argument("--step", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.step:
        print(json.dumps(run_step(arguments)))
        return
    folder = arguments.folder or Path(tempfile.mkdtemp(prefix="gsmap-city-"))
    try:
        print(f"{'':12} {'CPU s':>8} {'wall s':>8} {'peak MB':>8}  what", flush=True)
        for step in STEPS:
            command = [sys.executable, "-m", "tools.bench.city", *sys.argv[1:], "--folder", str(folder), "--step", step]
            found = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout)
            print(
                f"{step:12} {found['cpu_s']:8.1f} {found['wall_s']:8.1f} {found['peak_mb']:8.0f}  {found['what']}",
                flush=True,
            )
    finally:
        if arguments.folder is None:
            shutil.rmtree(folder, ignore_errors=True)


def run_step(arguments: argparse.Namespace) -> dict:
    folder, city = arguments.folder, City(round(arguments.millions * 1e6 / PER_BLOCK), 0, arguments.sh_degree)
    folder.mkdir(exist_ok=True)
    wall, cpu = time.perf_counter(), cpu_s()
    if arguments.step == "make":
        formats.write(folder / "city.ply", city)
        what = f"{city.num_gaussians / 1e6:.0f} million Gaussians, {(folder / 'city.ply').stat().st_size / 1e9:.1f} GB"
    elif arguments.step == "ingest":
        with open_or_create(folder / "city.gsmap") as m:
            (row,) = m.ingest(folder / "city.ply")
            what = f"{sum(f.stat().st_size for f in (folder / 'city.gsmap').rglob('*') if f.is_file()) / 1e9:.1f} GB"
            placed = ScenePose(row.scene, Sim3.identity(), 0, "placed")
            m.store.revisions.save(PoseGraph({row.scene: placed}))
    elif arguments.step == "one-more":
        middle = city.num_blocks // 2 + city.side // 2
        corner = BLOCK_M * np.array([*divmod(middle, city.side)[::-1], 0.0])
        block = City(city.num_blocks, 1, arguments.sh_degree).block(middle)
        own = type(block)(block.means - corner, block.quats, block.log_scales, block.logit_opacities, block.sh)
        with open_or_create(folder / "city.gsmap") as m:
            (row,) = m.ingest(own, name="one-more")
            before = m.store.revisions.get()
            placed = ScenePose(row.scene, Sim3(np.eye(3), corner), 0, "placed")
            m.store.revisions.save(PoseGraph({**before.poses, row.scene: placed}))
        what = f"{len(own)} Gaussians"
    else:
        with gsmap.open(folder / "city.gsmap") as m:
            if arguments.views is not None:
                m.with_settings({"export.levels.views": arguments.views})
            report = m.export(
                folder / "tiles", format="3dtiles", merge=arguments.merge, tile_size_m=arguments.tile_size
            )
        what = f"{report.recomputed} tiles made, {report.reused} unchanged"
    return {
        "wall_s": time.perf_counter() - wall,
        "cpu_s": cpu_s() - cpu,
        "peak_mb": peak_mb(),
        "what": what,
    }


if __name__ == "__main__":
    main()
