"""What kept photographs are worth to the merged map: half of them are kept, the others say how near it came.

    python -m tools.bench.photo_references HOUSE [--scenes c0 c1]          # the house's own frames
    python -m tools.bench.photo_references PLACES --made fit --share 0 2 4 8   # made places (`make_localize_places.py`)

Photographs are given to the merger with poses that are off by as much as localised ones are (.15 degrees, .9 cm). Of
made places every second photo is kept, changed furniture, people and exposures of their own included; of the others
those count that show the place as it was captured, brought to the merged map's exposure by one gain a channel.
"""

# Thread counts must be set before numpy comes in.
# ruff: noqa: E402
from __future__ import annotations

import os

from tools.harness import argument_parser, timed

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from PIL import Image

from gsmap.evaluate.images import psnr
from gsmap.evaluate.renders import find_images, read_image
from gsmap.geometry.rotations import exp_so3
from gsmap.geometry.transforms import transform_cameras, transform_gaussians
from gsmap.ingest import read_captures
from gsmap.merge import default_params, merge
from gsmap.render import render
from gsmap.types import Cameras, Gaussians, PosedScene, ReferencePhoto
from tools.bench.merge import true_pose

OFF_DEG, OFF_M = 0.15, 0.009
SEEN = 0.6  # of a made photo, that a capture must show for it to be scored


@dataclass(frozen=True, eq=False)
class Taken:
    """A photograph, its camera in the map, and of which scene it is."""

    camera: Cameras
    path: Path
    scene: int


def house(folder: Path, names: Sequence[str]) -> tuple[list[PosedScene], list[Taken], list[Taken]]:
    """The scenes, the photographs that are kept, and those that are not."""
    scenes, every = [], []
    for number, capture in enumerate(read_captures([folder / f"{name}.ply" for name in names])):
        S = true_pose(folder / "truth" / f"{capture.name}.json")
        cameras = transform_cameras(capture.cameras, S)
        scenes.append(PosedScene(transform_gaussians(capture.gaussians, S), cameras, capture.name))
        found = find_images(capture.cameras, folder / "frames")
        every.append([Taken(cameras[[row]], path, number) for row, path in found.items()])
    return scenes, [one for mine in every for one in mine[::2]], [one for mine in every for one in mine[1::2]]


def made(folder: Path) -> tuple[list[PosedScene], list[Taken], list[Taken]]:
    """The same of a made place."""
    scenes = []
    for capture in read_captures([folder / "c0.ply", folder / "c1.ply"]):
        S = true_pose(folder / "truth" / f"{capture.name}.json")
        placed = transform_gaussians(capture.gaussians, S), transform_cameras(capture.cameras, S)
        scenes.append(PosedScene(*placed, capture.name))
    kept, others = [], []
    for number, told in enumerate(json.loads((folder / "photos.json").read_text())):
        pose, lens = np.array(told["T_world_camera"])[None], np.array(told["intrinsics"])[None]
        camera = Cameras(pose, lens, np.array([[480, 360]]))
        shows = [render(scene.gaussians, camera).alpha[0].mean() for scene in scenes]
        one = Taken(camera, folder / "photos" / told["file"], int(np.argmax(shows)))
        if number % 2 == 0:
            kept.append(one)
        elif not told["changed"] and not told["occluded"] and max(shows) > SEEN:
            others.append(one)
    return scenes, kept, others


def off(camera: Cameras, rng: np.random.Generator) -> Cameras:
    """A camera as localisation finds it."""
    turn, shift = rng.normal(size=(2, 3)) / np.sqrt(3) * [[np.radians(OFF_DEG)], [OFF_M]]
    pose = camera.T_frame_camera.copy()
    pose[0, :3, 3] += pose[0, :3, :3] @ shift
    pose[0, :3, :3] = pose[0, :3, :3] @ exp_so3(turn)
    return Cameras(pose, camera.intrinsics_px, camera.sizes_px)


def picture(path: Path) -> np.ndarray:
    return np.asarray(Image.open(path).convert("RGB"))


def psnr_db(gaussians: Gaussians, one: Taken, *, gained: bool) -> float:
    """Of a render beside the photograph."""
    shown = np.clip(render(gaussians, one.camera).colour[0], 0, 1)
    wanted = read_image(one.path)
    if gained:
        shown = np.clip(shown * ((shown * wanted).sum((0, 1)) / np.maximum((shown**2).sum((0, 1)), 1e-9)), 0, 1)
    return psnr(shown, wanted)


def measure(
    name: str,
    made_of: Callable[[], tuple[list[PosedScene], list[Taken], list[Taken]]],
    shares: Sequence[float],
    gained: bool,
) -> list[tuple[float, float, float]]:
    """By share: PSNR of the photographs that were kept and of the others, and CPU seconds; a line of each."""
    scenes, kept, others = made_of()
    rng, out = np.random.default_rng(1), []
    photos = [ReferencePhoto(off(one.camera, rng), partial(picture, one.path)) for one in kept]
    given = [
        replace(scene, photos=tuple(p for p, one in zip(photos, kept, strict=True) if one.scene == number))
        for number, scene in enumerate(scenes)
    ]
    for share in shares:
        params = replace(default_params("tto"), photo_weight=share)
        merged, seconds = timed(merge, given, "tto", params)
        of_kept, of_others = (
            float(np.mean([psnr_db(merged.gaussians, one, gained=gained) for one in them])) for them in (kept, others)
        )
        out.append((of_kept, of_others, seconds))
        print(
            f"{name}, share {share:g}: {len(kept)} kept {of_kept:.2f} dB, {len(others)} others {of_others:.2f} dB; "
            f"{len(merged.gaussians)} Gaussians, {merged.steps} steps, {seconds:.0f} CPU s",
            flush=True,
        )
    return out


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--scenes", nargs="+", default=["c0", "c1"])
    parser.add_argument("--made", metavar="SET", help="the folder holds sets of made places: those of this one")
    parser.add_argument("--share", nargs="+", type=float, default=[0.0, 4.0])
    args = parser.parse_args()
    if not args.made:
        measure(" ".join(args.scenes), partial(house, args.folder, args.scenes), args.share, gained=False)
        return
    places = [path for path in sorted((args.folder / args.made).iterdir()) if (path / "done").exists()]
    rows = [measure(path.name, partial(made, path), args.share, gained=True) for path in places]
    for share, (kept, others, seconds) in zip(args.share, np.mean(rows, axis=0), strict=True):
        print(f"{len(places)} places, share {share:g}: kept {kept:.2f} dB, others {others:.2f} dB; {seconds:.1f} CPU s")


if __name__ == "__main__":
    main()
