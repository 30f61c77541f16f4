"""What cleaning removes and costs: floaters planted in captures of made flats.

    python -m tools.bench.clean [--seeds 6] [--first 1] [--steps 400]

Planted are single Gaussians in free air (small and opaque, large and faint, needles), clusters of 10 to 80 of them, and
a shell for the sky, all of random colour and place; those within 5 cm of a true surface do not count. Surface lost is
measured on the capture without them: of the pixels of its own views that show a surface, the fraction that shows none
afterwards, or another depth (by more than 5 % and 2 cm). Gaussians lost are those within 5 cm of a true surface; one
that others cover leaves no hole.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

import gsmap_synthetic as synthetic
from gsmap.geometry.floaters import find_detached
from gsmap.geometry.sh import sh0_of_rgb
from gsmap.render import render
from gsmap.types import Cameras, Gaussians, Sim3
from gsmap_synthetic.make import DemoCapture
from gsmap_synthetic.perturb import strewn
from tools.harness import argument_parser, print_table, say, timed

NEAR_M = 0.05
SINGLE = ("opaque", "haze", "needles")


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--seeds", type=int, default=6)
    parser.add_argument("--first", type=int, default=1)
    parser.add_argument("--steps", type=int, default=400, help="of training")
    args = parser.parse_args()
    rows: list[list[object]] = []
    for seed in range(args.first, args.first + args.seeds):
        place = synthetic.make_place(seed)
        (capture,) = synthetic.make_captures(seed, 1, steps=args.steps, num_frames=48, place=place)
        planted = list(plant(capture.gaussians, np.random.default_rng([seed, 17])))
        whole = Gaussians.concatenate([capture.gaussians, *(more for _, more in planted)])
        kind = np.repeat(np.arange(len(planted) + 1), [len(capture.gaussians), *(len(more) for _, more in planted)])
        free = distance_to_truth(whole, capture, place) > NEAR_M
        removed, cpu = timed(detached, whole)
        share = [removed[(kind == number) & free].mean() for number in range(1, len(planted) + 1)]
        single = np.isin(kind, [1 + i for i, (name, _) in enumerate(planted) if name in (*SINGLE, "sky")])
        alone = detached(capture.gaussians)
        lost = alone[~free[kind == 0]].mean()
        holes, other_depth = surface_lost(capture.gaussians, ~alone, capture.cameras)
        rows.append([seed, *share, removed[single & free].mean(), lost, holes, other_depth, cpu])
        say(f"seed {seed} done")
    heads = ["seed", *(name for name, _ in planted), "all but clusters", "Gaussians lost", "holes", "other depth"]
    values = np.array(rows, float)
    shown = [[row[0], *(f"{value:.2%}" for value in row[1:-1]), f"{row[-1]:.2f}"] for row in rows]
    shown.append(["mean", *(f"{value:.2%}" for value in values[:, 1:-1].mean(0)), f"{values[:, -1].mean():.2f}"])
    print_table([*heads, "CPU s"], shown)


def detached(gaussians: Gaussians) -> np.ndarray:
    """(N,) mask of floaters and background."""
    found = find_detached(gaussians)
    return np.zeros(len(gaussians), bool) if found is None else found[0] | found[1]


def plant(gaussians: Gaussians, rng: np.random.Generator) -> Iterator[tuple[str, Gaussians]]:
    """Floaters of each kind, by name."""
    n = len(gaussians)
    low, high = np.percentile(gaussians.means, [2, 98], axis=0)
    yield "opaque", strewn(gaussians, rng, 0.02, size_m=0.03, opacity=0.8)[n:]
    yield "haze", strewn(gaussians, rng, 0.01, size_m=0.25, opacity=0.08)[n:]
    needles = strewn(gaussians, rng, 0.003, size_m=0.01, opacity=0.8)[n:]
    long = needles.log_scales + np.float32(np.log([100, 1, 1]))
    yield "needles", replace(needles, log_scales=long)
    clusters = []
    for _ in range(12):
        count, radius = int(rng.integers(10, 80)), rng.uniform(0.04, 0.12)
        base = gaussians[rng.integers(0, n, count)]
        means = rng.uniform(low, high) + rng.normal(0, radius, (count, 3))
        sizes = np.log(0.02 * rng.lognormal(0, 0.5, (count, 3)))
        colours = np.clip(rng.uniform(0.1, 0.9, 3) + rng.normal(0, 0.05, (count, 3)), 0, 1)
        clusters.append(replace(base, means=means, log_scales=sizes, sh=coloured(base, colours)))
    yield "clusters", Gaussians.concatenate(clusters)
    count, radius = n // 20, float(np.linalg.norm(high - low) * rng.uniform(3, 20))
    base, outwards = gaussians[rng.integers(0, n, count)], rng.normal(size=(count, 3))
    outwards *= (1 + rng.normal(0, 0.01, (count, 1))) / np.linalg.norm(outwards, axis=1, keepdims=True)
    blue = np.array([0.6, 0.75, 0.95]) + rng.normal(0, 0.03, (count, 3))
    sizes = np.log(0.02 * radius * rng.lognormal(0, 0.3, (count, 3)))
    sky = replace(base, means=(low + high) / 2 + radius * outwards, log_scales=sizes, sh=coloured(base, blue))
    yield "sky", sky


def coloured(gaussians: Gaussians, rgb: np.ndarray) -> np.ndarray:
    """Spherical harmonics of Gaussians in other colours (N, 3), the same from all sides."""
    sh = np.zeros_like(gaussians.sh)
    sh[:, 0] = sh0_of_rgb(rgb)
    return sh


def distance_to_truth(gaussians: Gaussians, capture: DemoCapture, place: synthetic.Place) -> np.ndarray:
    """(N,) distances of means from the true surfaces, with all doors shut, in metres."""
    import open3d

    skin = place.skin.with_shut(range(len(place.doors)))
    points = Sim3.from_matrix(capture.T_scene_world).inverse().apply(gaussians.means.astype(np.float64))
    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(*(open3d.core.Tensor(part) for part in skin.mesh()))
    distances: np.ndarray = scene.compute_distance(open3d.core.Tensor(points.astype(np.float32))).numpy()
    return distances


def surface_lost(gaussians: Gaussians, kept: np.ndarray, cameras: Cameras) -> tuple[float, float]:
    """Of the pixels that show a surface, the fractions that show none, and another depth, without the others."""
    cameras = cameras.evenly(24).resized(160)
    holes = other = total = 0
    for i in range(len(cameras)):
        before, after = (render(g, cameras[i], dominant_id=False) for g in (gaussians, gaussians[kept]))
        shown = before.alpha[0] >= 0.5
        still = shown & (after.alpha[0] >= 0.5)
        off = np.abs(after.depth[0] - before.depth[0]) > 0.05 * before.depth[0] + 0.02
        total, holes, other = total + shown.sum(), holes + (shown & ~still).sum(), other + (still & off).sum()
    return float(holes / total), float(other / total)


if __name__ == "__main__":
    main()
