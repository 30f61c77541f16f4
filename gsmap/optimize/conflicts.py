"""Groups of edges that agree with each other and contradict the map: places that look alike.

One such edge is noise; a group means that two places look the same, or that the map is folded. Which of the two
cannot be told from the group itself, only from the weight of what holds the map together the other way round.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import breadth_first_order, connected_components, maximum_flow
from scipy.spatial import cKDTree

from gsmap.geometry.similarities import Similarities
from gsmap.optimize.components import BRIDGE_EDGES
from gsmap.optimize.cycles import Vote
from gsmap.optimize.gauge import far_off
from gsmap.optimize.measurements import Measurements
from gsmap.optimize.priors import PriorTerms
from gsmap.optimize.robust import islands

# What contradicts priors must weigh this many times as much to prevail.
DECISIVE = 2.0
MAX_WEIGHT = 20_000  # sums of weights must stay within 32 bits
LINK_POWER = 3
# A prior weighs as much as this many edges without a triangle.
PRIOR_WEIGHT = 10.0
_GENERIC = np.array([0.8164, 0.5213, 0.2483])


@dataclass(frozen=True, eq=False)
class Link:
    """A set of edges that ties two parts of a map: its rows, the side that moves, and how dense it is.

    Density is the number of tied pairs among all pairs of its end scenes, one of either part, that lie near each
    other: the places of a true link are tied as often as any, those of look-alikes only where the mistake was made.
    ``low`` and ``high`` bound it (Wilson's interval, two sigmas).
    """

    rows: np.ndarray
    moving: np.ndarray
    low: float
    high: float

    @property
    def middle(self) -> float:
        return (self.low + self.high) / 2


def undecided_groups(
    edges: Measurements, accepted: np.ndarray, settled: np.ndarray, poses: Similarities, votes: Vote
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Edges to let go, and the groups that contradict them.

    A group of edges asks for one part of an island to move against another. It and the accepted links on the way
    round form a loop, and one link of the loop is wrong. The one that is clearly least dense is let go (the map stands
    if it is the group); where none is, the group and all links that may be wrong are, and their parts become islands,
    which is the truth about what is known.

    Args:
        settled: (E,) bool, edges that were let go before and have no say.

    Returns:
        (E,) bool each: edges that are wrong, groups that are right, and all that stays undecided.
    """
    wrong, right, open_question = (np.zeros(len(edges), dtype=bool) for _ in range(3))
    labels = islands(edges, np.flatnonzero(accepted))
    inside = labels[edges.targets] == labels[edges.sources]
    rows = np.flatnonzero(inside & ~accepted & ~settled)
    length = typical_length(edges, poses) if len(rows) else 0.0
    for group, near, far, motion in _groups(edges, rows, labels, poses, length):
        if len(np.unique(np.r_[near, far])) < 3 or wrong.any() or open_question.any():
            continue
        links = _links(edges, accepted, votes, poses, near, far, length)
        if not links:
            continue
        least = min(links, key=lambda link: link.high)
        ends = np.zeros(edges.num_scenes, dtype=bool)
        ends[far] = True
        moved = poses.replaced(far, motion[np.zeros(len(far), dtype=np.int64)] @ poses[far])
        asking = _link(edges, group, ends, moved, length)
        others = [link for link in links if link is not least]
        if asking.high < min(link.middle for link in links):
            continue
        if len(group) >= BRIDGE_EDGES and least.high < min(link.middle for link in [asking, *others]):
            wrong[least.rows] = True
            right[group] = True
            continue
        open_question[group] = True
        for link in links:
            if link.middle <= least.high:
                open_question[link.rows] = True
    return wrong, right, open_question


def _links(
    edges: Measurements,
    accepted: np.ndarray,
    votes: Vote,
    poses: Similarities,
    near: np.ndarray,
    far: np.ndarray,
    length: float,
    depth: int = 3,
) -> list[Link]:
    """The weak links on the way between two sets of scenes: the lightest cut, and then those on either side of it."""
    parts = smallest_cut(edges, accepted, votes, near, far, LINK_POWER) if depth else None
    if parts is None:
        return []
    rows, moving = parts
    ends = np.unique(np.r_[edges.targets[rows], edges.sources[rows]])
    beyond = moving[edges.targets] & moving[edges.sources]
    before = ~moving[edges.targets] & ~moving[edges.sources]
    still_end, moving_end = ends[~moving[ends]], ends[moving[ends]]
    return [
        *_links(edges, accepted & before, votes, poses, near, still_end, length, depth - 1),
        _link(edges, rows, moving, poses, length),
        *_links(edges, accepted & beyond, votes, poses, moving_end, far, length, depth - 1),
    ]


def _link(edges: Measurements, rows: np.ndarray, moving: np.ndarray, poses: Similarities, length: float) -> Link:
    ends = np.unique(np.r_[edges.targets[rows], edges.sources[rows]])
    still = cKDTree(poses.translations[ends[~moving[ends]]])
    pairs = int(still.count_neighbors(cKDTree(poses.translations[ends[moving[ends]]]), length))
    a, b = poses.translations[edges.targets[rows]], poses.translations[edges.sources[rows]]
    tied = min(pairs, int((np.linalg.norm(a - b, axis=1) <= length).sum()))
    # Nothing near to count by: any density is possible.
    middle, half = (tied + 2) / (pairs + 4), 2 * np.sqrt(tied * (pairs - tied) / max(pairs, 1) + 1) / (pairs + 4)
    return Link(rows, moving, max(0.0, middle - half), min(1.0, middle + half))


def contradicted_priors(
    edges: Measurements, accepted: np.ndarray, poses: Similarities, votes: Vote, priors: PriorTerms
) -> tuple[np.ndarray, np.ndarray]:
    """Edges to let go because priors at either end of them contradict each other; priors that are outweighed.

    The priors of an island are compared under the motion of the island that satisfies most of them. Those it leaves
    far off either name a part that belongs elsewhere, and the smallest cut to it is let go, or they are wrong
    themselves, if that cut weighs `DECISIVE` times as much.

    Returns:
        (E,) bool: cut edges; (P,) bool: outweighed priors.
    """
    cut, outweighed = np.zeros(len(edges), dtype=bool), np.zeros(len(priors), dtype=bool)
    labels = islands(edges, np.flatnonzero(accepted))
    for island in np.unique(labels[priors.scenes]):
        mine = np.flatnonzero(labels[priors.scenes] == island)
        off = far_off(poses, priors[mine], typical_length(edges, poses))
        if not off.any() or off.all():
            continue
        near, far = priors.scenes[mine[~off]], priors.scenes[mine[off]]
        parts = smallest_cut(edges, accepted, votes, near, far, 2)
        if parts is not None and (1 + votes.agree[parts[0]]).sum() <= DECISIVE * PRIOR_WEIGHT * off.sum():
            cut[parts[0]] = True
        else:
            outweighed[mine[off]] = True
    return cut, outweighed


def typical_length(edges: Measurements, poses: Similarities) -> float:
    """Median length of an edge in map units."""
    unit = np.exp(poses.log_scales[edges.targets])
    return float(np.median(np.linalg.norm(edges.measured.translations, axis=1) * unit))


def _groups(
    edges: Measurements, rows: np.ndarray, labels: np.ndarray, poses: Similarities, length: float
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray, Similarities]]:
    """Edges of one island that ask for the same motion; the scenes at their fixed and at their moving end; it."""
    if not len(rows):
        return []
    a, b = edges.targets[rows], edges.sources[rows]
    motion = poses[a] @ edges.measured[rows] @ poses[b].inverse()
    middle = poses.translations.mean(0)
    way = motion.apply(np.tile(middle, (len(rows), 1))) - middle
    # The same disagreement, seen from its other end, is the inverse motion.
    turned = way @ _GENERIC < 0
    motion = motion.replaced(turned, motion[turned].inverse())
    near, far = np.where(turned, b, a), np.where(turned, a, b)
    corners = middle + 10 * length * np.eye(3)
    feature = np.concatenate([motion.apply(np.tile(c, (len(rows), 1))) - c for c in corners], axis=1)
    off = np.flatnonzero(np.abs(feature).max(1) > 2 * length)
    if not len(off):
        return []
    rows, near, far, feature, motion = rows[off], near[off], far[off], feature[off], motion[off]
    pairs = cKDTree(feature).query_pairs(length, p=np.inf, output_type="ndarray")
    pairs = pairs[labels[near[pairs[:, 0]]] == labels[near[pairs[:, 1]]]]
    graph = sp.coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(rows), len(rows)))
    which = connected_components(graph, directed=False)[1]
    order = np.argsort(which, kind="stable")
    return [
        (rows[mine], near[mine], far[mine], motion[mine[:1]])
        for mine in np.split(order, np.flatnonzero(np.diff(which[order])) + 1)
        if len(mine) > 1
    ]


def smallest_cut(
    edges: Measurements, accepted: np.ndarray, votes: Vote, near: np.ndarray, far: np.ndarray, power: float
) -> tuple[np.ndarray, np.ndarray] | None:
    """The lightest set of accepted edges, none of them confirmed, that parts ``near`` from ``far``.

    An edge weighs a power of its share of agreeing neighbours: edges inside a place are heavy, so that the cut runs
    between places rather than around the few scenes that are named.

    Returns:
        Rows of the edges, and (N,) bool for the side of ``far``; None where no such set exists, or where a scene is
        asked to be on both sides.
    """
    near, far = np.setdiff1d(near, far), np.setdiff1d(far, near)
    if not len(near) or not len(far):
        return None
    n, rows = edges.num_scenes, np.flatnonzero(accepted)
    good = votes.share[rows] / max(float(np.median(votes.share[rows])), 1e-9)
    weight = 1 + np.round(np.minimum(100 * good**power, MAX_WEIGHT)).astype(np.int64)
    heavy = int(weight.sum()) + 1
    flow = np.where(edges.confirmed[rows], heavy, weight)
    a, b = edges.targets[rows], edges.sources[rows]
    tail = np.r_[a, b, np.full(len(near), n), far]
    head = np.r_[b, a, near, np.full(len(far), n + 1)]
    value = np.r_[flow, flow, np.full(len(near) + len(far), heavy)].astype(np.int32)
    graph = sp.coo_matrix((value, (tail, head)), shape=(n + 2, n + 2)).tocsr()
    found = maximum_flow(graph, n, n + 1)
    if found.flow_value >= heavy:
        return None
    rest = graph - found.flow
    rest.data[rest.data <= 0] = 0
    rest.eliminate_zeros()
    reached = np.zeros(n + 2, dtype=bool)
    reached[breadth_first_order(rest, n, return_predecessors=False)] = True
    return rows[reached[a] != reached[b]], ~reached[:n]
