"""How exact and how costly the refinement of a pose is: gsmap's, stage by stage, beside GICP from the same start.

A folder holds captures (NAME.ply, NAME.cameras.json) and truth/NAME.json with T_scene_world. Every pair that overlaps
starts from its true pose, turned by about 1.5 deg and moved by about 5 cm, and is refined and judged as `register_pair`
does with a proposal. Errors are those of pairs that gsmap accepts, and of all; GICP (small_gicp) takes every surface
point, and the correspondence distance that serves it best over all accepted pairs is named. CPU seconds are of the
process on one thread: those of a pair whose scenes were met before, and what a scene costs when it is met first.

    python -m tools.bench.refine house kitchen_splats --cache FOLDER
    python -m tools.bench.refine places/30* --no-gicp --cache FOLDER --profile
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
import json
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from gsmap.evaluate.overlap import solid_centres, true_overlaps
from gsmap.evaluate.registration import pose_error, scene_centroid
from gsmap.geometry.rotations import exp_so3
from gsmap.geometry.similarities import Similarities
from gsmap.ingest import read_captures
from gsmap.register import SceneView, refinement, scale_selection
from gsmap.register import pair as pair_module
from gsmap.register.pair import check_pose
from gsmap.types import NodeLayer, Proposal, SceneGraph, Sim3

TURN_DEG, SHIFT_M = 1.5, 0.05
GICP_RADII_M = (0.03, 0.05, 0.1, 0.2, 0.4)


@dataclass
class Capture:
    name: str
    view: SceneView
    S_scene_world: Sim3
    kept: dict[str, Any] = field(default_factory=dict)

    def all_points(self) -> tuple[Any, Any]:
        """Every surface point, as small_gicp takes them."""
        if "cloud" not in self.kept:
            import small_gicp

            cloud = small_gicp.PointCloud(self.view.surface().points)
            tree = small_gicp.KdTree(cloud, num_threads=1)
            small_gicp.estimate_normals_covariances(cloud, tree, num_neighbors=20, num_threads=1)
            self.kept["cloud"] = cloud, tree
        return self.kept["cloud"]


@dataclass
class Row:
    """One pair: errors (degrees, metres, scale) by method, seconds by stage, squared error over covariance."""

    pair: str
    overlap: float
    accepted: bool
    errors: dict[str, tuple[float, float, float]]
    seconds: dict[str, float]
    first_s: float
    nees: float


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--cache", type=Path, required=True, help="keep overlaps and what GICP answered here")
    parser.add_argument("--least-overlap", type=float, default=0.1)
    parser.add_argument("--most-pairs", type=int, default=10**9, metavar="N", help="of each folder, evenly drawn")
    parser.add_argument("--no-gicp", action="store_true")
    parser.add_argument("--profile", action="store_true", help="one line per pair with its stages")
    options = parser.parse_args()
    options.cache.mkdir(parents=True, exist_ok=True)
    rows, hopeless = [], []
    for folder in options.folders:
        captures = list(read_folder(folder))
        pairs = overlapping(folder, captures, options)
        for a, b, overlap in pairs:
            rows.append(run(folder, a, b, overlap, options))
            if options.profile:
                print(_line(rows[-1]), flush=True)
        hopeless += [hopeless_s(a, b) for a, b, _ in pairs[:3]]
    if rows:
        report(rows, hopeless)


def read_folder(folder: Path) -> Iterator[Capture]:
    for read in read_captures(folder):
        path = folder / "truth" / f"{read.name}.json"
        if path.exists():
            S = Sim3.from_matrix(np.array(json.loads(path.read_text())["T_scene_world"]))
            graph = SceneGraph(read.name, {"landmarks": _no_nodes()}, None, 1.0)
            yield Capture(read.name, SceneView(read.name, read.gaussians, read.cameras, graph, "auto"), S)


def _no_nodes() -> NodeLayer:
    empty = np.zeros(0)
    return NodeLayer(np.zeros((0, 3)), np.zeros((0, 1)), empty, empty, np.zeros((0, 2, 3)), np.zeros((0, 1)), empty, "")


def overlapping(folder: Path, captures: list[Capture], options: argparse.Namespace):
    """The pairs of a folder that overlap enough; overlaps are kept in the cache."""
    path = options.cache / f"{folder.parent.name}-{folder.name}.overlaps.json"
    if not path.exists():
        centres = {c.name: solid_centres(c.view.gaussians, c.S_scene_world) for c in captures}
        found = true_overlaps(list(centres), centres.__getitem__)
        path.write_text(json.dumps({"|".join(sorted(pair)): overlap for pair, overlap in found.items()}))
    overlaps = json.loads(path.read_text())
    pairs = [(a, b, overlaps["|".join(sorted((a.name, b.name)))]) for a, b in itertools.combinations(captures, 2)]
    pairs = [p for p in pairs if p[2] >= options.least_overlap]
    return pairs[:: max(1, -(-len(pairs) // options.most_pairs))]


def run(folder: Path, a: Capture, b: Capture, overlap: float, options: argparse.Namespace) -> Row:
    truth = a.S_scene_world @ b.S_scene_world.inverse()
    start = perturbed(truth, b, np.random.default_rng([ord(c) for c in f"{folder.name}{a.name}{b.name}"]))
    proposal = Proposal("bench", start, False, 100, log_nfa=-30.0)
    began = time.process_time()
    check_pose(a.view, b.view, proposal)
    cold = time.process_time() - began
    with stages() as seconds:
        found, seconds["all"] = timed(check_pose, a.view, b.view, proposal)
    poses = {"start": start, "gsmap": found.S_target_source, **seconds.pop("poses")}
    if not options.no_gicp:
        poses |= gicp(folder, a, b, start, options.cache, seconds)
    centre = scene_centroid(b.view.gaussians)
    errors = {}
    for name, pose in poses.items():
        e = pose_error(pose, truth, centre)
        errors[name] = (e.rre_deg, e.centroid_m / a.S_scene_world.scale, e.rse)
    nees = float("nan")
    if found.information is not None:
        off = (Similarities.stack([found.S_target_source]).inverse() @ Similarities.stack([truth])).log()[0]
        nees = float(off @ found.information @ off)
    name = f"{folder.name}/{a.name}-{b.name}"
    return Row(name, overlap, found.status == "accepted", errors, seconds, cold - seconds["all"], nees)


def perturbed(truth: Sim3, source: Capture, rng: np.random.Generator) -> Sim3:
    """The pose about the source's centre turned about any axis and moved in any direction."""
    centre = scene_centroid(source.view.gaussians)
    axis, direction = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    turn = exp_so3(np.radians(TURN_DEG * rng.uniform(0.7, 1.3)) * axis)
    return truth @ Sim3(turn, centre - turn @ centre + SHIFT_M * rng.uniform(0.7, 1.3) * direction)


@contextmanager
def stages() -> Iterator[dict[str, Any]]:
    """CPU seconds of each stage of a pair while this is entered, and the pose after each under ``poses``."""
    seconds: dict[str, Any] = defaultdict(float)
    seconds["poses"] = {}

    def timed(name: str, inner):
        def call(*args, **more):
            scaled = more.get("with_scale")
            label = name if scaled is None else f"{name} {'scaled' if scaled else 'rigid'}"
            out, took = timed(inner, *args, **more)
            seconds[label] += took
            if isinstance(out, Sim3):
                pair = args[0]
                seconds["poses"][label] = pair.to_scene_units(out)
            return out

        return call

    with ExitStack() as stack:
        for module, attribute, name in (
            (refinement, "refine_coarse", "coarse"),
            (refinement, "refine_fine", "fine"),
            (scale_selection, "condition", "condition"),
            (pair_module, "measure", "measure"),
        ):
            stack.enter_context(mock.patch.object(module, attribute, timed(name, getattr(module, attribute))))
        yield seconds


def gicp(folder: Path, a: Capture, b: Capture, start: Sim3, cache: Path, seconds: dict[str, Any]) -> dict[str, Sim3]:
    """GICP on all surface points at each radius; kept in the cache."""
    path = cache / f"{folder.parent.name}-{folder.name}-{a.name}-{b.name}.gicp.json"
    if not path.exists():
        import small_gicp

        (target, tree), (source, _) = a.all_points(), b.all_points()
        answers = {}
        for radius in GICP_RADII_M:
            began = time.process_time()
            result = small_gicp.align(
                target, source, tree, init_T_target_source=start.matrix(), registration_type="GICP",
                max_correspondence_distance=radius, num_threads=1, max_iterations=100,
            )  # fmt: skip
            answers[f"gicp {radius:g}"] = (result.T_target_source.tolist(), time.process_time() - began)
        path.write_text(json.dumps(answers))
    answers = json.loads(path.read_text())
    seconds |= {name: spent for name, (_, spent) in answers.items()}
    return {name: Sim3.from_matrix(np.array(pose)) for name, (pose, _) in answers.items()}


def hopeless_s(a: Capture, b: Capture) -> float:
    """CPU seconds of a pose that is wrong, of captures met before."""
    turn = exp_so3([0.0, 0.0, 2.0])
    pose = Sim3(turn, a.view.centre - turn @ b.view.centre)
    proposal = Proposal("bench", pose, False, 5, log_nfa=0.0)
    check_pose(a.view, b.view, proposal)
    return timed(check_pose, a.view, b.view, proposal)[1]


# --- the tables ----------------------------------------------------------------------------------------------------


def _line(row: Row) -> str:
    degrees, metres, scale = row.errors["gsmap"]
    spent = "  ".join(f"{k} {v:.2f}" for k, v in row.seconds.items() if not k.startswith("gicp"))
    verdict = "accepted" if row.accepted else "refused"
    return (
        f"{row.pair} overlap {row.overlap:.2f} {verdict}: {degrees:.3f} deg {100 * metres:.2f} cm {scale:.2%} "
        f"NEES {row.nees:.1f};  CPU s {spent}; first meeting {row.first_s:.2f}"
    )


def report(rows: list[Row], hopeless: list[float]) -> None:
    accepted = [r for r in rows if r.accepted]
    print(f"{len(rows)} pairs, {len(accepted)} accepted")
    places = sorted({r.pair.split("/")[0] for r in rows})
    tables = {"accepted": accepted, "all": rows}
    if 1 < len(places) <= 4:
        tables |= {f"accepted, {p}": [r for r in accepted if r.pair.startswith(f"{p}/")] for p in places}
    for title, some in tables.items():
        if some:
            print(f"\n{title} ({len(some)}): median and 90 % of degrees, of cm; scale; better than gsmap")
            for name in dict.fromkeys(n for r in some for n in r.errors):
                have = [r for r in some if name in r.errors]
                degrees, metres, scale = np.array([r.errors[name] for r in have]).T
                own = np.array([r.errors["gsmap"] for r in have])
                print(
                    f"  {name:14s} {np.median(degrees):6.3f} {np.quantile(degrees, 0.9):6.3f} deg "
                    f"{100 * np.median(metres):6.3f} {100 * np.quantile(metres, 0.9):6.2f} cm "
                    f"{np.median(scale):.3%} n {len(have):3d}  "
                    f"{(degrees < own[:, 0]).mean():4.0%} {(metres < own[:, 1]).mean():4.0%}"
                )
    print("\nCPU s of an accepted pair whose scenes were met before, median (90 %)")
    for name in dict.fromkeys(n for r in accepted for n in r.seconds):
        values = [r.seconds[name] for r in accepted if name in r.seconds]
        print(f"  {name:14s} {np.median(values):.3f} ({np.quantile(values, 0.9):.3f}) n {len(values)}")
    print(f"  scenes met first: {np.median([r.first_s for r in accepted]):.3f} more")
    print(f"  a hopeless pose: {np.median(hopeless):.3f}")
    print(f"NEES of accepted: median {np.nanmedian([r.nees for r in accepted]):.1f}")


if __name__ == "__main__":
    main()
