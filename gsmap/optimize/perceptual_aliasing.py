"""Perceptual aliasing: groups of edges that agree with each other and contradict the map, because places look alike.

One such edge is noise; a group means that two places look the same, or that the map is folded. Which of the two
cannot be told from the group itself, only from the weight of what holds the map together the other way round.

Assumptions: of the links of one contradictory loop exactly one is wrong; links are wrong independently of each other;
and a wrong link is sparser than the map around it (`gsmap.optimize.link_density`). They fail where a place is torn and
taken for another one at once, where every pair of two places was mistaken, and where so few edges lead round that a
true link looks as sparse as a wrong one: the map may then fold, or single scenes go to the wrong place.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import breadth_first_order, connected_components, maximum_flow
from scipy.spatial import cKDTree

from gsmap.geometry.similarities import Similarities
from gsmap.optimize.consistency import DirectedEdges
from gsmap.optimize.contradictions import MAX_SUSPECTS
from gsmap.optimize.cycles import Vote
from gsmap.optimize.drift import DriftModel
from gsmap.optimize.gauge import outlier_priors
from gsmap.optimize.link_density import Link, LinkDensity, typical_length
from gsmap.optimize.measurements import Measurements
from gsmap.optimize.params import Params
from gsmap.optimize.priors import PriorTerms
from gsmap.optimize.structure import component_labels

_SPARE_RATIO = 3.0  # where no link is surely wrong, links so many times less probable than the likeliest are spared
_WELL_SUPPORTED = 0.5  # edges with this share of the median support lie within a place, and are considered first
_CUT_DEPTH = 5  # recursion to either side of the lightest cut of a loop
_SUPPORT_POWER = 3.0  # an edge weighs this power of its share of agreeing neighbours when a loop is cut
_PRIOR_SUPPORT_POWER = 2.0  # the same where contradicting priors are separated
_MIN_MOTION_LENGTHS = 2.0  # a group matters if it demands a motion of more than so many typical edges
_GROUP_LENGTHS = 1.0  # edges that demand motions within so many typical edges may be one group
_CONTESTED_RATIO = 3  # scenes of which more than one edge in so many crosses a wrong link belong to neither side
_PRIOR_EDGES = 10.0  # a prior weighs as much as so many edges without a triangle,
_PRIOR_FACTOR = 2.0  # and is outweighed by a cut of more than so many times its weight
MAX_WEIGHT = 20_000  # sums of weights must stay within 32 bits
# The side of this direction tells a motion from its inverse; motions are hardly ever at right angles to odd numbers.
_GENERIC = np.array([0.8164, 0.5213, 0.2483])


@dataclass(eq=False)
class Findings:
    """What contradictory loops say, as (E,) bool.

    Args:
        wrong: edges that are surely wrong.
        right: edges of groups that are right against the map.
        undecided: everything that may be wrong without it being clear what is.
    """

    wrong: np.ndarray
    right: np.ndarray
    undecided: np.ndarray

    @classmethod
    def none(cls, count: int) -> Findings:
        return cls(*(np.zeros(count, dtype=bool) for _ in range(3)))


def resolve_aliased_loops(
    edges: Measurements,
    accepted: np.ndarray,
    settled: np.ndarray,
    poses: Similarities,
    votes: Vote,
    params: Params,
) -> Findings:
    """Edges to let go, and the groups that contradict them.

    A group of edges asks for one part of a component to move against another. It and the accepted links on the way
    round form a loop, and one link of the loop is wrong. The one that surely is is let go (the map stands if it is the
    group); where none is sure, the group and all links that may be wrong are, and their parts become components of
    their own: nothing known ties them.

    Args:
        settled: (E,) bool, edges that were let go before and do not count.
    """
    found = Findings.none(len(edges))
    labels = component_labels(edges, np.flatnonzero(accepted))
    inside = labels[edges.targets] == labels[edges.sources]
    rows = np.flatnonzero(inside & ~accepted & ~settled)
    if not len(rows):
        return found
    length = typical_length(edges, poses)
    density = LinkDensity.of(edges, accepted, labels, poses)
    drift = DriftModel.over(edges, np.flatnonzero(accepted), poses)
    # A torn place and the look-alikes that tore it ask for one motion: the place's own edges are those that their
    # neighbours support, and come first.
    supported = votes.support >= _WELL_SUPPORTED * np.median(votes.support[accepted])
    for group in _groups(edges, rows, drift, length, params.gate_probability):
        inner = supported[group.rows]
        for candidate in (group,) if inner.all() else (group[inner], group):
            if found.wrong.any() or found.undecided.any() or len(np.unique(np.r_[candidate.near, candidate.far])) < 3:
                continue
            links = _links(edges, accepted, votes, density, poses, candidate.near, candidate.far, _CUT_DEPTH)
            if links:
                hypothesis = candidate.hypothesis(edges, density, poses)
                _decide(found, edges, accepted, group, candidate, [hypothesis, *links], params)
    return found


def _decide(
    found: Findings,
    edges: Measurements,
    accepted: np.ndarray,
    group: Group,
    candidate: Group,
    loop: list[Link],
    params: Params,
) -> None:
    """Which link of a loop is wrong; the first of ``loop`` is the candidate itself, all or a part of the group."""
    log_odds = np.array([link.log_odds_wrong for link in loop])
    probability = np.exp(log_odds - log_odds.max())
    probability /= probability.sum()
    worst = int(probability.argmax())
    if probability[worst] >= params.min_wrong_probability and worst > 0:
        # What too few edges speak against is not called wrong; the parts that they tie stay apart.
        least = loop[worst].rows
        verdict = found.wrong if len(candidate.rows) >= params.min_bridge_edges or len(least) == 1 else found.undecided
        verdict[least] = True
        found.undecided |= _contested(edges, accepted, least)
        found.right[candidate.rows] = True
    elif candidate is not group:
        return
    elif probability[worst] >= params.min_wrong_probability:
        found.undecided |= _contested(edges, accepted, group.rows)
    else:
        suspects = [
            link for link, p in zip(loop[1:], probability[1:], strict=True) if p * _SPARE_RATIO > probability[worst]
        ]
        # Where hardly any stands out the wrong one is not among them: parting all would lose what is known.
        suspects = suspects if len(suspects) <= MAX_SUSPECTS else []
        for link in suspects:
            found.undecided[link.rows] = True
            found.undecided |= _contested(edges, accepted, link.rows)
        # A link deep in the loop may leave other ways round: then the group asks again.
        parts = component_labels(edges, np.flatnonzero(accepted & ~found.undecided))
        if not suspects or (parts[group.near] != parts[group.far]).all():
            found.undecided[group.rows] = True


@dataclass(frozen=True, eq=False)
class Group:
    """Edges (``rows``) that ask for one motion of the scenes at their ``far`` ends against those at their ``near``."""

    rows: np.ndarray
    near: np.ndarray
    far: np.ndarray
    motion: Similarities

    def __getitem__(self, keep: np.ndarray) -> Group:
        return Group(self.rows[keep], self.near[keep], self.far[keep], self.motion)

    def hypothesis(self, edges: Measurements, density: LinkDensity, poses: Similarities) -> Link:
        """The link that the group would be, once its scenes have moved."""
        ends = np.zeros(edges.num_scenes, dtype=bool)
        ends[self.far] = True
        moved = self.motion[np.zeros(len(self.far), dtype=np.int64)] @ poses[self.far]
        return density.link(edges, self.rows, ends, poses.replaced(self.far, moved))


def _contested(edges: Measurements, accepted: np.ndarray, link: np.ndarray) -> np.ndarray:
    """(E,) bool: edges of scenes of which one edge in `_CONTESTED_RATIO` or more crosses a link; they join no side."""
    n = edges.num_scenes
    across = np.bincount(np.r_[edges.targets[link], edges.sources[link]], minlength=n)
    rows = np.union1d(np.flatnonzero(accepted), link)
    whole = np.bincount(np.r_[edges.targets[rows], edges.sources[rows]], minlength=n)
    contested = (across > 0) & (_CONTESTED_RATIO * across > whole)
    out = np.zeros(len(edges), dtype=bool)
    out[rows] = contested[edges.targets[rows]] | contested[edges.sources[rows]]
    return out


def _links(
    edges: Measurements,
    accepted: np.ndarray,
    votes: Vote,
    density: LinkDensity,
    poses: Similarities,
    near: np.ndarray,
    far: np.ndarray,
    depth: int,
) -> list[Link]:
    """The weak links on the way between two sets of scenes: the lightest cut, and then those on either side of it."""
    parts = smallest_cut(edges, accepted, votes, near, far, _SUPPORT_POWER) if depth else None
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
        *_links(edges, accepted & before, votes, density, poses, near, still_end, depth - 1),
        density.link(edges, rows, moving, poses),
        *_links(edges, accepted & beyond, votes, density, poses, moving_end, far, depth - 1),
    ]


def contradicted_priors(
    edges: Measurements, accepted: np.ndarray, poses: Similarities, votes: Vote, priors: PriorTerms
) -> tuple[np.ndarray, np.ndarray]:
    """Edges to let go because priors at either end of them contradict each other; priors that are outweighed.

    The priors of a component are compared under the motion of the component that satisfies most of them. Those it
    leaves far off either name a part that belongs elsewhere, and the smallest cut to it is let go, or they are wrong
    themselves, if that cut weighs more than `_PRIOR_FACTOR` times as much.

    Returns:
        (E,) bool: cut edges; (P,) bool: outweighed priors.
    """
    cut, outweighed = np.zeros(len(edges), dtype=bool), np.zeros(len(priors), dtype=bool)
    labels = component_labels(edges, np.flatnonzero(accepted))
    for label in np.unique(labels[priors.scenes]):
        mine = np.flatnonzero(labels[priors.scenes] == label)
        off = outlier_priors(poses, priors[mine], typical_length(edges, poses))
        if not off.any() or off.all():
            continue
        near, far = priors.scenes[mine[~off]], priors.scenes[mine[off]]
        parts = smallest_cut(edges, accepted, votes, near, far, _PRIOR_SUPPORT_POWER)
        bearable = _PRIOR_FACTOR * _PRIOR_EDGES * off.sum()
        if parts is not None and (1 + votes.agree[parts[0]]).sum() <= bearable:
            cut[parts[0]] = True
        else:
            outweighed[mine[off]] = True
    return cut, outweighed


def _groups(edges: Measurements, rows: np.ndarray, drift: DriftModel, length: float, probability: float) -> list[Group]:
    """Edges of one component that ask for the same motion."""
    poses, labels = drift.poses, drift.labels
    a, b = edges.targets[rows], edges.sources[rows]
    motion = poses[a] @ edges.measured[rows] @ poses[b].inverse()
    middle = poses.translations.mean(0)
    way = motion.apply(np.tile(middle, (len(rows), 1))) - middle
    # The same disagreement, seen from its other end, is the inverse motion.
    turned = way @ _GENERIC < 0
    motion = motion.replaced(turned, motion[turned].inverse())
    directed = DirectedEdges.of(edges, rows, turned)
    corners = middle + 10 * length * np.eye(3)
    feature = np.concatenate([motion.apply(np.tile(c, (len(rows), 1))) - c for c in corners], axis=1)
    off = np.abs(feature).max(1) > _MIN_MOTION_LENGTHS * length
    # Motions that are nearly alike, and then those that are the same within what the map knows.
    pairs = cKDTree(feature).query_pairs(_GROUP_LENGTHS * length, p=np.inf, output_type="ndarray")
    pairs = pairs[off[pairs].all(1) & (labels[a[pairs[:, 0]]] == labels[a[pairs[:, 1]]])]
    pairs = pairs[directed.pairwise_consistent(pairs[:, 0], pairs[:, 1], drift, probability)]
    graph = sp.coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(rows), len(rows)))
    which = connected_components(graph, directed=False)[1]
    order = np.argsort(which, kind="stable")
    return [
        Group(rows[mine], directed.near[mine], directed.far[mine], motion[mine[:1]])
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
    confirmed = edges.confirmed[rows]
    side = _smoothed(reached[:n], a, b, np.r_[near, far, a[confirmed], b[confirmed]])
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
