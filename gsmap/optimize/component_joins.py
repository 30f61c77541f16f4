"""Decide on joins of components by their evidence, and move the joined components."""

from __future__ import annotations

import heapq
import itertools
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import minimum_spanning_tree

from gsmap.geometry.similarities import Similarities
from gsmap.optimize.consistency import agreeing_pairs
from gsmap.optimize.drift import DriftModel
from gsmap.optimize.measurements import Measurements
from gsmap.optimize.params import Params
from gsmap.reason_codes import reason

_MIN_RIVAL_EDGES = 2  # so many contradicting edges that agree with each other count as a place that looks alike
_RIVAL_FACTOR = 3  # large components join only if agreeing edges outnumber such a rival by this factor


@dataclass(frozen=True, eq=False)
class Join:
    """Edges that agree on the pose of component ``source`` in the frame of component ``target``.

    Args:
        target, source: components by label.
        edges: rows of the edges that agree; first the edge with which most of them agree.
        rival: number of edges in the largest group that contradicts the agreeing edges.
        offered: rows of all edges between the two components.
        log_odds_wrong: `Measurements.log_odds_wrong` of the least likely agreeing edge; 0 if unknown.
        log_odds: natural log-odds that the likeliest contradicting edge is wrong rather than the least likely agreeing
            edge; 0 if unknown or without contradiction.
    """

    target: int
    source: int
    edges: np.ndarray
    rival: int
    offered: np.ndarray
    log_odds_wrong: float = 0.0
    log_odds: float = 0.0


def find_joins(edges: Measurements, rows: np.ndarray, drift: DriftModel, probability: float) -> list[Join]:
    """For every pair of components with edges between them, find the largest group of edges that agree."""
    labels = drift.labels
    rows = rows[labels[edges.targets[rows]] != labels[edges.sources[rows]]]
    if not len(rows):
        return []
    low = np.minimum(labels[edges.targets[rows]], labels[edges.sources[rows]])
    high = np.maximum(labels[edges.targets[rows]], labels[edges.sources[rows]])
    order = np.lexsort((rows, high, low))
    rows, low, high = rows[order], low[order], high[order]
    starts = np.flatnonzero(np.r_[True, (low[1:] != low[:-1]) | (high[1:] != high[:-1])])
    ends = np.r_[starts[1:], len(rows)]
    first, second = agreeing_pairs(edges, rows, drift, np.repeat(ends, ends - starts), probability)
    neighbours = sp.coo_matrix((np.ones(len(first)), (first, second)), shape=(len(rows), len(rows))).tocsr()
    neighbours = neighbours + neighbours.T
    # Two edges between the same pair of scenes count as one piece of evidence; see `join_decision`.
    weight = -np.log(np.trace(edges.covariance[rows], axis1=1, axis2=2))
    group = np.repeat(np.arange(len(starts)), ends - starts)
    wrong = edges.log_odds_wrong[rows]
    # Confirmed edges first, then the edge with which most edges agree, then the likeliest.
    best = np.lexsort((weight, -np.nan_to_num(wrong), np.diff(neighbours.indptr), edges.confirmed[rows], group))[
        ends - 1
    ]
    mine = np.zeros(len(rows), dtype=bool)
    mine[best] = True
    mine |= neighbours @ mine.astype(float) > 0
    apart = ~mine & (neighbours @ mine.astype(float) == 0)
    agreeing_apart = np.where(apart, 1 + neighbours @ apart.astype(float), 0).astype(np.int64)
    rivals = np.maximum.reduceat(agreeing_apart, starts)
    out = []
    for k, (begin, end) in enumerate(zip(starts.tolist(), ends.tolist(), strict=True)):
        others = begin + np.flatnonzero(mine[begin:end])
        chosen = np.r_[best[k], others[others != best[k]]]
        against = wrong[begin:end][apart[begin:end]]
        least = float(wrong[chosen].max())
        odds = np.nan_to_num([least, against.min() - least if len(against) else 0.0]).tolist()
        out.append(Join(int(low[begin]), int(high[begin]), rows[chosen], int(rivals[k]), rows[begin:end], *odds))
    return out


def join_decision(join: Join, edges: Measurements, sizes: np.ndarray, params: Params) -> str:
    """Decide on a join: return ``agreed``, ``single`` or, where the evidence does not suffice, the reason in words.

    Assumption: independent mistakes do not agree with each other, so agreeing edges are either correct or come from
    places that look alike. It fails where one mistake is repeated: scenes cut from one capture, or many copies of one
    piece of furniture.

    If as many edges contradict the join as agree with it, it is still accepted where the evidence separates both groups
    by ``params.min_wrong_probability``.
    """
    rows = join.edges
    if edges.confirmed[join.offered].any():
        return "agreed"
    large = min(sizes[join.target], sizes[join.source]) >= params.min_large_component
    aliased = join.rival >= _MIN_RIVAL_EDGES and len(rows) < _RIVAL_FACTOR * join.rival
    sure = params.min_wrong_probability
    outweighed = len(rows) <= join.rival - int(join.log_odds >= np.log(sure / (1 - sure)))
    if outweighed or (large and aliased):
        return reason(
            "outvoted",
            f"{len(rows)} edges agree and {join.rival} others contradict them, so none of them is used",
        )
    low = np.minimum(edges.targets[rows], edges.sources[rows])
    high = np.maximum(edges.targets[rows], edges.sources[rows])
    pairs = len(np.unique(low * edges.num_scenes + high))
    if large:
        if pairs >= params.min_bridge_edges:
            return "agreed"
        return reason(
            "too_few_edges",
            f"would join two components of {params.min_large_component} or more scenes: needs "
            f"{params.min_bridge_edges} agreeing edges over {params.min_bridge_edges} scene pairs, or a confirmed "
            f"edge, but has {pairs}",
        )
    return "agreed" if pairs >= 2 else "single"


def merge_components(
    edges: Measurements, chosen: list[Join], labels: np.ndarray, poses: Similarities
) -> tuple[np.ndarray, Similarities]:
    """Move whole components so that the first edge of each chosen join is satisfied. The joins must not form a cycle.

    Returns:
        Rows of the accepted edges, and the moved poses.
    """
    ties: dict[int, list[tuple[int, int]]] = {}
    for k, join in enumerate(chosen):
        ties.setdefault(join.target, []).append((join.source, k))
        ties.setdefault(join.source, []).append((join.target, k))
    size = np.bincount(labels)
    motion = Similarities.identity(len(size))
    seen = np.zeros(len(size), dtype=bool)
    # The larger component keeps its frame.
    for start in sorted(ties, key=lambda label: (-size[label], label)):
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


def spanning_joins(offers: list[Join], count: int) -> list[Join]:
    """Select the joins with most edges that form no cycle between ``count`` components."""
    order = sorted(offers, key=lambda join: (-len(join.edges), join.target, join.source))
    # With distinct weights the minimum spanning forest equals that of a greedy choice in order.
    rank = np.arange(1.0, len(order) + 1)
    ends = np.array([join.target for join in order]), np.array([join.source for join in order])
    tree = minimum_spanning_tree(sp.coo_matrix((rank, ends), shape=(count, count)).tocsr())
    return [order[int(k) - 1] for k in np.sort(tree.data)]


def attaching_joins(offers: list[Join], sizes: np.ndarray, min_large: int) -> list[Join]:
    """Select joins by single edges, each of which attaches one small component; the likeliest come first, and equally
    likely ones from the largest component outwards (a minimum spanning forest, as by Prim's algorithm)."""
    ties: dict[int, list[tuple[int, Join]]] = {}
    for join in offers:
        ties.setdefault(join.target, []).append((join.source, join))
        ties.setdefault(join.source, []).append((join.target, join))
    starts = sorted(ties, key=lambda label: (-sizes[label], label))
    taken = {label for label in starts if sizes[label] >= min_large}
    out: list[Join] = []
    front: list[tuple[float, int, int, int, Join]] = []
    pushed = itertools.count()

    def reach(here: int, rank: int) -> None:
        for there, join in sorted(ties[here], key=lambda tie: tie[0]):
            heapq.heappush(front, (join.log_odds_wrong, rank, next(pushed), there, join))

    for rank, start in enumerate(starts):
        if start in taken and sizes[start] < min_large:
            continue
        taken.add(start)
        reach(start, rank)
        # All large components grow at once: a small component between two of them joins by the likelier edge.
        if rank + 1 < len(starts) and sizes[starts[rank + 1]] >= min_large:
            continue
        while front:
            _, mine, _, there, join = heapq.heappop(front)
            if there not in taken:
                taken.add(there)
                out.append(join)
                reach(there, mine)
    return out
