"""What an index says of a scene: the scenes that its nodes vote for, and whether what they match lies alike in both."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gsmap._native import near_codes
from gsmap.errors import CorruptError
from gsmap.retrieve import codes
from gsmap.retrieve.index import positions_of
from gsmap.retrieve.params import Params
from gsmap.retrieve.voters import Voters
from gsmap.types.retrieval import Candidate, Member
from gsmap.types.segments import Segment, lists_of, places_of

VERSION = 5

_BLOCK_ROWS = 250_000  # of an index that are in memory at a time: 15 MB
_SAME_NODE_M = 0.05  # two nodes nearer than this may be one
VOTES_PER_NODE = 200  # most similar nodes that each node votes for
_MIN_SIMILARITY = 0.6  # nodes whose vectors have a smaller cosine do not match
_EQUAL_SIMILARITY = 0.02  # a match is common where other scenes have nodes whose cosine is at most this much smaller
_TURNED_SIGNS = 2  # of the axes that name a node's list, so many are searched on both sides
_MAX_MATCHES = 24  # highest weighted matches of two scenes by which they are aligned
CHECKED_SCENES = 300  # most voted for scenes that are verified geometrically
PEERS = 30  # nearest aligned candidates, at most a third of all, by which a score is normalized
# Largest difference of the distance and of the rise of two nodes between two scenes, and largest residual of an aligned
# match; working metres.
_TOLERANCE_M = 0.2
_MIN_DISTANCE_M = 0.5  # nodes nearer to each other are not counted as independent inliers; working metres
_SCALE_SLACK = 0.25  # share of a distance that it may differ by where the metre of one of the scenes is guessed
_LEAST_SPREAD = 0.05  # of the best score: smaller differences are chance


def look_up(voters: Sequence[Voters], segments: Sequence[Segment], params: Params) -> list[list[Candidate]]:
    """For each scene that asks the most promising others, best first, equals by id.

    A node's match is worth the more the fewer scenes have one like it (the logarithm of their share, squared: once for
    either scene, as in tf-idf). The most voted for scenes are laid onto the one that asks, where most of what they
    match agrees, and what a scene says is the worth of the nodes that lie where those do that they match. Rooms that
    are decorated alike come to lie at the same place and agree in all that is decoration; so the score is by how much
    a scene says more than those that come to lie nearest to it, in deviations of what these say. 0: it does not.

    Args:
        voters: the scenes that ask; a scene does not find itself.
        segments: all parts of the index.
    """
    members = _Members(segments)
    found = [_Matches(asker, members, params) for asker in voters]
    for segment, place_of in zip(segments, members.places, strict=True):
        for block in _blocks(found, segment):
            for matches in found:
                _search(matches, block, place_of)
    return [_ranked(matches, members, params) for matches in found]


class _Members:
    """The scenes of all segments that count, each once, by id: which segment came first decides nothing."""

    def __init__(self, segments: Sequence[Segment]) -> None:
        first: dict[str, tuple[int, int, Member]] = {}
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
        """Whether every scene is to be paired with every other."""
        return len(self.members) - 1 <= params.top_k


class _Matches:
    """What is found of one scene's nodes, block by block.

    Args:
        asker: the scene.
        own: its place among the members; -1 where it is none.
        probes: (M, 2 ** turned_signs) int64 lists in which each of its nodes looks.
        nearest: (M, votes_per_node) int32 squared distances of the nearest that count, as a heap, the largest first.
        seen: where all scenes are to be paired, places of those with nodes in the same lists, however unlike.
    """

    def __init__(self, asker: Voters, members: _Members, params: Params) -> None:
        self.asker, self.own = asker, members.place_of.get(asker.member.scene, -1)
        self.probes = codes.probes(asker.asking.keys, asker.asking.codes, _TURNED_SIGNS)
        most = int(2 * codes.SCALE**2 * (1 - _MIN_SIMILARITY) + 1e-6)
        self.nearest = np.full((len(asker.asking), VOTES_PER_NODE), most, np.int32)
        self.seen: set[int] | None = set() if members.are_few(params) else None
        self.parts: list[tuple[np.ndarray, ...]] = []


@dataclass(frozen=True, eq=False)
class _Block:
    """Some lists of a segment.

    Args:
        keys: (W,) int64 of the lists, rising.
        starts: (W + 1,) int64 where each begins in the rows.
        rows: (M, B) uint8.
        num_members: of the segment.
    """

    keys: np.ndarray
    starts: np.ndarray
    rows: np.ndarray
    num_members: int


def _blocks(found: Sequence[_Matches], segment: Segment) -> Iterator[_Block]:
    """The lists of a segment that any of the scenes looks into, some at a time, with what lies between them."""
    keys, starts = lists_of(segment)
    asked = np.unique(np.concatenate([matches.probes.ravel() for matches in found] or [np.zeros(0, np.int64)]))
    wanted = np.flatnonzero(np.isin(keys, asked, assume_unique=True))
    block_of = (starts[wanted + 1] - 1) // _BLOCK_ROWS
    for number in np.unique(block_of):
        mine = wanted[block_of == number]
        low, high = int(mine[0]), int(mine[-1]) + 1
        rows = np.ascontiguousarray(segment.rows(int(starts[low]), int(starts[high])))
        yield _Block(keys[low:high], starts[low : high + 1] - starts[low], rows, len(segment.members))


def _search(found: _Matches, block: _Block, place_of: np.ndarray) -> None:
    """Compare a scene's nodes with those of the lists they look into.

    Squared distances of codes are whole numbers, and of each node all are kept that are as near as the last of its
    nearest: no order decides.

    Args:
        place_of: of each scene of the segment that counts, its place among the members; else -1.
    """
    at = np.minimum(np.searchsorted(block.keys, found.probes), len(block.keys) - 1)
    node, column = np.nonzero(block.keys[at] == found.probes)
    which = at[node, column]
    order = np.argsort(which, kind="stable")
    node, begin, end = node[order], block.starts[which[order]], block.starts[which[order] + 1]
    others = np.where(place_of == found.own, np.int32(-1), place_of)
    try:
        who, row, squared, place = near_codes(
            found.asker.asking.codes, node, begin, end, block.rows, others, found.nearest
        )
    except ValueError as error:
        raise CorruptError(f"an index has rows of scenes that it has not ({error})", code="index_damaged") from error
    found.parts.append((who, squared, place, positions_of(block.rows[row])))
    if found.seen is not None:
        for first, last in zip(begin.tolist(), end.tolist(), strict=True):
            there = others[places_of(block.rows[first:last], block.num_members)]
            found.seen.update(there[there >= 0].tolist())


def _ranked(found: _Matches, members: _Members, params: Params) -> list[Candidate]:
    if not found.parts:
        return []
    asker = found.asker
    node, squared, place, theirs = (np.concatenate(part) for part in zip(*found.parts, strict=True))
    near = squared <= found.nearest[node, 0]  # the others were near when they were found
    node, squared, place, theirs = node[near], squared[near], place[near], theirs[near]
    # Nearest first. Squared distances are whole numbers below 2 ** 23; equals come by scene, and within a scene as they
    # lie in its lists: no order of arrival decides. With a vote goes the best match of a node in each scene.
    order = np.argsort((node << 44) | (squared << 20) | place, kind="stable")
    node, place, squared, theirs = node[order], place[order], squared[order], theirs[order]
    best = np.unique(node * len(members.members) + place, return_index=True)[1]
    best.sort()
    worth = np.zeros(len(node))
    worth[best] = _worth(node[best], squared[best], len(members.members))
    votes = np.bincount(place, weights=worth, minlength=len(members.members))
    chosen = np.argsort(-np.round(votes, 6), kind="stable")[:CHECKED_SCENES]
    chosen = chosen[votes[chosen] > 0]
    scores = _scores(_Checked.of(asker, chosen, node, place, worth, theirs, members))
    out = [
        Candidate(members.members[k].scene, round(float(score), 4), round(float(votes[k]), 4))
        for k, score in zip(chosen, scores, strict=True)
    ]
    if members.are_few(params):  # a small map: whatever can be compared at all is worth a try
        rest = (found.seen or set()).difference(chosen.tolist())
        out += [Candidate(members.members[k].scene, 0.0, 0.0) for k in sorted(rest)]
    return sorted(out, key=lambda c: (-c.score, -c.votes, c.scene))


def _worth(node: np.ndarray, squared: np.ndarray, num_scenes: int) -> np.ndarray:
    """(K,) what each match says; matches of a node lie together, nearest first, each of another scene."""
    if not len(node):
        return np.zeros(0)
    cosine = codes.similarity(squared.astype(np.float64))
    # How many scenes have a match as good as this one, or nearly: one search in all nodes' matches, laid end to end.
    step = 4.0 * node
    alike = np.searchsorted(step - cosine, step - cosine + _EQUAL_SIMILARITY, side="right")
    first = np.searchsorted(node, node)
    rarity = np.log(1 + num_scenes / (alike - first))
    worth: np.ndarray = rarity**2 * np.maximum(cosine - _MIN_SIMILARITY, 0.0)
    return worth


@dataclass(frozen=True, eq=False)
class _Checked:
    """The matches of C scenes with the M nodes of the one that asks, and what is known of how these scenes lie.

    Args:
        row: (K,) of each match its scene, rising.
        node: (K,) of each match the node that asked.
        worth: (K,) what it says; 0 of all but a node's best in that scene.
        mine, theirs: (K, 3) float64 where the nodes lie in either scene.
        num_nodes: M.
        coarse: (C,) metres that look like one in a room, of the coarser of the two.
        metric, upright: (C,) bool whether both are.
    """

    row: np.ndarray
    node: np.ndarray
    worth: np.ndarray
    mine: np.ndarray
    theirs: np.ndarray
    num_nodes: int
    coarse: np.ndarray
    metric: np.ndarray
    upright: np.ndarray

    @classmethod
    def of(
        cls,
        asker: Voters,
        chosen: np.ndarray,
        node: np.ndarray,
        place: np.ndarray,
        worth: np.ndarray,
        theirs: np.ndarray,
        members: _Members,
    ) -> _Checked:
        row_of = np.full(len(members.members), -1)
        row_of[chosen] = np.arange(len(chosen))
        mine = np.flatnonzero(row_of[place] >= 0)
        mine = mine[np.argsort(row_of[place[mine]], kind="stable")]
        others = [members.members[k] for k in chosen]
        return cls(
            row_of[place[mine]],
            node[mine],
            worth[mine],
            asker.asking.positions[node[mine]].astype(np.float64),
            theirs[mine].astype(np.float64),
            len(asker.asking),
            np.array([max(o.coarseness, asker.member.coarseness) for o in others]),
            np.array([o.metric and asker.member.metric for o in others], bool),
            np.array([o.upright and asker.member.upright for o in others], bool),
        )


def _scores(checked: _Checked) -> np.ndarray:
    """(C,) by how much the matches that lie alike in both scenes say more than is usual of scenes that lie there."""
    count = len(checked.coarse)
    if not count:
        return np.zeros(0)
    alike, centres = _laid(checked)
    rarity = np.log((count + 1) / (alike.sum(0) + 0.5)) ** 2
    said = np.round(alike @ rarity, 6)
    # What lies alike in many scenes is decoration; where the same room may be laid in two ways, the rest decides.
    other, others = _laid(replace(checked, worth=checked.worth * rarity[checked.node]))
    then = np.round(other @ rarity, 6)
    centres[then > said] = others[then > said]
    said = np.maximum(said, then)
    # Scenes that show the same decoration come to lie at the same place, and agree in as much of it.
    gaps = np.round(((centres[:, None] - centres) ** 2).sum(2), 6)
    np.fill_diagonal(gaps, np.inf)
    beside = np.argsort(gaps, axis=1, kind="stable")[:, : min(PEERS, count // 3)]
    mean = said[beside].sum(1) / max(PEERS, 1)
    spread = np.sqrt(np.maximum((said[beside] ** 2).sum(1) / max(PEERS, 1) - mean**2, 0.0))
    least = max(_LEAST_SPREAD * float(said.max()), 1e-9)
    out: np.ndarray = np.maximum(said - mean, 0.0) / (spread + least)
    return out


def _laid(checked: _Checked) -> tuple[np.ndarray, np.ndarray]:
    """Lay each scene onto the one that asks, where most of its most telling matches agree.

    Returns:
        (C, M) bool the nodes that lie at the same place then as one that they match, and (C, 3) where the scenes'
        middles come to lie.
    """
    rows, fits = _first_matches(checked)
    for reach in (1.5, 1.0):
        turns, shifts = _fitted(checked, rows)
        laid = np.einsum("kij,kj->ki", turns[checked.row], checked.theirs) + shifts[checked.row]
        off = np.linalg.norm(laid - checked.mine, axis=1)
        borne_out = fits[checked.row] & (off <= reach * _TOLERANCE_M * checked.coarse[checked.row])
        rows = np.flatnonzero(borne_out)
    alike = np.zeros((len(fits), checked.num_nodes), bool)
    alike[checked.row[rows], checked.node[rows]] = True
    return alike, shifts


def _first_matches(checked: _Checked) -> tuple[np.ndarray, np.ndarray]:
    """The matches that bear out the best pair of each scene, of its most telling ones; and (C,) where there is one."""
    num, count = len(checked.coarse), _MAX_MATCHES
    at = np.full((num, count), -1)
    order = np.lexsort((checked.node, -np.round(checked.worth, 9), checked.row))
    order = order[checked.worth[order] > 0]
    rank = np.arange(len(order)) - np.searchsorted(checked.row[order], checked.row[order])
    order, rank = order[rank < count], rank[rank < count]
    at[checked.row[order], rank] = order
    weights = np.where(at >= 0, checked.worth[at], 0.0)
    a, b = (points[at].astype(np.float32) for points in (checked.mine, checked.theirs))
    coarse = checked.coarse.astype(np.float32)[:, None, None]
    da, db = _distances(a), _distances(b)
    loose = np.where(checked.metric, 0, _SCALE_SLACK).astype(np.float32)[:, None, None]
    slack = _TOLERANCE_M * coarse + loose * np.maximum(da, db)
    agree = np.abs(da - db) <= slack
    rise = a[:, :, None, 2] - a[:, None, :, 2] - b[:, :, None, 2] + b[:, None, :, 2]
    agree &= ~checked.upright[:, None, None] | (np.abs(rise) <= slack)
    agree &= (np.minimum(da, db) > _SAME_NODE_M * coarse) & (weights[:, :, None] > 0) & (weights[:, None] > 0)
    apart = agree & (np.minimum(da, db) > _MIN_DISTANCE_M * coarse)
    borne_out, fits = _borne_out(agree, apart, weights)
    return at[borne_out], fits


def _fitted(checked: _Checked, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(C, 3, 3) and (C, 3) what lays each scene's nodes onto the asker's, by these of the matches: turned, about the
    vertical where both know it, and moved; and to scale, as far as it may be off, where the metre is guessed."""
    row, num = checked.row[rows], len(checked.coarse)
    times = np.maximum(np.bincount(row, minlength=num), 1)[:, None]

    def means(values: np.ndarray) -> np.ndarray:
        return np.stack([np.bincount(row, column, num) for column in values.T], 1) / times

    here, there = means(checked.mine[rows]), means(checked.theirs[rows])
    x, y = checked.mine[rows] - here[row], checked.theirs[rows] - there[row]
    both = means((x[:, :, None] * y[:, None]).reshape(-1, 9)).reshape(-1, 3, 3)
    both[checked.upright, 2, :2] = both[checked.upright, :2, 2] = 0.0
    both[checked.upright, 2, 2] = 1.0 + np.abs(both[checked.upright]).sum((1, 2))
    u, _, v = np.linalg.svd(both)
    u[:, :, 2] *= np.sign(np.linalg.det(u) * np.linalg.det(v))[:, None]
    large, small = means(x**2).sum(1), means(y**2).sum(1)
    least = max(1.0 - _SCALE_SLACK, 1e-3)
    scale = np.clip(np.sqrt(np.maximum(large, 1e-12) / np.maximum(small, 1e-12)), least, 1.0 / least)
    turns = (u @ v) * np.where(checked.metric, 1.0, scale)[:, None, None]
    return turns, here - np.einsum("kij,kj->ki", turns, there)


def _borne_out(agree: np.ndarray, apart: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of each scene the matches (C, M) bool that bear out the two that most of the weight agrees with, and these; and
    (C,) whether there are two.

    Args:
        agree: (C, M, M) whether two matches lie alike in both scenes.
        apart: the same, of two that are far enough from each other.
        weights: (C, M) of the matches; 0 where there is none.
    """
    plain = agree.astype(np.float32)
    scaled = np.round(weights * (1 << 10) / max(float(weights.max()), 1e-9)).astype(np.float32)  # their sums are exact
    both = (plain * scaled[:, None]) @ plain + scaled[:, :, None] + scaled[:, None]
    both[~apart] = 0.0
    best = both.reshape(len(both), -1).argmax(1)  # of what is as good, the first
    i, j = np.divmod(best, weights.shape[1])
    each = np.arange(len(both))
    fits = both[each, i, j] > 0
    out = agree[each, i] & agree[each, j]
    out[each, i] = out[each, j] = True
    return out & fits[:, None], fits


def _distances(points: np.ndarray) -> np.ndarray:
    out: np.ndarray = np.linalg.norm(points[:, :, None] - points[:, None], axis=3)
    return out
