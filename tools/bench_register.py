"""Registers all pairs of captures with known poses: gsmap, what else one would pick, and ablations, in one table.

A folder holds captures (NAME.ply, NAME.cameras.json) and truth/NAME.json with T_scene_world. Pairs of different folders
are true negatives. CPU seconds are of the process, single-threaded, from cached scene graphs.

    python tools/bench_register.py house kitchen_splats --methods gsmap,kiss,fpfh --json out.json
    python tools/bench_register.py house --rescale --methods gsmap
    python tools/bench_register.py --made 15 --methods gsmap
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
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from gsmap.evaluate.registration import PoseError, pose_error, scene_centroid, summarise
from gsmap.geometry.transforms import transform_cameras, transform_gaussians
from gsmap.register import Params, SceneView, dense, propose, register_pair
from gsmap.register.clique import maximum_clique
from gsmap.register.consistency import Params as TestParams
from gsmap.register.consistency import consistency_graph, unpack
from gsmap.register.correspondences import Correspondences, correspondences
from gsmap.register.pose import fit_pose
from gsmap.register.refiners import gicp
from gsmap.register.surface import Params as SurfaceParams
from gsmap.types import Cameras, Gaussians, SceneGraph, Sim3

OVERLAPPING = 0.25


@dataclass
class Capture:
    name: str
    place: str
    view: SceneView
    S_scene_world: Sim3

    @property
    def graph(self) -> SceneGraph:
        return self.view.graph

    def surface(self):
        return self.view.surface(1.0, SurfaceParams())


@dataclass
class Answer:
    """What a method says of a pair: a pose it stands by, or None; ``note`` for people."""

    pose: Sim3 | None
    note: str = ""


# --- methods -------------------------------------------------------------------------------------------------------


def gsmap(params: Params | None = None) -> Callable[[Capture, Capture], Answer]:
    def run(target: Capture, source: Capture) -> Answer:
        found = register_pair(target.view, source.view, params)
        e = found.evidence
        note = f"{found.status} {found.method} w={found.num_inliers} " + " ".join(f"{k}={v:.2f}" for k, v in e.items())
        return Answer(found.S_target_source if found.status == "accepted" else None, f"{note} {found.reason}")

    return run


def proposal(params: propose.Params | None = None, kind: str = "landmarks") -> Callable[[Capture, Capture], Answer]:
    """The clique's pose, unrefined and unjudged."""

    def run(target: Capture, source: Capture) -> Answer:
        found = propose.propose(target.graph, source.graph, kind, params)
        return Answer(found[0].S_target_source, f"w={found[0].num_inliers}") if found else Answer(None)

    return run


def _landmark_matches(target: Capture, source: Capture) -> Correspondences:
    a, b = target.graph, source.graph
    return correspondences(a.layers["landmarks"], b.layers["landmarks"], ups=(a.up, b.up))


def no_clique(target: Capture, source: Capture) -> Answer:
    """Least squares over all candidates, no distance test."""
    m = _landmark_matches(target, source)
    return Answer(fit_pose(m.target, m.source).S_target_source) if len(m) > 3 else Answer(None)


def best_score_clique(target: Capture, source: Capture) -> Answer:
    """A clique grown from the most similar candidate, always adding the most similar that agrees with all."""
    m = _landmark_matches(target, source)
    adjacency = unpack(consistency_graph(m))
    best: list[int] = []
    for first in range(min(len(m), 200)):
        members, left = [first], adjacency[first].copy()
        while left.any():
            members.append(int(np.argmax(left)))  # candidates come most similar first
            left &= adjacency[members[-1]]
        if m.similarity[members].sum() > m.similarity[best].sum():
            best = members
    return Answer(fit_pose(m.target[best], m.source[best]).S_target_source if len(best) > 2 else None)


def kiss_gicp(voxel_m: float) -> Callable[[Capture, Capture], Answer]:
    def run(target: Capture, source: Capture) -> Answer:
        found = dense.match_surfaces(target.surface(), source.surface(), dense.Params(voxel_m))
        if found is None:
            return Answer(None)
        return Answer(gicp.refine(target.surface(), source.surface(), found[0]), f"inliers={found[1]}")

    return run


def _fpfh(capture: Capture, voxel_m: float):
    import open3d as o3d

    points = capture.surface().coarse[0]
    centre = points.mean(0)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points - centre)).voxel_down_sample(voxel_m)
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(2 * voxel_m, 30))
    features = o3d.pipelines.registration.compute_fpfh_feature(
        cloud, o3d.geometry.KDTreeSearchParamHybrid(5 * voxel_m, 100)
    )
    return cloud, features, centre


def fpfh_ransac_icp(target: Capture, source: Capture, voxel_m: float = 0.1) -> Answer:
    import open3d as o3d

    reg = o3d.pipelines.registration
    o3d.utility.random.seed(0)
    (a, fa, ca), (b, fb, cb) = _fpfh(target, voxel_m), _fpfh(source, voxel_m)
    checks = [
        reg.CorrespondenceCheckerBasedOnEdgeLength(0.9),
        reg.CorrespondenceCheckerBasedOnDistance(1.5 * voxel_m),
    ]
    found = reg.registration_ransac_based_on_feature_matching(
        b, a, fb, fa, True, 1.5 * voxel_m, reg.TransformationEstimationPointToPoint(False), 3, checks,
        reg.RANSACConvergenceCriteria(1_000_000, 0.999),
    )  # fmt: skip
    plane, stop = reg.TransformationEstimationPointToPlane(), reg.ICPConvergenceCriteria(max_iteration=50)
    fine = reg.registration_icp(b, a, 0.1, found.transformation, plane, stop)
    pose = Sim3.from_matrix(fine.transformation)
    return Answer(Sim3(pose.rotation, pose.translation + ca - pose.rotation @ cb), f"fitness={fine.fitness:.2f}")


def fpfh_clique(target: Capture, source: Capture, voxel_m: float = 0.15) -> Answer:
    """TEASER-style: mutual FPFH matches, absolute distance test, maximum clique, SVD, GICP."""
    from scipy.spatial import cKDTree

    (a, fa, ca), (b, fb, cb) = _fpfh(target, voxel_m), _fpfh(source, voxel_m)
    fa, fb = fa.data.T, fb.data.T
    to_b, to_a = cKDTree(fb).query(fa)[1], cKDTree(fa).query(fb)[1]
    rows = np.flatnonzero(to_a[to_b] == np.arange(len(fa)))
    distance = np.linalg.norm(fa[rows] - fb[to_b[rows]], axis=1)
    rows = rows[np.argsort(distance, kind="stable")[:3000]]
    t, s = np.asarray(a.points)[rows], np.asarray(b.points)[to_b[rows]]
    ids = rows.astype(np.int32), to_b[rows].astype(np.int32)
    m = Correspondences(t + ca, s + cb, *ids, np.ones(len(rows), np.float32))
    clique = maximum_clique(consistency_graph(m, TestParams(sigma_m=0.05)), 5_000_000)
    if len(clique) < 4:
        return Answer(None)
    pose = fit_pose(m.target[clique.members], m.source[clique.members], sigma_m=0.05).S_target_source
    return Answer(gicp.refine(target.surface(), source.surface(), pose), f"w={len(clique)}")


def splatreg(target: Capture, source: Capture) -> Answer:
    """The pip package, where it is installed (points only, init="robust")."""
    import splatreg as package

    def splats(g: Gaussians):
        import torch

        arrays = (g.means, g.quats, g.scales, g.opacities, g.sh)
        return package.Gaussians(*(torch.from_numpy(np.array(array)) for array in arrays))

    found = package.register(splats(target.view.gaussians), splats(source.view.gaussians), init="robust")
    return Answer(Sim3.from_matrix(np.asarray(found.T, dtype=np.float64)), f"confidence={found.info.get('confidence')}")


def _p(**changes) -> Params:
    return replace(Params(), **changes)


METHODS: dict[str, Callable[[Capture, Capture], Answer]] = {
    "gsmap": gsmap(),
    "gsmap-coarse": proposal(),
    "gsmap-gicp": gsmap(_p(refiner="gicp")),
    "landmarks": gsmap(_p(kinds=("landmarks",), fallback="never")),
    "objects": gsmap(_p(kinds=("objects",), fallback="never")),
    "ratio-test": proposal(propose.Params(consistency=TestParams(test="ratio"))),
    "no-height-test": proposal(propose.Params(consistency=TestParams(height_slope=np.inf))),
    "best-score": best_score_clique,
    "no-clique": no_clique,
    "kiss": kiss_gicp(0.15),
    "kiss-0.1": kiss_gicp(0.1),
    "fpfh": fpfh_ransac_icp,
    "fpfh-clique": fpfh_clique,
    "splatreg": splatreg,
}


# --- captures ------------------------------------------------------------------------------------------------------


def read_folder(folder: Path, policy: str) -> list[Capture]:
    from gsmap.ingest import read_captures

    out = []
    for capture in read_captures(folder):
        truth = folder / "truth" / f"{capture.name}.json"
        if truth.exists():
            S = Sim3.from_matrix(np.array(json.loads(truth.read_text())["T_scene_world"]))
            out.append(_capture(capture.name, folder.name, capture.gaussians, capture.cameras, S, policy))
    return out


def make(count: int, policy: str) -> list[Capture]:
    from gsmap.demo import make_captures

    out = []
    for seed in range(count):
        _say(f"making place {seed}")
        for c in make_captures(seed, 1, num_frames=40, num_gaussians=40_000, size_px=(240, 180)):
            S = Sim3.from_matrix(c.T_scene_world)
            out.append(_capture(f"m{seed}", f"made{seed}", c.gaussians, c.cameras, S, policy))
    return out


def _capture(name: str, place: str, gaussians: Gaussians, cameras: Cameras, S: Sim3, policy: str) -> Capture:
    from gsmap.describe import describe

    _say(f"describing {name}")
    graph = describe(name, gaussians, cameras, scale_policy=policy)
    return Capture(name, place, SceneView(name, gaussians, cameras, graph, policy), S)


def rescaled(capture: Capture, factor: float) -> Capture:
    """The capture in another unit; it is described again there, its scale unknown."""
    S = Sim3(np.eye(3), np.zeros(3), factor)
    gaussians = transform_gaussians(capture.view.gaussians, S)
    cameras = transform_cameras(capture.view.cameras, S)
    return _capture(capture.name, capture.place, gaussians, cameras, S @ capture.S_scene_world, "unknown")


def true_overlap(a: Capture, b: Capture) -> float:
    """The smaller of both directions' share of opaque, not huge Gaussians within 8 cm of one of the other's."""
    from scipy.spatial import cKDTree

    if a.place != b.place:
        return 0.0
    points = []
    for c in (a, b):
        g, unit = c.view.gaussians, 1.0 / c.S_scene_world.scale
        keep = (g.opacities > 0.3) & (g.scales.max(1) * unit < 0.3)
        points.append(c.S_scene_world.inverse().apply(g.means[keep]))
    trees = [cKDTree(p) for p in points]
    both = zip(trees, points[::-1], strict=True)
    return float(min(np.isfinite(t.query(p, distance_upper_bound=0.08)[0]).mean() for t, p in both))


# --- the table -----------------------------------------------------------------------------------------------------


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="*", type=Path)
    parser.add_argument("--made", type=int, default=0, metavar="N", help="also N generated places, one capture each")
    parser.add_argument("--methods", default="gsmap", help=f"of {', '.join(METHODS)}, or all")
    parser.add_argument("--rescale", action="store_true", help="each capture in a random unit, 1/5 to 5, not told")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--verbose", action="store_true", help="one line per pair")
    options = parser.parse_args()
    names = list(METHODS) if options.methods == "all" else options.methods.split(",")
    if "splatreg" in names and not _installed("splatreg"):
        _say("splatreg is not installed: left out")
        names.remove("splatreg")
    captures = [c for folder in options.folders for c in read_folder(folder, "auto")] + make(options.made, "auto")
    if options.rescale:
        rng = np.random.default_rng(0)
        captures = [rescaled(c, float(np.exp(rng.uniform(-1, 1) * np.log(5)))) for c in captures]
    for c in captures:  # surfaces are shared by all methods, so none pays for them
        c.surface().cloud  # noqa: B018
    pairs = [(a, b, true_overlap(a, b)) for a, b in itertools.combinations(captures, 2)]
    rows = [measure(name, METHODS[name], pairs, options.verbose) for name in names]
    print_table(rows)
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1))


def measure(name: str, method: Callable, pairs: list, verbose: bool) -> dict:
    """One row of the table: every pair by one method."""
    records, seconds = [], []
    for a, b, overlap in pairs:
        start = time.process_time()
        answer = method(a, b)
        seconds.append(time.process_time() - start)
        error = None
        if answer.pose is not None and a.place == b.place:
            error = pose_error(
                answer.pose, a.S_scene_world @ b.S_scene_world.inverse(), scene_centroid(b.view.gaussians)
            )
            error = replace(error, centroid_m=error.centroid_m / a.S_scene_world.scale)
        records.append((a, b, overlap, answer, error))
        if verbose:
            said = "no pose" if answer.pose is None else "pose" if error is None else _text(error)
            _say(f"{name:14s} {a.name}-{b.name} overlap {overlap:.2f} {seconds[-1]:5.2f} s  {said}  {answer.note}")
    wanted = [e for _, _, overlap, _, e in records if overlap >= OVERLAPPING]
    off = [e for *_, e in records if e is not None and (e.rre_deg > 1 or e.centroid_m > 0.05)]
    apart = [x.pose is not None for _, _, overlap, x, _ in records if overlap < 0.01]
    summary = asdict(summarise(wanted))
    return {
        "method": name,
        "pairs": len(wanted),
        "posed": summary["num_estimated"],
        "fine": round(summary["recall"]["fine"] * len(wanted)) if wanted else 0,
        "coarse": round(summary["recall"]["coarse"] * len(wanted)) if wanted else 0,
        "off": len(off),
        "negatives": len(apart),
        "false": sum(apart),
        "cpu_s": float(np.median(seconds)),
        "cpu_s_max": float(np.max(seconds)),
        "summary": summary,
        "each": [
            {"target": a.name, "source": b.name, "overlap": o, "error": e and asdict(e), "posed": x.pose is not None}
            for a, b, o, x, e in records
        ],
    }


def _text(e: PoseError) -> str:
    return f"{e.rre_deg:.2f} deg {100 * e.centroid_m:.1f} cm scale {e.rse:.2%}"


def print_table(rows: list[dict]) -> None:
    heads = [
        "method",
        "pairs",
        "posed",
        "fine",
        "coarse",
        "off",
        "apart",
        "false",
        "median",
        "worst",
        "scale",
        "CPU_s",
        "max",
    ]
    widths = (15, 6, 6, 5, 7, 4, 6, 6, 14, 15, 7, 7, 7)
    print("".join(f"{h:>{w}s}" for h, w in zip(heads, widths, strict=True)))
    for r in rows:
        s = r["summary"]
        cells = [r[k] for k in ("method", "pairs", "posed", "fine", "coarse", "off", "negatives", "false")]
        cells += [f"{s[f'{k}_rre_deg']:.2f}d {100 * s[f'{k}_centroid_m']:.1f}cm" for k in ("median", "worst")]
        cells += [f"{s['mean_rse']:.2%}", f"{r['cpu_s']:.2f}", f"{r['cpu_s_max']:.2f}"]
        print("".join(f"{c!s:>{w}s}" for c, w in zip(cells, widths, strict=True)))
    print(
        "pairs: overlap >= 25 %; posed: of those; fine: within 1 deg and 5 cm; coarse: 5 deg and 30 cm; off: poses of "
        "any pair of one place beyond fine; apart, false: pairs that share nothing, and how many of them got a pose"
    )


def _installed(package: str) -> bool:
    from importlib.util import find_spec

    return find_spec(package) is not None


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
