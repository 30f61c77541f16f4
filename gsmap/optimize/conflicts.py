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
from gsmap.optimize.components import BRIDGE_EDGES, Claims, Walk
from gsmap.optimize.cycles import Vote
from gsmap.optimize.density import Link, Ties, typical_length
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
# Of the links of a contradictory loop one is taken to be wrong: named if this probable, spared if this many times less
# probable than the likeliest, or if more than so many are not.
SURE, FAR_LESS, MANY = 0.9, 3.0, 4
# Edges with this share of the typical support are hardly ever look-alikes.
WELL_SUPPORTED = 0.5
_GENERIC = np.array([0.8164, 0.5213, 0.2483])


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
    ties = Ties.of(edges, accepted, labels, poses)
    walk = Walk.over(edges, np.flatnonzero(accepted), poses)
    # Of a torn place and the look-alikes that tore it, which ask for one motion, the place's own edges are those that
    # their neighbours support: they are heard first.
    strong = votes.support >= WELL_SUPPORTED * np.median(votes.support[accepted])
    for group in _groups(edges, rows, walk, length, probability):
        sure = strong[group.rows]
        for voice in (group,) if sure.all() else (group[sure], group):
            if wrong.any() or open_question.any() or len(np.unique(np.r_[voice.near, voice.far])) < 3:
                continue
            links = _links(edges, accepted, votes, ties, poses, voice.near, voice.far)
            if not links:
                continue
            doubts = np.array([link.doubt for link in [voice.link(edges, ties, poses), *links]])
            odds = np.exp(doubts - doubts.max())
            odds /= odds.sum()
            worst = int(odds.argmax())
            if odds[worst] >= SURE and worst > 0:
                # What too few edges speak against is not called wrong; the parts that they tie stay apart.
                least = links[worst - 1].rows
                verdict = wrong if len(voice.rows) >= BRIDGE_EDGES or len(least) == 1 else open_question
                verdict[least] = True
                open_question |= _contested(edges, accepted, least)
                right[voice.rows] = True
            elif voice is not group:
                continue
            elif odds[worst] >= SURE:
                open_question |= _contested(edges, accepted, group.rows)
            else:
                suspects = [link for link, p in zip(links, odds[1:], strict=True) if p * FAR_LESS > odds[worst]]
                # Where hardly any stands out the wrong one is not among them: parting all would lose what is known.
                suspects = suspects if len(suspects) <= MANY else []
                for link in suspects:
                    open_question[link.rows] = True
                    open_question |= _contested(edges, accepted, link.rows)
                # A link deep in the loop may leave other ways round: then the group asks again.
                parts = islands(edges, np.flatnonzero(accepted & ~open_question))
                if not suspects or (parts[group.near] != parts[group.far]).all():
                    open_question[group.rows] = True
    return wrong, right, open_question


@dataclass(frozen=True, eq=False)
class Group:
    """Edges (``rows``) that ask for one motion of the scenes at their ``far`` ends against those at their ``near``."""

    rows: np.ndarray
    near: np.ndarray
    far: np.ndarray
    motion: Similarities

    def __getitem__(self, keep: np.ndarray) -> Group:
        return Group(self.rows[keep], self.near[keep], self.far[keep], self.motion)

    def link(self, edges: Measurements, ties: Ties, poses: Similarities) -> Link:
        """The link that the group would be, once its scenes have moved."""
        ends = np.zeros(edges.num_scenes, dtype=bool)
        ends[self.far] = True
        moved = self.motion[np.zeros(len(self.far), dtype=np.int64)] @ poses[self.far]
        return ties.link(edges, self.rows, ends, poses.replaced(self.far, moved))


def _contested(edges: Measurements, accepted: np.ndarray, link: np.ndarray) -> np.ndarray:
    """(E,) bool: edges of scenes that a link leaves to one side by little more than chance; they go to neither."""
    n = edges.num_scenes
    across = np.bincount(np.r_[edges.targets[link], edges.sources[link]], minlength=n)
    rows = np.union1d(np.flatnonzero(accepted), link)
    whole = np.bincount(np.r_[edges.targets[rows], edges.sources[rows]], minlength=n)
    contested = (across > 0) & (3 * across > whole)
    out = np.zeros(len(edges), dtype=bool)
    out[rows] = contested[edges.targets[rows]] | contested[edges.sources[rows]]
    return out


def _links(
    edges: Measurements,
    accepted: np.ndarray,
    votes: Vote,
    ties: Ties,
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


def _groups(edges: Measurements, rows: np.ndarray, walk: Walk, length: float, probability: float) -> list[Group]:
    """Edges of one island that ask for the same motion."""
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
        Group(rows[mine], claims.near[mine], claims.far[mine], motion[mine[:1]])
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
    good = votes.support[rows] / max(float(np.median(votes.support[rows])), 1e-9)
    weight = 1 + np.round(np.minimum(500 * good**power, MAX_WEIGHT)).astype(np.int64)
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
    vouched = edges.confirmed[rows]
    side = _smoothed(reached[:n], a, b, np.r_[near, far, a[vouched], b[vouched]])
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
