"""Fits a metric for landmarks' embeddings on made places, and says how well landmarks are told apart under it.

    python -m tools.make.verdict_places PLACES --set fit && python -m tools.make.verdict_places PLACES --set test
    python -m tools.fit.descriptor PLACES --cache FOLDER             # writes gsmap/describe/landmarks/metrics.npz
    python -m tools.fit.descriptor PLACES --cache FOLDER --keep      # figures alone, of the file as it is

Every pair of captures of a fit place is cut in two, too, so that the halves share little (5 to 25 %). Landmarks of one
type that lie within 6 cm of each other under the true pose are partners; the metric is the inverse root of the scatter
of their differences, with a share of the identity. Figures are of the test places, whole and cut: how many partners are
each other's nearest, how many pairs get a right pose from the landmarks alone, how many of these are surer (log NFA)
than 99 % and than all of the pairs of different places, and what of the latter is worth a look (log NFA below 6).
"""

# Thread counts must be set before numpy comes in.
# ruff: noqa: E402
from __future__ import annotations

import os

from tools.harness import argument_parser, say

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import json
import pickle
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from gsmap.describe import Params, describe
from gsmap.describe.landmarks.context import METRICS
from gsmap.evaluate.overlap import solid_centres, true_overlaps
from gsmap.evaluate.registration import pose_error
from gsmap.ingest import Capture, read_captures
from gsmap.register.proposers.graph import propose_by_kind
from gsmap.types import SceneGraph, Sim3

LAYERS = ("landmarks", "landmarks_gravity_free")
PARTNER_M = 0.06
OVERLAPPING, LOW = 0.3, (0.04, 0.26)  # pairs that are cut; overlaps of what is left that are kept
SHARE = 0.3  # of the mean scatter in every direction; .03 to 1 tell left-out places' landmarks apart alike
APART = 600
RIGHT_DEG, RIGHT_M = 5.0, 0.3

Embed = Callable[[np.ndarray], np.ndarray]


@dataclass
class Pair:
    """Two scenes of one place, with landmarks as they are before any metric."""

    place: str
    target: SceneGraph
    source: SceneGraph
    S_target_source: Sim3
    overlap: float


def main() -> int:
    parser = argument_parser(__doc__)
    parser.add_argument("places", type=Path)
    parser.add_argument("--cache", type=Path, required=True)
    parser.add_argument("--keep", action="store_true", help="leave the file as it is")
    args = parser.parse_args()
    args.cache.mkdir(parents=True, exist_ok=True)
    if not args.keep:
        pairs = read(args.places / "fit", args.cache)
        fitted = {layer: fit(pairs, layer) for layer in LAYERS}
        np.savez_compressed(METRICS, **{str(len(m)): m.astype(np.float16) for m in fitted.values()})
        say(f"{METRICS}: {METRICS.stat().st_size / 1e3:.0f} kB, of {len(pairs)} pairs")
    with np.load(METRICS) as stored:
        metrics = {int(name): stored[name].astype(np.float64) for name in stored}
    tests = read(args.places / "test", args.cache)
    for layer in LAYERS:
        for name, embed in (("without", lambda e: e), ("with", lambda e: unit(e @ metrics[e.shape[1]]))):
            for kind, low, high in (("cut", *LOW), ("whole", 0.005, 1.01)):
                chosen = [p for p in tests if low <= p.overlap < high and kind in p.target.scene_id]
                print(f"{layer} {name} the metric, {kind} test pairs: {figures(chosen, layer, embed)}", flush=True)
    return 0


def fit(pairs: list[Pair], layer: str) -> np.ndarray:
    """The metric of one kind of layer."""
    off = [np.zeros((0, 0))]
    for pair in pairs:
        a, b = pair.target.layers[layer], pair.source.layers[layer]
        i, j = partners(pair, layer)
        off.append(a.embeddings[i].astype(np.float64) - b.embeddings[j])
    differences = np.concatenate(off[1:])
    scatter = differences.T @ differences / len(differences)
    scatter += SHARE * np.trace(scatter) / len(scatter) * np.eye(len(scatter))
    values, axes = np.linalg.eigh(scatter)
    root = axes / np.sqrt(values) @ axes.T
    return root / np.linalg.norm(root, 2)


def partners(pair: Pair, layer: str) -> tuple[np.ndarray, np.ndarray]:
    """Rows of landmarks of one type that are each other's nearest under the true pose, and near enough."""
    a, b = pair.target.layers[layer], pair.source.layers[layer]
    here = np.column_stack([a.positions, a.types * 1e4])
    there = np.column_stack([pair.S_target_source.apply(b.positions), b.types * 1e4])
    distance, j = cKDTree(there).query(here)
    back = cKDTree(here).query(there)[1]
    i = np.flatnonzero((distance < PARTNER_M) & (back[np.minimum(j, len(there) - 1)] == np.arange(len(here))))
    return i, j[i]


def figures(pairs: list[Pair], layer: str, embed: Embed) -> str:
    """What landmarks under a metric are worth."""

    def seen(graph: SceneGraph) -> SceneGraph:
        own = graph.layers[layer]
        up = graph.up if layer == LAYERS[0] else None
        return replace(graph, layers={LAYERS[0]: replace(own, embeddings=embed(own.embeddings))}, up=up)

    views = [(seen(pair.target), seen(pair.source)) for pair in pairs]
    nearest, right, began = [], [], time.process_time()
    for pair, (target, source) in zip(pairs, views, strict=True):
        a, b = (graph.layers[LAYERS[0]] for graph in (target, source))
        i, j = partners(pair, layer)
        alike = np.where(a.types[i][:, None] == b.types, a.embeddings[i] @ b.embeddings.T, -1)
        nearest.append(alike.argmax(1) == j)
        right.append(min((p.log_nfa for p in poses(target, source) if is_right(p, pair, b.positions)), default=np.inf))
    spent = (time.process_time() - began) / len(pairs)
    others = [(i, j) for i, j in combinations(range(len(pairs)), 2) if pairs[i].place != pairs[j].place]
    chosen = np.random.default_rng(0).permutation(len(others))[:APART]
    apart = np.array([min((p.log_nfa for p in poses(views[i][0], views[j][1])), default=np.inf)
                      for i, j in (others[k] for k in chosen)])  # fmt: skip
    nfa, count = np.array(right), len(right)
    return (
        f"partners nearest {np.concatenate(nearest).mean():.3f}; of {count} pairs right {np.isfinite(nfa).sum()}, "
        f"surer than 99 % of {len(apart)} apart {(nfa < np.quantile(apart, 0.01)).sum()}, than all "
        f"{(nfa < apart.min()).sum()}; apart worth a look {(apart < 6).mean():.2f}; {1e3 * spent:.0f} CPU ms a pair"
    )


def poses(target: SceneGraph, source: SceneGraph) -> list:
    return propose_by_kind(target, source, LAYERS[0])


def is_right(proposal, pair: Pair, points: np.ndarray) -> bool:
    error = pose_error(proposal.S_target_source, pair.S_target_source, points.mean(0))
    return bool(error.rre_deg < RIGHT_DEG and error.centroid_m < RIGHT_M)


# --- pairs -----------------------------------------------------------------------------------------------------------


def read(folder: Path, cache: Path) -> list[Pair]:
    """All pairs of captures of one place, whole and cut; those whose vertical is unknown are left out."""
    out = []
    for place in sorted(p.parent for p in folder.glob("*/truth")):
        kept = cache / f"{folder.name}-{place.name}.pickle"
        if not kept.exists():
            began = time.process_time()
            kept.write_bytes(pickle.dumps(list(pairs_of(place))))
            say(f"{place.name}: {time.process_time() - began:.0f} CPU s")
        out += pickle.loads(kept.read_bytes())
    return out


def pairs_of(place: Path) -> Iterator[Pair]:
    """Pairs of captures of a place, and what is left of them when they are cut."""
    rng = np.random.default_rng(int(place.name))
    captures = {c.name: c for c in read_captures(place)}
    truth = {
        name: Sim3.from_matrix(np.array(json.loads((place / "truth" / f"{name}.json").read_text())["T_scene_world"]))
        for name in captures
    }
    solid = {name: solid_centres(c.gaussians, truth[name]) for name, c in captures.items()}
    overlaps = true_overlaps(sorted(captures), solid.__getitem__)
    graphs = {name: graph_of(f"whole {name}", c, np.ones(len(c.gaussians), bool)) for name, c in captures.items()}
    for a, b in combinations(sorted(captures), 2):
        S, overlap = truth[a] @ truth[b].inverse(), overlaps[frozenset((a, b))]
        pairs = [Pair(place.name, graphs[a], graphs[b], S, overlap)]
        if overlap >= OVERLAPPING:
            heading = rng.uniform(0, 2 * np.pi)
            axis = np.array([np.cos(heading), np.sin(heading), 0])
            wanted = rng.uniform(0.06, 0.22)
            shared = cKDTree(solid[b]).query(solid[a], distance_upper_bound=0.15)[0] < np.inf
            middle = np.quantile(solid[a][shared] @ axis, rng.uniform(0.35, 0.65))
            reach, left = cut(solid[a] @ axis - middle, solid[b] @ axis - middle, solid[a], solid[b], wanted)
            along = {n: truth[n].inverse().apply(captures[n].gaussians.means) @ axis - middle for n in (a, b)}
            keep = {a: along[a] < reach, b: along[b] > -reach}
            if min(keep[a].sum(), keep[b].sum()) > 3000 and LOW[0] < left < LOW[1]:
                halves = [graph_of(f"cut {n}", captures[n], keep[n]) for n in (a, b)]
                pairs.append(Pair(place.name, *halves, S, left))
        yield from (p for p in pairs if p.target.up is not None and p.source.up is not None)


def cut(along_a, along_b, a: np.ndarray, b: np.ndarray, wanted: float) -> tuple[float, float]:
    """How far two halves may reach beyond the middle for an overlap, and the overlap that this leaves them."""
    low, high, overlap = 0.0, 6.0, 0.0
    for _ in range(7):
        reach = (low + high) / 2
        halves = {"a": a[along_a < reach], "b": b[along_b > -reach]}
        enough = min(map(len, halves.values())) > 500
        overlap = next(iter(true_overlaps(["a", "b"], halves.__getitem__).values())) if enough else 0.0
        low, high = (low, reach) if overlap > wanted else (reach, high)
    return reach, overlap


def graph_of(name: str, capture: Capture, keep: np.ndarray) -> SceneGraph:
    """Landmarks alone, before any metric."""
    params = Params(objects=False, things=False)
    return describe(name, capture.gaussians[keep], capture.cameras, params, scale_policy="known")


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-9)


if __name__ == "__main__":
    sys.exit(main())
