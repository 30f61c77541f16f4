"""Registers all pairs of captures of made courts, 64 m long and seen from 3 to 15 m, in metres and in other units.

    python -m tools.bench.large --seeds 501 502 503 --cache FOLDER

Each court (`gsmap_synthetic.court`) is captured six times. Four times over the same pairs: in metres and told so, in
metres and not told (``auto``), and each capture times a random factor from .2 to 5, not told (``auto``) and told to be
in no known unit (``unknown``). What is known of the unit should make no difference. Seeds from 500 on are for testing:
nothing was chosen by them.

Under each line stands what GICP (small_gicp, all surface points, the best of three radii for each pair by the truth)
makes of every accepted pair, started where gsmap ended: a peer that is given the best of starts and of settings.
"""

# Thread counts must be set before numpy comes in.
# ruff: noqa: E402
from __future__ import annotations

import os

from tools.harness import argument_parser

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import argparse
import itertools
import json
import time
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from scipy.stats import chi2

import gsmap.map
from gsmap.evaluate.overlap import solid_centres, true_overlaps
from gsmap.evaluate.registration import pose_error, scene_centroid
from gsmap.geometry.similarities import Similarities
from gsmap.ingest import read_captures
from gsmap.register import register_pair, surface
from gsmap.types import Sim3
from tools.bench.register import described, rescaled
from tools.bench.registration_methods import Capture

MODES = {"metres, known": ("known", False), "metres, auto": ("auto", False)}
MODES |= {"random factors, auto": ("auto", True), "random factors, unknown": ("unknown", True)}
RIGHT_DEG, RIGHT_M = 5.0, 1.2  # as 30 cm in a room, four times as near
SIZE = 4.0  # of what is seen, against rooms: overlap is counted within 4 x 8 cm
GICP_RADII_M = (0.15, 0.3, 0.6)


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--seeds", nargs="+", type=int, default=[501, 502])
    parser.add_argument("--captures", type=int, default=6)
    parser.add_argument("--steps", type=int, default=150)
    parser.add_argument("--gaussians", type=int, default=60_000)
    parser.add_argument("--modes", nargs="+", default=list(MODES), choices=list(MODES))
    parser.add_argument("--gicp", action="store_true", help="let GICP refine what was accepted in metres")
    parser.add_argument("--cache", type=Path, required=True, help="keep captures and scene graphs here")
    parser.add_argument("--verbose", action="store_true", help="one line per pair")
    options = parser.parse_args()
    options.cache.mkdir(parents=True, exist_ok=True)
    rows: dict[str, list[dict[str, Any]]] = {mode: [] for mode in options.modes}
    with gsmap.map.open_or_create(options.cache / "bench.gsmap") as m:
        for seed in options.seeds:
            folder = make_folder(options, seed)
            for mode in options.modes:
                rows[mode] += run(m, folder, seed, mode, options)
    for mode, found in rows.items():
        print_line(mode, found)
    print(
        "pairs over 25 % overlap (surface within 32 cm), of 10 to 25 %, and below accepted; wrong: beyond "
        f"{RIGHT_DEG:.0f} deg or {RIGHT_M} m; errors of the right ones, median and worst; chi2: normalised squared "
        f"errors (honest median {chi2.ppf(0.5, 6):.2f} rigid, {chi2.ppf(0.5, 7):.2f} with scale)"
    )


def make_folder(options: argparse.Namespace, seed: int) -> Path:
    """The captures of a court, made where they are not there yet."""
    from gsmap_synthetic import write_captures
    from gsmap_synthetic.court import court_captures

    folder: Path = options.cache / str(seed)
    if not (folder / "done").exists():
        made = court_captures(
            seed, options.captures, steps=options.steps, num_gaussians=options.gaussians, vary_exposure=True
        )
        write_captures(folder, made)
        (folder / "done").touch()
    return folder


def run(m: Any, folder: Path, seed: int, mode: str, options: argparse.Namespace) -> list[dict[str, Any]]:
    """Register the pairs of one court."""
    policy, drawn = MODES[mode]
    rng, captures, centres = np.random.default_rng([seed, 41]), [], {}
    for read in read_captures(folder):
        S = Sim3.from_matrix(
            np.array(json.loads((folder / "truth" / f"{read.name}.json").read_text())["T_scene_world"])
        )
        parts = read.gaussians, read.cameras, S
        if drawn:
            parts = rescaled(*parts, float(np.exp(rng.uniform(-1, 1) * np.log(5))))
        captures.append(described(m, read.name, f"{seed} {mode}", *parts, policy))
        near = captures[-1].S_scene_world @ Sim3(np.eye(3), np.zeros(3), SIZE)
        centres[captures[-1].name] = solid_centres(captures[-1].view.gaussians, near)
    overlaps = true_overlaps(list(centres), centres.__getitem__)
    rows = []
    for a, b in itertools.combinations(captures, 2):
        overlap = overlaps.get(frozenset((a.name, b.name)), 0.0)
        start = time.process_time()
        found = register_pair(a.view, b.view)
        row: dict[str, Any] = {
            "overlap": overlap,
            "seconds": time.process_time() - start,
            "accepted": found.status == "accepted",
        }
        said = f"{seed} {mode}: {a.name}-{b.name} overlap {overlap:.2f} {found.status}"
        if found.status == "accepted" and found.S_target_source is not None:
            row |= measured(a, b, found.S_target_source, found.information)
            said += f" {row['deg']:.3f} deg {100 * row['m']:.2f} cm scale {row['scale']:.3%} chi2 {row['chi2']:.1f}"
            if options.gicp and mode == "metres, known":
                row["gicp"] = gicp(a, b, found.S_target_source)
                said += f"; GICP {row['gicp'][0]:.3f} deg {100 * row['gicp'][1]:.2f} cm"
        if options.verbose:
            print(f"{said} {found.reason} ({row['seconds']:.2f} s)", flush=True)
        rows.append(row)
    return rows


def measured(a: Capture, b: Capture, S: Sim3, information: np.ndarray | None) -> dict[str, float]:
    truth = a.S_scene_world @ b.S_scene_world.inverse()
    error = pose_error(S, truth, scene_centroid(b.view.gaussians))
    off = (Similarities.stack([S]).inverse() @ Similarities.stack([truth])).log()[0]
    chi = float(off @ information @ off) if information is not None else float("nan")
    return {
        "deg": error.rre_deg,
        "m": error.centroid_m / a.S_scene_world.scale,
        "scale": error.rse,
        "chi2": chi,
    }


def gicp(a: Capture, b: Capture, start: Sim3) -> tuple[float, float]:
    """The errors of GICP from a start (captures in metres), at the radius that is best by the truth."""
    import small_gicp

    clouds = []
    for capture in (a, b):
        with mock.patch.object(surface, "MAX_SCALE_M", 0.5):
            points = surface.Surface.of(capture.view.gaussians).points
        cloud = small_gicp.PointCloud(points)
        tree = small_gicp.KdTree(cloud, num_threads=1)
        small_gicp.estimate_normals_covariances(cloud, tree, num_neighbors=20, num_threads=1)
        clouds.append((cloud, tree))
    errors = []
    for radius in GICP_RADII_M:
        result = small_gicp.align(
            clouds[0][0],
            clouds[1][0],
            clouds[0][1],
            init_T_target_source=Sim3(start.rotation, start.translation).matrix(),
            registration_type="GICP",
            max_correspondence_distance=radius,
            num_threads=1,
            max_iterations=30,
        )
        row = measured(a, b, Sim3.from_matrix(result.T_target_source), None)
        errors.append((row["deg"], row["m"]))
    return min(errors, key=lambda e: e[1])


def print_line(mode: str, rows: list[dict[str, Any]]) -> None:
    def right(r: dict[str, Any]) -> bool:
        return bool(r["accepted"] and r["deg"] < RIGHT_DEG and r["m"] < RIGHT_M)

    bands = []
    for low, high in ((0.25, 1.01), (0.1, 0.25), (0.0, 0.1)):
        band = [r for r in rows if low <= r["overlap"] < high]
        bands.append(f"{sum(right(r) for r in band)} of {len(band)}")
    good = [r for r in rows if right(r)]
    line = f"{mode:24s} {', '.join(bands)}; wrong {sum(r['accepted'] and not right(r) for r in rows)}"
    if good:
        deg, m, scale, chi = (np.array([r[k] for r in good]) for k in ("deg", "m", "scale", "chi2"))
        line += (
            f"; {np.median(deg):.3f} deg {deg.max():.2f}, {100 * np.median(m):.2f} cm {100 * m.max():.1f}, "
            f"scale {np.median(scale):.3%}, chi2 {np.median(chi):.1f}"
        )
    seconds = [r["seconds"] for r in rows]
    print(f"{line}; {np.median(seconds):.2f} CPU s a pair", flush=True)
    peers = np.array([r["gicp"] for r in good if "gicp" in r])
    if len(peers):
        print(f"{'':24s} GICP from there: {np.median(peers[:, 0]):.3f} deg, {100 * np.median(peers[:, 1]):.2f} cm")


if __name__ == "__main__":
    main()
