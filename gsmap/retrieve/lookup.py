"""What an index says of a scene: the scenes that its nodes vote for, and whether what they match lies alike in both."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from gsmap.retrieve import codes
from gsmap.retrieve.index import Unpacked, unpacked
from gsmap.retrieve.params import Params
from gsmap.retrieve.voters import Voters
from gsmap.types.retrieval import Candidate, Member
from gsmap.types.segments import Segment, lists_of

VERSION = 3

_BLOCK_ROWS = 100_000  # of an index that are in memory at a time: 6 MB
_FAR = 1e12  # squared: farther than any code
_SAME_NODE_M = 0.05  # two nodes nearer than this may be one


def look_up(voters: Sequence[Voters], segments: Sequence[Segment], params: Params) -> list[list[Candidate]]:
    """For each scene that asks the most promising others, best first, equals by id.

    A node's match is worth the more the fewer scenes have one like it (the logarithm of their share, squared: once for
    either scene, as in tf-idf). The score of a scene is the largest worth of matches that bear out one pair of them:
    distances between nodes, and differences in height, are the same in both scenes, which two points and the vertical
    fix but for a mirror.

    Args:
        voters: the scenes that ask; a scene does not find itself.
        segments: all parts of the index.
    """
    members = _Members(segments)
    found = [_Matches() for _ in voters]
    for block in _blocks(voters, segments, members, params):
        for asker, matches in zip(voters, found, strict=True):
            _search(asker, block, members, matches, params)
    return [_ranked(asker, matches, members, params) for asker, matches in zip(voters, found, strict=True)]


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


@dataclass(frozen=True, eq=False)
class _Part:
    """What a segment has of some lists.

    Args:
        at: (W, 2) where each of them begins and ends among the nodes.
        nodes: their places are those of `_Members`, -1 where a scene does not count.
    """

    at: np.ndarray
    nodes: Unpacked


@dataclass(frozen=True, eq=False)
class _Block:
    """Some lists of an index, of all segments; ``keys`` (W,) rises."""

    keys: np.ndarray
    parts: list[_Part]


def _blocks(
    voters: Sequence[Voters], segments: Sequence[Segment], members: _Members, params: Params
) -> Iterator[_Block]:
    """The lists that any of the scenes looks into, some at a time."""
    asked = [codes.probes(v.asking.keys, v.asking.codes, params.turned_signs).ravel() for v in voters]
    wanted = np.unique(np.concatenate(asked)) if asked else np.zeros(0, np.int64)
    lists = [lists_of(segment) for segment in segments]
    total = np.zeros(len(wanted), dtype=np.int64)
    for keys, starts in lists:
        at = np.searchsorted(keys, wanted)
        there = at < len(keys)
        there[there] = keys[at[there]] == wanted[there]
        total[there] += np.diff(starts)[at[there]]
    wanted, total = wanted[total > 0], total[total > 0]
    if not len(wanted):
        return
    block_of = (np.cumsum(total) - 1) // _BLOCK_ROWS
    for number in np.unique(block_of):
        mine = wanted[block_of == number]
        yield _read(mine, segments, lists, members)


def _read(
    wanted: np.ndarray,
    segments: Sequence[Segment],
    lists: Sequence[tuple[np.ndarray, np.ndarray]],
    members: _Members,
) -> _Block:
    parts = []
    for segment, (keys, starts), place_of in zip(segments, lists, members.places, strict=True):
        low, high = np.searchsorted(keys, wanted[0]), np.searchsorted(keys, wanted[-1], side="right")
        if low == high:
            continue
        found = unpacked(segment.rows(int(starts[low]), int(starts[high])), len(segment.members))
        places = place_of[found.places]
        first = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
        at = np.stack([starts[first], starts[first + (keys[first] == wanted)]], 1) - starts[low]
        at[keys[first] != wanted] = 0
        parts.append(_Part(at, Unpacked(found.codes, found.positions, places)))
    return _Block(wanted, parts)


class _Matches:
    """Matches of one scene's nodes, collected over blocks."""

    def __init__(self) -> None:
        self.nodes: list[np.ndarray] = []
        self.places: list[np.ndarray] = []
        self.squared: list[np.ndarray] = []
        self.positions: list[np.ndarray] = []
        self.seen: set[int] = set()  # places of scenes with nodes in the same lists, however unlike


def _search(asker: Voters, block: _Block, members: _Members, found: _Matches, params: Params) -> None:
    """Compare a scene's nodes with those of the lists they look into."""
    own, is_small = members.place_of.get(asker.member.scene, -1), members.are_few(params)
    probes = codes.probes(asker.asking.keys, asker.asking.codes, params.turned_signs)
    at = np.searchsorted(block.keys, probes)
    there = (at < len(block.keys)) & (block.keys[np.minimum(at, len(block.keys) - 1)] == probes)
    node, which = np.nonzero(there)[0], at[there]
    order = np.argsort(which, kind="stable")
    node, which = node[order], which[order]
    firsts = np.flatnonzero(np.r_[True, which[1:] != which[:-1]]) if len(which) else np.zeros(0, np.int64)
    vectors = np.ones((len(asker.asking), codes.NUM_DIMS + 2), np.float32)
    vectors[:, :-2] = asker.asking.codes
    vectors[:, -2] = (vectors[:, :-2] ** 2).sum(1)
    vectors[:, :-2] *= -2
    most = np.float32(2 * codes.SCALE**2 * (1 - params.min_similarity))
    for first, last in zip(firsts, np.r_[firsts[1:], len(which)], strict=True):
        nodes = _listed(block, int(which[first]))
        mine, theirs = node[first:last], np.ones((len(nodes.codes), codes.NUM_DIMS + 2), np.float32)
        theirs[:, :-2] = nodes.codes
        theirs[:, -1] = (theirs[:, :-2] ** 2).sum(1)
        theirs[(nodes.places == own) | (nodes.places < 0), -1] = _FAR
        squared = vectors[mine] @ theirs.T  # |a|^2 + |b|^2 - 2 a b: whole numbers below 2 ** 22, so exact in any order
        bar = np.full(len(mine), most)
        if squared.shape[1] > params.votes_per_node:  # all that are as near as the last one: no order decides
            kth = params.votes_per_node - 1
            bar = np.minimum(bar, np.partition(squared, kth, axis=1)[:, kth])
        if is_small:
            found.seen.update(nodes.places[nodes.places >= 0].tolist())
        q, e = np.nonzero(squared <= bar[:, None])
        found.nodes.append(mine[q])
        found.places.append(nodes.places[e])
        found.squared.append(squared[q, e])
        found.positions.append(nodes.positions[e])


def _listed(block: _Block, number: int) -> Unpacked:
    """What one list holds, of all segments."""
    slices = [(part.nodes, slice(*part.at[number])) for part in block.parts]
    return Unpacked(
        np.concatenate([nodes.codes[rows] for nodes, rows in slices]),
        np.concatenate([nodes.positions[rows] for nodes, rows in slices]),
        np.concatenate([nodes.places[rows] for nodes, rows in slices]),
    )


def _ranked(asker: Voters, found: _Matches, members: _Members, params: Params) -> list[Candidate]:
    if not found.nodes:
        return []
    node, place = np.concatenate(found.nodes), np.concatenate(found.places)
    squared, theirs = np.concatenate(found.squared), np.concatenate(found.positions)
    # Of each node its nearest matches, and of these the best one in each scene. Squared distances are whole numbers
    # below 2 ** 23; equals come by scene, and within a scene as they lie in its lists: no order of arrival decides.
    order = np.argsort((node << 44) | (squared.astype(np.int64) << 20) | place, kind="stable")
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
        rest = found.seen.difference(chosen.tolist()) - {members.place_of.get(asker.member.scene, -1)}
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
    """(C,) how much of what the matches of each scene say is borne out by where they lie."""
    if not len(chosen):
        return np.zeros(0)
    count = params.matches
    weights = np.zeros((len(chosen), count))
    a, b = np.zeros((len(chosen), count, 3), np.float32), np.zeros((len(chosen), count, 3), np.float32)
    order = np.lexsort((node, -np.round(worth, 9), place))
    firsts = np.searchsorted(place[order], chosen, side="left")
    lasts = np.searchsorted(place[order], chosen, side="right")
    mine = asker.asking.positions.astype(np.float32)
    for row, (first, last) in enumerate(zip(firsts, lasts, strict=True)):
        rows = order[first : min(last, first + count)]
        weights[row, : len(rows)] = worth[rows]
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
    plain = agree.astype(np.float64)
    both = (plain * weights[:, None]) @ plain + weights[:, :, None] + weights[:, None]
    both[~(agree & (np.minimum(da, db) > params.apart_m * coarse))] = 0.0
    out: np.ndarray = both.max(axis=(1, 2))
    return out


def _distances(points: np.ndarray) -> np.ndarray:
    out: np.ndarray = np.linalg.norm(points[:, :, None] - points[:, None], axis=3)
    return out
