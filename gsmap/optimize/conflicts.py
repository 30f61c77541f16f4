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
from scipy.special import betaln

from gsmap.geometry.similarities import Similarities
from gsmap.optimize.components import BRIDGE_EDGES, Claims, Walk
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
# Of the links of a contradictory loop exactly one is taken to be wrong: named if this probable, spared if less than that.
SURE, UNLIKELY = 0.9, 0.05
# How likely a link is wrong before its density is looked at: one edge by itself may be any mistake, several that agree
# only a place that looks like another.
ALONE, ALIKE = 0.3, 0.01
# How much the density of true links varies, as the weight of that many pairs; look-alikes are this many times sparser.

SPREAD, SPARSER = 20.0, 3.0
_GENERIC = np.array([0.8164, 0.5213, 0.2483])


@dataclass(frozen=True, eq=False)
class Link:
    """A set of edges that ties two parts of a map: its rows, the side that moves, and the log odds that it is wrong.

    The places of a true link are tied as often as any, those of look-alikes only where the mistake was made: of the
    pairs of a link's end scenes, one of either part, that lie near each other, how many are tied? Under a true link the
    share is Beta distributed about that of the whole map, under look-alikes about a third of it.
    """

    rows: np.ndarray
    moving: np.ndarray
    doubt: float


def undecided_groups(
    edges: Measurements,
    accepted: np.ndarray,
    settled: np.ndarray,
    poses: Similarities,
    votes: Vote,
    probability: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Edges to let go, and the groups that contradict them.

    A group of edges asks for one part of an island to move against another. It and the accepted links on the way
    round form a loop, and one link of the loop is wrong. The one that surely is is let go (the map stands if it is the
    group); where none is sure, the group and all links that may be wrong are, and their parts become islands, which is
    the truth about what is known.

    Args:
        settled: (E,) bool, edges that were let go before and have no say.

    Returns:
        (E,) bool each: edges that are wrong, groups that are right, and all that stays undecided.
    """
    wrong, right, open_question = (np.zeros(len(edges), dtype=bool) for _ in range(3))
    labels = islands(edges, np.flatnonzero(accepted))
    inside = labels[edges.targets] == labels[edges.sources]
    rows = np.flatnonzero(inside & ~accepted & ~settled)
    if not len(rows):
        return wrong, right, open_question
    length = typical_length(edges, poses)
    ties = _Ties.of(edges, accepted, labels, poses, 1.25 * length)
    typical_share = 0.5 * np.median(votes.share[accepted])
    walk = Walk.over(edges, np.flatnonzero(accepted), poses)
    for group, near, far, motion in _groups(edges, rows, walk, length, probability):
        if len(np.unique(np.r_[near, far])) < 3 or wrong.any() or open_question.any():
            continue
        ends = np.zeros(edges.num_scenes, dtype=bool)
        ends[far] = True
        moved = poses.replaced(far, motion[np.zeros(len(far), dtype=np.int64)] @ poses[far])
        asking = ties.link(edges, group, ends, moved)
        # A torn place asks together with the look-alikes that tore it: its own edges are the better supported ones.
        strong = votes.share[group] >= typical_share
        if strong.sum() >= BRIDGE_EDGES:
            group, near, far = group[strong], near[strong], far[strong]
        links = _links(edges, accepted, votes, ties, poses, near, far)
        if not links:
            continue
        doubts = np.array([link.doubt for link in [asking, *links]])
        odds = np.exp(doubts - doubts.max())
        odds /= odds.sum()
        worst = int(odds.argmax())
        if odds[worst] >= SURE:
            if worst == 0:
                continue
            # What too few edges speak against is not called wrong; the parts that they tie stay apart.
            least = links[worst - 1]
            verdict = wrong if len(group) >= BRIDGE_EDGES or len(least.rows) == 1 else open_question
            verdict[least.rows] = True
            open_question |= accepted & _contested(edges, accepted, least.rows)
            right[group] = True
            continue
        open_question[group] = True
        for link, chance in zip(links, odds[1:], strict=True):
            if chance > UNLIKELY:
                open_question[link.rows] = True
    return wrong, right, open_question


def _contested(edges: Measurements, accepted: np.ndarray, cut: np.ndarray) -> np.ndarray:
    """(E,) bool: edges of scenes that a cut leaves to one side by little more than chance; they go to neither."""
    n = edges.num_scenes
    across = np.bincount(np.r_[edges.targets[cut], edges.sources[cut]], minlength=n)
    rows = np.flatnonzero(accepted)
    whole = np.bincount(np.r_[edges.targets[rows], edges.sources[rows]], minlength=n)
    contested = (across > 0) & (3 * across > whole)
    return contested[edges.targets] | contested[edges.sources]


def _links(
    edges: Measurements,
    accepted: np.ndarray,
    votes: Vote,
    ties: _Ties,
    poses: Similarities,
    near: np.ndarray,
    far: np.ndarray,
    depth: int = 5,
) -> list[Link]:
    """The weak links on the way between two sets of scenes: the lightest cut, and then those on either side of it."""
    parts = smallest_cut(edges, accepted, votes, near, far, LINK_POWER) if depth else None
    if parts is None:
        return []
    rows, moving = parts
    if not len(rows):
        return []
    ends = np.unique(np.r_[edges.targets[rows], edges.sources[rows]])
    beyond = moving[edges.targets] & moving[edges.sources]
    before = ~moving[edges.targets] & ~moving[edges.sources]
    still_end, moving_end = ends[~moving[ends]], ends[moving[ends]]
    return [
        *_links(edges, accepted & before, votes, ties, poses, near, still_end, depth - 1),
        ties.link(edges, rows, moving, poses),
        *_links(edges, accepted & beyond, votes, ties, poses, moving_end, far, depth - 1),
    ]


@dataclass(frozen=True)
class _Ties:
    """Up to which ``length`` scenes count as near each other, and the ``share`` of near pairs that is tied."""

    length: float
    share: float

    @classmethod
    def of(
        cls, edges: Measurements, accepted: np.ndarray, labels: np.ndarray, poses: Similarities, length: float
    ) -> _Ties:
        near = cKDTree(poses.translations).query_pairs(length, output_type="ndarray")
        near = near[labels[near[:, 0]] == labels[near[:, 1]]]
        pairs = np.bincount(near.ravel(), minlength=edges.num_scenes)
        tied = np.bincount(_tied(edges, np.flatnonzero(accepted), poses, length).ravel(), minlength=edges.num_scenes)
        busy = pairs > 0
        # The median scene's: where the map is folded, scenes that are not neighbours lie together.
        share = np.median(tied[busy] / pairs[busy]) if busy.any() else 0.5
        return cls(length, float(np.clip(share, 0.05, 0.9)))

    def link(self, edges: Measurements, rows: np.ndarray, moving: np.ndarray, poses: Similarities) -> Link:
        """A link by its rows, and how much speaks against it."""
        ends = np.unique(np.r_[edges.targets[rows], edges.sources[rows]])
        still = cKDTree(poses.translations[ends[~moving[ends]]])
        pairs = int(still.count_neighbors(cKDTree(poses.translations[ends[moving[ends]]]), self.length))
        tied = min(pairs, len(_tied(edges, rows, poses, self.length)))
        true = SPREAD * self.share, SPREAD * (1 - self.share)
        alike = 1.0, SPARSER / self.share - 1.0
        wrong = ALONE if len(rows) == 1 else ALIKE
        evidence = [betaln(a + tied, b + pairs - tied) - betaln(a, b) for a, b in (alike, true)]
        return Link(rows, moving, float(evidence[0] - evidence[1] + np.log(wrong / (1 - wrong))))


def _tied(edges: Measurements, rows: np.ndarray, poses: Similarities, length: float) -> np.ndarray:
    """(P, 2) pairs of scenes that edges at ``rows`` tie and that lie near each other."""
    ends = np.sort(np.stack([edges.targets[rows], edges.sources[rows]], axis=1), axis=1)
    near = np.linalg.norm(poses.translations[ends[:, 0]] - poses.translations[ends[:, 1]], axis=1) <= length
    return np.unique(ends[near], axis=0)


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
    edges: Measurements, rows: np.ndarray, walk: Walk, length: float, probability: float
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray, Similarities]]:
    """Edges of one island that ask for the same motion; the scenes at their fixed and at their moving end; it."""
    if not len(rows):
        return []
    poses, labels = walk.poses, walk.labels
    a, b = edges.targets[rows], edges.sources[rows]
    motion = poses[a] @ edges.measured[rows] @ poses[b].inverse()
    middle = poses.translations.mean(0)
    way = motion.apply(np.tile(middle, (len(rows), 1))) - middle
    # The same disagreement, seen from its other end, is the inverse motion.
    turned = way @ _GENERIC < 0
    motion = motion.replaced(turned, motion[turned].inverse())
    claims = Claims.of(edges, rows, turned)
    corners = middle + 10 * length * np.eye(3)
    feature = np.concatenate([motion.apply(np.tile(c, (len(rows), 1))) - c for c in corners], axis=1)
    off = np.abs(feature).max(1) > 2 * length
    # Motions that are nearly alike, and then those that are the same within what the map knows.
    pairs = cKDTree(feature).query_pairs(length, p=np.inf, output_type="ndarray")
    pairs = pairs[off[pairs].all(1) & (labels[a[pairs[:, 0]]] == labels[a[pairs[:, 1]]])]
    pairs = pairs[claims.agree(pairs[:, 0], pairs[:, 1], walk, probability)]
    graph = sp.coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(rows), len(rows)))
    which = connected_components(graph, directed=False)[1]
    order = np.argsort(which, kind="stable")
    return [
        (rows[mine], claims.near[mine], claims.far[mine], motion[mine[:1]])
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
    side = _smoothed(reached[:n], a, b, np.r_[near, far])
    return rows[side[a] != side[b]], ~side


def _smoothed(side: np.ndarray, a: np.ndarray, b: np.ndarray, held: np.ndarray) -> np.ndarray:
    """The cut with scenes moved to the side that most of their edges go to, as long as fewer edges are cut.

    Weights draw the cut between places; at its rim a scene of few and light edges may be left on the wrong side.
    """
    n, crossing = len(side), int((side[a] != side[b]).sum())
    while True:
        apart = side[a] != side[b]
        across = np.bincount(np.r_[a[apart], b[apart]], minlength=n)
        along = np.bincount(np.r_[a[~apart], b[~apart]], minlength=n)
        move = across > along
        move[held] = False
        moved = side ^ move
        left = int((moved[a] != moved[b]).sum())
        if left >= crossing:
            return side
        side, crossing = moved, left
