"""What `bench_register.py` compares: gsmap and parts of it, what else one would pick, and the paper's ablations.

A method takes two captures (target, source) and gives an `Answer`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from gsmap.methods import MethodParams
from gsmap.register import Params, SceneView, register_pair
from gsmap.register.a_contrario import BackgroundModel, find_inliers
from gsmap.register.clique import maximum_clique
from gsmap.register.consistency import SIGMA_M, consistency_graph, unpack
from gsmap.register.consistency import Params as TestParams
from gsmap.register.context import Params as ContextParams
from gsmap.register.context import add_context
from gsmap.register.correspondences import Correspondences, match_nodes
from gsmap.register.metric_scene import MetricScene
from gsmap.register.pose import fit_pose
from gsmap.register.proposers import graph, kiss_matcher
from gsmap.register.refiners import gicp
from gsmap.types import NodeLayer, SceneGraph, Sim3
from tools.harness import timed

FPFH_SIGMA_M = 0.05
STEP_LIMIT = 5_000_000


@dataclass
class Capture:
    name: str
    place: str
    view: SceneView
    S_scene_world: Sim3
    kept: dict[Any, tuple[Any, float]] = field(default_factory=dict)

    @property
    def graph(self) -> SceneGraph:
        return self.view.graph

    def surface(self):
        return self.view.surface(1.0)

    def once(self, key: Any, make: Callable[[], Any]) -> tuple[Any, float]:
        """Something of this capture alone, made once, and the CPU seconds that took."""
        if key not in self.kept:
            made, took = timed(make)
            self.kept[key] = made, took
        return self.kept[key]


@dataclass
class Answer:
    """What a method says of a pair.

    Args:
        pose: one it stands by, or None.
        note: for people.
        score: how sure the method itself is, more is surer; NaN where it gives no such figure.
        information: (7, 7) of the pose, where the method claims one.
        shared_s: CPU seconds of work on single captures that was done for an earlier pair and belongs to this one too.
    """

    pose: Sim3 | None
    note: str = ""
    score: float = float("nan")
    information: np.ndarray | None = None
    shared_s: float = 0.0


Method = Callable[[Capture, Capture], Answer]


# --- gsmap ---------------------------------------------------------------------------------------------------------


def gsmap(kinds: tuple[str, ...] | None = None, **changes) -> Method:
    params = replace(Params(), **changes)
    if kinds is not None:
        proposers = MethodParams("proposer").with_params("graph", graph.Params(kinds=kinds))
        params = replace(params, proposers=proposers)

    def run(target: Capture, source: Capture) -> Answer:
        found = register_pair(target.view, source.view, params)
        e = found.evidence
        note = f"{found.status} {found.proposer} w={found.num_inliers} " + " ".join(
            f"{k}={v:.2f}" for k, v in e.items()
        )
        pose = found.S_target_source if found.status == "accepted" else None
        return Answer(pose, f"{note} {found.reason}", information=found.information)

    return run


# --- the paper's ablations: the pose that nodes alone propose, unrefined and unjudged ------------------------------

CHANGES = (
    "full",
    "no-context",
    "3-hop",
    "5-hop",
    "fpfh-nodes",
    "ratio",
    "no-distance",
    "no-height",
    "no-clique",
    "best-score",
)


def ablation(change: str, kind: str) -> Method:
    """gsmap's matching of one kind of nodes with one thing changed."""

    def run(target: Capture, source: Capture) -> Answer:
        found = _hypothesis(target, source, kind, change)
        if found is None:
            return Answer(None)
        log_nfa, pose, count = found
        return Answer(pose, f"w={count} logNFA={log_nfa:.1f}", -log_nfa)

    return run


def _hypothesis(target: Capture, source: Capture, kind: str, change: str) -> tuple[float, Sim3, int] | None:
    """log10 NFA, pose and number of correspondences it rests on."""
    if any(kind not in c.graph.layers or not len(c.graph.layers[kind]) for c in (target, source)):
        return None
    a, b = _layer(target, kind, change), _layer(source, kind, change)
    if kind == "objects" and change not in ("no-context", "fpfh-nodes"):
        hops = {"3-hop": 3, "5-hop": 5}.get(change, ContextParams().hops)
        a, b = add_context(a, b, ContextParams(hops))
    unit = float(np.sqrt(a.unit_m * b.unit_m))  # one metre for both: the pose is rigid
    ups = target.graph.up, source.graph.up
    top_k, sigma_m = (5, 0.05) if kind == "objects" else (1, SIGMA_M)  # as in `gsmap.register.proposers.graph`
    m = match_nodes(a, b, top_k=top_k, units_m=(unit, unit), ups=ups)
    if len(m) < 4:
        return None
    test, tolerances = TestParams(), {"sigma_m": sigma_m}
    if change == "ratio":
        test = TestParams(test="ratio")
    elif change == "no-height":
        test = TestParams(height_slope=np.inf)
    elif change == "no-distance":  # correspondences then only have to be one-to-one
        tolerances = {"sigma_m": 1e6, "min_distance_m": 0.0}
    compatibility = consistency_graph(m, test, **tolerances)
    if change == "no-clique":
        members = np.arange(len(m))
    elif change == "best-score":
        members = _best_score(m, unpack(compatibility))
    else:
        members = maximum_clique(compatibility, STEP_LIMIT).members
    if len(members) < 3:
        return None
    pose = fit_pose(m.target[members], m.source[members]).S_target_source
    radius = max(4.0 * np.sqrt(2.0) * sigma_m, 0.15)
    inliers = m[find_inliers(m, pose, radius)]
    if len(inliers) > len(members):
        pose = fit_pose(inliers.target, inliers.source).S_target_source
    points = b.positions * unit
    heights = None if m.source_heights is None else points @ ups[1]
    log_nfa = BackgroundModel(a, b, points, m, source_heights=heights).log10_nfa(pose, radius)
    return log_nfa, Sim3(pose.rotation, pose.translation / unit), len(members)


def _best_score(m: Correspondences, adjacency: np.ndarray) -> np.ndarray:
    """Cliques grown from the most similar candidates, always adding the most similar that agrees; the best in sum."""
    best: list[int] = []
    for first in range(min(len(m), 200)):
        members, left = [first], adjacency[first].copy()
        while left.any():
            members.append(int(np.argmax(left)))  # candidates come most similar first
            left &= adjacency[members[-1]]
        if m.similarity[members].sum() > m.similarity[best].sum():
            best = members
    return np.array(best, dtype=int)


def _layer(capture: Capture, kind: str, change: str) -> NodeLayer:
    layer = capture.graph.layers[kind]
    if change == "no-context" and kind == "landmarks":
        # A landmark's embedding is its surroundings; what is its own beside the type is response and scale.
        own = np.log(np.maximum(layer.features, 1e-6))
        return replace(layer, embeddings=_unit((own - own.mean(0)) / (own.std(0) + 1e-9)))
    if change == "fpfh-nodes":
        (cloud, features, centre), _ = _fpfh(capture, 0.1)
        _, row = _tree(np.asarray(cloud.points)).query(layer.positions - centre)
        return replace(layer, embeddings=_unit(features.data.T[row]))
    return layer


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-9)


# --- peers ---------------------------------------------------------------------------------------------------------


def kiss_gicp(voxel_m: float) -> Method:
    def run(target: Capture, source: Capture) -> Answer:
        scenes = (MetricScene(capture.view, 1.0) for capture in (target, source))
        found = kiss_matcher.propose(*scenes, kiss_matcher.Params(voxel_m))
        if not found:
            return Answer(None)
        pose = gicp.refine(target.surface(), source.surface(), found[0].S_target_source)
        return Answer(pose, f"inliers={found[0].num_inliers}", found[0].num_inliers)

    return run


def _fpfh(capture: Capture, voxel_m: float) -> tuple[tuple[Any, Any, np.ndarray], float]:
    """Voxel cloud about its centre, FPFH features, the centre; and CPU seconds."""

    def make():
        import open3d as o3d

        points = capture.surface().coarse[0]
        centre = points.mean(0)
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points - centre)).voxel_down_sample(voxel_m)
        cloud.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(2 * voxel_m, 30))
        around = o3d.geometry.KDTreeSearchParamHybrid(5 * voxel_m, 100)
        return cloud, o3d.pipelines.registration.compute_fpfh_feature(cloud, around), centre

    known = ("fpfh", voxel_m) in capture.kept
    made, seconds = capture.once(("fpfh", voxel_m), make)
    return made, seconds if known else 0.0


def fpfh_ransac_icp(target: Capture, source: Capture, voxel_m: float = 0.2) -> Answer:
    """Open3D's global registration as its tutorial has it, then point-to-plane ICP."""
    import open3d as o3d

    reg = o3d.pipelines.registration
    o3d.utility.random.seed(0)
    ((a, fa, ca), spent_a), ((b, fb, cb), spent_b) = _fpfh(target, voxel_m), _fpfh(source, voxel_m)
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
    pose = Sim3(pose.rotation, pose.translation + ca - pose.rotation @ cb)
    return Answer(pose, f"fitness={fine.fitness:.2f}", fine.fitness, shared_s=spent_a + spent_b)


def _fpfh_matches(target: Capture, source: Capture, voxel_m: float) -> tuple[Correspondences, float]:
    """Mutually nearest FPFH features, the closest 3000."""
    ((a, fa, ca), spent_a), ((b, fb, cb), spent_b) = _fpfh(target, voxel_m), _fpfh(source, voxel_m)
    fa, fb = fa.data.T, fb.data.T
    to_b, to_a = _tree(fb).query(fa)[1], _tree(fa).query(fb)[1]
    rows = np.flatnonzero(to_a[to_b] == np.arange(len(fa)))
    distance = np.linalg.norm(fa[rows] - fb[to_b[rows]], axis=1)
    rows = rows[np.argsort(distance, kind="stable")[:3000]]
    t, s = np.asarray(a.points)[rows], np.asarray(b.points)[to_b[rows]]
    ids = rows.astype(np.int32), to_b[rows].astype(np.int32)
    return Correspondences(t + ca, s + cb, *ids, np.ones(len(rows), np.float32)), spent_a + spent_b


def teaser_style(target: Capture, source: Capture, voxel_m: float = 0.2) -> Answer:
    """Mutual FPFH matches, absolute distance test, maximum clique, SVD, GICP."""
    m, spent = _fpfh_matches(target, source, voxel_m)
    clique = maximum_clique(consistency_graph(m, sigma_m=FPFH_SIGMA_M), STEP_LIMIT)
    if len(clique) < 4:
        return Answer(None, shared_s=spent)
    pose = fit_pose(m.target[clique.members], m.source[clique.members], sigma_m=FPFH_SIGMA_M).S_target_source
    pose = gicp.refine(target.surface(), source.surface(), pose)
    return Answer(pose, f"w={len(clique)}", len(clique), shared_s=spent)


def mac_style(target: Capture, source: Capture, voxel_m: float = 0.2) -> Answer:
    """After MAC (Zhang et al. 2023): second-order weights, a maximal clique through each node, a pose by each clique.

    The pose under which the matches lie nearest (sum of ``1 - residual / tau``) wins, and goes to GICP. Cliques are
    grown greedily by weight from the 1000 heaviest nodes instead of listed all.
    """
    m, spent = _fpfh_matches(target, source, voxel_m)
    adjacency = unpack(consistency_graph(m, sigma_m=FPFH_SIGMA_M))
    first = adjacency.astype(np.float32)
    weights = first * (first @ first)
    tau, best = 0.15, (-1.0, None, 0)
    seen: set[bytes] = set()
    for seed in np.argsort(-weights.sum(1), kind="stable")[:1000]:
        members, left = [int(seed)], adjacency[seed].copy()
        gain = weights[seed].copy()
        while left.any():
            members.append(int(np.argmax(np.where(left, gain, -1.0))))
            left &= adjacency[members[-1]]
            gain += weights[members[-1]]
        key = np.sort(members).tobytes()
        if len(members) < 3 or key in seen:
            continue
        seen.add(key)
        pose = fit_pose(m.target[members], m.source[members], sigma_m=FPFH_SIGMA_M).S_target_source
        residual = np.linalg.norm(pose.apply(m.source) - m.target, axis=1)
        score = float(np.maximum(0.0, 1.0 - residual / tau).sum())
        if score > best[0]:
            best = score, pose, len(members)
    if best[1] is None:
        return Answer(None, shared_s=spent)
    pose = gicp.refine(target.surface(), source.surface(), best[1])
    return Answer(pose, f"w={best[2]} score={best[0]:.1f}", best[0], shared_s=spent)


def splatreg(target: Capture, source: Capture) -> Answer:
    """The pip package with the seed it recommends for rooms (``robust``), on surface Gaussians; it reads means only."""
    import splatreg as package

    def splats(capture: Capture):
        import torch

        g = capture.view.gaussians
        g = g[(g.opacities > 0.5) & (g.scales.max(1) < 0.08)]
        arrays = (g.means, g.quats, g.scales, g.opacities)
        return package.Gaussians(*(torch.from_numpy(np.array(array, dtype=np.float32)) for array in arrays))

    metric = target.view.scale_policy != "unknown"
    found = package.register(splats(target), splats(source), init="robust", transform="se3" if metric else "sim3")
    pose = Sim3.from_matrix(np.asarray(found.T, dtype=np.float64))
    confidence = float(found.info.get("confidence", np.nan))
    return Answer(pose, f"confidence={confidence:.3f}", confidence)


def _tree(points: np.ndarray):
    from scipy.spatial import cKDTree

    return cKDTree(points)


METHODS: dict[str, Method] = {
    "gsmap": gsmap(),
    "landmarks": gsmap(kinds=("landmarks",), fallback="never"),
    "objects": gsmap(kinds=("objects",), fallback="never"),
    "gicp": gsmap(refiner="gicp"),
    "icp": gsmap(refiner="icp"),
    "kiss-0.2": kiss_gicp(0.2),
    "kiss-0.1": kiss_gicp(0.1),
    "fpfh-ransac": fpfh_ransac_icp,
    "teaser-style": teaser_style,
    "mac-style": mac_style,
    "splatreg": splatreg,
}
ABLATIONS: dict[str, Method] = {
    f"{change}:{kind}": ablation(change, kind) for change in CHANGES for kind in ("objects", "landmarks")
}
del ABLATIONS["3-hop:landmarks"], ABLATIONS["5-hop:landmarks"]  # contexts of landmarks are of space, not of a graph
