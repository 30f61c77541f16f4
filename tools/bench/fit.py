"""The fit of merged tiles: how many passes over the views, and how long its steps are; CPU seconds beside PSNR.

    python -m tools.bench.fit [--seed 72] [--vary-exposure] [--set max_passes=4 momentum=0.9] [--set ...]

A made place of four captures is merged in tiles once for each width of halo, up to the fit, and fitted by each of the
settings of `gsmap.merge.mergers.tto` that are given: first those that are shipped, then each ``--set`` (several
settings a set). PSNR is of all tiles together against the place's own pictures; CPU seconds are of the fits alone, and
of all that comes before them. The shipped steps were chosen by this on the place of seed 71.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any
from unittest import mock

import numpy as np

from gsmap.evaluate.images import psnr
from gsmap.export import plan_tiles
from gsmap.geometry.boxes import inside
from gsmap.geometry.transforms import transform_cameras
from gsmap.merge import reach_m
from gsmap.merge.mergers import tto
from gsmap.merge.overlap import clamp_inside
from gsmap.merge.tile import LazyScene, merge_tile
from gsmap.render import render
from gsmap.types import Gaussians, Sim3
from gsmap_synthetic import make_captures
from gsmap_synthetic.make import DemoCapture
from tools.harness import argument_parser


@dataclass(frozen=True, eq=False)
class Begun:
    """Tiles merged up to their fit.

    Args:
        fits: arguments of each fit, and the tile's bounds.
        others: Gaussians of the tiles that no camera sees.
        cpu_s: what it took.
    """

    fits: list[tuple[tuple[Any, ...], np.ndarray]]
    others: list[Gaussians]
    cpu_s: float


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--seed", type=int, default=72)
    parser.add_argument(
        "--vary-exposure", action="store_true", help="captures that disagree in colour, as real ones do"
    )
    parser.add_argument("--tile-size", type=float, default=5.0)
    parser.add_argument("--set", nargs="+", action="append", default=[], dest="sets", metavar="NAME=VALUE")
    arguments = parser.parse_args()
    varies = arguments.vary_exposure
    captures = make_captures(arguments.seed, 4, steps=300, num_frames=48, num_gaussians=40_000, vary_exposure=varies)
    begun: dict[float, Begun] = {}
    for words in [[], *arguments.sets]:
        params = changed(tto.Params(), words)
        if params.halo_m not in begun:
            begun[params.halo_m] = begin(captures, params, arguments.tile_size)
        start = begun[params.halo_m]
        before = time.process_time()
        merged, steps = finish(start, params, tto._fit)
        took = time.process_time() - before
        print(
            f"{' '.join(words) or 'as shipped':60} {took:6.1f} CPU s (+ {start.cpu_s:.1f} before), {steps} steps, "
            f"{likeness(merged, captures):.3f} dB",
            flush=True,
        )


def changed(params: tto.Params, words: list[str]) -> tto.Params:
    for word in words:
        name, _, value = word.partition("=")
        params = replace(params, **{name: float(value)})
    return params


def pose(capture: DemoCapture) -> Sim3:
    return Sim3.from_matrix(capture.T_scene_world).inverse()


def begin(captures: list[DemoCapture], params: tto.Params, tile_size_m: float) -> Begun:
    before = time.process_time()
    poses = {c.name: pose(c) for c in captures}
    bounds = {c.name: np.array([c.gaussians.means.min(0), c.gaussians.means.max(0)]) for c in captures}
    by_name = {c.name: c for c in captures}
    fits: list[tuple[tuple[Any, ...], np.ndarray]] = []
    others = []
    for tile in plan_tiles(poses, bounds, tile_size_m=tile_size_m, reach_m=reach_m("tto", params)):
        scenes = [
            LazyScene(name, S, lambda box, name=name: by_name[name].gaussians, by_name[name].cameras)
            for name, S in tile.poses.items()
        ]
        found: list[tuple[Any, ...]] = []

        def instead(*arguments: Any, found: list[tuple[Any, ...]] = found) -> tuple[Gaussians, int, bool]:
            found.append(arguments)
            return arguments[0], 0, False

        with mock.patch.object(tto, "_fit", instead):
            result = merge_tile(scenes, "tto", params, bounds=tile.bounds)
        if found:
            fits.append((found[0], tile.bounds))
        else:
            others.append(result.gaussians)
    return Begun(fits, others, time.process_time() - before)


def finish(begun: Begun, params: tto.Params, fit: Callable[..., tuple[Gaussians, int, bool]]) -> tuple[Gaussians, int]:
    """All tiles together, and how many steps they took."""
    parts, count = list(begun.others), 0
    for (start, frozen, wanted, _, *options), bounds in begun.fits:
        fitted, steps, _ = fit(start, frozen, wanted, params, *options)
        mine = inside(start.means, bounds)
        parts.append(replace(fitted[mine], means=clamp_inside(fitted.means[mine], bounds)))
        count += steps
    return Gaussians.concatenate(parts), count


def likeness(merged: Gaussians, captures: list[DemoCapture]) -> float:
    """Mean PSNR over all pictures of all captures, dB."""
    found = []
    for capture in captures:
        cameras = transform_cameras(capture.cameras, pose(capture))
        for k in range(len(cameras)):
            shown = render(merged, cameras[k], depth=False, dominant_id=False).colour[0]
            found.append(psnr(np.clip(shown, 0, 1), capture.images[k] / np.float32(255)))
    return float(np.mean(found))


if __name__ == "__main__":
    main()
