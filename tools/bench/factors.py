"""How well scales are measured of captures whose unit is nearly, but not quite, a metre: ``auto``, the default.

The source of each pair that overlaps is enlarged by a factor between .95 and 1.05, of which nothing is told. Pairs of
unknown scale get a random factor each.

    python -m tools.bench.factors house kitchen_splats --cache FOLDER
    python -m tools.bench.factors house --factors .98 1.02 --cache FOLDER --describe

The scene graph of an enlarged capture is that of the capture as it is, moved along, which is exact for the layers that
are made under a guess of the metre, and differs for those made under the capture's own unit by what a landmark's radius
differs: --describe makes each anew (10 CPU s).
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
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.stats import chi2

import gsmap.map
from gsmap.evaluate.registration import pose_error, scene_centroid
from gsmap.geometry.similarities import Similarities
from gsmap.ingest import read_captures
from gsmap.register import SceneView, register_pair
from gsmap.types import SceneGraph, Sim3
from tools.bench.register import OVERLAPPING, described, rescaled, true_overlap
from tools.bench.registration_methods import Capture

FACTORS = tuple(np.round(np.arange(0.95, 1.051, 0.01), 2).tolist())
RIGHT_DEG, RIGHT_M = 5.0, 0.3
HONEST = float(chi2.ppf(0.5, 7))


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--factors", nargs="+", type=float, default=FACTORS)
    parser.add_argument("--describe", action="store_true", help="describe each enlarged capture anew")
    parser.add_argument("--cache", type=Path, required=True, help="keep scene graphs here")
    options = parser.parse_args()
    options.cache.mkdir(parents=True, exist_ok=True)
    with gsmap.map.open_or_create(options.cache / "bench.gsmap") as m:
        for folder in options.folders:
            captures = read_folder(m, folder)
            pairs = [(a, b) for a, b in itertools.combinations(captures, 2) if true_overlap(a, b) >= OVERLAPPING]
            for factor in options.factors:
                run(f"{folder.name}, auto, x {factor:.3f}", [(a, enlarged(m, b, factor, options)) for a, b in pairs])
            rng = np.random.default_rng(0)
            drawn = {c.name: float(np.exp(rng.uniform(-1, 1) * np.log(5))) for c in captures}
            scaled = {c.name: enlarged(m, c, drawn[c.name], options, "unknown") for c in captures}
            run(f"{folder.name}, unknown", [(scaled[a.name], scaled[b.name]) for a, b in pairs])
    print(
        f"accepted: of the pairs that overlap by {OVERLAPPING:.0%}; scale, centroid: errors of those, median and worst "
        f"(centroids in metres); NEES: normalised squared errors, 7 degrees of freedom (honest median {HONEST:.2f}, "
        f"99 % {chi2.ppf(0.99, 7):.1f}); sigma: median claimed standard deviation of the scale"
    )


def read_folder(m, folder: Path) -> list[Capture]:
    """The captures of a folder whose pose is known, described as they are."""
    import json

    out = []
    for read in read_captures(folder):
        truth = folder / "truth" / f"{read.name}.json"
        if truth.exists():
            S = Sim3.from_matrix(np.array(json.loads(truth.read_text())["T_scene_world"]))
            out.append(described(m, read.name, folder.name, read.gaussians, read.cameras, S, "auto"))
    return out


def enlarged(m, capture: Capture, factor: float, options: argparse.Namespace, policy: str = "auto") -> Capture:
    """A capture in another unit, with its graph made anew or moved along."""
    if factor == 1.0 and policy == "auto":
        return capture
    gaussians, cameras, S = rescaled(capture.view.gaussians, capture.view.cameras, capture.S_scene_world, factor)
    if options.describe:
        return described(m, f"{capture.name}x{factor:.3f}", capture.place, gaussians, cameras, S, policy)
    layers = {
        name: replace(
            layer,
            positions=layer.positions * factor,
            extents=layer.extents * factor,
            unit_m=layer.unit_m / factor if ":" in name else layer.unit_m,
        )
        for name, layer in capture.graph.layers.items()
        if policy == "auto" or ":" in name
    }
    graph = SceneGraph(capture.view.id, layers, capture.graph.up, capture.graph.unit_m / factor)
    view = SceneView(capture.view.id, gaussians, cameras, graph, policy)
    return Capture(capture.name, capture.place, view, S)


def run(name: str, pairs: list[tuple[Capture, Capture]]) -> None:
    """Register the pairs and print one line for each, and one for all."""
    rows, seconds = [], []
    for a, b in pairs:
        found, took = timed(register_pair, a.view, b.view)
        seconds.append(took)
        said = f"  {a.name}-{b.name} {found.status}"
        if found.status == "accepted":
            truth = a.S_scene_world @ b.S_scene_world.inverse()
            error = pose_error(found.S_target_source, truth, scene_centroid(b.view.gaussians))
            off = (Similarities.stack([found.S_target_source]).inverse() @ Similarities.stack([truth])).log()[0]
            nees = float(off @ found.information @ off)
            sigma = float(np.sqrt(np.linalg.inv(found.information)[6, 6]))
            metres = error.centroid_m / a.S_scene_world.scale
            rows.append((error.rse, metres, nees, sigma, error.rre_deg))
            said += (
                f" {error.rre_deg:.2f} deg {100 * metres:.1f} cm scale {error.rse:.3%} (sigma {sigma:.3%}) "
                f"NEES {nees:.1f}" + (" rigid" if found.S_target_source.is_rigid else "")
            )
        print(f"{said} {found.reason} {' '.join(found.notes)}".rstrip(), flush=True)
    if rows:
        scale, metres, nees, sigma, degrees = np.array(rows).T
        wrong = int(((degrees > RIGHT_DEG) | (metres > RIGHT_M)).sum())
        print(
            f"{name}: accepted {len(rows)} of {len(pairs)}, wrong {wrong}; scale {np.median(scale):.3%} "
            f"{scale.max():.3%}; centroid {100 * np.median(metres):.2f} cm {100 * metres.max():.1f} cm; "
            f"NEES {np.median(nees):.1f} {nees.max():.1f}; sigma {np.median(sigma):.3%}; "
            f"CPU {np.median(seconds):.2f} s",
            flush=True,
        )


if __name__ == "__main__":
    main()
