"""Exporting a street: a capture replicated along x until the map is large; memory, what is made again, and seconds.

    python -m tools.bench.export CAPTURE.ply [--millions 10] [--method voxel] [--tile-size 10] [--folder DIR]

Every step runs in a process of its own, so that its peak memory is its own: ingest, export of everything, export again
with nothing changed, export after one more capture arrived.
"""

from __future__ import annotations

import argparse
import json
import math
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import gsmap
from gsmap.geometry.transforms import transform_cameras, transform_gaussians
from gsmap.ingest import read_captures
from gsmap.types import PoseGraph, ScenePose, Sim3
from tools.harness import argument_parser


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--millions", type=float, default=10.0, help="Gaussians in the map")
    parser.add_argument("--method", default="voxel")
    parser.add_argument("--tile-size", type=float, default=10.0)
    parser.add_argument("--folder", type=Path, help="where to work; a temporary folder else")
    parser.add_argument("--step", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.step:
        print(json.dumps(run_step(arguments)))
        return
    folder = arguments.folder or Path(tempfile.mkdtemp(prefix="gsmap-street-"))
    try:
        print(f"{'':16} {'wall s':>8} {'CPU s':>8} {'peak MB':>8}  what")
        for step in ("ingest", "export", "unchanged", "one-more"):
            command = [
                sys.executable,
                "-m",
                "tools.bench.export",
                *sys.argv[1:],
                "--folder",
                str(folder),
                "--step",
                step,
            ]
            result = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
            print(
                f"{step:16} {result['wall_s']:8.1f} {result['cpu_s']:8.1f} {result['peak_mb']:8.0f}  {result['what']}"
            )
    finally:
        if arguments.folder is None:
            shutil.rmtree(folder, ignore_errors=True)


def run_step(arguments: argparse.Namespace) -> dict:
    wall, cpu = time.perf_counter(), time.process_time()
    if arguments.step == "ingest":
        what = ingest(arguments, count_of(arguments))
    else:
        if arguments.step == "one-more":
            ingest(arguments, count_of(arguments) + 1)
            wall, cpu = time.perf_counter(), time.process_time()
        with gsmap.open(arguments.folder / "street.gsmap") as street:
            report = street.export(arguments.folder / "tiles", merge=arguments.method, tile_size_m=arguments.tile_size)
        what = f"{report.recomputed} tiles made, {report.reused} unchanged, {report.removed} removed"
    return {
        "wall_s": time.perf_counter() - wall,
        "cpu_s": time.process_time() - cpu,
        "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "what": what,
    }


def count_of(arguments: argparse.Namespace) -> int:
    (capture,) = read_captures(arguments.capture)
    return math.ceil(arguments.millions * 1e6 / len(capture.gaussians))


def ingest(arguments: argparse.Namespace, count: int) -> str:
    """Bring the map to ``count`` replicas side by side, each in a frame of its own."""
    from gsmap.map import open_or_create

    (capture,) = read_captures(arguments.capture)
    step_m = 0.9 * np.ptp(np.percentile(capture.gaussians.means, [1, 99], axis=0)[:, 0])
    poses = {}
    with open_or_create(arguments.folder / "street.gsmap") as street:
        for i in range(count):
            # A frame of its own makes it other content; its place in the map takes that back.
            S_scene_capture = Sim3(np.eye(3), [0.1 * i, 0.0, 0.0])
            scene, _ = street.store.scenes.add(
                transform_gaussians(capture.gaussians, S_scene_capture),
                transform_cameras(capture.cameras, S_scene_capture),
                name=f"house-{i:03d}",
            )
            S_map_capture = Sim3(np.eye(3), [step_m * i, 0.0, 0.0])
            poses[scene.id] = ScenePose(scene.id, S_map_capture @ S_scene_capture.inverse(), 0, "placed")
        street.store.revisions.save(PoseGraph(poses))
    return f"{count} captures, {count * len(capture.gaussians) / 1e6:.1f} million Gaussians"


if __name__ == "__main__":
    main()
