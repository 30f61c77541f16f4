"""Which edges an island may take in, and when two islands may join."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components, depth_first_order, dijkstra
from scipy.stats import chi2

from gsmap.geometry.similarities import Similarities
from gsmap.optimize.cycles import _ranges
from gsmap.optimize.measurements import Measurements
from gsmap.optimize.robust import islands, residuals, roots

SMALL_ISLAND = 3  # below this many scenes a single edge may join
BRIDGE_EDGES = 3  # two islands that are not small need this many agreeing edges over as many scene pairs
MAX_EXACT_HOPS = 20_000_000  # scenes x sources of shortest paths; beyond it hops are estimated from distances


@dataclass(frozen=True, eq=False)
class Walk:
    """How far the prediction between two scenes may be off: a random walk along the accepted edges between them.

    After h edges with rotation variance sr^2, translation variance st^2 and length l, a walk is off by h sr^2 in
    rotation and h st^2 + sr^2 l^2 h^3 / 3 in position (the rotation errors act on ever longer levers). More paths than
    one only make the truth better than this, so the bound is on the side of letting edges be compared.
    """

    graph: sp.csr_matrix
    labels: np.ndarray
    depth: np.ndarray
    step: np.ndarray
    poses: Similarities

    @classmethod
    def over(cls, edges: Measurements, rows: np.ndarray, poses: Similarities) -> Walk:
        n = edges.num_scenes
        labels = islands(edges, rows)
        a, b = edges.targets[rows], edges.sources[rows]
        graph = sp.coo_matrix((np.ones(len(rows)), (a, b)), shape=(n, n)).tocsr()
        graph = ((graph + graph.T) > 0).astype(np.float64)
        depth = dijkstra(graph, directed=False, indices=roots(labels), unweighted=True, min_only=True)
        rows = rows if len(rows) else np.arange(len(edges))
        if not len(edges):
            return cls(graph, labels, depth, np.zeros(4), poses)
        diagonal = np.einsum("eii->ei", edges.covariance[rows])
        unit = np.exp(poses.log_scales[edges.sources[rows]])
        length = np.linalg.norm(edges.measured.translations[rows], axis=1) * np.exp(
            poses.log_scales[edges.targets[rows]]
        )
        step = np.array(
            [
                np.median(diagonal[:, :3].mean(1)),
                np.median(diagonal[:, 3:6].mean(1) * unit**2),
                np.median(diagonal[:, 6]) if edges.dim == 7 else 0.0,
                np.median(length),
            ]
        )
        return cls(graph, labels, depth, step, poses)

    def bound(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Hops from a to b at most: through the root of their island."""
        return self.depth[a] + self.depth[b]

    def hops(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Hops between scenes of one island."""
        out = np.zeros(len(a))
        starts, which = np.unique(a, return_inverse=True)
        if len(starts) * len(self.depth) > MAX_EXACT_HOPS:
            distance = np.linalg.norm(self.poses.translations[a] - self.poses.translations[b], axis=1)
            guess = 2 + 1.5 * distance / max(self.step[3], 1e-9)
            return np.where(a == b, 0.0, np.minimum(guess, self.bound(a, b)))
        for begin in range(0, len(starts), 256):
            mine = (which >= begin) & (which < begin + 256)
            paths = dijkstra(self.graph, directed=False, indices=starts[begin : begin + 256], unweighted=True)
            out[mine] = paths[which[mine] - begin, b[mine]]
        return np.minimum(out, self.bound(a, b))

    def variances(self, hops: np.ndarray, at: np.ndarray, dim: int) -> np.ndarray:
        """(K, dim) diagonal covariance after ``hops``, in the unit of scene ``at``."""
        rotation, translation, scale, length = self.step
        unit = np.exp(-2 * self.poses.log_scales[at])
        out = np.empty((len(hops), dim))
        out[:, :3] = (rotation * hops)[:, None]
        out[:, 3:6] = ((translation * hops + (rotation + scale) * length**2 * hops**3 / 3) * unit)[:, None]
        if dim == 7:
            out[:, 6] = scale * hops
        return out


def closes(edges: Measurements, rows: np.ndarray, walk: Walk, probability: float) -> np.ndarray:
    """(len(rows),) bool: the edge, inside one island, agrees with the island's own prediction of it."""
    limit = chi2.ppf(probability, edges.dim)
    out = walk.labels[edges.targets[rows]] == walk.labels[edges.sources[rows]]
    r = residuals(edges[rows], walk.poses)
    for hops in (walk.bound, walk.hops):
        left = np.flatnonzero(out)
        if not len(left):
            break
        a, b = edges.targets[rows[left]], edges.sources[rows[left]]
        out[left] = _chi2(edges.covariance[rows[left]], walk.variances(hops(a, b), b, edges.dim), r[left]) < limit
    return out


@dataclass(frozen=True, eq=False)
class Join:
    """Edges that agree on how island ``source`` lies in the frame of island ``target``.

    ``edges`` are the rows that agree, ``rival`` how many edges the best contradicting group has.
    """

    target: int
    source: int
    edges: np.ndarray
    rival: int
    offered: np.ndarray


def joins(edges: Measurements, rows: np.ndarray, walk: Walk, probability: float) -> list[Join]:
    """For every pair of islands with edges between them, the largest group of edges that agree."""
    labels = walk.labels
    rows = rows[labels[edges.targets[rows]] != labels[edges.sources[rows]]]
    if not len(rows):
        return []
    low = np.minimum(labels[edges.targets[rows]], labels[edges.sources[rows]])
    high = np.maximum(labels[edges.targets[rows]], labels[edges.sources[rows]])
    order = np.lexsort((rows, high, low))
    rows, low, high = rows[order], low[order], high[order]
    starts = np.flatnonzero(np.r_[True, (low[1:] != low[:-1]) | (high[1:] != high[:-1])])
    ends = np.r_[starts[1:], len(rows)]
    first, second = _agreeing_pairs(edges, rows, walk, np.repeat(ends, ends - starts), probability)
    neighbours = sp.coo_matrix((np.ones(len(first)), (first, second)), shape=(len(rows), len(rows))).tocsr()
    neighbours = neighbours + neighbours.T
    count = np.diff(neighbours.indptr)
    # A pair of scenes tied twice is one piece of evidence when it comes to counting pairs; see `allowed`.
    weight = -np.log(np.trace(edges.covariance[rows], axis1=1, axis2=2))
    out = []
    for begin, end in zip(starts, ends, strict=True):
        # A person's word decides which group counts.
        best = begin + int(np.lexsort((weight[begin:end], count[begin:end], edges.confirmed[rows[begin:end]]))[-1])
        mine = np.zeros(end - begin, dtype=bool)
        mine[np.r_[neighbours.indices[neighbours.indptr[best] : neighbours.indptr[best + 1]], best] - begin] = True
        rival = _largest_apart(neighbours, begin, mine)
        group = np.r_[best, begin + np.flatnonzero(mine)]
        group = group[np.sort(np.unique(group, return_index=True)[1])]
        out.append(Join(int(low[begin]), int(high[begin]), rows[group], rival, rows[begin:end]))
    return out


def _largest_apart(neighbours: sp.csr_matrix, begin: int, mine: np.ndarray) -> int:
    """Size of the largest agreeing group among edges that agree with none of ``mine``."""
    block = neighbours[begin : begin + len(mine), begin : begin + len(mine)]
    apart = ~mine & (block @ mine.astype(float) == 0)
    return int((block[apart] @ apart.astype(float)).max()) + 1 if apart.any() else 0


def allowed(join: Join, edges: Measurements, sizes: np.ndarray) -> str:
    """``agreed``, ``single`` or, where the evidence does not suffice, the reason in words."""
    rows = join.edges
    if edges.confirmed[join.offered].any():
        return "agreed"
    large = min(sizes[join.target], sizes[join.source]) >= SMALL_ISLAND
    # Chance never makes two wrong edges agree: a rival group of two is a place that looks like another.
    if len(rows) <= join.rival or (large and join.rival >= 2 and len(rows) < 3 * join.rival):
        return f"{len(rows)} edges agree and {join.rival} others contradict them: undecided"
    low, high = (
        np.minimum(edges.targets[rows], edges.sources[rows]),
        np.maximum(edges.targets[rows], edges.sources[rows]),
    )
    pairs = len(np.unique(low * edges.num_scenes + high))
    if large:
        if pairs >= BRIDGE_EDGES:
            return "agreed"
        return (
            f"would join two islands of {SMALL_ISLAND} or more scenes: needs {BRIDGE_EDGES} agreeing edges over "
            f"{BRIDGE_EDGES} scene pairs or a person's word, has {pairs}"
        )
    if pairs >= 2:
        return "agreed"
    return "single"


def bridges(edges: Measurements, accepted: np.ndarray) -> np.ndarray:
    """(E,) bool: accepted edges on no cycle of accepted edges.

    Direct the edges of a depth-first tree downwards and all others, which go to an ancestor, upwards: what is then
    strongly connected is what two edge-disjoint paths connect (Robbins 1939), and the edges between are the bridges.
    """
    n, rows = edges.num_scenes, np.flatnonzero(accepted)
    ends = np.sort(np.stack([edges.targets[rows], edges.sources[rows]]), axis=0)
    pairs, which, count = np.unique(ends[0] * n + ends[1], return_inverse=True, return_counts=True)
    low, high = pairs // n, pairs % n
    # One more node above the first scene of every island makes the forest a tree.
    first = roots(islands(edges, rows))
    a, b = np.r_[low, first], np.r_[high, np.full(len(first), n)]
    graph = sp.coo_matrix((np.ones(len(a)), (a, b)), shape=(n + 1, n + 1)).tocsr()
    order, parent = depth_first_order((graph + graph.T).tocsr(), n, directed=False)
    rank = np.empty(n + 1, dtype=np.int64)
    rank[order] = np.arange(n + 1)
    early, late = np.where(rank[a] < rank[b], a, b), np.where(rank[a] < rank[b], b, a)
    down = parent[late] == early
    tail, head = np.where(down, early, late), np.where(down, late, early)
    directed = sp.coo_matrix((np.ones(len(a)), (tail, head)), shape=(n + 1, n + 1)).tocsr()
    blocks = connected_components(directed, directed=True, connection="strong")[1]
    out = np.zeros(len(edges), dtype=bool)
    out[rows] = (blocks[low] != blocks[high])[which] & (count[which] == 1)
    return out


def merge_islands(
    edges: Measurements, chosen: list[Join], labels: np.ndarray, poses: Similarities
) -> tuple[np.ndarray, Similarities]:
    """Move whole islands so that the first edge of each chosen join is met. Joins must form no cycle.

    Returns:
        Rows of the edges taken in, and the moved poses.
    """
    ties: dict[int, list[tuple[int, int]]] = {}
    for k, join in enumerate(chosen):
        ties.setdefault(join.target, []).append((join.source, k))
        ties.setdefault(join.source, []).append((join.target, k))
    size = np.bincount(labels)
    motion = Similarities.identity(len(size))
    seen = np.zeros(len(size), dtype=bool)
    # The larger island keeps its frame.
    for start in sorted(ties, key=lambda island: (-size[island], island)):
        if seen[start]:
            continue
        seen[start] = True
        front = [start]
        while front:
            here = front.pop()
            for there, k in ties[here]:
                if seen[there]:
                    continue
                seen[there] = True
                edge = chosen[k].edges[:1]
                a, b, S = edges.targets[edge], edges.sources[edge], edges.measured[edge]
                if labels[a[0]] == here:
                    onto = poses[a] @ S @ poses[b].inverse()
                else:
                    onto = poses[b] @ S.inverse() @ poses[a].inverse()
                motion = motion.replaced(np.array([there]), motion[np.array([here])] @ onto)
                front.append(there)
    taken = np.concatenate([join.edges for join in chosen]) if chosen else np.zeros(0, dtype=np.int64)
    return taken, (motion[labels] @ poses).orthonormalised()


def forest(chosen: list[Join], num_islands: int) -> list[Join]:
    """The strongest joins that form no cycle."""
    leader = list(range(num_islands))

    def find(k: int) -> int:
        while leader[k] != k:
            leader[k] = leader[leader[k]]
            k = leader[k]
        return k

    out = []
    for join in sorted(chosen, key=lambda j: (-len(j.edges), j.target, j.source)):
        a, b = find(join.target), find(join.source)
        if a != b:
            leader[max(a, b)] = min(a, b)
            out.append(join)
    return out


def grow(chosen: list[Join], sizes: np.ndarray) -> list[Join]:
    """Joins by single edges: from the largest island outwards, each step taking in one small island."""
    ties: dict[int, list[tuple[int, Join]]] = {}
    for join in chosen:
        ties.setdefault(join.target, []).append((join.source, join))
        ties.setdefault(join.source, []).append((join.target, join))
    taken: set[int] = set()
    out = []
    for start in sorted(ties, key=lambda island: (-sizes[island], island)):
        if start in taken:
            continue
        taken.add(start)
        front = [start]
        while front:
            here = front.pop(0)
            for there, join in sorted(ties[here], key=lambda tie: tie[0]):
                if there not in taken and sizes[there] < SMALL_ISLAND:
                    taken.add(there)
                    out.append(join)
                    front.append(there)
    return out


def _agreeing_pairs(
    edges: Measurements, rows: np.ndarray, walk: Walk, ends: np.ndarray, probability: float
) -> tuple[np.ndarray, np.ndarray]:
    """Pairs (positions in ``rows``) of edges between the same two islands that predict the same relative pose."""
    poses, labels = walk.poses, walk.labels
    # Direct every edge from the island of lower number.
    claims = Claims.of(edges, rows, labels[edges.targets[rows]] > labels[edges.sources[rows]])
    flat = (poses[claims.near] @ claims.measured @ poses[claims.far].inverse()).rotations.reshape(-1, 9)
    spread = 2 * edges.covariance[rows][:, :3, :3].trace(axis1=1, axis2=2).max(initial=0)
    limit = chi2.ppf(probability, edges.dim)
    firsts, seconds = [], []
    counts = ends - np.arange(len(rows)) - 1
    block = np.searchsorted(np.cumsum(counts), np.arange(0, counts.sum() + 1, 2_000_000), side="left")
    block = np.unique(np.r_[0, block, len(rows)])
    for begin, end in itertools.pairwise(block):
        first, offset = _ranges(counts[begin:end])
        first = first + begin
        second = first + 1 + offset
        # Cheap first test: the two predictions of the other island's orientation.
        hops = walk.bound(claims.near[first], claims.near[second]) + walk.bound(claims.far[first], claims.far[second])
        allowance = np.minimum(limit * (spread + 3 * walk.step[0] * hops), 8.0)
        chord = ((flat[first] - flat[second]) ** 2).sum(1) / 2
        near = chord < allowance
        firsts.append(first[near])
        seconds.append(second[near])
    first, second = np.concatenate(firsts), np.concatenate(seconds)
    same = claims.agree(first, second, walk, probability)
    return first[same], second[same]


@dataclass(frozen=True, eq=False)
class Claims:
    """Edges read as claims of how the part of the map at their ``far`` end lies in that at their ``near`` end.

    Args:
        near, far: (K,) scenes.
        measured: K similarities ``S_near_far``.
        covariance: (K, D, D) on the far side.
    """

    near: np.ndarray
    far: np.ndarray
    measured: Similarities
    covariance: np.ndarray

    @classmethod
    def of(cls, edges: Measurements, rows: np.ndarray, turned: np.ndarray) -> Claims:
        """Edges at ``rows``, read from source to target where ``turned``."""
        a, b, measured, dim = edges.targets[rows], edges.sources[rows], edges.measured[rows], edges.dim
        covariance = edges.covariance[rows].copy()
        adjoint = measured[turned].adjoint()[:, :dim, :dim]
        covariance[turned] = adjoint @ covariance[turned] @ adjoint.transpose(0, 2, 1)
        measured = measured.replaced(turned, measured[turned].inverse())
        return cls(np.where(turned, b, a), np.where(turned, a, b), measured, covariance)

    def agree(self, first: np.ndarray, second: np.ndarray, walk: Walk, probability: float) -> np.ndarray:
        """(P,) bool: claims ``first`` and ``second`` are the same, within their noise and that of the map between."""
        poses, dim = walk.poses, self.covariance.shape[1]
        a, b, measured, covariance = self.near, self.far, self.measured, self.covariance
        limit = chi2.ppf(probability, dim)
        there = poses[b[second]].inverse() @ poses[b[first]]
        across = poses[a[first]].inverse() @ poses[a[second]]
        r = (measured[first].inverse() @ across @ measured[second] @ there).log()[:, :dim]
        carry = there.inverse().adjoint()[:, :dim, :dim]
        noise = covariance[first] + carry @ covariance[second] @ carry.transpose(0, 2, 1)
        left = np.arange(len(first))
        for measure in (walk.bound, walk.hops):
            f, s = first[left], second[left]
            hops = measure(a[f], a[s]) + measure(b[f], b[s])
            left = left[_chi2(noise[left], walk.variances(hops, b[f], dim), r[left]) < limit]
        out = np.zeros(len(first), dtype=bool)
        out[left] = True
        return out


def _chi2(covariance: np.ndarray, variances: np.ndarray, r: np.ndarray) -> np.ndarray:
    total = covariance + variances[:, :, None] * np.eye(covariance.shape[1])
    return np.einsum("ed,ed->e", r, np.linalg.solve(total, r[:, :, None])[:, :, 0])
