"""How well photographs of real places outdoors are localised: each in a map of the place's other captures.

    python -m tools.bench.outdoors PLACE... --cache FOLDER              # every photograph of every place
    python -m tools.bench.outdoors PLACE... --cache FOLDER --every 3    # every third one

A PLACE is a folder of captures of one place: NAME.ply and NAME.cameras.json, frames/CAMERA.jpg (the photograph of each
camera, which the capture was trained on), and truth/NAME.json with ``T_scene_world``, by which captures lie in the map
where they truly lie. So it takes structure from motion of all photographs of a place together, which are then divided
among captures that are trained apart.

Every photograph is a stranger in the map of the next PLACE, and so are the photographs of ``--strangers``: none may be
placed. A photograph's coverage is the share of its pixels in which another capture is opaque from its pose. Right is a
pose within 1 degree and 2 % of the median distance of what the photograph shows; every other pose that is placed is
wrong.
"""

# Thread counts must be set before numpy comes in.
# ruff: noqa: E402
from __future__ import annotations

import os

from tools.harness import argument_parser, timed

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from gsmap.ingest import read_captures
from gsmap.localize import Params, localize_photo
from gsmap.localize.candidate_renders import render_scenes
from gsmap.localize.map_scene import MapScene
from gsmap.methods import family
from gsmap.types.localization import Photo
from tools.fit.localize import camera_error, index_of, load_place

RIGHT_DEG, RIGHT_SHARE = 1.0, 0.02
COVERED = 0.4
FOCAL = 0.8  # of strangers, per longer side
COVERAGE_PX = 120  # longer side of the renders by which coverage is measured


@dataclass(eq=False)
class Shot:
    """A photograph, the pose of its camera in the world, its coverage and the median distance of what it shows."""

    photo: Photo
    T_world_camera: np.ndarray
    coverage: float
    median_m: float


def shots(folder: Path, own: MapScene, others: list[MapScene], every: int) -> Iterator[Shot]:
    """The photographs of a capture, each with what others show of it."""
    name = own.scene.split("/")[-1]
    cameras = next(iter(read_captures([str(folder / f"{name}.ply")]))).cameras
    for row in range(0, len(cameras), every):
        file = folder / "frames" / f"{cameras.names[row]}.jpg"
        pose = np.eye(4)
        pose[:3, :3] = own.S_metric_scene.rotation @ cameras.T_frame_camera[row, :3, :3]
        pose[:3, 3] = own.S_metric_scene.apply(cameras.centers[row])
        photo = Photo(np.asarray(Image.open(file).convert("RGB")), cameras.intrinsics_px[row], 0.0, file.name)
        small = cameras[[row]].resized(COVERAGE_PX)
        shown = render_scenes(others, pose, small.intrinsics_px[0], tuple(int(v) for v in small.sizes_px[0]))
        opaque = np.stack([one.alpha > 0.9 for one in shown])
        depth = np.stack([one.depth_m for one in shown])[opaque]
        yield Shot(photo, pose, float(opaque.any(0).mean()), float(np.median(depth)) if len(depth) else 0.0)


def main() -> int:
    parser = argument_parser(__doc__)
    parser.add_argument("places", type=Path, nargs="+")
    parser.add_argument("--cache", type=Path, required=True, help="keeps features of captures")
    parser.add_argument("--every", type=int, default=1, help="use every N-th photograph of a capture")
    parser.add_argument("--strangers", type=Path, nargs="*", default=[], help="photographs (JPEG) of other places")
    parser.add_argument("-v", action="store_true")
    args = parser.parse_args()
    params = Params()
    extractor = family("extractor").get(params.extractor).make({}, params.extractors[params.extractor])
    scenes = {folder: load_place(folder, args.cache, params) for folder in args.places}
    indexes = {scene.scene: index_of([scene], params) for of_one in scenes.values() for scene in of_one}
    rows, strangers = [], []
    for number, folder in enumerate(args.places):
        elsewhere = args.places[(number + 1) % len(args.places)]
        for own in scenes[folder]:
            others = [scene for scene in scenes[folder] if scene is not own]
            maps = [others] if elsewhere == folder else [others, scenes[elsewhere]]
            for shot in shots(folder, own, others, args.every):
                for stranger, held in enumerate(maps):
                    index = index_of(held, params) if len(held) > 1 else indexes[held[0].scene]
                    by_id = {scene.scene: scene for scene in held}
                    found, seconds = timed(localize_photo, shot.photo, index, by_id, extractor, params)
                    text, right = found.reason, False
                    if found.T_map_camera is not None:
                        error = camera_error(found.T_map_camera, shot.T_world_camera)
                        deg, metres = float(np.degrees(np.linalg.norm(error[:3]))), float(np.linalg.norm(error[3:]))
                        right = not stranger and deg < RIGHT_DEG and metres < RIGHT_SHARE * shot.median_m
                        text = f"{deg:.2f} deg {100 * metres:.1f} cm at {shot.median_m:.1f} m"
                    (strangers if stranger else rows).append((shot.coverage, found.is_placed, right, seconds))
                    if args.v:
                        where = f"among {held[0].scene.split('/')[0]}" if stranger else f"covered {shot.coverage:.0%}"
                        print(f"  {shot.photo.name} {where}: {text} ({seconds:.2f} CPU s)", flush=True)
        by_id = {scene.scene: scene for scene in scenes[folder]}
        for file in args.strangers:
            rgb = np.asarray(Image.open(file).convert("RGB"))
            focal = FOCAL * max(rgb.shape)
            photo = Photo(rgb, np.array([focal, focal, rgb.shape[1] / 2, rgb.shape[0] / 2]), 0.0, file.name)
            index = index_of(scenes[folder], params)
            found, seconds = timed(localize_photo, photo, index, by_id, extractor, params)
            strangers.append((0.0, found.is_placed, False, seconds))
            if args.v:
                print(
                    f"  {file.name} among {folder.name}: {found.reason or 'placed'} ({seconds:.2f} CPU s)", flush=True
                )
    report("covered by 40 %", [row for row in rows if row[0] >= COVERED])
    report("covered by less", [row for row in rows if row[0] < COVERED])
    report("of another place", strangers)
    return 0


def report(name: str, rows: list[tuple[float, bool, bool, float]]) -> None:
    """One line: how many are placed right and wrong, how many are refused, and CPU seconds of either."""
    if not rows:
        return
    placed, right, seconds = (np.array(column) for column in list(zip(*rows, strict=True))[1:])
    costs = (np.mean(seconds[some]) if some.any() else np.nan for some in (placed, ~placed))
    print(
        f"{name}: {len(rows)} photographs, {right.sum()} placed right, {(placed & ~right).sum()} wrong, "
        f"{(~placed).sum()} refused; {'{:.2f} CPU s of a placement, {:.2f} of a refusal'.format(*costs)}",
        flush=True,
    )


if __name__ == "__main__":
    sys.exit(main())
