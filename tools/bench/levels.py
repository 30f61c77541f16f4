"""How levels of detail look from where they are meant to be seen, beside voxels and others' decimation.

    python -m tools.bench.levels CAPTURE.ply... [--splat-transform "node .../splat-transform -g cpu"]
    python -m tools.bench.levels --tree COUNT [--fit VIEWS STEPS]

A level of a quarter of the Gaussians has half the detail of a surface: it is seen from twice as far, which is a picture
of half the size; one of a sixteenth (6 %) from four times as far. PSNR against the capture's own render at that size,
from cameras of its own (CAPTURE.cameras.json) that the level was not fitted to. splat-transform (npm:
@playcanvas/splat-transform, node 22) needs a GPU or, as here, ``-g cpu``.

--tree: CPU seconds and memory of the levels over a made scene of so many Gaussians in tiles of 100,000, cameras
included, as an export of 3D Tiles makes them. What makes the tiles is not counted.
"""

from __future__ import annotations

import json
import os
import resource
import shlex
import subprocess
import tempfile
from pathlib import Path

import numpy as np

from gsmap import formats
from gsmap.export.levels import Params, make_level
from gsmap.export.tileset import write_tilesets
from gsmap.formats import tiles3d
from gsmap.geometry.decimate import decimate
from gsmap.geometry.voxels import merge_groups, voxel_labels
from gsmap.render import render
from gsmap.types import Cameras, Gaussians, Sim3, Tile
from tools.harness import argument_parser, cpu_s

LEVELS = ((0.25, 2), (0.06, 4))
"""Share of the Gaussians, and how many times smaller the pictures are."""


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("captures", nargs="*", type=Path)
    parser.add_argument("--tree", type=int, metavar="COUNT")
    parser.add_argument("--splat-transform", default="", metavar="COMMAND")
    parser.add_argument("--views", type=int, default=15)
    parser.add_argument("--fit", type=int, nargs=2, metavar=("VIEWS", "STEPS"), help="of levels, other than by default")
    options = parser.parse_args()
    params = Params(*options.fit) if options.fit else Params()
    if options.tree:
        tree(options.tree, params)
    for path in options.captures:
        g = formats.read(path)
        cameras = formats.read_cameras(path.with_suffix(".cameras.json"))
        shown = np.linspace(0, len(cameras) - 1, options.views).astype(int)
        others = cameras[np.setdiff1d(np.arange(len(cameras)), shown)]
        cameras = cameras[shown]
        print(f"{path.name}: {len(g):,} Gaussians")
        for share, smaller in LEVELS:
            seen = cameras.resized(int(cameras.sizes_px[0].max()) // smaller)
            whole, count = pictures(g, seen), int(share * len(g))
            report(f"{share:.0%} gsmap", lambda: make_level(g, count, others, params).gaussians, seen, whole)  # noqa: B023
            report(f"{share:.0%} gsmap, merged only", lambda: decimate(g, count)[0], seen, whole)  # noqa: B023
            report(f"{share:.0%} voxels", lambda: voxels(g, count), seen, whole)  # noqa: B023
            if options.splat_transform:
                for way in ("decimate", "decimate-adaptive"):
                    made = lambda: theirs(options.splat_transform, path, way, share)  # noqa: B023, E731
                    report(f"{share:.0%} splat-transform --{way}", made, seen, whole)


def tree(count: int, params: Params) -> None:
    """The levels above tiles of 10 m, made of tiles that are made one by one."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        (out / "component_0").mkdir()
        (out / "tiles.json").write_text("{}")
        side = max(1, round((count / 100_000) ** 0.5))
        tiles, cameras = [], []
        for i, (x, y) in enumerate((x, y) for x in range(side) for y in range(side)):
            g = room(i, count // side**2, np.array([10.0 * x, 10.0 * y, 0]))
            path = f"component_0/tile_{x:+04d}_{y:+04d}_+000.glb"
            tiles3d.write_content(out / path, g)
            low = np.array([10.0 * x, 10.0 * y, -1])
            bounds = np.stack([low, low + 10])
            tiles.append(
                Tile(f"k{i}", 0, bounds, {"0" * 32: Sim3.identity()}, len(g), {}, False, path, f"tile {i}", ())
            )
            cameras.append(around(i, low + np.array([5, 5, 2.6])))
        poses = np.concatenate(cameras)
        intrinsics = np.tile([240.0, 240.0, 160.0, 120.0], (len(poses), 1))
        all_cameras = Cameras(poses, intrinsics, np.tile([320, 240], (len(poses), 1)))
        print(f"{count:,} Gaussians in {len(tiles)} tiles, {len(poses)} cameras", flush=True)
        before = cpu_s()
        (file,) = write_tilesets(out, tiles, cameras=lambda component: all_cameras, levels=params)
        took = cpu_s() - before
        levels = [json.loads(file.read_text())["root"]]
        for node in levels:
            levels += [child for child in node.get("children", ()) if child.get("children")]
        found = [node["extras"]["psnr_db"] for node in levels if "psnr_db" in node.get("extras", {})]
        most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        print(
            f"  {len(levels)} levels, {took:.0f} CPU s, {1e6 * took / count:.0f} us a Gaussian, {most:.0f} MB at most; "
            f"median of the levels' PSNR {np.median(found) if found else float('nan'):.1f} dB"
        )


def room(seed: int, count: int, at: np.ndarray) -> Gaussians:
    """A floor, two walls and clutter, coloured in patches."""
    rng = np.random.default_rng(seed)
    means = rng.uniform(0, [10, 10, 3], (count, 3))
    kind = rng.integers(0, 4, count)
    means[kind == 0, 2] = 0
    means[kind == 1, 0] = 0.2
    means[kind == 2, 1] = 9.8
    means[kind == 3] = np.clip(rng.normal([5, 5, 0.5], [2, 2, 0.4], ((kind == 3).sum(), 3)), 0, 10)
    means[:, 2] += 0.02 * np.sin(means[:, 0] * 5)
    sh = np.zeros((count, 4, 3))
    sh[:, 0] = 0.9 * np.sin(means @ rng.normal(0, 3, (3, 3))) + rng.normal(0, 0.15, (count, 3))
    sh[:, 1:] = rng.normal(0, 0.05, (count, 3, 3))
    log_scales = rng.normal(np.log(0.03), 0.4, (count, 3))
    return Gaussians(means + at, rng.normal(size=(count, 4)), log_scales, rng.normal(2, 1, count), sh)


def around(seed: int, eye: np.ndarray, count: int = 12) -> np.ndarray:
    """(count, 4, 4) poses of cameras that look all round, a little down; z is up."""
    rng = np.random.default_rng(seed)
    out = np.tile(np.eye(4), (count, 1, 1))
    for k, angle in enumerate(2 * np.pi * (np.arange(count) + rng.uniform()) / count):
        front = np.array([np.cos(angle), np.sin(angle), -0.3])
        front /= np.linalg.norm(front)
        right = np.cross(front, [0, 0, 1])
        right /= np.linalg.norm(right)
        out[k, :3, :3] = np.stack([right, np.cross(front, right), front], axis=1)
        out[k, :3, 3] = eye - 3 * front * [1, 1, 0]
    return out


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


if __name__ == "__main__":
    main()
