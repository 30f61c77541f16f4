"""Fits what `gsmap.register.covariance` adds for errors that leave no residual, on made places, and prints its honesty.

A trainer's bias, or a sensor whose depths are a percent off, bends a capture so that the pose takes most of it up and
the residuals show little. Made captures know the truth: places are filmed, their depths bent as depth cameras bend them
(a scale, a term in the depth's square, a lens, colour and depth some pixels apart, noise; each drawn for each capture,
times a level), and laid out as Gaussians; others are trained on perfect frames. The standard deviations of the model
and their growth with the errors that residuals do show are those of largest likelihood for the true errors of poses,
with the scale and without, taken for normally distributed. How much a sensor hides varies more than that from one to
the next: most poses are better than this says, and the worst are worse. Places that are only tested on are not fitted.
No given capture takes part.

    python tools/fit_covariance.py --cache FOLDER
    python tools/fit_covariance.py --cache FOLDER --test house kitchen_splats

Making the places takes some ten CPU minutes, once.
"""

# Thread counts must be set before numpy comes in.
# ruff: noqa: E402
from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import argparse
import itertools
import json
import pickle
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.optimize import minimize
from scipy.stats import chi2

from gsmap.geometry.rotations import exp_so3
from gsmap.geometry.similarities import Similarities
from gsmap.ingest import read_captures
from gsmap.register import Params, covariance
from gsmap.register.covariance import condition, hidden_sigmas
from gsmap.register.refiners import colored_icp
from gsmap.register.surface import Surface
from gsmap.types import Sim3
from gsmap_synthetic import make_captures, write_captures
from gsmap_synthetic.capture import Frames, default_routes, film, unused_doors, walk
from gsmap_synthetic.make import fit_frames, put_in_own_frame
from gsmap_synthetic.place import make_place

TRAINED = -1.0  # on perfect frames; other levels lay Gaussians on bent depths
FITTED = {TRAINED: (501, 502, 503), 0.0: (631,), 0.25: (621,), 0.5: (611, 612), 0.7: (641,), 1.0: (601, 602)}
TESTED = {TRAINED: (504, 505, 506), 0.0: (632,), 0.25: (622,), 0.5: (613,), 0.7: (642,), 1.0: (603,)}
LEAST_OVERLAP = 0.08
START_DEG, START_M = 1.5, 0.05


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cache", type=Path, required=True, help="keep made places and their errors here")
    parser.add_argument("--test", type=Path, nargs="*", default=[], help="print the honesty in these folders, too")
    options = parser.parse_args()
    fitted, tested = collect(FITTED, options.cache), collect(TESTED, options.cache)
    model = fit([pair for pairs in fitted.values() for pair in pairs])
    field_m = Params().covariance.field_m
    print(
        f"hidden turn, shift, swell = {', '.join(f'{h:.5f}' for h in model.hidden_m)}, field_power = {model.power:.2f} "
        f"at field_m = {field_m:g}"
    )
    for title, groups in (("fitted", fitted), ("tested", tested)):
        for level, pairs in groups.items():
            report(f"{title}, " + ("trained" if level == TRAINED else f"bent x {level:g}"), pairs, model)
        report(f"{title}, all", [pair for pairs in groups.values() for pair in pairs], model)
    for folder in options.test:
        report(folder.name, pairs_of(folder, options.cache), model)


# --- made captures -------------------------------------------------------------------------------------------------


def made(cache: Path, level: float, seed: int) -> Path:
    """The folder of three captures of a made place."""
    folder = cache / (f"trained_{seed}" if level == TRAINED else f"bent_{level:g}_{seed}")
    if not folder.exists():
        print(f"making {folder.name}", file=sys.stderr, flush=True)
        if level == TRAINED:
            sizes = {"num_frames": 40, "num_gaussians": 30_000, "size_px": (240, 180)}
            write_captures(folder, make_captures(seed, 3, steps=200, vary_exposure=True, **sizes))
        else:
            write_captures(folder, bent_captures(level, seed))
    return folder


def bent_captures(level: float, seed: int) -> list:
    """Three captures of one place, each by a depth camera of its own."""
    place, out = make_place(seed, rooms=3), []
    for i, route in enumerate(default_routes(place, 3)):
        rng, name = np.random.default_rng([seed, i, 77]), f"capture_{chr(97 + i)}"
        shut = unused_doors(place, route)
        frames = film(place, walk(place, route, 40, seed=i), size_px=(160, 120), shut=shut, name=name)
        gaussians = fit_frames(bent(frames, rng, level), steps=0, num_gaussians=30_000, seed=i)
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


# --- true errors ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Pair:
    """True errors of one pair's poses about the overlap's centroid, scaled and rigid, and what residuals say of them.

    Args:
        errors: (7,) and (6,).
        covariances: (7, 7) and (6, 6), nothing hidden added.
        field_m: the errors that residuals show beyond a block.
        radius_m: of the overlap.
    """

    errors: tuple[np.ndarray, np.ndarray]
    covariances: tuple[np.ndarray, np.ndarray]
    field_m: float
    radius_m: float


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
        captures = []
        for read in read_captures(folder):
            truth = json.loads((folder / "truth" / f"{read.name}.json").read_text())["T_scene_world"]
            captures.append((Surface.of(read.gaussians), Sim3.from_matrix(np.array(truth))))
        pairs = [_pair(*a, *b, seed) for seed, (a, b) in enumerate(itertools.combinations(captures, 2))]
        kept.write_bytes(pickle.dumps([pair for pair in pairs if pair is not None]))
    found: list[Pair] = pickle.loads(kept.read_bytes())
    return found


def _pair(target: Surface, S_target: Sim3, source: Surface, S_source: Sim3, seed: int) -> Pair | None:
    params, truth = Params(), S_target @ S_source.inverse()
    bare = Model((0.0, 0.0, 0.0), 1.0).params
    near = np.isfinite(target.nearest(truth.apply(source.coarse[0]), params.covariance.radius_m)[0])
    if near.mean() < LEAST_OVERLAP:
        return None
    rng, centre = np.random.default_rng(seed), np.median(source.points, axis=0)
    turn, shift = (length * v / np.linalg.norm(v) for length, v in zip(
        (np.radians(START_DEG), START_M), rng.normal(size=(2, 3)), strict=True
    ))  # fmt: skip
    R = exp_so3(turn)
    coarse, fine = params.coarse_refiners["colored_icp"], params.refiners["colored_icp"]
    pose = colored_icp.refine(target, source, truth @ Sim3(R, centre - R @ centre + shift), coarse)
    scaled = colored_icp.refine(target, source, pose, coarse, with_scale=True)
    scaled = colored_icp.refine(target, source, scaled, fine, with_scale=True)
    conditioned = condition(target, source, scaled, bare)
    if conditioned is None:
        return None
    rigid = colored_icp.refine(target, source, conditioned.rescaled(scaled, 1.0), fine)
    centroid = Sim3(np.eye(3), conditioned.centroid)
    inverse = Similarities.stack([truth @ centroid])
    errors = [(Similarities.stack([p @ centroid]).inverse() @ inverse).log()[0] for p in (scaled, rigid)]
    inside = source.coarse[0][near] - source.coarse[0][near].mean(0)
    radius = float(np.sqrt((inside**2).sum(1).mean()))
    covariances = conditioned.scaled, conditioned.rigid
    return Pair((errors[0], errors[1][:6]), covariances, conditioned.field_m, radius)


# --- the model -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Model:
    """`gsmap.register.covariance.Params`' part that is fitted."""

    hidden_m: tuple[float, float, float]
    power: float

    @property
    def params(self) -> covariance.Params:
        """Those of the room, with this model."""
        turn, shift, swell = self.hidden_m
        return replace(
            Params().covariance,
            hidden_turn_m=turn,
            hidden_shift_m=shift,
            hidden_swell_m=swell,
            field_power=self.power,
        )

    def covariance(self, pair: Pair, k: int) -> np.ndarray:
        """Of the scaled (0) or the rigid pose (1)."""
        hidden = hidden_sigmas(pair.field_m, pair.radius_m, self.params)
        own = pair.covariances[k]
        return own + np.diag(hidden[: len(own)] ** 2)


def fit(pairs: list[Pair]) -> Model:
    """The model of largest likelihood."""

    def model(x: np.ndarray) -> Model:
        turn, shift, swell = np.exp(x[:3]).tolist()
        return Model((turn, shift, swell), float(x[3]))

    def cost(x: np.ndarray) -> float:
        total = 0.0
        for pair, k in itertools.product(pairs, (0, 1)):
            matrix = model(x).covariance(pair, k)
            total += np.linalg.slogdet(matrix)[1] + pair.errors[k] @ np.linalg.solve(matrix, pair.errors[k])
        return total

    options = {"maxiter": 4000, "maxfev": 4000}
    found = [minimize(cost, [-6.0, -6.0, -6.0, p], method="Nelder-Mead", options=options) for p in (1.0, 3.0)]
    return model(min(found, key=lambda f: f.fun).x)


def report(title: str, pairs: list[Pair], model: Model) -> None:
    """Normalised squared errors of poses with their scale, and of rigid ones."""
    said = []
    for k, dof in ((0, 7), (1, 6)):
        values = [p.errors[k] @ np.linalg.solve(model.covariance(p, k), p.errors[k]) for p in pairs]
        if values:
            middle, high = np.percentile(values, [50, 95])
            said.append(f"{dof} dof: median {middle:.1f} ({chi2.ppf(0.5, dof):.1f}), 95 % {high:.1f} "
                        f"({chi2.ppf(0.95, dof):.1f})")  # fmt: skip
    field = 1000 * np.median([p.field_m for p in pairs]) if pairs else np.nan
    print(f"{title}, {len(pairs)} pairs, field {field:.1f} mm: NEES " + "; ".join(said))


if __name__ == "__main__":
    main()
