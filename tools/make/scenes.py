"""Posed frames, or a synthetic place, to trained splats as people keep them.

    python -m tools.make.scenes place OUT --seed 3 --captures 4
    python -m tools.make.scenes court OUT --seed 3 --captures 6
    python -m tools.make.scenes frames FOLDER OUT --name kitchen --hold-out 4

Writes OUT/NAME.ply, OUT/NAME.cameras.json and OUT/truth/NAME.json (`T_scene_world`, the frame the splats were put in).
A folder of frames is either an RGB-D recording (camera-intrinsics.txt and for each frame NAME.color.jpg or .png,
NAME.depth.png in millimetres, NAME.pose.txt camera-to-world), or pictures with anything `gsmap` reads cameras from
(cameras.json, transforms.json, COLMAP); the latter start from colour alone and want more steps.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np
from PIL import Image

import gsmap_synthetic as synthetic
from gsmap import formats
from gsmap.errors import GsmapError, InputError
from gsmap.evaluate.images import psnr
from gsmap.render import render
from gsmap.types import Cameras, Gaussians
from gsmap_synthetic.court import court_captures
from gsmap_synthetic.initialise import from_colour, from_depth
from gsmap_synthetic.make import put_in_own_frame
from gsmap_synthetic.train import Params, train
from tools.harness import argument_parser, say, timed


def main() -> int:
    parser = argument_parser(__doc__)
    verbs = parser.add_subparsers(dest="verb", required=True)
    place = verbs.add_parser("place", help="capture a synthetic place")
    place.add_argument("out", type=Path)
    place.add_argument("--captures", type=int, default=3)
    place.add_argument("--rooms", type=int, default=3)
    place.add_argument("--frames", type=int, default=60, help="per capture")
    place.add_argument("--twin", action="store_true", help="build the wing twice")
    place.add_argument("--vary-exposure", action="store_true")
    court = verbs.add_parser("court", help="capture a synthetic court: outdoors, 64 m long")
    court.add_argument("out", type=Path)
    court.add_argument("--captures", type=int, default=6)
    court.add_argument("--frames", type=int, default=48, help="per capture")
    court.add_argument("--vary-exposure", action="store_true")
    frames = verbs.add_parser("frames", help="train on posed frames")
    frames.add_argument("folder", type=Path)
    frames.add_argument("out", type=Path)
    frames.add_argument("--cameras", type=Path, help="where the cameras are, if not in the folder")
    frames.add_argument("--name", default="scene")
    frames.add_argument("--near-far", type=float, nargs=2, default=(0.3, 8.0), help="depth range, colour alone")
    for verb in (place, court, frames):
        verb.add_argument("--seed", type=int, default=0)
        verb.add_argument("--steps", type=int, default=600)
        verb.add_argument("--gaussians", type=int, default=50_000)
        verb.add_argument("--size", type=int, default=320, help="longer side of the pictures trained on, pixels")
        verb.add_argument(
            "--hold-out", type=int, default=0, metavar="N", help="keep every N-th frame back and print its PSNR"
        )
        verb.add_argument("--images", action="store_true", help="write the frames, too")
    args = parser.parse_args()
    try:
        captures = [_from_folder(args)] if args.verb == "frames" else _from_place(args)
        synthetic.write_captures(args.out, captures, images=args.images)
    except GsmapError as error:
        say(f"make_scenes: {error}")
        return 1
    return 0


def _from_place(args: argparse.Namespace) -> list[synthetic.DemoCapture]:
    start = time.process_time()
    court = args.verb == "court"
    captures = (court_captures if court else synthetic.make_captures)(
        args.seed,
        args.captures,
        steps=args.steps,
        num_frames=args.frames,
        num_gaussians=args.gaussians,
        size_px=(args.size, args.size * 3 // 4),
        **({} if court else {"rooms": args.rooms, "twin": args.twin}),
        vary_exposure=args.vary_exposure,
        hold_out=args.hold_out,
        progress=lambda fraction, text: print(f"\r{100 * fraction:3.0f} %  {text:60}", end="", file=sys.stderr),
    )
    say(f"\n{args.captures} captures: {time.process_time() - start:.1f} CPU s")
    for capture in captures:
        _report(capture.name, capture.gaussians, synthetic.Frames(capture.images, capture.cameras), args.hold_out)
    return captures


def _from_folder(args: argparse.Namespace) -> synthetic.DemoCapture:
    frames = read_frames(args.folder, args.cameras, args.size)
    shown = frames[synthetic.shown(len(frames), args.hold_out)]
    if frames.depths_m is not None:
        start, params = from_depth(shown, args.gaussians, args.seed), Params(steps=args.steps)
    else:
        start = from_colour(shown, args.gaussians, *args.near_far, seed=args.seed)
        params = Params(steps=args.steps, splits=max(2, args.steps // 300))
    _report(f"{args.name}, start", start, frames, args.hold_out)
    gaussians, took = timed(train, start, shown, params, seed=args.seed)
    say(f"{args.name}: {args.steps} steps, {took:.1f} CPU s")
    _report(args.name, gaussians, frames, args.hold_out)
    return put_in_own_frame(gaussians, frames, args.name, np.random.default_rng([args.seed, 8]))


def _report(name: str, gaussians: Gaussians, frames: synthetic.Frames, hold_out: int) -> None:
    """Print PSNR of the frames trained on and of those held back."""
    shown = synthetic.shown(len(frames), hold_out)
    record = {"name": name, "gaussians": len(gaussians)}
    for what, rows in (("psnr_trained", np.flatnonzero(shown)), ("psnr_held_out", np.flatnonzero(~shown))):
        if len(rows):
            colour = render(gaussians, frames.cameras[rows], depth=False, dominant_id=False).colour
            pairs = zip(np.clip(colour, 0, 1), frames.images[rows] / np.float32(255), strict=True)
            record[what] = round(float(np.mean([psnr(a, b) for a, b in pairs])), 2)
    print(json.dumps(record))


def read_frames(folder: Path, cameras: Path | None, longest_px: int) -> synthetic.Frames:
    """Posed frames of a folder, shrunk so that the longer side has at most ``longest_px`` pixels.

    Raises:
        InputError: no frames, or frames that lack their picture.
    """
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder: give the folder that holds the frames")
    poses = sorted(folder.glob("*.pose.txt"))
    if cameras is None and poses:
        return _read_recording(folder, [p.name.removesuffix(".pose.txt") for p in poses], longest_px)
    views = formats.read_cameras(cameras or folder)
    found = {p.stem: p for p in folder.rglob("*") if p.suffix.lower() in (".jpg", ".jpeg", ".png")}
    rows = [i for i, name in enumerate(views.names) if Path(name).stem in found]
    if not rows:
        raise InputError(f"no picture in {folder} has the name of a camera such as {views.names[0]!r}")
    small = views[rows].resized(longest_px)
    images = [
        _read_image(found[Path(name).stem], tuple(size)) for name, size in zip(small.names, small.sizes_px, strict=True)
    ]
    return synthetic.Frames(np.stack(images), small)


def _read_recording(folder: Path, names: list[str], longest_px: int) -> synthetic.Frames:
    """An RGB-D recording as 7-Scenes and 3DMatch lay it out; depth and colour are taken as registered."""
    K = np.loadtxt(folder / "camera-intrinsics.txt")
    pose = np.stack([np.loadtxt(folder / f"{name}.pose.txt") for name in names])
    # Written with few digits: back to the nearest rotation.
    u, _, vt = np.linalg.svd(pose[:, :3, :3])
    pose[:, :3, :3] = u @ vt
    colour = [next((p for s in ("jpg", "png") if (p := folder / f"{name}.color.{s}").exists()), None) for name in names]
    if None in colour:
        raise InputError(f"{folder} has no picture {names[colour.index(None)]}.color.jpg or .color.png")
    size = Image.open(folder / f"{names[0]}.depth.png").size
    count = len(names)
    views = Cameras(pose, np.tile([K[0, 0], K[1, 1], K[0, 2], K[1, 2]], (count, 1)), np.tile(size, (count, 1)), names)
    small = views.resized(longest_px)
    small_size = tuple(small.sizes_px[0])
    pictures = (Image.open(folder / f"{name}.depth.png") for name in names)
    depths = [np.asarray(picture.resize(small_size, Image.Resampling.NEAREST)) for picture in pictures]
    depth_m = np.stack(depths).astype(np.float32) / 1000
    depth_m[depth_m > 20] = 0  # 65535 marks "no depth".
    return synthetic.Frames(np.stack([_read_image(p, small_size) for p in colour]), small, depth_m)


def _read_image(path: Path, size: tuple[int, int]) -> np.ndarray:
    return np.asarray(Image.open(path).convert("RGB").resize(size, Image.Resampling.LANCZOS))


if __name__ == "__main__":
    sys.exit(main())
