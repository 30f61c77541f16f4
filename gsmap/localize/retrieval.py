"""Which views of the map show what a photograph shows: its features vote, by an index of those of all views.

Of each view the first features lie in the list of their word (`gsmap.localize.words`). A feature of the photo looks
into the lists of its nearest words; a match says more the fewer features of the map are as near. It also says how the
camera was turned: a feature has a frame of its ray and of the turn that it was described by, and the two frames of a
match are one. So matches with a scene count as far as they agree on that, each feature of the photo once (a weak check
of geometry as in Jegou et al. 2008, by whole rotations in place of angles).
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from gsmap._native import near_signatures
from gsmap.localize import turned
from gsmap.localize.features import UNIT
from gsmap.localize.words import VERSION, Words, words_for
from gsmap.methods import RecipeKey
from gsmap.types.localization import Keypoints, SceneFeatures
from gsmap.types.retrieval import IndexedScene
from gsmap.types.segments import PLACE_BYTES, InMemory, Segment, in_lists, lists_of, places_of, write_places

_SIGNS = slice(0, 8)
_TURN = slice(8, 12)
_VIEW = slice(12, 14)
_WIDTH = 14 + PLACE_BYTES
_BLOCK_ROWS = 200_000  # of an index that are in memory at a time: 4 MB


@dataclass(frozen=True)
class Params:
    """Which views a photograph is matched with.

    Args:
        words: nearest ones, in whose lists a feature of the photo looks.
        max_signs: that may differ between two features of one place, of 64.
        scenes_beside: what features of other scenes are like is known before as well as so many scenes tell.
        least: worth of a match that counts; the logarithm of how rare it is.
        max_turn_deg: two matches that turn the camera otherwise by more than this are not both right.
        first: scenes whose matches are looked at for how they turn the camera, those that most speaks for first; ...
        most: ... of each scene at most so many, those worth most; ...
        scenes: ... and of these scenes the views are ranked.
        of_scene: how much of what speaks for a scene speaks for each of its views.
    """

    words: int = 4
    max_signs: int = 20
    scenes_beside: int = 200
    least: float = 0.3
    max_turn_deg: float = 25.0
    first: int = 60
    most: int = 400
    scenes: int = 12
    of_scene: float = 0.3


@dataclass(frozen=True, eq=False)
class ViewIndex:
    """The views of many scenes.

    Args:
        segments: of their features; what counts of these.
        wanted: ids of the scenes that may be named.
    """

    segments: Sequence[Segment]
    wanted: frozenset[str]

    def __len__(self) -> int:
        return len(self.wanted)

    def only(self, scenes: Collection[str]) -> ViewIndex:
        """The same, of some of its scenes; how rare a feature is, all of them tell."""
        return replace(self, wanted=self.wanted & frozenset(scenes))


def view_index(segments: Sequence[Segment]) -> ViewIndex:
    """An index of all scenes that count in some segments."""
    return ViewIndex(segments, frozenset(m.scene for one in segments for m in one.members if m is not None))


def index_recipe() -> str:
    """What names the segments of an index of views; which features of a view they hold, the features' own key says."""
    return RecipeKey("localize", "index", {"index": VERSION}).recipe


def new_segment(scenes: Sequence[tuple[SceneFeatures, str]], indexed: int) -> InMemory:
    """A segment of scenes that are not in any.

    Args:
        scenes: features, and the key that they are kept under.
        indexed: of a view, at most.
    """
    rows, lists = [np.zeros((0, _WIDTH), np.uint8)], [np.zeros(0, np.int64)]
    for place, (found, _) in enumerate(scenes):
        starts = found.starts
        first = [np.arange(a, min(b, a + indexed)) for a, b in pairwise(starts)]
        kept = np.concatenate([np.zeros(0, np.int64), *first])
        if not len(kept):
            continue
        view = np.repeat(np.arange(len(first)), [len(part) for part in first])
        words = words_for(found.descriptors.shape[1])
        short = words.shortened(found.descriptors[kept] / np.float32(UNIT))
        word = words.nearest(short)[:, 0]
        part = np.empty((len(kept), _WIDTH), np.uint8)
        part[:, _SIGNS] = words.signatures(short, word)[:, None].view(np.uint8)
        part[:, _TURN] = _packed(turned.in_scene(found, kept, view)).view(np.uint8)
        part[:, _VIEW] = view.astype("<u2")[:, None].view(np.uint8)
        write_places(part, place)
        rows.append(part)
        lists.append(word)
    members = [IndexedScene(found.scene, key) for found, key in scenes]
    return in_lists(members, np.concatenate(lists), np.concatenate(rows))


def most_alike(
    index: ViewIndex, found: Keypoints, intrinsics_px: np.ndarray, count: int, params: Params
) -> list[tuple[str, int]]:
    """The ``count`` views that most speaks for, best first: scenes and the numbers of their views.

    Args:
        found: features of the photograph.
        intrinsics_px: (4,) its own.

    Raises:
        CorruptError: the index is damaged.
        NotFoundError: others have changed it meanwhile.
    """
    if not len(index) or not len(found):
        return []
    matches = _matches(index, found, params)
    photo = turned.in_camera(found, intrinsics_px)
    scored = []
    for scene in _best(_by_feature(matches), params.first):
        mine = matches.of(scene, params.most)
        cameras = turned.of_camera(mine.turn, photo[mine.feature]).astype(np.float32)
        agree = turned.alike(cameras, cameras, params.max_turn_deg)
        scored.append((float(_agreeing(agree, mine.feature, mine.worth)), scene, mine, agree))
    scored.sort(key=lambda one: (-one[0], one[1]))
    views = []
    for score, scene, mine, agree in scored[: params.scenes]:
        for view in np.unique(mine.view):
            rows = np.flatnonzero(mine.view == view)
            own = _agreeing(agree[np.ix_(rows, rows)], mine.feature[rows], mine.worth[rows])
            views.append((own + params.of_scene * score, matches.scenes[scene], int(view)))
    views.sort(key=lambda one: (-one[0], one[1], one[2]))
    return [(scene, view) for _, scene, view in views[:count]]


# --- votes -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Matches:
    """K matches of a photo's features with those of views.

    Args:
        feature: (K,) of the photo.
        scene: (K,) among ``scenes``, the wanted ones.
        view: (K,) of the scene.
        turn: (K, 4) of the frame of the view's feature in that of the scene.
        worth: (K,).
        scenes: ids.
    """

    feature: np.ndarray
    scene: np.ndarray
    view: np.ndarray
    turn: np.ndarray
    worth: np.ndarray
    scenes: Sequence[str]

    def of(self, scene: int, most: int) -> _Matches:
        """Those with one scene, worth most first, features of equal worth in order."""
        rows = np.flatnonzero(self.scene == scene)
        rows = rows[np.lexsort((self.view[rows], self.feature[rows], -self.worth[rows]))][:most]
        parts = (self.feature[rows], self.scene[rows], self.view[rows], self.turn[rows], self.worth[rows])
        return _Matches(*parts, self.scenes)


def _matches(index: ViewIndex, found: Keypoints, params: Params) -> _Matches:
    words = words_for(found.descriptors.shape[1])
    probes = _probes(found, words, params)
    scenes = sorted(index.wanted)
    number = {scene: k for k, scene in enumerate(scenes)}
    nearer = np.zeros((len(found), params.max_signs + 1), np.int64)  # features of the map, by signs that differ
    parts = []
    for segment in index.segments:
        number_of = np.array([-2 if m is None else number.get(m.scene, -1) for m in segment.members], np.int64)
        for feature, differ, rows in _near(segment, probes, params.max_signs):
            scene = number_of[places_of(rows, len(number_of))]
            np.add.at(nearer, (feature[scene > -2], differ[scene > -2]), 1)
            kept = scene >= 0
            parts.append((feature[kept], differ[kept], scene[kept], rows[kept]))
    feature, differ, scene = (np.concatenate([np.zeros(0, np.int64), *(p[k] for p in parts)]) for k in range(3))
    rows = np.concatenate([np.zeros((0, _WIDTH), np.uint8), *(p[3] for p in parts)])
    count = sum(member is not None for segment in index.segments for member in segment.members)
    expected = np.cumsum(nearer, axis=1) + params.scenes_beside * words.chance[: params.max_signs + 1]
    worth = -np.log(np.minimum(expected[feature, differ] / (count + params.scenes_beside), 1.0))
    kept = np.flatnonzero(worth > params.least)
    rows = rows[kept]
    turn = _unpacked(np.ascontiguousarray(rows[:, _TURN]).view(np.int8))
    view = np.ascontiguousarray(rows[:, _VIEW]).view("<u2")[:, 0].astype(np.int64)
    return _Matches(feature[kept], scene[kept], view, turn, worth[kept], scenes)


@dataclass(frozen=True, eq=False)
class _Probes:
    """Lists that the features of a photo look into, by list.

    Args:
        words: (P,) rising.
        feature: (P,) who looks.
        signs: (P,) uint64 its signature beside that word.
    """

    words: np.ndarray
    feature: np.ndarray
    signs: np.ndarray


def _probes(found: Keypoints, words: Words, params: Params) -> _Probes:
    short = words.shortened(found.descriptors)
    probed = words.nearest(short, min(params.words, len(words.centres)))
    feature, word = np.repeat(np.arange(len(found)), probed.shape[1]), probed.ravel()
    order = np.argsort(word, kind="stable")
    return _Probes(word[order], feature[order], words.signatures(short[feature], word)[order])


def _near(segment: Segment, probes: _Probes, max_signs: int) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Features of the photo (k,), signs (k,) by which they differ from those of a segment, and these, rows (k, B)."""
    keys, starts = lists_of(segment)
    wanted, first = np.unique(probes.words, return_index=True)
    last = np.r_[first[1:], len(probes.words)]
    at = np.searchsorted(keys, wanted)
    there = np.flatnonzero(at < len(keys))
    there = there[keys[at[there]] == wanted[there]]
    block_of = starts[at[there]] // _BLOCK_ROWS
    for block in np.unique(block_of):
        mine = there[block_of == block]
        low, high = int(starts[at[mine[0]]]), int(starts[at[mine[-1]] + 1])
        rows = np.ascontiguousarray(segment.rows(low, high))
        theirs = np.ascontiguousarray(rows[:, _SIGNS]).view("<u8")[:, 0]
        sizes = (last - first)[mine]
        asking = np.concatenate([np.arange(first[k], last[k]) for k in mine])
        begin, end = (np.repeat(starts[at[mine] + k], sizes) - low for k in range(2))
        who, which, differ = near_signatures(probes.signs[asking], begin, end, theirs, max_signs)
        yield probes.feature[asking[who]], differ, rows[which]


def _by_feature(matches: _Matches) -> np.ndarray:
    """What speaks for each scene, each feature of the photo once."""
    order = np.lexsort((-matches.worth, matches.feature, matches.scene))
    scene, feature = matches.scene[order], matches.feature[order]
    first = np.r_[True, (scene[1:] != scene[:-1]) | (feature[1:] != feature[:-1])][: len(order)]
    return np.bincount(scene[first], matches.worth[order][first], minlength=len(matches.scenes))


def _best(scores: np.ndarray, count: int) -> list[int]:
    order = np.argsort(-scores, kind="stable")[:count]
    found: list[int] = order[scores[order] > 0].tolist()
    return found


def _agreeing(agree: np.ndarray, feature: np.ndarray, worth: np.ndarray) -> float:
    """The most that matches are worth which agree with one of them, each feature of the photo once."""
    order = np.argsort(feature, kind="stable")
    first = np.flatnonzero(np.r_[True, np.diff(feature[order]) > 0])
    worths = np.where(agree[:, order], worth[order], 0.0)
    return float(np.maximum.reduceat(worths, first, axis=1).sum(1).max())


# --- rows ------------------------------------------------------------------------------------------------------------


def _packed(quats: np.ndarray) -> np.ndarray:
    """(N, 4) int8 of unit quaternions: to half a degree."""
    return np.round(quats * 127).astype(np.int8)


def _unpacked(packed: np.ndarray) -> np.ndarray:
    quats = packed.astype(np.float64)
    out: np.ndarray = quats / np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), 1e-9)
    return out
