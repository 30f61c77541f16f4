"""How levels of detail look from where they are meant to be seen, beside voxels and others' decimation.

    python tools/bench_levels.py CAPTURE.ply... [--splat-transform "node .../splat-transform -g cpu"]

A level of a quarter of the Gaussians has half the detail of a surface: it is seen from twice as far, which is a picture
of half the size; one of a sixteenth (6 %) from four times as far. PSNR against the capture's own render at that size,
from its own cameras (CAPTURE.cameras.json). splat-transform (npm: @playcanvas/splat-transform, node 22) needs a GPU or,
as here, ``-g cpu``.
"""

from __future__ import annotations

import argparse
import os
import resource
import shlex
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np

from gsmap import formats
from gsmap.geometry.decimate import decimate
from gsmap.geometry.voxels import merge_groups, voxel_labels
from gsmap.render import render
from gsmap.types import Cameras, Gaussians

LEVELS = ((0.25, 2), (0.06, 4))
"""Share of the Gaussians, and how many times smaller the pictures are."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", nargs="+", type=Path)
    parser.add_argument("--splat-transform", default="", metavar="COMMAND")
    parser.add_argument("--views", type=int, default=15)
    options = parser.parse_args()
    for path in options.captures:
        g = formats.read(path)
        cameras = formats.read_cameras(path.with_suffix(".cameras.json"))
        cameras = cameras[np.linspace(0, len(cameras) - 1, options.views).astype(int)]
        print(f"{path.name}: {len(g):,} Gaussians")
        for share, smaller in LEVELS:
            seen = cameras.resized(int(cameras.sizes_px[0].max()) // smaller)
            whole, count = pictures(g, seen), int(share * len(g))
            report(f"{share:.0%} decimate", lambda: decimate(g, count)[0], seen, whole)  # noqa: B023
            report(f"{share:.0%} voxels", lambda: voxels(g, count), seen, whole)  # noqa: B023
            if options.splat_transform:
                for way in ("decimate", "decimate-adaptive"):
                    made = lambda: theirs(options.splat_transform, path, way, share)  # noqa: B023, E731
                    report(f"{share:.0%} splat-transform --{way}", made, seen, whole)


def report(name: str, make, cameras: Cameras, whole: np.ndarray) -> None:
    """Make a level, and print what it costs and how its pictures differ."""
    before = cpu_s()
    level = make()
    took = cpu_s() - before
    errors = ((pictures(level, cameras) - whole) ** 2).mean((1, 2, 3))
    decibels = -10 * np.log10(errors)
    print(
        f"  {name:40} {len(level):8,}  {decibels.mean():6.2f} dB, worst {decibels.min():6.2f}  {took:6.1f} CPU s",
        flush=True,
    )


def pictures(g: Gaussians, cameras: Cameras) -> np.ndarray:
    return np.clip(render(g, cameras, depth=False, dominant_id=False).colour, 0, 1)


def voxels(g: Gaussians, count: int) -> Gaussians:
    """At most so many by voxels with moments kept, which levels were made by before."""
    low, high = 1e-4, float(np.ptp(g.means, axis=0).max())
    while high > 1.02 * low:
        size = (low * high) ** 0.5
        low, high = (low, size) if int(voxel_labels(g.means, size).max()) < count else (size, high)
    return merge_groups(g, voxel_labels(g.means, high))[0]


def theirs(command: str, path: Path, way: str, share: float) -> Gaussians:
    with tempfile.TemporaryDirectory() as scratch:
        out = Path(scratch) / "level.ply"
        words = [*shlex.split(command), "-q", "-w", path, f"--{way}", f"{share:.0%}", out]
        subprocess.run(words, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=os.environ)
        return formats.read(out)


def cpu_s() -> float:
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


if __name__ == "__main__":
    main()
