"""Look up the candidates of a scene in an inverted index: nodes vote with tf-idf weights, then geometry verifies."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gsmap._native import near_codes
from gsmap.errors import CorruptError
from gsmap.retrieve import codes
from gsmap.retrieve.index import positions_of
from gsmap.retrieve.params import Params
from gsmap.retrieve.scene_nodes import SceneNodes
from gsmap.types.retrieval import Candidate, IndexedScene
from gsmap.types.segments import Segment, lists_of, places_of

VERSION = 5

_BLOCK_ROWS = 250_000  # of an index that are in memory at the same time: 15 MB
_SAME_NODE_M = 0.05  # two nodes nearer to each other than this may be the same
VOTES_PER_NODE = 200  # number of most similar nodes for which each node votes
_MIN_SIMILARITY = 0.6  # smallest cosine between the vectors of matching nodes
_EQUAL_SIMILARITY = 0.02  # another scene has a match about as good if its cosine is at most this much smaller
_FLIPPED_SIGNS = 2  # number of axes, of those that name a node's list, that are searched on both sides
_MAX_MATCHES = 24  # number of matches of highest weight by which two scenes are aligned
MAX_VERIFIED = 300  # number of scenes, those with most votes, that are verified geometrically
PEERS = 30  # number of nearest aligned candidates (at most a third of all) that normalize a score
# Tolerance, in working metres, of the distance and of the height difference of two nodes in two scenes, and of the
# residual of an aligned match.
_TOLERANCE_M = 0.2
_MIN_DISTANCE_M = 0.5  # nodes nearer to each other, in working metres, are not independent inliers
_SCALE_SLACK = 0.25  # relative tolerance of a distance if the metre of one of the scenes is estimated
_LEAST_SPREAD = 0.05  # of the best score: smaller differences are due to chance


def look_up(queries: Sequence[SceneNodes], segments: Sequence[Segment], params: Params) -> list[list[Candidate]]:
    """Return the candidates of each query scene, best first; equal candidates are sorted by id.

    The weight of a node's match is that of a tf-idf score: the squared logarithm of the share of scenes that have a
    match about as good. The scenes with most votes are aligned with the query by their matches of highest weight, and
    the tf-idf score of an aligned scene sums over its inliers. Aliased rooms align at the same place, and their
    decoration gives the same inliers. So the final score is normalized by the tf-idf scores of the nearest aligned
    candidates: their mean is subtracted, the difference divided by their standard deviation, and negative values set to
    0.

    Args:
        queries: the query scenes; a scene is no candidate of itself.
        segments: all segments of the index.
    """
    members = _IndexedScenes(segments)
    found = [_NodeMatches(query, members, params) for query in queries]
    for segment, place_of in zip(segments, members.places, strict=True):
        for block in _blocks(found, segment):
            for matches in found:
                _search(matches, block, place_of)
    return [_rank(matches, members, params) for matches in found]


class _IndexedScenes:
    """The indexed scenes of all segments, each scene once, sorted by id."""

    def __init__(self, segments: Sequence[Segment]) -> None:
        first: dict[str, tuple[int, int, IndexedScene]] = {}
        for number, segment in enumerate(segments):
            for place, member in enumerate(segment.members):
                if member is not None:
                    first.setdefault(member.scene, (number, place, member))
        self.members = [first[scene][2] for scene in sorted(first)]
        self.place_of = {member.scene: place for place, member in enumerate(self.members)}
        self.places = [np.full(len(segment.members), -1, dtype=np.int32) for segment in segments]
        for scene, (number, place, _) in first.items():
            self.places[number][place] = self.place_of[scene]

    def are_few(self, params: Params) -> bool:
        """Return whether there are so few scenes that each is paired with every other scene."""
        return len(self.members) - 1 <= params.top_k


class _NodeMatches:
    """Matches of the nodes of one query, collected block by block.

    Args:
        query: the query scene.
        own: place of the query scene among the members; -1 if it is not indexed.
        probes: (M, 2 ** _FLIPPED_SIGNS) int64 inverted lists that each node of the query searches.
        nearest: (M, VOTES_PER_NODE) int32 squared distances of the nearest matches, as a heap with the largest first.
        seen: if all scenes are paired, the places of the scenes with nodes in the same lists, similar or not.
    """

    def __init__(self, query: SceneNodes, members: _IndexedScenes, params: Params) -> None:
        self.query, self.own = query, members.place_of.get(query.member.scene, -1)
        self.probes = codes.probes(query.query_nodes.keys, query.query_nodes.codes, _FLIPPED_SIGNS)
        most = int(2 * codes.SCALE**2 * (1 - _MIN_SIMILARITY) + 1e-6)
        self.nearest = np.full((len(query.query_nodes), VOTES_PER_NODE), most, np.int32)
        self.seen: set[int] | None = set() if members.are_few(params) else None
        self.parts: list[tuple[np.ndarray, ...]] = []


@dataclass(frozen=True, eq=False)
class _Block:
    """Consecutive inverted lists of a segment.

    Args:
        keys: (W,) int64 keys of the lists, ascending.
        starts: (W + 1,) int64 first row of each list, and the end.
        rows: (M, B) uint8 encoded nodes.
        num_members: number of scenes in the segment.
    """

    keys: np.ndarray
    starts: np.ndarray
    rows: np.ndarray
    num_members: int


def _blocks(found: Sequence[_NodeMatches], segment: Segment) -> Iterator[_Block]:
    """Yield, block by block, the inverted lists of a segment that any query searches, and the lists between them."""
    keys, starts = lists_of(segment)
    searched = np.unique(np.concatenate([matches.probes.ravel() for matches in found] or [np.zeros(0, np.int64)]))
    rows_searched = np.flatnonzero(np.isin(keys, searched, assume_unique=True))
    block_of = (starts[rows_searched + 1] - 1) // _BLOCK_ROWS
    for number in np.unique(block_of):
        mine = rows_searched[block_of == number]
        low, high = int(mine[0]), int(mine[-1]) + 1
        rows = np.ascontiguousarray(segment.rows(int(starts[low]), int(starts[high])))
        yield _Block(keys[low:high], starts[low : high + 1] - starts[low], rows, len(segment.members))


def _search(found: _NodeMatches, block: _Block, place_of: np.ndarray) -> None:
    """Compare a query's nodes with the nodes in the inverted lists that they search.

    Squared distances of codes are integers, and all matches that tie with the last of a node's nearest are kept, so the
    result does not depend on the order.

    Args:
        place_of: for each scene of the segment, its place among the members; -1 for scenes that are not members.
    """
    at = np.minimum(np.searchsorted(block.keys, found.probes), len(block.keys) - 1)
    node, column = np.nonzero(block.keys[at] == found.probes)
    which = at[node, column]
    order = np.argsort(which, kind="stable")
    node, begin, end = node[order], block.starts[which[order]], block.starts[which[order] + 1]
    member_places = np.where(place_of == found.own, np.int32(-1), place_of)
    try:
        matched, row, squared, place = near_codes(
            found.query.query_nodes.codes, node, begin, end, block.rows, member_places, found.nearest
        )
    except ValueError as error:
        raise CorruptError(
            f"rows of the index refer to scenes that it does not contain ({error})", code="index_damaged"
        ) from error
    found.parts.append((matched, squared, place, positions_of(block.rows[row])))
    if found.seen is not None:
        for first, last in zip(begin.tolist(), end.tolist(), strict=True):
            there = member_places[places_of(block.rows[first:last], block.num_members)]
            found.seen.update(there[there >= 0].tolist())


def _rank(found: _NodeMatches, members: _IndexedScenes, params: Params) -> list[Candidate]:
    if not found.parts:
        return []
    query = found.query
    node, squared, place, candidate_points = (np.concatenate(part) for part in zip(*found.parts, strict=True))
    near = squared <= found.nearest[node, 0]  # drop matches that were near when found but no longer are
    node, squared, place, candidate_points = node[near], squared[near], place[near], candidate_points[near]
    # Sort the nearest first. Squared distances are integers below 2 ** 23. Equal ones are sorted by scene, and within a
    # scene by list, so the order of arrival has no effect. A node votes by its best match in each scene.
    order = np.argsort((node << 44) | (squared << 20) | place, kind="stable")
    node, place, squared, candidate_points = node[order], place[order], squared[order], candidate_points[order]
    best = np.unique(node * len(members.members) + place, return_index=True)[1]
    best.sort()
    weight = np.zeros(len(node))
    weight[best] = _tf_idf_weights(node[best], squared[best], len(members.members))
    votes = np.bincount(place, weights=weight, minlength=len(members.members))
    chosen = np.argsort(-np.round(votes, 6), kind="stable")[:MAX_VERIFIED]
    chosen = chosen[votes[chosen] > 0]
    scores = _scores(_CandidateMatches.of(query, chosen, node, place, weight, candidate_points, members))
    out = [
        Candidate(members.members[k].scene, round(float(score), 4), round(float(votes[k]), 4))
        for k, score in zip(chosen, scores, strict=True)
    ]
    if members.are_few(params):  # a small map: every scene with comparable nodes is a candidate
        rest = (found.seen or set()).difference(chosen.tolist())
        out += [Candidate(members.members[k].scene, 0.0, 0.0) for k in sorted(rest)]
    return sorted(out, key=lambda c: (-c.score, -c.votes, c.scene))


def _tf_idf_weights(node: np.ndarray, squared: np.ndarray, num_scenes: int) -> np.ndarray:
    """Return the (K,) tf-idf weights of matches; matches of a node must be consecutive, nearest first, one per
    scene."""
    if not len(node):
        return np.zeros(0)
    cosine = codes.similarity(squared.astype(np.float64))
    # Count the scenes with a match about as good by one search in the concatenated matches of all nodes.
    step = 4.0 * node
    similar = np.searchsorted(step - cosine, step - cosine + _EQUAL_SIMILARITY, side="right")
    first = np.searchsorted(node, node)
    rarity = np.log(1 + num_scenes / (similar - first))
    weight: np.ndarray = rarity**2 * np.maximum(cosine - _MIN_SIMILARITY, 0.0)
    return weight


@dataclass(frozen=True, eq=False)
class _CandidateMatches:
    """The matches of C candidates with the M nodes of the query.

    Args:
        row: (K,) candidate of each match, ascending.
        node: (K,) query node of each match.
        weight: (K,) tf-idf weight; 0 except for a node's best match in a candidate.
        query_points, candidate_points: (K, 3) float64 positions of the matched nodes.
        num_nodes: M.
        coarse: (C,) metres per working metre of the coarser scene of the pair.
        metric, upright: (C,) masks, True if both scenes are metric, and if both are upright.
    """

    row: np.ndarray
    node: np.ndarray
    weight: np.ndarray
    query_points: np.ndarray
    candidate_points: np.ndarray
    num_nodes: int
    coarse: np.ndarray
    metric: np.ndarray
    upright: np.ndarray

    @classmethod
    def of(
        cls,
        query: SceneNodes,
        chosen: np.ndarray,
        node: np.ndarray,
        place: np.ndarray,
        weight: np.ndarray,
        candidate_points: np.ndarray,
        members: _IndexedScenes,
    ) -> _CandidateMatches:
        row_of = np.full(len(members.members), -1)
        row_of[chosen] = np.arange(len(chosen))
        kept = np.flatnonzero(row_of[place] >= 0)
        kept = kept[np.argsort(row_of[place[kept]], kind="stable")]
        others = [members.members[k] for k in chosen]
        return cls(
            row_of[place[kept]],
            node[kept],
            weight[kept],
            query.query_nodes.positions[node[kept]].astype(np.float64),
            candidate_points[kept].astype(np.float64),
            len(query.query_nodes),
            np.array([max(o.coarseness, query.member.coarseness) for o in others]),
            np.array([o.metric and query.member.metric for o in others], bool),
            np.array([o.upright and query.member.upright for o in others], bool),
        )


def _scores(candidates: _CandidateMatches) -> np.ndarray:
    """Return the (C,) scores: the tf-idf scores of the inliers, normalized by the scores of the nearest aligned
    candidates."""
    count = len(candidates.coarse)
    if not count:
        return np.zeros(0)
    inliers, centres = _align(candidates)
    rarity = np.log((count + 1) / (inliers.sum(0) + 0.5)) ** 2
    tf_idf = np.round(inliers @ rarity, 6)
    # Nodes that are inliers of many candidates belong to common decoration; if a room can be aligned in two ways, the
    # remaining nodes decide.
    other, other_centres = _align(replace(candidates, weight=candidates.weight * rarity[candidates.node]))
    other_tf_idf = np.round(other @ rarity, 6)
    centres[other_tf_idf > tf_idf] = other_centres[other_tf_idf > tf_idf]
    tf_idf = np.maximum(tf_idf, other_tf_idf)
    # Candidates with the same decoration align at the same place and have similar scores.
    gaps = np.round(((centres[:, None] - centres) ** 2).sum(2), 6)
    np.fill_diagonal(gaps, np.inf)
    peers_of = np.argsort(gaps, axis=1, kind="stable")[:, : min(PEERS, count // 3)]
    mean = tf_idf[peers_of].sum(1) / PEERS
    spread = np.sqrt(np.maximum((tf_idf[peers_of] ** 2).sum(1) / PEERS - mean**2, 0.0))
    least = max(_LEAST_SPREAD * float(tf_idf.max()), 1e-9)
    out: np.ndarray = np.maximum(tf_idf - mean, 0.0) / (spread + least)
    return out


def _align(candidates: _CandidateMatches) -> tuple[np.ndarray, np.ndarray]:
    """Align each candidate with the query by its matches of highest weight.

    Returns:
        A (C, M) mask of inliers among the query's nodes, and the (C, 3) aligned centres of the candidates.
    """
    rows, fits = _select_matches(candidates)
    for reach in (1.5, 1.0):
        turns, shifts = _fit_alignments(candidates, rows)
        aligned = np.einsum("kij,kj->ki", turns[candidates.row], candidates.candidate_points) + shifts[candidates.row]
        off = np.linalg.norm(aligned - candidates.query_points, axis=1)
        inlier = fits[candidates.row] & (off <= reach * _TOLERANCE_M * candidates.coarse[candidates.row])
        rows = np.flatnonzero(inlier)
    inliers = np.zeros((len(fits), candidates.num_nodes), bool)
    inliers[candidates.row[rows], candidates.node[rows]] = True
    return inliers, shifts


def _select_matches(candidates: _CandidateMatches) -> tuple[np.ndarray, np.ndarray]:
    """Return the matches that are compatible with the best pair of each candidate, and a (C,) mask of candidates that
    have such a pair."""
    num, count = len(candidates.coarse), _MAX_MATCHES
    at = np.full((num, count), -1)
    order = np.lexsort((candidates.node, -np.round(candidates.weight, 9), candidates.row))
    order = order[candidates.weight[order] > 0]
    rank = np.arange(len(order)) - np.searchsorted(candidates.row[order], candidates.row[order])
    order, rank = order[rank < count], rank[rank < count]
    at[candidates.row[order], rank] = order
    weights = np.where(at >= 0, candidates.weight[at], 0.0)
    a, b = (points[at].astype(np.float32) for points in (candidates.query_points, candidates.candidate_points))
    coarse = candidates.coarse.astype(np.float32)[:, None, None]
    da, db = _distances(a), _distances(b)
    loose = np.where(candidates.metric, 0, _SCALE_SLACK).astype(np.float32)[:, None, None]
    slack = _TOLERANCE_M * coarse + loose * np.maximum(da, db)
    agree = np.abs(da - db) <= slack
    rise = a[:, :, None, 2] - a[:, None, :, 2] - b[:, :, None, 2] + b[:, None, :, 2]
    agree &= ~candidates.upright[:, None, None] | (np.abs(rise) <= slack)
    agree &= (np.minimum(da, db) > _SAME_NODE_M * coarse) & (weights[:, :, None] > 0) & (weights[:, None] > 0)
    apart = agree & (np.minimum(da, db) > _MIN_DISTANCE_M * coarse)
    inlier, fits = _best_pair_inliers(agree, apart, weights)
    return at[inlier], fits


def _fit_alignments(candidates: _CandidateMatches, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fit the alignment of each candidate's nodes with the query's nodes to some matches; return (C, 3, 3) and (C, 3).

    Rotations are about the vertical if gravity is known in both scenes; a bounded scale is fitted if a metre is
    estimated.
    """
    row, num = candidates.row[rows], len(candidates.coarse)
    times = np.maximum(np.bincount(row, minlength=num), 1)[:, None]

    def means(values: np.ndarray) -> np.ndarray:
        return np.stack([np.bincount(row, column, num) for column in values.T], 1) / times

    here, there = means(candidates.query_points[rows]), means(candidates.candidate_points[rows])
    x, y = candidates.query_points[rows] - here[row], candidates.candidate_points[rows] - there[row]
    both = means((x[:, :, None] * y[:, None]).reshape(-1, 9)).reshape(-1, 3, 3)
    both[candidates.upright, 2, :2] = both[candidates.upright, :2, 2] = 0.0
    both[candidates.upright, 2, 2] = 1.0 + np.abs(both[candidates.upright]).sum((1, 2))
    u, _, v = np.linalg.svd(both)
    u[:, :, 2] *= np.sign(np.linalg.det(u) * np.linalg.det(v))[:, None]
    large, small = means(x**2).sum(1), means(y**2).sum(1)
    least = 1.0 - _SCALE_SLACK
    scale = np.clip(np.sqrt(np.maximum(large, 1e-12) / np.maximum(small, 1e-12)), least, 1.0 / least)
    turns = (u @ v) * np.where(candidates.metric, 1.0, scale)[:, None, None]
    return turns, here - np.einsum("kij,kj->ki", turns, there)


def _best_pair_inliers(agree: np.ndarray, apart: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a (C, M) mask of the matches compatible with the pair of matches that has the largest compatible weight,
    and a (C,) mask of candidates that have such a pair.

    Args:
        agree: (C, M, M) mask of compatible pairs of matches.
        apart: (C, M, M) mask of compatible pairs of matches that are far enough apart.
        weights: (C, M) weights of the matches; 0 where there is none.
    """
    plain = agree.astype(np.float32)
    scaled = np.round(weights * (1 << 10) / max(float(weights.max()), 1e-9)).astype(np.float32)  # exact sums
    both = (plain * scaled[:, None]) @ plain + scaled[:, :, None] + scaled[:, None]
    both[~apart] = 0.0
    best = both.reshape(len(both), -1).argmax(1)  # the first of equal pairs
    i, j = np.divmod(best, weights.shape[1])
    each = np.arange(len(both))
    fits = both[each, i, j] > 0
    out = agree[each, i] & agree[each, j]
    out[each, i] = out[each, j] = True
    return out & fits[:, None], fits


def _distances(points: np.ndarray) -> np.ndarray:
    out: np.ndarray = np.linalg.norm(points[:, :, None] - points[:, None], axis=3)
    return out
