"""The merging table: how close a merged map comes to rendering each capture alone.

    python -m tools.bench.merge CAPTURES [--scenes c0 c1] [--map site.gsmap] [--curve 0.5 0.4] [--tiles 6]

CAPTURES is a folder of captures (``NAME.ply`` with ``NAME.cameras.json``), with ``truth/NAME.json`` holding
``T_scene_world`` and ``frames/`` holding pictures named like cameras. Rows: the oracle (each capture alone, at its own
views), then each merging method, under true poses and, with --map, under the poses that a map made by ``gsmap update``
from the same files estimated. Seconds are wall and CPU of the merge alone. MB is the size of the ``.ply``. "Worst" is
the lowest difference, over captures, of the PSNR to that of the capture alone.

    python -m tools.bench.merge CAPTURES --retrained c0:60 c1:420 --cache DIR    # captures of uneven quality

With --retrained further captures join: each is trained anew for so many steps on renders of the capture named, from
those of its cameras that have no picture. So no picture that judges it was trained on.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from gsmap import formats
from gsmap.evaluate.renders import compare_renders, find_images
from gsmap.export import plan_tiles
from gsmap.geometry.transforms import transform_cameras, transform_gaussians
from gsmap.ingest import Capture, read_captures
from gsmap.merge import default_params, merge, methods, reach_m
from gsmap.merge.tile import LazyScene, merge_tile
from gsmap.render import render
from gsmap.types import Gaussians, MergeResult, PosedScene, Sim3
from gsmap_synthetic.capture import Frames
from gsmap_synthetic.make import fit_frames
from tools.harness import argument_parser


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("captures", type=Path)
    parser.add_argument("--scenes", nargs="+", default=["c0", "c1"], help="names of captures to merge")
    parser.add_argument("--images", type=Path, help="folder of pictures, CAPTURES/frames else")
    parser.add_argument("--retrained", nargs="*", default=[], metavar="NAME:STEPS", help="add such captures")
    parser.add_argument("--cache", type=Path, help="keep retrained captures here")
    parser.add_argument("--map", type=Path, help="a map of the same captures, for rows under estimated poses")
    parser.add_argument("--methods", nargs="*", choices=methods(), default=["union", "distance", "voxel", "tto"])
    parser.add_argument("--curve", nargs="*", type=float, default=[], help="tto at these sizes (share of the union)")
    parser.add_argument("--tiles", type=float, help="also merge in tiles of this edge (m) and compare with one tile")
    parser.add_argument("--json", type=Path, help="write all figures here")
    arguments = parser.parse_args()

    captures = read_captures([arguments.captures / f"{name}.ply" for name in arguments.scenes])
    images = arguments.images or arguments.captures / "frames"
    truth = {c.name: true_pose(arguments.captures / "truth" / f"{c.name}.json") for c in captures}
    for name, steps in (wanted.split(":") for wanted in arguments.retrained):
        source = next(c for c in captures if c.name == name)
        captures.append(retrained(source, int(steps), images, arguments.cache))
        truth[captures[-1].name] = truth[name]
    poses = {"true": truth}
    if arguments.map:
        poses["estimated"] = estimated_poses(arguments.map, truth)
    pictures = {c.name: held_out(c, arguments.captures / "truth", images) for c in captures}
    rows = [oracle_row(captures, pictures)]
    print_title()
    print_row(rows[0])
    for kind, S_map_scene in poses.items():
        for method in arguments.methods:
            add(rows, merge_row(captures, S_map_scene, pictures, method, default_params(method), f"{method} ({kind})"))
        for keep in arguments.curve:
            params = replace(default_params("tto"), kept_fraction=keep)
            add(rows, merge_row(captures, S_map_scene, pictures, "tto", params, f"tto keep={keep:g} ({kind})"))
        if arguments.tiles:
            add(rows, tiled_row(captures, S_map_scene, pictures, arguments.tiles, f"tto, tiles ({kind})"))
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=1))


def retrained(capture: Capture, steps: int, images: Path, cache: Path | None) -> Capture:
    """The capture trained anew, on its own renders from cameras without pictures; kept in the folder ``cache``."""
    name = f"{capture.name}-{steps}"
    kept = None if cache is None else cache / f"{name}.ply"
    if kept is not None and kept.exists():
        gaussians = formats.read(kept)
    else:
        rows = sorted(set(range(len(capture.cameras))) - set(find_images(capture.cameras, images)))
        seen = render(capture.gaussians, capture.cameras[rows])
        frames = Frames((seen.colour.clip(0, 1) * 255).astype(np.uint8), capture.cameras[rows], seen.depth)
        gaussians = fit_frames(frames, steps=steps, num_gaussians=len(capture.gaussians))
        if kept is not None:
            formats.write(kept, gaussians)
    return Capture(gaussians, capture.cameras, name)


def true_pose(path: Path) -> Sim3:
    return Sim3.from_matrix(np.array(json.loads(path.read_text())["T_scene_world"])).inverse()


def estimated_poses(map_folder: Path, truth: dict[str, Sim3]) -> dict[str, Sim3]:
    """Poses as ``gsmap list MAP scenes --json`` tells them; all scenes must lie in one component."""
    command = [sys.executable, "-P", "-m", "gsmap", "list", str(map_folder), "scenes", "--json"]
    scenes = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    placed = {s["name"]: s for s in scenes if s["name"] in truth and s["S_map_scene"] is not None}
    if set(placed) != set(truth) or len({s["component"] for s in placed.values()}) != 1:
        sys.exit(f"{map_folder} does not place {', '.join(sorted(truth))} in one component")
    return {name: Sim3.from_matrix(np.array(s["S_map_scene"])) for name, s in placed.items()}


def held_out(capture: Capture, truth: Path, images: Path) -> dict[int, Path]:
    """Pictures of a capture by camera; only those that it was not trained on where its truth names them."""
    found = find_images(capture.cameras, images)
    about = truth / f"{capture.name}.json"
    names = json.loads(about.read_text()).get("held_out") if about.exists() else None
    return found if names is None else {row: path for row, path in found.items() if capture.cameras.names[row] in names}


def likeness(merged: Gaussians, captures: list[Capture], S_map_scene: dict[str, Sim3], pictures: dict) -> dict:
    """Mean figures over all pictures of all captures, rendered from the captures' cameras in the map."""
    parts = [
        compare_renders(merged, transform_cameras(c.cameras, S_map_scene[c.name]), pictures[c.name]) for c in captures
    ]
    return {
        "psnr_db": float(np.concatenate([p.psnr_db for p in parts]).mean()),
        "ssim": float(np.concatenate([p.ssim for p in parts]).mean()),
        "psnr_db_by_scene": {c.name: float(p.psnr_db.mean()) for c, p in zip(captures, parts, strict=True)},
    }


def oracle_row(captures: list[Capture], pictures: dict) -> dict:
    parts = [compare_renders(c.gaussians, c.cameras, pictures[c.name]) for c in captures]
    count = sum(len(c.gaussians) for c in captures)
    return {
        "name": "oracle (each alone)",
        "psnr_db": float(np.concatenate([p.psnr_db for p in parts]).mean()),
        "ssim": float(np.concatenate([p.ssim for p in parts]).mean()),
        "psnr_db_by_scene": {c.name: float(p.psnr_db.mean()) for c, p in zip(captures, parts, strict=True)},
        "num_gaussians": count,
        "share": 1.0,
        "worst_db": 0.0,
        "mb": ply_mb(captures[0].gaussians) / len(captures[0].gaussians) * count,
    }


def merge_row(captures, S_map_scene, pictures, method, params, name, *, run=None) -> dict:
    scenes = [
        PosedScene(
            transform_gaussians(c.gaussians, S_map_scene[c.name]),
            transform_cameras(c.cameras, S_map_scene[c.name]),
            c.name,
            c.captured_at,
        )
        for c in captures
    ]
    wall, cpu = time.perf_counter(), time.process_time()
    result: MergeResult = (run or merge)(scenes, method, params)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    return {
        "name": name,
        **likeness(result.gaussians, captures, S_map_scene, pictures),
        "num_gaussians": len(result.gaussians),
        "share": len(result.gaussians) / sum(len(c.gaussians) for c in captures),
        "mb": ply_mb(result.gaussians),
        "steps": result.steps,
        "wall_s": wall,
        "cpu_s": cpu,
        "notes": list(result.notes),
    }


def tiled_row(captures, S_map_scene, pictures, tile_size_m, name) -> dict:
    """The same map merged tile by tile, all tiles rendered together."""
    bounds = {c.name: np.array([c.gaussians.means.min(0), c.gaussians.means.max(0)]) for c in captures}
    by_name = {c.name: c for c in captures}

    def in_tiles(scenes, method, params):
        plan = plan_tiles(S_map_scene, bounds, tile_size_m=tile_size_m, reach_m=reach_m(method, params))
        results = []
        for tile in plan:
            lazy = [
                LazyScene(n, pose, lambda box, n=n: by_name[n].gaussians, by_name[n].cameras)
                for n, pose in tile.poses.items()
            ]
            results.append(merge_tile(lazy, method, params, bounds=tile.bounds))
        merged = Gaussians.concatenate([r.gaussians for r in results])
        made = sum(len(r.gaussians) > 0 for r in results)
        return MergeResult(
            merged, np.zeros(len(merged), int), steps=sum(r.steps for r in results), notes=(f"{made} tiles",)
        )

    return merge_row(captures, S_map_scene, pictures, "tto", default_params("tto"), name, run=in_tiles)


def ply_mb(gaussians: Gaussians) -> float:
    return len(gaussians) * 4 * (14 + 3 * gaussians.sh.shape[1]) / 1e6


def add(rows: list[dict], row: dict) -> None:
    alone = rows[0]["psnr_db_by_scene"]
    row["worst_db"] = min(db - alone[name] for name, db in row["psnr_db_by_scene"].items())
    rows.append(row)
    print_row(row)


def print_title() -> None:
    columns = (
        ("PSNR", 6),
        ("SSIM", 6),
        ("Gaussians", 9),
        ("share", 6),
        ("worst", 6),
        ("MB", 6),
        ("wall s", 7),
        ("CPU s", 7),
        ("steps", 5),
    )
    print(" " * 30, *(f"{title:>{width}}" for title, width in columns))


def print_row(r: dict) -> None:
    print(
        f"{r['name']:30} {r['psnr_db']:6.2f} {r['ssim']:6.4f} {r['num_gaussians']:9d} {r['share']:6.1%} "
        f"{r['worst_db']:+6.2f} {r['mb']:6.1f} {r.get('wall_s', 0):7.1f} {r.get('cpu_s', 0):7.1f} "
        f"{r.get('steps', 0):5d}",
        flush=True,
    )


if __name__ == "__main__":
    main()
