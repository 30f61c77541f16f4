"""Captures that are stretched along one axis: how many accepted pairs say so, and how well they measure it.

    python -m tools.bench.stretch --made 21 22 23 24 [--percent 0 1 2 3 4] [--captures FOLDER --pairs c0:c1 c1:c2]

Every place is captured twice. The second capture is ingested as it is and stretched by each percentage along an axis
drawn at random, with its cameras, and each is registered with the first one. ``--captures`` takes pairs of a folder of
captures (NAME.ply, NAME.cameras.json) besides. One row for each percentage: pairs, accepted ones, accepted ones that
say that they are stretched (all but the first row should), and the largest error of the stretch that they name.
"""

from __future__ import annotations

import re
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

import gsmap.map
from gsmap import formats
from gsmap.geometry.rotations import matrices_to_quats, quats_to_matrices
from gsmap.map import Map
from gsmap.types import Cameras, Gaussians
from gsmap_synthetic import make_captures, write_captures
from tools.harness import argument_parser, print_table, say

_NAMED = re.compile(r"change by ([+-][\d.]+)% along")
Capture = tuple[Gaussians, Cameras]


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--made", type=int, nargs="*", default=[21, 22, 23, 24], help="seeds of places")
    parser.add_argument("--percent", type=float, nargs="+", default=[0, 1, 2, 3, 4])
    parser.add_argument("--captures", type=Path, help="folder of captures")
    parser.add_argument("--pairs", nargs="*", default=[], help="of captures, A:B")
    given = parser.parse_args()
    rng = np.random.default_rng(0)
    counts = {percent: [0, 0, 0, 0.0] for percent in given.percent}
    with tempfile.TemporaryDirectory(prefix="gsmap-stretch-") as folder:
        for name, target, source in _pairs(given.made, given.captures, given.pairs, Path(folder)):
            with gsmap.map.create(Path(folder) / f"{name}.gsmap") as m:
                for percent, row in counts.items():
                    _measure(m, target, source, percent, int(rng.integers(3)), row)
            say(name)
    columns = ["stretch, %", "pairs", "accepted", "named as stretched", "largest error of the stretch, %"]
    print_table(columns, [[percent, *row[:3], f"{row[3]:.2f}"] for percent, row in counts.items()])


def _pairs(seeds: list[int], captures: Path | None, pairs: list[str], folder: Path):
    for seed in seeds:
        place = folder / f"place{seed}"
        made = make_captures(seed, 2, steps=0, num_frames=40, num_gaussians=40_000, size_px=(240, 180))
        yield f"place {seed}", *(_read(place, path.stem) for path in write_captures(place, made))
    for pair in pairs:
        yield pair.replace(":", "-"), *(_read(captures, name) for name in pair.split(":"))


def _read(folder: Path, name: str) -> Capture:
    return formats.read(folder / f"{name}.ply"), formats.read_cameras(folder / f"{name}.cameras.json")


def _measure(m: Map, target: Capture, source: Capture, percent: float, axis: int, row: list) -> None:
    """Register a stretched source with the target, and count it in a row."""
    if not m.scene_rows():
        m.ingest(target[0], cameras=target[1], name="target")
    gaussians, cameras = stretched(*source, percent, axis)
    name = f"stretched {percent:g}"
    m.ingest(gaussians, cameras=cameras, name=name)
    m.describe()
    (edge,) = m.register(f"target:{name}")
    named = [float(found[1]) for note in m.show_pair(f"target:{name}").notes if (found := _NAMED.search(note))]
    row[0] += 1
    row[1] += edge.status == "accepted"
    row[2] += bool(named)
    # Relative to the other directions, what was stretched must shrink to fit, or the other capture must grow.
    wanted = 100 * (1 / (1 + percent / 100) - 1) if edge.source_name == name else percent
    row[3] = max([row[3], *(abs(value - wanted) for value in named)])


def stretched(gaussians: Gaussians, cameras: Cameras, percent: float, axis: int) -> Capture:
    """Stretch a capture along an axis of its frame."""
    A = np.eye(3)
    A[axis, axis] += percent / 100
    shapes = quats_to_matrices(gaussians.quats.astype(np.float64)) * np.exp(gaussians.log_scales)[:, None]
    turns, scales, _ = np.linalg.svd(A @ shapes)
    turns[:, :, 2] *= np.linalg.det(turns)[:, None]
    poses = cameras.T_frame_camera.copy()
    poses[:, :3, 3] = poses[:, :3, 3] @ A.T
    means = gaussians.means.astype(np.float64) @ A.T
    moved = replace(gaussians, means=means, quats=matrices_to_quats(turns), log_scales=np.log(scales))
    return moved, replace(cameras, T_frame_camera=poses)


if __name__ == "__main__":
    main()
