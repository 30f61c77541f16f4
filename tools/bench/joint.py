"""Whether a joint refinement of all captures is more exact than the pose graph over their pairs.

A folder holds captures (NAME.ply, NAME.cameras.json, in metres) and truth/NAME.json with T_scene_world. Every pair that
overlaps is refined and judged from its true pose, turned by about 1.5 deg and moved by about 5 cm; the accepted ones
make a pose graph. Beside its poses stand those of

    joint, cells         all captures refined together: in every round each pair's cells are paired anew under the poses
                         that all captures have by then, their normal equations (`gsmap.register.refiners.colored_icp`)
                         over the variance of the distances to the planes are summed, and one sparse step moves all
    joint, information   the same, but that a pair counts by its information, as in the pose graph
    refined again        every pair refined anew from where the graph has it, and the graph solved again
    graph, cells         the pose graph, but that a pair counts by its cells; nothing is paired anew

    python -m tools.bench.joint house kitchen_splats places/30* --cache FOLDER
"""

# Thread counts must be set before numpy comes in.
# ruff: noqa: E402
from __future__ import annotations

import os

from tools.harness import argument_parser, timed

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import argparse
import itertools
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.sparse import lil_matrix
from scipy.sparse.linalg import spsolve
from scipy.stats import chi2

from gsmap import optimize
from gsmap.evaluate.calibration import nees_of_pose, relative_covariance
from gsmap.evaluate.registration import pose_error, scene_centroid
from gsmap.geometry.rotations import skew
from gsmap.geometry.similarities import Similarities, exp
from gsmap.register import Params, refinement
from gsmap.register.metric_scene import MetricPair
from gsmap.register.pair import check_pose
from gsmap.register.refiners import colored_icp
from gsmap.register.refiners.colored_icp import _OneWayPairs
from gsmap.register.surface import Surface
from gsmap.types import Edge, Proposal, Registration, Sim3
from tools.bench.refine import Capture, overlapping, perturbed, read_folder
from tools.fit.covariance import working_metres

ROUNDS = 40
WIDE_ROUNDS = 8
STILL_M = 1e-5  # a round that moves no capture's middle by more is the last
_SURE = 1e12  # information on a scale that is known
_CELLS_ALIKE = 1e-3  # cells share their errors: about so many of them are independent; it decides no pose


@dataclass(frozen=True)
class Pair:
    """A pair in use, indices of its captures, its surfaces in working metres, and what was found of it alone."""

    target: int
    source: int
    surfaces: tuple[Surface, Surface]
    found: Registration

    @property
    def information(self) -> np.ndarray:
        """(6, 6) of a rigid pose, whatever its scale, on the source side."""
        assert self.found.information is not None
        return np.asarray(np.linalg.inv(np.linalg.inv(self.found.information)[:6, :6]))


@dataclass
class Place:
    name: str
    captures: list[Capture]
    pairs: list[Pair]
    unit_m: float  # working metres per metre


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--cache", type=Path, required=True, help="keep overlaps here")
    parser.add_argument("--least-overlap", type=float, default=0.1)
    parser.set_defaults(most_pairs=10**9)
    options = parser.parse_args()
    options.cache.mkdir(parents=True, exist_ok=True)
    print("errors: median and most of pairs in use | of all pairs of placed captures; NEES of poses (5.3 expected)")
    for folder in options.folders:
        place, registered = timed(read_place, folder, options)
        if not place.pairs:
            print(f"{place.name}: no pair is accepted", flush=True)
            continue
        began = time.process_time()
        graph, covariances = solved(place, [p.found for p in place.pairs])
        print(f"{place.name}: {len(place.captures)} captures, {len(place.pairs)} pairs in use, "
              f"{registered:.0f} CPU s to read and register", flush=True)  # fmt: skip
        show("pairs alone", place, None, None, 0.0)
        show("pose graph", place, graph, covariances, time.process_time() - began)
        for name, refine in VARIANTS.items():
            poses, took = timed(refine, place, graph)
            show(name, place, poses, covariances, took)


def read_place(folder: Path, options: argparse.Namespace) -> Place:
    """The captures of a folder, and the pairs that are accepted, under one working metre."""
    captures = list(read_folder(folder))
    unit_m = float(np.exp(np.mean([np.log(working_metres(c.view.gaussians, c.view.cameras)) for c in captures])))
    captures = [
        replace(c, view=replace(c.view, graph=replace(c.view.graph, working_m=unit_m), scale_policy="known"))
        for c in captures
    ]
    pairs = []
    for a, b, _ in overlapping(folder, captures, options):
        truth = a.S_scene_world @ b.S_scene_world.inverse()
        start = perturbed(truth, b, np.random.default_rng([ord(c) for c in f"{folder.name}{a.name}{b.name}"]))
        proposal = Proposal("bench", start, False, 100, log_nfa=-30.0)
        found = check_pose(a.view, b.view, proposal)
        if found.status == "accepted":
            metric = MetricPair.of(a.view, b.view, proposal, Params())
            surfaces = metric.target.surface(), metric.source.surface()
            pairs.append(Pair(captures.index(a), captures.index(b), surfaces, found))
    return Place(folder.name, captures, pairs, unit_m)


def solved(place: Place, found: list[Registration]) -> tuple[dict[int, Sim3], dict[int, np.ndarray]]:
    """Poses and covariances of the pose graph by index of the capture, those in the largest component."""
    names = [f"{i:03d}" for i in range(len(place.captures))]
    edges = [
        Edge(names[p.target], names[p.source], r.S_target_source, r.information)
        for p, r in zip(place.pairs, found, strict=True)
        if r.S_target_source is not None and r.information is not None
    ]
    answer = optimize.optimize(names, edges)
    placed = {int(n): p for n, p in answer.poses.items() if p.component == 0 and p.status != "isolated"}
    return (
        {i: p.S_map_scene for i, p in placed.items()},
        {i: p.covariance for i, p in placed.items() if p.covariance is not None},
    )


# --- refining jointly ------------------------------------------------------------------------------------------------


def jointly(place: Place, start: dict[int, Sim3], *, by_information: bool) -> dict[int, Sim3]:
    """Gauss-Newton over all poses, every pair's cells paired anew in every round."""
    unit, radii_m = place.unit_m, colored_icp.FULL.radii_m
    poses = {i: Sim3(S.rotation, S.translation * unit) for i, S in start.items()}
    used = [p for p in place.pairs if p.target in poses and p.source in poses]
    free = {i: k for k, i in enumerate(sorted(poses)[1:])}  # the first holds the frame
    noise, W = [radii_m[-2] / colored_icp._MIN_SIGMAS] * len(used), np.diag(np.r_[np.ones(3), np.full(3, 1 / unit)])
    for around in range(ROUNDS):
        if around in (0, WIDE_ROUNDS):  # then as fine as each pair's noise allows, as a pair alone is refined
            finest = radii_m[-2 if around == 0 else -1]
            radii = [min(radii_m[-2], max(finest, colored_icp._MIN_SIGMAS * n)) for n in noise]
            laid = [_laid(pair) for pair in used]
        system, gradient = lil_matrix((6 * len(free), 6 * len(free))), np.zeros(6 * len(free))
        for k, pair in enumerate(used):
            S = poses[pair.target].inverse() @ poses[pair.source]
            H, g, noise[k] = _equations(pair, laid[k], S, radii[k])
            if by_information:  # it pulls to where the pair by itself would step to
                information = W @ pair.information @ W
                H, g = information, information @ np.linalg.solve(H, g)
            by_target = -Similarities.stack([S.inverse()]).adjoint()[0][:6, :6]
            ends = [(free[i], J) for i, J in ((pair.target, by_target), (pair.source, np.eye(6))) if i in free]
            for a, J in ends:
                gradient[6 * a : 6 * a + 6] += J.T @ g
                for b, K in ends:
                    system[6 * a : 6 * a + 6, 6 * b : 6 * b + 6] += J.T @ H @ K
        step = -colored_icp._OVERSTEP * spsolve(system.tocsc(), gradient).reshape(-1, 6)
        moved = 0.0
        for i, k in free.items():
            new, middle = poses[i] @ exp(step[k][None]).item(0), place.captures[i].view.centre * unit
            moved = max(moved, float(np.linalg.norm(new.apply(middle) - poses[i].apply(middle))))
            poses[i] = new
        if around > WIDE_ROUNDS and moved < STILL_M:
            break
    return {i: Sim3(S.rotation, S.translation / unit) for i, S in poses.items()}


def again(place: Place, start: dict[int, Sim3]) -> dict[int, Sim3]:
    """Every pair refined anew from where the graph has it, and the graph solved again."""
    found = []
    for pair in place.pairs:
        a, b = place.captures[pair.target], place.captures[pair.source]
        S = pair.found.S_target_source
        if pair.target in start and pair.source in start:
            S = start[pair.target].inverse() @ start[pair.source]
        metric = MetricPair.of(a.view, b.view, Proposal("bench", S, False, 100), Params())
        pose = refinement.refine_fine(metric, metric.to_metres(S), Params(), with_scale=False)
        found.append(replace(pair.found, S_target_source=metric.to_scene_units(pose)))
    return solved(place, found)[0]


def by_cells(place: Place, start: dict[int, Sim3]) -> dict[int, Sim3]:
    """A pose graph over the pairs' own poses, each weighed by its cells there."""
    unit, found, radii_m = place.unit_m, [], colored_icp.FULL.radii_m
    for pair in place.pairs:
        S = pair.found.S_target_source
        assert S is not None
        S, noise = Sim3(S.rotation, S.translation * unit), radii_m[-2] / colored_icp._MIN_SIGMAS
        for finest in radii_m[-2:]:
            laid = _laid(pair)
            system, _, noise = _equations(pair, laid, S, min(radii_m[-2], max(finest, colored_icp._MIN_SIGMAS * noise)))
        W = np.diag(np.r_[np.ones(3), np.full(3, unit)])
        information = _SURE * np.eye(7)
        information[:6, :6] = _CELLS_ALIKE * W @ system @ W
        found.append(replace(pair.found, information=information))
    return solved(place, found)[0]


def _laid(pair: Pair) -> tuple[_OneWayPairs, _OneWayPairs]:
    """The cells of each capture, to be laid on the other's."""
    count = colored_icp.FULL.max_points[-1] // 2
    return _OneWayPairs(*pair.surfaces, count), _OneWayPairs(*pair.surfaces[::-1], count, backward=True)


def _equations(
    pair: Pair, laid: tuple[_OneWayPairs, _OneWayPairs], S: Sim3, radius: float
) -> tuple[np.ndarray, np.ndarray, float]:
    """Normal equations (6, 6), (6,) of a pair under a pose (working metres) about the source's origin, over the
    variance of the distances to the planes; and the standard deviation of these."""
    params, centre = colored_icp.Params(), pair.surfaces[1].coarse[0].mean(0)
    there, back = (
        one.equations(pose, centre, radius, params) for one, pose in zip(laid, (S, S.inverse()), strict=True)
    )
    share = there.count / max(back.count, 1)
    about = np.eye(6)
    about[3:6, :3] = -skew(centre)
    system = about.T @ (there.system + share * back.system)[:6, :6] @ about
    gradient = about.T @ (there.gradient + share * back.gradient)[:6]
    return system / there.noise_m**2, gradient / there.noise_m**2, there.noise_m


VARIANTS: dict[str, Callable[[Place, dict[int, Sim3]], dict[int, Sim3]]] = {
    "joint, cells": lambda place, start: jointly(place, start, by_information=False),
    "joint, information": lambda place, start: jointly(place, start, by_information=True),
    "refined again": again,
    "graph, cells": by_cells,
}


# --- the table -------------------------------------------------------------------------------------------------------


def show(
    name: str, place: Place, poses: dict[int, Sim3] | None, covariances: dict[int, np.ndarray] | None, seconds: float
) -> None:
    tied = [_error(place, p.target, p.source, p.found.S_target_source) for p in place.pairs] if poses is None else []
    everything = []
    if poses is not None:
        used = {(p.target, p.source) for p in place.pairs}
        for a, b in itertools.combinations(sorted(poses), 2):
            everything.append(_error(place, a, b, poses[a].inverse() @ poses[b]))
            if (a, b) in used:
                tied.append(everything[-1])
    said = f"  {name:18s} {_figures(tied)}" + (f" | {_figures(everything)}" if everything else "")
    if poses is not None and covariances:
        said += f"; NEES {_nees(place, poses, covariances)}"
    print(f"{said}; {seconds:.1f} CPU s", flush=True)


def _error(place: Place, a: int, b: int, S: Sim3) -> tuple[float, float]:
    target, source = place.captures[a], place.captures[b]
    e = pose_error(S, target.S_scene_world @ source.S_scene_world.inverse(), scene_centroid(source.view.gaussians))
    return e.rre_deg, 100 * e.centroid_m


def _figures(errors: list[tuple[float, float]]) -> str:
    degrees, centimetres = np.array(errors).T
    return (
        f"{np.median(degrees):.4f} {degrees.max():.4f} deg, {np.median(centimetres):.3f} {centimetres.max():.3f} cm "
        f"(rms {np.sqrt((degrees**2).mean()):.4f}, {np.sqrt((centimetres**2).mean()):.3f})"
    )


def _nees(place: Place, poses: dict[int, Sim3], covariances: dict[int, np.ndarray]) -> str:
    anchor, *others = sorted(poses)
    values = []
    for i in others:
        S = poses[anchor].inverse() @ poses[i]
        known = relative_covariance(S, covariances[i], covariances[anchor])
        if known is not None:
            true = place.captures[anchor].S_scene_world @ place.captures[i].S_scene_world.inverse()
            values.append(nees_of_pose(S, known, true).value / chi2.ppf(0.5, 6))
    return f"{np.median(values) * chi2.ppf(0.5, 6):.1f}" if values else "-"


if __name__ == "__main__":
    main()
