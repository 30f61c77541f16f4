"""Make captures of a synthetic place, each trained alone and in its own frame, and write them as people keep them."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from gsmap.errors import ConfigError
from gsmap.types import Cameras, Gaussians, Sim3
from gsmap.types.progress import Progress, silent
from gsmap_synthetic.capture import Frames, default_routes, film, unused_doors, walk
from gsmap_synthetic.initialise import from_depth
from gsmap_synthetic.place import Place, make_place
from gsmap_synthetic.train import Params, train


@dataclass(frozen=True, eq=False)
class DemoCapture:
    """One capture of a synthetic place and what is true about it.

    Args:
        gaussians, cameras: in the capture's own frame (and unit, where it has its own scale).
        images: (C, H, W, 3) uint8, what each camera saw.
        T_scene_world: (4, 4) similarity from the place's frame (metres, z up) to the capture's.
        name: of the capture.
    """

    gaussians: Gaussians
    cameras: Cameras
    images: np.ndarray
    T_scene_world: np.ndarray
    name: str


def make_captures(
    seed: int = 0,
    num_captures: int = 3,
    *,
    steps: int = 600,
    num_frames: int = 60,
    num_gaussians: int = 50_000,
    size_px: tuple[int, int] = (320, 240),
    rooms: int = 3,
    twin: bool = False,
    routes: Sequence[Sequence[int]] | None = None,
    scales: Sequence[float] | None = None,
    shut_doors: bool = True,
    vary_exposure: bool = False,
    hold_out: int = 0,
    place: Place | None = None,
    paths: Sequence[np.ndarray] | None = None,
    far: float = np.inf,
    first: int = 0,
    progress: Progress | None = None,
) -> list[DemoCapture]:
    """Build the place of ``seed`` and capture it ``num_captures`` times, each in its own random frame.

    Args:
        steps: how long each capture is trained; 0 leaves the Gaussians as laid on the depth frames (seconds, not
            minutes; good enough wherever a test needs captures with truth).
        num_frames, size_px: of each capture.
        num_gaussians: of each capture.
        rooms, twin: see `make_place`.
        routes: rooms each capture walks through; by default two neighbouring ones, so that three captures of three
            rooms pairwise share one room.
        scales: units per metre of each capture's frame; by default all are metric.
        shut_doors: shut the doors a capture's route does not pass, so that captures see only the rooms they walk
            through; with open doors they glimpse most of the rooms next to those, too.
        vary_exposure: give each capture its own exposure (gain 0.85 to 1.15, gamma 0.9 to 1.15).
        hold_out: every ``hold_out``-th frame is not trained on (see `shown`); it stays among the images and cameras.
        place: a place already built, instead of the one of ``seed``.
        paths: (C, 4, 4) camera poses of each capture, instead of walks along routes.
        far: depths greater than this (metres) are unknown, as to a scanner; nothing is laid there.
        first: number of the first capture, where those of one place are made in several calls: two of one number walk
            the same steps.

    Raises:
        ConfigError: counts that do not fit together, or a route without doorways.
    """
    report = progress or silent
    report(0.0, "building a place")
    place = place or make_place(seed, rooms=rooms, twin=twin)
    routes = [()] * len(paths) if paths else routes or default_routes(place, num_captures)
    scales = scales or [1.0] * num_captures
    if not len(routes) == len(scales) == num_captures:
        raise ConfigError(
            f"{num_captures} captures need as many routes and scales, got {len(routes)} and {len(scales)}"
        )
    out = []
    for made, (route, scale) in enumerate(zip(routes, scales, strict=True)):
        i = first + made
        rng = np.random.default_rng([seed, i, 8])
        gain, gamma = (rng.uniform(0.85, 1.15), rng.uniform(0.9, 1.15)) if vary_exposure else (1.0, 1.0)
        name = f"capture_{chr(ord('a') + i)}" if first + num_captures <= 26 else f"capture_{i:03d}"

        def step(fraction: float, text: str, start: float = made) -> None:
            report(0.05 + 0.95 * (start + fraction) / num_captures, text)

        poses = paths[made] if paths else walk(place, route, num_frames, seed=i)
        shut = unused_doors(place, route) if shut_doors and not paths else ()
        filming = _part(step, 0.0, 0.3)
        frames = film(place, poses, size_px=size_px, shut=shut, gain=gain, gamma=gamma, name=name, progress=filming)
        known = _within(frames[shown(len(frames), hold_out)], far)
        gaussians = fit_frames(known, steps=steps, num_gaussians=num_gaussians, seed=i, progress=_part(step, 0.3, 1.0))
        out.append(put_in_own_frame(gaussians, frames, name, rng, scale))
    report(1.0, "captures made")
    return out


def _within(frames: Frames, far: float) -> Frames:
    """The frames with no depth beyond ``far``."""
    if frames.depths_m is None or not np.isfinite(far):
        return frames
    return replace(frames, depths_m=np.where(frames.depths_m > far, np.float32(0), frames.depths_m))


def shown(count: int, hold_out: int) -> np.ndarray:
    """(count,) bool, which frames are trained on: all, or all but every ``hold_out``-th."""
    rows = np.arange(count)
    return rows % hold_out != hold_out // 2 if hold_out else rows >= 0


def fit_frames(
    frames: Frames, *, steps: int, num_gaussians: int, seed: int = 0, progress: Progress | None = None
) -> Gaussians:
    """Gaussians of posed frames: laid on their depth, then trained for ``steps``."""
    gaussians = from_depth(frames, num_gaussians, seed)
    if steps == 0:
        return gaussians
    return train(gaussians, frames, Params(steps=steps), seed=seed, progress=progress)


def put_in_own_frame(
    gaussians: Gaussians, frames: Frames, name: str, rng: np.random.Generator, scale: float = 1.0
) -> DemoCapture:
    """Move a capture to a random frame of its own: any rotation, tens of metres away, ``scale`` units per metre."""
    from gsmap.geometry.rotations import quats_to_matrices
    from gsmap.geometry.transforms import transform_cameras, transform_gaussians

    S_scene_world = Sim3(quats_to_matrices(rng.normal(size=4)), scale * rng.uniform(-15, 15, 3), scale)
    return DemoCapture(
        transform_gaussians(gaussians, S_scene_world),
        transform_cameras(frames.cameras, S_scene_world),
        frames.images,
        S_scene_world.matrix(),
        name,
    )


def write_captures(
    folder: str | os.PathLike[str], captures: Sequence[DemoCapture], *, images: bool = False
) -> list[Path]:
    """Write ``NAME.ply`` and ``NAME.cameras.json`` for each capture, and ``truth/NAME.json`` (``T_scene_world``).

    ``images=True`` adds ``frames/CAMERA.jpg``. Returns the paths of the .ply files.
    """
    from PIL import Image

    from gsmap import formats
    from gsmap.formats import cameras_json

    folder = Path(folder)
    (folder / "truth").mkdir(parents=True, exist_ok=True)
    paths = []
    for capture in captures:
        paths.append(folder / f"{capture.name}.ply")
        formats.write(paths[-1], capture.gaussians)
        cameras_json.write(folder / f"{capture.name}.cameras.json", capture.cameras)
        truth = {"T_scene_world": capture.T_scene_world.tolist(), "n": len(capture.gaussians)}
        (folder / "truth" / f"{capture.name}.json").write_text(json.dumps(truth))
        if images:
            (folder / "frames").mkdir(exist_ok=True)
            for image, camera in zip(capture.images, capture.cameras.names, strict=True):
                Image.fromarray(image).save(folder / "frames" / f"{camera}.jpg", quality=92)
    return paths


def _part(progress: Progress, start: float, end: float) -> Progress:
    """Progress of a part as progress of the whole."""
    return lambda fraction, text: progress(start + (end - start) * fraction, text)
