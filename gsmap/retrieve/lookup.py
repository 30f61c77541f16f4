"""What an index says of a scene: the scenes that its nodes vote for, and whether what they match lies alike in both."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from gsmap._native import near_codes
from gsmap.errors import CorruptError
from gsmap.retrieve import codes
from gsmap.retrieve.index import positions_of
from gsmap.retrieve.params import Params
from gsmap.retrieve.voters import Voters
from gsmap.types.retrieval import Candidate, Member
from gsmap.types.segments import Segment, lists_of, places_of

VERSION = 4

_BLOCK_ROWS = 250_000  # of an index that are in memory at a time: 15 MB
_SAME_NODE_M = 0.05  # two nodes nearer than this may be one


def look_up(voters: Sequence[Voters], segments: Sequence[Segment], params: Params) -> list[list[Candidate]]:
    """For each scene that asks the most promising others, best first, equals by id.

    A node's match is worth the more the fewer scenes have one like it (the logarithm of their share, squared: once for
    either scene, as in tf-idf). The score of a scene is the largest worth of matches that bear out one pair of them:
    distances between nodes, and differences in height, are the same in both scenes, which two points and the vertical
    fix but for a mirror. Rooms that are decorated alike bear each other out by what is decoration; so a node counts the
    less, likewise, the more scenes it bears out, and scenes are scored by that once more.

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
        self.probes = codes.probes(asker.asking.keys, asker.asking.codes, params.turned_signs)
        most = int(2 * codes.SCALE**2 * (1 - params.min_similarity) + 1e-6)
        self.nearest = np.full((len(asker.asking), params.votes_per_node), most, np.int32)
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
        raise CorruptError(f"an index has rows of scenes that it has not ({error})") from error
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
    # Of each node its nearest matches, and of these the best one in each scene. Squared distances are whole numbers
    # below 2 ** 23; equals come by scene, and within a scene as they lie in its lists: no order of arrival decides.
    order = np.argsort((node << 44) | (squared << 20) | place, kind="stable")
    node, place, squared, theirs = node[order], place[order], squared[order], theirs[order]
    first = np.searchsorted(node, node)
    last = np.minimum(first + params.votes_per_node, np.searchsorted(node, node, side="right")) - 1
    best = np.zeros(len(node), dtype=bool)
    best[np.unique(node * len(members.members) + place, return_index=True)[1]] = True
    best &= squared <= squared[last]
    node, place, squared, theirs = node[best], place[best], squared[best], theirs[best]
    worth = _worth(node, squared, len(members.members), params)
    votes = np.bincount(place, weights=worth, minlength=len(members.members))
    chosen = np.argsort(-np.round(votes, 6), kind="stable")[: params.checked_scenes]
    chosen = chosen[votes[chosen] > 0]
    scores = _scores(asker, chosen, node, place, worth, theirs, members, params)
    out = [
        Candidate(members.members[k].scene, round(float(score), 4), round(float(votes[k]), 4))
        for k, score in zip(chosen, scores, strict=True)
    ]
    if members.are_few(params):  # a small map: whatever can be compared at all is worth a try
        rest = (found.seen or set()).difference(chosen.tolist())
        out += [Candidate(members.members[k].scene, 0.0, 0.0) for k in sorted(rest)]
    return sorted(out, key=lambda c: (-c.score, -c.votes, c.scene))


def _worth(node: np.ndarray, squared: np.ndarray, num_scenes: int, params: Params) -> np.ndarray:
    """(K,) what each match says; matches of a node lie together, nearest first, each of another scene."""
    if not len(node):
        return np.zeros(0)
    cosine = codes.similarity(squared.astype(np.float64))
    # How many scenes have a match as good as this one, or nearly: one search in all nodes' matches, laid end to end.
    step = 4.0 * node
    alike = np.searchsorted(step - cosine, step - cosine + params.equal_similarity, side="right")
    first = np.searchsorted(node, node)
    rarity = np.log((num_scenes + 1) / (alike - first))
    worth: np.ndarray = rarity**2 * np.maximum(cosine - params.min_similarity, 0.0)
    return worth


def _scores(
    asker: Voters,
    chosen: np.ndarray,
    node: np.ndarray,
    place: np.ndarray,
    worth: np.ndarray,
    theirs: np.ndarray,
    members: _Members,
    params: Params,
) -> np.ndarray:
    """(C,) how much of what the matches of each scene say is borne out by where they lie, and not in every scene."""
    if not len(chosen):
        return np.zeros(0)
    count = params.matches
    weights, nodes = np.zeros((len(chosen), count)), np.zeros((len(chosen), count), dtype=np.int64)
    a, b = np.zeros((len(chosen), count, 3), np.float32), np.zeros((len(chosen), count, 3), np.float32)
    order = np.lexsort((node, -np.round(worth, 9), place))
    firsts = np.searchsorted(place[order], chosen, side="left")
    lasts = np.searchsorted(place[order], chosen, side="right")
    mine = asker.asking.positions.astype(np.float32)
    for row, (first, last) in enumerate(zip(firsts, lasts, strict=True)):
        rows = order[first : min(last, first + count)]
        weights[row, : len(rows)], nodes[row, : len(rows)] = worth[rows], node[rows]
        a[row, : len(rows)], b[row, : len(rows)] = mine[node[rows]], theirs[rows]
    others = [members.members[k] for k in chosen]
    coarse = np.array([max(o.coarseness, asker.member.coarseness) for o in others], np.float32)[:, None, None]
    metric = np.array([o.metric and asker.member.metric for o in others])[:, None, None]
    upright = np.array([o.upright and asker.member.upright for o in others])[:, None, None]
    da, db = _distances(a), _distances(b)
    slack = params.tolerance_m * coarse + np.where(metric, np.float32(0), params.scale_slack * np.maximum(da, db))
    agree = np.abs(da - db) <= slack
    rise = a[:, :, None, 2] - a[:, None, :, 2] - b[:, :, None, 2] + b[:, None, :, 2]
    agree &= ~upright | (np.abs(rise) <= slack)
    agree &= (np.minimum(da, db) > _SAME_NODE_M * coarse) & (weights[:, :, None] > 0) & (weights[:, None] > 0)
    apart = agree & (np.minimum(da, db) > params.apart_m * coarse)
    which, best = _best_pairs(agree, apart, weights)
    each = np.arange(len(chosen))
    borne_out = agree[each, which[0]] & agree[each, which[1]]
    borne_out[each, which[0]] = borne_out[each, which[1]] = True
    borne_out[best == 0] = False
    times = np.bincount(nodes[borne_out], minlength=len(mine))
    rarity = np.log((len(members.members) + 1) / np.maximum(times, 1))
    return _best_pairs(agree, apart, weights * rarity[nodes] ** 2)[1]


def _best_pairs(agree: np.ndarray, apart: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of each scene the two matches (2, C) that most of the weight agrees with, and (C,) how much that is.

    Args:
        agree: (C, M, M) whether two matches lie alike in both scenes.
        apart: the same, of two that are far enough from each other.
        weights: (C, M) of the matches; 0 where there is none.
    """
    plain = agree.astype(np.float64)
    both = (plain * weights[:, None]) @ plain + weights[:, :, None] + weights[:, None]
    both[~apart] = 0.0
    # Sums differ in their last digits from machine to machine: of what is as good, the first.
    best = np.round(both, 6).reshape(len(both), -1).argmax(1)
    i, j = np.divmod(best, weights.shape[1])
    return np.stack([i, j]), both[np.arange(len(both)), i, j]


def _distances(points: np.ndarray) -> np.ndarray:
    out: np.ndarray = np.linalg.norm(points[:, :, None] - points[:, None], axis=3)
    return out
