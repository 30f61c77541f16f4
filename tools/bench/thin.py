#!/usr/bin/env python
"""What thinning saves and costs: several visits of one made flat, a year apart, all but the newest thinned.

    python -m tools.bench.thin                     10 visits
    python -m tools.bench.thin --visits 3 --steps 100

Prints the map's bytes before and after beside those of a map of one visit (arrays and catalog), and for each thinned
visit, and for an export as of its date, the PSNR at photographs that no training saw, before and after.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import gsmap.map
import gsmap_synthetic as synthetic
from gsmap import formats
from gsmap.evaluate.images import psnr
from gsmap.geometry.transforms import transform_gaussians
from gsmap.map import Map
from gsmap.render import render
from gsmap.types import Gaussians, Sim3
from gsmap_synthetic.capture import default_routes
from gsmap_synthetic.make import fit_frames, put_in_own_frame
from tools.harness import argument_parser, say, timed

HOLD_OUT = 6


def main() -> int:
    parser = argument_parser(__doc__)
    parser.add_argument("--visits", type=int, default=10)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--steps", type=int, default=300, help="of training, a visit")
    parser.add_argument("--gaussians", type=int, default=40_000)
    args = parser.parse_args()
    began = time.process_time()
    place = synthetic.make_place(args.seed)
    visits = [make_visit(args, place, k) for k in range(args.visits)]
    say(f"{len(visits)} visits made in {time.process_time() - began:.0f} CPU s")
    with tempfile.TemporaryDirectory() as folder:
        one = bytes_of(ingested(Path(folder) / "one.gsmap", visits[-1:]))
        path = ingested(Path(folder) / "all.gsmap", visits)
        every = bytes_of(path)
        with gsmap.map.open(path) as m:
            before = scores(m, visits, Path(folder) / "before")
            report, cpu = timed(m.thin, keep_days=200, now=date(args.visits - 1))
            after = scores(m, visits, Path(folder) / "after")
        thinned = bytes_of(path)
    print(f"thinned {sum(row.thinned for row in report.scenes)} of {len(report.scenes)} in {cpu:.1f} CPU s")
    for row in report.scenes:
        if not row.thinned:
            print(f"  {row.scene_name} stays: {row.reason}")
    print(f"one visit          {one / 1e6:7.2f} MB")
    print(f"{args.visits:2} visits          {every / 1e6:7.2f} MB   {every / one:5.2f}x")
    print(f"{args.visits:2} visits, thinned {thinned / 1e6:7.2f} MB   {thinned / one:5.2f}x")
    print("held-out photographs, dB, before and after: the capture alone; the export as of its date")
    worst = 0.0
    for name, (alone, exported) in before.items():
        now_alone, now_exported = after[name]
        worst = max(worst, alone - now_alone, exported - now_exported)
        print(f"  {name}  {alone:6.2f} {now_alone:6.2f}   {exported:6.2f} {now_exported:6.2f}")
    print(f"worst loss {worst:.3f} dB")
    return 0


def date(visit: int) -> str:
    return f"{2010 + visit}-06-01T12:00:00+00:00"


def make_visit(args: argparse.Namespace, place: synthetic.Place, k: int) -> synthetic.DemoCapture:
    """The same two rooms, filmed and trained anew, in another frame."""
    poses = synthetic.walk(place, default_routes(place, 1)[0], 48, seed=100 + k)
    frames = synthetic.film(place, poses, size_px=(320, 240), name=f"visit{k:02}")
    known = frames[synthetic.shown(len(frames), HOLD_OUT)]
    fitted = fit_frames(known, steps=args.steps, num_gaussians=args.gaussians, seed=k)
    return put_in_own_frame(fitted, frames, f"visit{k:02}", np.random.default_rng([args.seed, k, 8]))


def ingested(path: Path, visits: list[synthetic.DemoCapture]) -> Path:
    with gsmap.map.create(path) as m:
        for k, visit in enumerate(visits):
            m.ingest(visit.gaussians, cameras=visit.cameras, name=visit.name, captured_at=date(k))
        m.update()
    return path


def bytes_of(path: Path) -> int:
    return sum(file.stat().st_size for file in path.rglob("*") if file.is_file())


def scores(m: Map, visits: list[synthetic.DemoCapture], out: Path) -> dict[str, tuple[float, float]]:
    """PSNR of each visit but the newest at its held-out photographs: alone, and exported as of its date (union)."""
    found = {}
    poses = m.pose_graph().poses
    for k, visit in enumerate(visits[:-1]):
        scene = m.store.scenes.get(visit.name)
        alone = at_photographs(m.store.scenes.gaussians(scene.id), visit, Sim3.identity())
        m.export(out / visit.name, tile_size_m=0, merge="voxel", as_of=date(k))
        tile = next((out / visit.name).rglob("*.ply"))
        S_scene_map = poses[scene.id].S_map_scene.inverse()
        found[visit.name] = alone, at_photographs(formats.read(tile), visit, S_scene_map)
    return found


def at_photographs(gaussians: Gaussians, visit: synthetic.DemoCapture, S_scene_frame: Sim3) -> float:
    held = np.flatnonzero(~synthetic.shown(len(visit.images), HOLD_OUT))
    seen = render(transform_gaussians(gaussians, S_scene_frame), visit.cameras[held], depth=False, dominant_id=False)
    pairs = zip(np.clip(seen.colour, 0, 1), visit.images[held] / np.float32(255), strict=True)
    return float(np.mean([psnr(a, b) for a, b in pairs]))


if __name__ == "__main__":
    sys.exit(main())
