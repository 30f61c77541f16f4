"""Fits what `gsmap.register.covariance` adds for errors that leave no residual, on made places, and prints its honesty.

A trainer's bias, or a sensor whose depths are a percent off, bends a capture so that the pose takes most of it up and
the residuals show little. Made captures know the truth: places are filmed, their depths bent as depth cameras bend them
(a scale, a term in the depth's square, a lens, colour and depth some pixels apart, noise; each drawn for each capture,
times a level), and laid out as Gaussians, in part under poses that wander, and trained on such frames; others are
trained on perfect frames, or laid on them sparsely (tested only). Two models are of largest likelihood, errors taken
for normally distributed: of the pose with the scale that was measured, and then, that scale known, of the rigid pose.
Places that are only tested on are not fitted. No given capture takes part.

    python -m tools.fit.covariance --cache FOLDER
    python -m tools.fit.covariance --cache FOLDER --test house kitchen_splats

Making the places takes some twenty CPU minutes, once.
"""

# Thread counts must be set before numpy comes in.
# ruff: noqa: E402
from __future__ import annotations

import os

from tools.harness import argument_parser, say

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import itertools
import json
import pickle
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from scipy.optimize import minimize
from scipy.stats import chi2

from gsmap.describe.cloud import surface_cloud
from gsmap.describe.gravity import estimate_up
from gsmap.describe.unit import estimate_unit_m, working_unit_m
from gsmap.geometry.rotations import exp_so3
from gsmap.geometry.similarities import Similarities
from gsmap.ingest import read_captures
from gsmap.register import SceneView
from gsmap.register.covariance import (
    RADIUS_M,
    Conditioning,
    UnobservedErrors,
    condition,
    find_colour_motion,
    load_model,
)
from gsmap.register.refiners import colored_icp
from gsmap.register.surface import Surface
from gsmap.register.unit_scale import decide_scale
from gsmap.types import Cameras, Gaussians, SceneGraph, Sim3
from gsmap_synthetic import make_captures, write_captures
from gsmap_synthetic.capture import Frames, default_routes, film, unused_doors, walk
from gsmap_synthetic.court import court_captures
from gsmap_synthetic.make import fit_frames, put_in_own_frame
from gsmap_synthetic.place import make_place

TRAINED = -1.0  # on perfect frames; other levels lay Gaussians on bent depths
COURT = -2.0  # the same, outdoors and seen from far
WANDERED = -3.0  # half as bent, by cameras that are a centimetre off along the way
FILMED = -4.0  # the same, trained on these frames, as people's captures are
SPARSE = -5.0  # perfect depths, few Gaussians, a hand's breadth or two apart
KINDS = {TRAINED: "trained", COURT: "court", WANDERED: "wandered", FILMED: "filmed", SPARSE: "sparse"}
FITTED = {
    TRAINED: (501, 502, 503),
    COURT: (401, 402),
    WANDERED: (711, 712, 713, 714),
    FILMED: (731, 732, 733, 734),
    0.0: (631,),
    0.25: (621, 650, 652, 654),
    0.5: (611, 612, 660, 662, 664),
    0.7: (641, 670, 672, 674),
    1.0: (601, 602, 680, 682, 684),
}
TESTED = {
    TRAINED: (504, 505, 506),
    COURT: (403,),
    WANDERED: (721, 722, 723, 724),
    FILMED: (741, 742, 743, 744),
    SPARSE: (751, 752, 753, 754, 761, 762, 763, 764),
    0.0: (632,),
    0.25: (622, 651, 653, 655),
    0.5: (613, 661, 663, 665),
    0.7: (642, 671, 673, 675),
    1.0: (603, 681, 683, 685),
}
DRAWN = {
    TRAINED: (507, 508),
    COURT: (404,),
    WANDERED: (725, 726),
    FILMED: (745, 746, 747),
    SPARSE: (765, 766),
    0.25: (656,),
    0.5: (666,),
    0.7: (676,),
    1.0: (686, 687),
}
"""Drawn after the model's form was chosen."""
LEAST_OVERLAP = 0.08
WANDER_KNOTS, WANDER_TURN_PER_M = 6, 0.4  # radians
START_DEG, START_M = 1.5, 0.05
RIGHT_M = 0.3
THREE_SIGMA = 0.9973


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--cache", type=Path, required=True, help="keep made places and their errors here")
    parser.add_argument("--test", type=Path, nargs="*", default=[], help="print the honesty in these folders, too")
    options = parser.parse_args()
    fitted, tested, drawn = (collect(places, options.cache) for places in (FITTED, TESTED, DRAWN))
    model = fit([pair for pairs in fitted.values() for pair in pairs])
    for name in (*SCALE, *MOTION):
        print(f"{name} = {getattr(model, name):.5f}")
    for title, groups in (("fitted", fitted), ("tested", tested), ("drawn since", drawn)):
        for level, pairs in groups.items():
            report(f"{title}, " + KINDS.get(level, f"bent x {level:g}"), pairs, model)
        report(f"{title}, all", [pair for pairs in groups.values() for pair in pairs], model)
    for name, told in (("as fitted", model), ("as shipped", load_model(coloured=True))):
        report(
            f"tested and drawn since, {name}", [p for g in (tested, drawn) for pairs in g.values() for p in pairs], told
        )
    for folder in options.test:
        report(folder.name, pairs_of(folder, options.cache), model)


# --- made captures -------------------------------------------------------------------------------------------------


def made(cache: Path, level: float, seed: int) -> Path:
    """The folder of three captures of a made place."""
    folder = cache / f"{KINDS.get(level, f'bent_{level:g}')}_{seed}"
    if not folder.exists():
        say(f"making {folder.name}")
        if level == TRAINED:
            sizes = {"num_frames": 40, "num_gaussians": 30_000, "size_px": (240, 180)}
            write_captures(folder, make_captures(seed, 3, steps=200, vary_exposure=True, **sizes))
        elif level == COURT:
            sizes = {"num_gaussians": 60_000, "size_px": (240, 180)}
            write_captures(folder, court_captures(seed, 6, steps=150, vary_exposure=True, **sizes))
        elif level == SPARSE:
            sizes = {"num_frames": 14, "num_gaussians": 3000, "size_px": (96, 72)}
            write_captures(folder, make_captures(seed, 4, steps=0, **sizes))
        elif level in (WANDERED, FILMED):
            write_captures(folder, bent_captures(0.5, seed, wander_m=0.01, steps=150 * (level == FILMED)))
        else:
            write_captures(folder, bent_captures(level, seed))
    return folder


def bent_captures(level: float, seed: int, wander_m: float = 0.0, steps: int = 0) -> list:
    """Three captures of one place, each by a depth camera of its own, whose poses are so far off along its way."""
    place, out = make_place(seed, rooms=3), []
    for i, route in enumerate(default_routes(place, 3)):
        rng, name = np.random.default_rng([seed, i, 77]), f"capture_{chr(97 + i)}"
        shut = unused_doors(place, route)
        frames = film(place, walk(place, route, 40, seed=i), size_px=(160, 120), shut=shut, name=name)
        frames = bent(frames, rng, level)
        if wander_m:
            frames = replace(frames, cameras=wandered(frames.cameras, rng, wander_m))
        gaussians = fit_frames(frames, steps=steps, num_gaussians=30_000, seed=i)
        out.append(put_in_own_frame(gaussians, frames, name, rng))
    return out


def bent(frames: Frames, rng: np.random.Generator, level: float) -> Frames:
    """The frames as one depth camera would have measured them; at level 1 its depths are a percent off."""
    assert frames.depths_m is not None
    depths = frames.depths_m.astype(np.float64)
    _, height, width = depths.shape
    scale, square = 1 + 0.01 * level * rng.normal(), 0.004 * level * rng.normal()
    y, x = np.mgrid[0:height, 0:width]
    radius = np.hypot((x - width / 2) / width, (y - height / 2) / height)
    lens = 1 + 0.01 * level * rng.normal() * (4 * radius**2 - 0.5)
    depths = depths * scale * lens + square * depths**2
    depths *= 1 + 0.004 * level * rng.normal(size=depths.shape)
    dx, dy = np.round(1.5 * level * rng.normal(size=2)).astype(int)
    return replace(frames, depths_m=np.roll(depths, (dy, dx), (1, 2)).astype(np.float32))


def wandered(cameras: Cameras, rng: np.random.Generator, wander_m: float) -> Cameras:
    """The cameras as one that finds its way alone takes them to be: off by smooth motions that are none on average."""
    ways, knots = np.linspace(0, 1, len(cameras)), np.linspace(0, 1, WANDER_KNOTS)
    off = np.stack([np.interp(ways, knots, rng.normal(size=WANDER_KNOTS)) for _ in range(6)], axis=1)
    off = (off - off.mean(0)) * wander_m * np.r_[np.full(3, WANDER_TURN_PER_M), np.ones(3)]
    poses = cameras.T_frame_camera.copy()
    poses[:, :3, :3] = exp_so3(off[:, :3]) @ poses[:, :3, :3]
    poses[:, :3, 3] += off[:, 3:]
    return replace(cameras, T_frame_camera=poses)


# --- true errors ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Pair:
    """True errors of one pair's poses, and how they hang on those of the surfaces.

    Args:
        scaled, rigid: (7,) and (6,) errors about the overlap's centroid of the pose with its scale, and without.
        scale: of the first pose.
        conditioned: of that.
        colour_motion: (7,) by which colours would move the second.
    """

    scaled: np.ndarray
    rigid: np.ndarray
    scale: float
    conditioned: Conditioning
    colour_motion: np.ndarray | None

    def told(self, unobserved: UnobservedErrors) -> Conditioning:
        """The conditioning, so much thought to be unobserved."""
        return replace(self.conditioned, unobserved=unobserved)

    def under(self, unobserved: UnobservedErrors) -> tuple[np.ndarray, np.ndarray]:
        """(7, 7) and (6, 6) covariances of the two poses."""
        told = self.told(unobserved)
        decision = decide_scale(float(np.log(self.scale)), told.log_scale_sigma, specified=True)
        rigid = told.covariance_of_rigid(1.0, decision.log_scale, decision.log_scale_sigma, self.colour_motion)
        return told.covariance_with_scale(self.scale), rigid[:6, :6]


def collect(places: dict[float, tuple[int, ...]], cache: Path) -> dict[float, list[Pair]]:
    """The pairs of made places, by level."""
    return {
        level: [pair for seed in seeds for pair in pairs_of(made(cache, level, seed), cache)]
        for level, seeds in places.items()
    }


def pairs_of(folder: Path, cache: Path) -> list[Pair]:
    """All pairs of a folder that overlap, refined from a start near the truth."""
    kept = cache / f"{folder.name}.pairs"
    if not kept.exists():
        captures, reads = [], list(read_captures(folder))
        working_m = float(np.exp(np.mean([np.log(working_metres(read.gaussians, read.cameras)) for read in reads])))
        for read in reads:
            truth = json.loads((folder / "truth" / f"{read.name}.json").read_text())["T_scene_world"]
            metres = Sim3.from_matrix(np.array(truth))
            view = SceneView(read.name, read.gaussians, read.cameras, SceneGraph(read.name))
            captures.append((view.surface(working_m), Sim3(metres.rotation, metres.translation * working_m)))
        pairs = [
            _pair(*a, *b, RIGHT_M * working_m, seed) for seed, (a, b) in enumerate(itertools.combinations(captures, 2))
        ]
        kept.write_bytes(pickle.dumps([pair for pair in pairs if pair is not None]))
    found: list[Pair] = pickle.loads(kept.read_bytes())
    return found


def working_metres(gaussians: Gaussians, cameras: Cameras | None) -> float:
    """Working metres per metre of a capture."""
    points = surface_cloud(gaussians).points
    return working_unit_m(estimate_unit_m(points, cameras, estimate_up(points, cameras)), cameras)


def _pair(target: Surface, S_target: Sim3, source: Surface, S_source: Sim3, right_m: float, seed: int) -> Pair | None:
    """None where too little overlaps, or another pose was found, which the verdict is to tell."""
    truth = S_target @ S_source.inverse()
    near = np.isfinite(target.nearest(truth.apply(source.coarse[0]), RADIUS_M)[0])
    if near.mean() < LEAST_OVERLAP:
        return None
    rng, centre = np.random.default_rng(seed), np.median(source.points, axis=0)
    turn, shift = (length * v / np.linalg.norm(v) for length, v in zip(
        (np.radians(START_DEG), START_M), rng.normal(size=(2, 3)), strict=True
    ))  # fmt: skip
    R = exp_so3(turn)
    coarse, fine = colored_icp.SCHEDULES["coarse"], colored_icp.SCHEDULES["fine"]
    pose = colored_icp.refine(target, source, truth @ Sim3(R, centre - R @ centre + shift), schedule=coarse)
    scaled = colored_icp.refine(target, source, pose, with_scale=True, schedule=coarse)
    scaled = colored_icp.refine(target, source, scaled, with_scale=True, schedule=fine)
    conditioned = condition(target, source, scaled)
    if conditioned is None:
        return None
    rigid = colored_icp.refine(target, source, conditioned.rescaled(scaled, 1.0), schedule=fine)
    centroid = Sim3(np.eye(3), conditioned.centroid)
    inverse = Similarities.stack([truth @ centroid])
    errors = [(Similarities.stack([p @ centroid]).inverse() @ inverse).log()[0] for p in (scaled, rigid)]
    if np.linalg.norm(errors[1][3:6]) > right_m:
        return None
    colour_motion = find_colour_motion(target, source, rigid, conditioned.centroid, with_scale=False)
    return Pair(errors[0], errors[1][:6], scaled.scale, conditioned, colour_motion)


# --- the models ----------------------------------------------------------------------------------------------------

SCALE = ("scale_error_m", "field_power", "colour_scale_share")
"""Fitted to the poses with the scale that was measured."""
MOTION = ("residual_factor", "colour_share", "shift_per_scale")
"""Fitted to the rigid poses, their scale known."""
ROUNDS = 2  # each of the two fits knows the other's outcome


def fit(pairs: list[Pair]) -> UnobservedErrors:
    """The model of largest likelihood."""

    def cost(unobserved: UnobservedErrors, *, rigid: bool) -> float:
        total = 0.0
        for pair in pairs:
            matrix, error = pair.under(unobserved)[rigid], pair.rigid if rigid else pair.scaled
            total += np.linalg.slogdet(matrix)[1] + error @ np.linalg.solve(matrix, error)
        return total

    unobserved = load_model(coloured=True)
    for names, rigid in ((SCALE, False), (MOTION, True)) * ROUNDS:
        unobserved = _largest(unobserved, names, partial(cost, rigid=rigid))
    return unobserved


def _largest(
    unobserved: UnobservedErrors, names: tuple[str, ...], cost: Callable[[UnobservedErrors], float]
) -> UnobservedErrors:
    """The model with those of these parameters, all positive, at which a cost is least."""

    def at(x: np.ndarray) -> UnobservedErrors:
        return replace(unobserved, **dict(zip(names, np.exp(x).tolist(), strict=True)))

    start = np.log([getattr(unobserved, name) for name in names])
    options = {"maxiter": 4000, "maxfev": 4000}
    found = [minimize(lambda x: cost(at(x)), start + off, method="Nelder-Mead", options=options) for off in (0.0, 0.7)]
    return at(min(found, key=lambda f: f.fun).x)


def report(title: str, pairs: list[Pair], unobserved: UnobservedErrors) -> None:
    """Normalised squared errors (NEES) of poses with their scale, and of rigid ones.

    "Beyond 3 sigma" are those that a chi-square would exceed as rarely as a normal variable three standard deviations;
    "cost" is minus the mean log likelihood, less what no covariance changes. Taken for another scale should be none of
    the made pairs, which all are of one metre.
    """
    both = [pair.under(unobserved) for pair in pairs]
    said = []
    for dof, errors, k in ((7, [p.scaled for p in pairs], 0), (6, [p.rigid for p in pairs], 1)):
        values = [e @ np.linalg.solve(b[k], e) for e, b in zip(errors, both, strict=True)]
        if values:
            middle, high = np.percentile(values, [50, 95])
            out = int((np.array(values) > chi2.ppf(THREE_SIGMA, dof)).sum())
            cost = 0.5 * np.mean([np.linalg.slogdet(b[k])[1] + v for b, v in zip(both, values, strict=True)])
            said.append(f"{dof} dof: median {middle:.1f} ({chi2.ppf(0.5, dof):.1f}), 95 % {high:.1f} "
                        f"({chi2.ppf(0.95, dof):.1f}), most {max(values):.0f}, beyond 3 sigma {out}, "
                        f"cost {cost:.2f}")  # fmt: skip
    scales = [(float(np.log(pair.scale)), pair.told(unobserved).log_scale_sigma) for pair in pairs]
    others = sum(not decide_scale(log_scale, sigma).rigid for log_scale, sigma in scales)
    print(f"{title}, {len(pairs)} pairs: NEES " + "; ".join(said) + f"; taken for another scale {others}")
    if len(pairs) > 2:
        print("    correlated with how far poses are shifted: " + ", ".join(
            f"{name} {value:.2f}" for name, value in foretold(pairs).items()
        ))  # fmt: skip


def foretold(pairs: list[Pair]) -> dict[str, float]:
    """Correlations of the logarithms of true shifts of rigid poses with those of what tells of them."""
    shift = np.log([np.linalg.norm(pair.rigid[3:]) for pair in pairs])
    told = {
        "field": [pair.conditioned.field_m for pair in pairs],
        "swell": [abs(np.log(pair.scale)) * pair.conditioned.radius_m for pair in pairs],
        "colour_motion": [
            np.nan if pair.colour_motion is None else np.linalg.norm(pair.colour_motion[3:6]) for pair in pairs
        ],
    }
    return {name: float(np.corrcoef(shift, np.log(np.array(v) + 1e-6))[0, 1]) for name, v in told.items()}


if __name__ == "__main__":
    main()
