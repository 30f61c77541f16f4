"""Detect perceptual aliasing: groups of edges that agree with each other and contradict the map, because places look
alike.

A single such edge is noise; a group means that two places look the same, or that the map is folded. The group alone
does not decide between both; the edges that connect the map the other way round decide by their weight.

Assumptions: of the links of one contradictory loop exactly one is wrong; links are wrong independently of each other;
and a wrong link is sparser than the map around it (`gsmap.optimize.link_density`). They fail where a place is both torn
apart and mistaken for another place, where every pair of two places was mistaken, and where a true link has so few
edges that it is as sparse as a wrong link: the map may then fold, or single scenes get a wrong pose.
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
from gsmap.optimize.cycles import CycleSupport
from gsmap.optimize.drift import DriftModel
from gsmap.optimize.gauge import find_outlier_priors
from gsmap.optimize.link_density import Link, LinkDensity, typical_length
from gsmap.optimize.measurements import Measurements
from gsmap.optimize.params import Params
from gsmap.optimize.priors import PriorTerms
from gsmap.optimize.structure import component_labels

# If no link is surely wrong, links are kept that are this many times less probably wrong than the worst.
_SPARE_RATIO = 3.0
# Edges with at least this share of the median support lie within a place; they are considered first.
_WELL_SUPPORTED = 0.5
_CUT_DEPTH = 5  # recursion depth on either side of the lightest cut of a loop
_SUPPORT_POWER = 3.0  # when a loop is cut, the weight of an edge is its share of agreeing neighbours to this power
_PRIOR_SUPPORT_POWER = 2.0  # the same power where contradicting priors are separated
_MIN_MOTION_LENGTHS = 2.0  # a group matters if it demands a motion of more than this, in lengths of a typical edge
_GROUP_LENGTHS = 1.0  # edges may form a group if the motions that they demand differ by less, in the same unit
# A scene belongs to neither side of a wrong link if more than one in this many of its edges crosses it.
_CONTESTED_RATIO = 3
_PRIOR_EDGES = 10.0  # a prior has the weight of this many edges without a triangle,
_PRIOR_FACTOR = 2.0  # and a cut of more than this many times its weight outweighs it
MAX_WEIGHT = 20_000  # sums of weights must stay within 32 bits
# The sign along this direction distinguishes a motion from its inverse; no likely motion is perpendicular to it.
_GENERIC = np.array([0.8164, 0.5213, 0.2483])


@dataclass(eq=False)
class AliasingResult:
    """Edges of contradictory loops, as (E,) masks.

    Args:
        wrong: edges that are wrong.
        right: edges of groups that are correct although they contradict the map.
        undecided: edges that may be wrong, but the evidence does not decide.
    """

    wrong: np.ndarray
    right: np.ndarray
    undecided: np.ndarray

    @classmethod
    def none(cls, count: int) -> AliasingResult:
        return cls(*(np.zeros(count, dtype=bool) for _ in range(3)))


def resolve_aliased_loops(
    edges: Measurements,
    accepted: np.ndarray,
    settled: np.ndarray,
    poses: Similarities,
    cycles: CycleSupport,
    params: Params,
) -> AliasingResult:
    """Find the edges to exclude, and the groups of edges that contradict the edges to exclude.

    A group of edges demands that one part of a component moves relative to another part. The group forms a loop with
    the accepted links between both parts, and one link of the loop is wrong. A link that is probably wrong is excluded;
    if that is the group, the map stays as it is. If no link is probably wrong, the group and all links that may be
    wrong are undecided, and the parts that these links connect become separate components.

    Args:
        settled: (E,) mask of edges that were excluded before and do not count.
    """
    found = AliasingResult.none(len(edges))
    labels = component_labels(edges, np.flatnonzero(accepted))
    inside = labels[edges.targets] == labels[edges.sources]
    rows = np.flatnonzero(inside & ~accepted & ~settled)
    if not len(rows):
        return found
    length = typical_length(edges, poses)
    density = LinkDensity.of(edges, accepted, labels, poses)
    drift = DriftModel.over(edges, np.flatnonzero(accepted), poses)
    # Both the edges of a torn place and the wrong edges that tore it demand one motion. Edges inside the place are
    # supported by their neighbours, so they are considered first.
    supported = cycles.support >= _WELL_SUPPORTED * np.median(cycles.support[accepted])
    for group in _groups(edges, rows, drift, length, params.gate_probability):
        inner = supported[group.rows]
        for candidate in (group,) if inner.all() else (group[inner], group):
            if found.wrong.any() or found.undecided.any() or len(np.unique(np.r_[candidate.near, candidate.far])) < 3:
                continue
            links = _links(edges, accepted, cycles, density, poses, candidate.near, candidate.far, _CUT_DEPTH)
            if links:
                hypothesis = candidate.hypothesis(edges, density, poses)
                _decide(found, edges, accepted, group, candidate, [hypothesis, *links], params)
    return found


def _decide(
    found: AliasingResult,
    edges: Measurements,
    accepted: np.ndarray,
    group: EdgeGroup,
    candidate: EdgeGroup,
    loop: list[Link],
    params: Params,
) -> None:
    """Decide which link of a loop is wrong; the first link of ``loop`` is the candidate, all or a part of the group."""
    log_odds = np.array([link.log_odds_wrong for link in loop])
    probability = np.exp(log_odds - log_odds.max())
    probability /= probability.sum()
    worst = int(probability.argmax())
    if probability[worst] >= params.min_wrong_probability and worst > 0:
        # A link that is contradicted by too few edges is undecided, not wrong.
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
        # If many links are suspect, the wrong one need not be among them, and excluding all would lose correct edges.
        suspects = suspects if len(suspects) <= MAX_SUSPECTS else []
        for link in suspects:
            found.undecided[link.rows] = True
            found.undecided |= _contested(edges, accepted, link.rows)
        # After a cut deep in the loop other paths may connect both parts: then the group is considered again.
        parts = component_labels(edges, np.flatnonzero(accepted & ~found.undecided))
        if not suspects or (parts[group.near] != parts[group.far]).all():
            found.undecided[group.rows] = True


@dataclass(frozen=True, eq=False)
class EdgeGroup:
    """Edges (``rows``) that demand the same motion of the scenes at their ``far`` ends relative to the scenes at their
    ``near`` ends."""

    rows: np.ndarray
    near: np.ndarray
    far: np.ndarray
    motion: Similarities

    def __getitem__(self, keep: np.ndarray) -> EdgeGroup:
        return EdgeGroup(self.rows[keep], self.near[keep], self.far[keep], self.motion)

    def hypothesis(self, edges: Measurements, density: LinkDensity, poses: Similarities) -> Link:
        """Return the link that the group would form once its scenes have moved."""
        ends = np.zeros(edges.num_scenes, dtype=bool)
        ends[self.far] = True
        moved = self.motion[np.zeros(len(self.far), dtype=np.int64)] @ poses[self.far]
        return density.link(edges, self.rows, ends, poses.replaced(self.far, moved))


def _contested(edges: Measurements, accepted: np.ndarray, link: np.ndarray) -> np.ndarray:
    """Return an (E,) mask of the edges of contested scenes. A scene is contested if more than one in `_CONTESTED_RATIO`
    of its edges crosses the link; it joins neither side."""
    n = edges.num_scenes
    across = np.bincount(np.r_[edges.targets[link], edges.sources[link]], minlength=n)
    rows = np.union1d(np.flatnonzero(accepted), link)
    whole = np.bincount(np.r_[edges.targets[rows], edges.sources[rows]], minlength=n)
    contested = _CONTESTED_RATIO * across > whole
    out = np.zeros(len(edges), dtype=bool)
    out[rows] = contested[edges.targets[rows]] | contested[edges.sources[rows]]
    return out


def _links(
    edges: Measurements,
    accepted: np.ndarray,
    cycles: CycleSupport,
    density: LinkDensity,
    poses: Similarities,
    near: np.ndarray,
    far: np.ndarray,
    depth: int,
) -> list[Link]:
    """Find the weak links between two sets of scenes: the lightest cut, then the lightest cuts on either side of it."""
    parts = smallest_cut(edges, accepted, cycles, near, far, _SUPPORT_POWER) if depth else None
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
        *_links(edges, accepted & before, cycles, density, poses, near, still_end, depth - 1),
        density.link(edges, rows, moving, poses),
        *_links(edges, accepted & beyond, cycles, density, poses, moving_end, far, depth - 1),
    ]


def contradicted_priors(
    edges: Measurements, accepted: np.ndarray, poses: Similarities, cycles: CycleSupport, priors: PriorTerms
) -> tuple[np.ndarray, np.ndarray]:
    """Find the edges to exclude because priors at their ends contradict each other, and the outweighed priors.

    The priors of a component are compared under the motion of the component that satisfies most of them. Outlier priors
    may belong to a part of the component that lies elsewhere: then the lightest cut between both parts is excluded. If
    that cut weighs more than `_PRIOR_FACTOR` times as much as the outlier priors, they are wrong instead.

    Returns:
        An (E,) mask of the cut edges and a (P,) mask of the outweighed priors.
    """
    cut, outweighed = np.zeros(len(edges), dtype=bool), np.zeros(len(priors), dtype=bool)
    labels = component_labels(edges, np.flatnonzero(accepted))
    for label in np.unique(labels[priors.scenes]):
        mine = np.flatnonzero(labels[priors.scenes] == label)
        off = find_outlier_priors(poses, priors[mine], typical_length(edges, poses))
        if not off.any() or off.all():
            continue
        near, far = priors.scenes[mine[~off]], priors.scenes[mine[off]]
        parts = smallest_cut(edges, accepted, cycles, near, far, _PRIOR_SUPPORT_POWER)
        bearable = _PRIOR_FACTOR * _PRIOR_EDGES * off.sum()
        if parts is not None and (1 + cycles.agree[parts[0]]).sum() <= bearable:
            cut[parts[0]] = True
        else:
            outweighed[mine[off]] = True
    return cut, outweighed


def _groups(
    edges: Measurements, rows: np.ndarray, drift: DriftModel, length: float, probability: float
) -> list[EdgeGroup]:
    """Group the edges of one component that demand the same motion."""
    poses, labels = drift.poses, drift.labels
    a, b = edges.targets[rows], edges.sources[rows]
    motion = poses[a] @ edges.measured[rows] @ poses[b].inverse()
    middle = poses.translations.mean(0)
    way = motion.apply(np.tile(middle, (len(rows), 1))) - middle
    # The same disagreement, seen from the other end of the edge, is the inverse motion.
    turned = way @ _GENERIC < 0
    motion = motion.replaced(turned, motion[turned].inverse())
    directed = DirectedEdges.of(edges, rows, turned)
    corners = middle + 10 * length * np.eye(3)
    feature = np.concatenate([motion.apply(np.tile(c, (len(rows), 1))) - c for c in corners], axis=1)
    off = np.abs(feature).max(1) > _MIN_MOTION_LENGTHS * length
    # First group similar motions, then motions that are equal within the uncertainty of the map.
    pairs = cKDTree(feature).query_pairs(_GROUP_LENGTHS * length, p=np.inf, output_type="ndarray")
    pairs = pairs[off[pairs].all(1) & (labels[a[pairs[:, 0]]] == labels[a[pairs[:, 1]]])]
    pairs = pairs[directed.pairwise_consistent(pairs[:, 0], pairs[:, 1], drift, probability)]
    graph = sp.coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(rows), len(rows)))
    which = connected_components(graph, directed=False)[1]
    order = np.argsort(which, kind="stable")
    return [
        EdgeGroup(rows[mine], directed.near[mine], directed.far[mine], motion[mine[:1]])
        for mine in np.split(order, np.flatnonzero(np.diff(which[order])) + 1)
        if len(mine) > 1
    ]


def smallest_cut(
    edges: Measurements, accepted: np.ndarray, cycles: CycleSupport, near: np.ndarray, far: np.ndarray, power: float
) -> tuple[np.ndarray, np.ndarray] | None:
    """Find the lightest set of accepted, unconfirmed edges that separates ``near`` from ``far`` (max-flow).

    The weight of an edge is a power of its share of agreeing neighbours. Edges inside a place are heavy, so the cut
    runs between places rather than around the few scenes of ``near`` or ``far``.

    Returns:
        Rows of the edges, and an (N,) mask of the scenes on the side of ``far``; None if no such set exists, or if a
        scene would have to be on both sides.
    """
    near, far = np.setdiff1d(near, far), np.setdiff1d(far, near)
    if not len(near) or not len(far):
        return None
    n, rows = edges.num_scenes, np.flatnonzero(accepted)
    good = cycles.support[rows] / max(float(np.median(cycles.support[rows])), 1e-9)
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
    """Move scenes to the side to which most of their edges lead, as long as fewer edges are cut.

    Weights keep the cut between places, but near the cut a scene with few light edges may end up on the wrong side.
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
