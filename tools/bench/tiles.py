"""Exporting captures of one place in tiles: CPU seconds, memory, and how near the tiles come to the photographs.

    python -m tools.bench.tiles CAPTURES [--scenes c0 c1 c2 c3 c5] [--tile-size 5] [--workers 1] [--set a.b=v]

CAPTURES is a folder as `tools/bench/merge.py` takes it. The captures lie in the map by their true poses. CPU seconds
are those of this process and of its workers, peak memory that of the largest of them; PSNR is of all tiles together,
rendered from the captures' cameras, against the photographs.
"""

from __future__ import annotations

import cProfile
import pstats
import tempfile
import time
from pathlib import Path

import gsmap.map
from gsmap import formats
from gsmap.ingest import Capture, read_captures
from gsmap.settings import parse
from gsmap.types import Gaussians, PoseGraph, ScenePose
from tools.bench.merge import likeness, true_pose
from tools.harness import argument_parser, cpu_s, peak_mb


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("captures", type=Path)
    parser.add_argument("--scenes", nargs="+", default=["c0", "c1", "c2", "c3", "c5"])
    parser.add_argument("--tile-size", type=float, default=5.0)
    parser.add_argument("--revisits", type=int, default=1, help="how often each capture lies in the map")
    parser.add_argument("--bbox", type=float, nargs=6)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--set", action="append", default=[], dest="sets", metavar="A.B=VALUE")
    parser.add_argument("--profile", action="store_true", help="where the time goes; with one worker")
    arguments = parser.parse_args()
    captures = read_captures([arguments.captures / f"{name}.ply" for name in arguments.scenes])
    poses = {c.name: true_pose(arguments.captures / "truth" / f"{c.name}.json") for c in captures}
    with tempfile.TemporaryDirectory(prefix="gsmap-tiles-") as folder:
        out = Path(folder) / "tiles"
        with gsmap.map.create(Path(folder) / "house.gsmap") as house:
            fill(house, captures, poses, arguments.revisits)
            sets = [f"engine.executors.local.workers={arguments.workers}", *arguments.sets]
            house.with_settings(dict(parse(text) for text in sets))
            before, profile = cpu_s(), cProfile.Profile(time.process_time)
            if arguments.profile:
                profile.enable()
            report = house.export(out, merge="tto", tile_size_m=arguments.tile_size, bbox=arguments.bbox)
            profile.disable()
            spent = cpu_s() - before
        merged = Gaussians.concatenate([formats.read(out / tile.path) for tile in report.tiles if tile.path])
        print(
            f"{len(report.tiles)} tiles, {len(merged)} Gaussians of {sum(len(c.gaussians) for c in captures)}, "
            f"{spent:.1f} CPU s, peak {peak_mb():.0f} MB",
            flush=True,
        )
        if arguments.profile:
            pstats.Stats(profile).sort_stats("tottime").print_stats(25)
        frames = arguments.captures / "frames"
        pictured = [c for c in captures if any(frames.glob(f"{c.name}_*"))]
        like = likeness(merged, pictured, poses, frames)
        by_scene = ", ".join(f"{name} {psnr:.2f}" for name, psnr in like["psnr_db_by_scene"].items())
        print(f"PSNR {like['psnr_db']:.3f} dB, SSIM {like['ssim']:.4f} ({by_scene})")


def fill(house: gsmap.map.Map, captures: list[Capture], poses: dict, revisits: int) -> None:
    """Lay the captures into the map by their true poses; a revisit is the same again, seen an instant later."""
    graph = {}
    for visit in range(revisits):
        for capture in captures:
            gaussians = capture.gaussians
            if visit:  # other content, and no other look
                gaussians = gaussians[: len(gaussians) - visit]
            scene, _ = house.store.scenes.add(gaussians, capture.cameras, name=f"{capture.name}-{visit}")
            graph[scene.id] = ScenePose(scene.id, poses[capture.name], 0, "placed")
    house.store.revisions.save(PoseGraph(graph))


if __name__ == "__main__":
    main()
