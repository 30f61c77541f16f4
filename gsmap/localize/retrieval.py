"""Retrieve the views of the map that are most similar to a photo, from an inverted index of their features.

Each indexed feature of a view is stored in the list of its visual word (`gsmap.localize.vocabulary`). A feature of the
photo is matched with the lists of its nearest words; the fewer features of the map are as near, the larger the weight
of a match. Each match also gives the camera's orientation (`gsmap.localize.feature_frames`), and only matches with a
common orientation count (weak geometric consistency, Jegou et al. 2008, with rotations in place of angles).
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from gsmap._native import near_signatures
from gsmap.localize import feature_frames
from gsmap.localize.features import INDEXED_FEATURES, UNIT
from gsmap.localize.vocabulary import VERSION, Vocabulary, load_vocabulary
from gsmap.methods import RecipeKey
from gsmap.types.localization import Keypoints, SceneFeatures
from gsmap.types.retrieval import IndexedScene
from gsmap.types.segments import PLACE_BYTES, InMemory, Segment, in_lists, lists_of, places_of, write_places

NUM_WORDS = 4
"""Number of nearest words with whose lists a feature of the photo is matched."""

MAX_HAMMING = 20
"""Largest number of the 64 signs in which two matching features may differ."""

PRIOR_SCENES = 200
"""Number of imaginary scenes with the expected number of chance matches, in the weight of a match."""

MIN_WEIGHT = 0.3
"""A match with a smaller negative log probability of being a chance match is dropped."""

MAX_TURN_DEG = 25.0
"""Largest angle between the orientations of two consistent matches."""

_VERIFIED_SCENES = 60  # scenes whose matches are checked for a common orientation
_MAX_MATCHES = 400  # of a scene; those of largest weight are kept
_RANKED_SCENES = 12  # scenes whose views are ranked
_SCENE_WEIGHT = 0.3  # share of a scene's score that each of its views gets
_SIGNS = slice(0, 8)
_TURN = slice(8, 12)
_VIEW = slice(12, 14)
_WIDTH = 14 + PLACE_BYTES
_BLOCK_ROWS = 200_000  # of the index that are in memory at the same time: 4 MB


@dataclass(frozen=True, eq=False)
class ViewIndex:
    """An inverted index of the views of many scenes.

    Args:
        segments: index segments of the views' features.
        wanted: ids of the scenes that may be returned.
    """

    segments: Sequence[Segment]
    wanted: frozenset[str]

    def __len__(self) -> int:
        return len(self.wanted)

    def only(self, scenes: Collection[str]) -> ViewIndex:
        """Restrict the results to some scenes; the weights of matches still depend on all scenes."""
        return replace(self, wanted=self.wanted & frozenset(scenes))


def view_index(segments: Sequence[Segment]) -> ViewIndex:
    """Return an index of all scenes in some segments."""
    return ViewIndex(segments, frozenset(m.scene for one in segments for m in one.members if m is not None))


def index_recipe() -> str:
    """Return the recipe of the index segments; features have a recipe key of their own."""
    return RecipeKey("localize", "index", {"index": VERSION}).recipe


def new_segment(scenes: Sequence[tuple[SceneFeatures, str]]) -> InMemory:
    """Index the features of scenes as a new segment.

    Args:
        scenes: the features of each scene, and the key under which they are stored.
    """
    rows, lists = [np.zeros((0, _WIDTH), np.uint8)], [np.zeros(0, np.int64)]
    for place, (found, _) in enumerate(scenes):
        starts = found.starts
        first = [np.arange(a, min(b, a + INDEXED_FEATURES)) for a, b in pairwise(starts)]
        kept = np.concatenate([np.zeros(0, np.int64), *first])
        if not len(kept):
            continue
        view = np.repeat(np.arange(len(first)), [len(part) for part in first])
        vocabulary = load_vocabulary(found.descriptors.shape[1])
        reduced = vocabulary.reduce(found.descriptors[kept] / np.float32(UNIT))
        word = vocabulary.nearest(reduced)[:, 0]
        part = np.empty((len(kept), _WIDTH), np.uint8)
        part[:, _SIGNS] = vocabulary.signatures(reduced, word)[:, None].view(np.uint8)
        part[:, _TURN] = _pack_quats(feature_frames.scene_frames(found, kept, view)).view(np.uint8)
        part[:, _VIEW] = view.astype("<u2")[:, None].view(np.uint8)
        write_places(part, place)
        rows.append(part)
        lists.append(word)
    members = [IndexedScene(found.scene, key) for found, key in scenes]
    return in_lists(members, np.concatenate(lists), np.concatenate(rows))


def retrieve_views(index: ViewIndex, found: Keypoints, intrinsics_px: np.ndarray, count: int) -> list[tuple[str, int]]:
    """Return the ``count`` most similar views, best first, each as a scene id and the number of the view.

    Args:
        found: features of the photo.
        intrinsics_px: (4,) intrinsics of the photo.

    Raises:
        CorruptError: the index is damaged.
        NotFoundError: another process has replaced segments.
    """
    if not len(index) or not len(found):
        return []
    matches = _match(index, found)
    photo = feature_frames.camera_frames(found, intrinsics_px)
    scored = []
    for scene in _best(_score_scenes(matches), _VERIFIED_SCENES):
        own = matches.of(scene)
        cameras = feature_frames.camera_orientations(own.frame, photo[own.feature]).astype(np.float32)
        agree = feature_frames.within_angle(cameras, cameras, MAX_TURN_DEG)
        scored.append((float(_consistent_weight(agree, own.feature, own.weight)), scene, own, agree))
    scored.sort(key=lambda one: (-one[0], one[1]))
    views = []
    for score, scene, own, agree in scored[:_RANKED_SCENES]:
        for view in np.unique(own.view):
            rows = np.flatnonzero(own.view == view)
            weight = _consistent_weight(agree[np.ix_(rows, rows)], own.feature[rows], own.weight[rows])
            views.append((weight + _SCENE_WEIGHT * score, matches.scenes[scene], int(view)))
    views.sort(key=lambda one: (-one[0], one[1], one[2]))
    return [(scene, view) for _, scene, view in views[:count]]


# --- matches ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Matches:
    """K matches between features of a photo and features of views.

    Args:
        feature: (K,) row of the photo's feature.
        scene: (K,) index of the scene in ``scenes``.
        view: (K,) number of the view in its scene.
        frame: (K, 4) frame of the view's feature in the scene.
        weight: (K,) weights.
        scenes: ids of the scenes.
    """

    feature: np.ndarray
    scene: np.ndarray
    view: np.ndarray
    frame: np.ndarray
    weight: np.ndarray
    scenes: Sequence[str]

    def of(self, scene: int) -> _Matches:
        """Return the matches with one scene, at most `_MAX_MATCHES`, sorted by decreasing weight and then by
        feature."""
        rows = np.flatnonzero(self.scene == scene)
        rows = rows[np.lexsort((self.view[rows], self.feature[rows], -self.weight[rows]))][:_MAX_MATCHES]
        parts = (self.feature[rows], self.scene[rows], self.view[rows], self.frame[rows], self.weight[rows])
        return _Matches(*parts, self.scenes)


def _match(index: ViewIndex, found: Keypoints) -> _Matches:
    vocabulary = load_vocabulary(found.descriptors.shape[1])
    probes = _probe_lists(found, vocabulary)
    scenes = sorted(index.wanted)
    number = {scene: k for k, scene in enumerate(scenes)}
    nearer = np.zeros((len(found), MAX_HAMMING + 1), np.int64)  # features of the map, by Hamming distance
    parts = []
    for segment in index.segments:
        number_of = np.array([-2 if m is None else number.get(m.scene, -1) for m in segment.members], np.int64)
        for feature, differ, rows in _near(segment, probes):
            scene = number_of[places_of(rows, len(number_of))]
            np.add.at(nearer, (feature[scene > -2], differ[scene > -2]), 1)
            kept = scene >= 0
            parts.append((feature[kept], differ[kept], scene[kept], rows[kept]))
    feature, differ, scene = (np.concatenate([np.zeros(0, np.int64), *(p[k] for p in parts)]) for k in range(3))
    rows = np.concatenate([np.zeros((0, _WIDTH), np.uint8), *(p[3] for p in parts)])
    count = sum(member is not None for segment in index.segments for member in segment.members)
    expected = np.cumsum(nearer, axis=1) + PRIOR_SCENES * vocabulary.chance[: MAX_HAMMING + 1]
    weight = -np.log(np.minimum(expected[feature, differ] / (count + PRIOR_SCENES), 1.0))
    kept = np.flatnonzero(weight > MIN_WEIGHT)
    rows = rows[kept]
    frame = _unpack_quats(np.ascontiguousarray(rows[:, _TURN]).view(np.int8))
    view = np.ascontiguousarray(rows[:, _VIEW]).view("<u2")[:, 0].astype(np.int64)
    return _Matches(feature[kept], scene[kept], view, frame, weight[kept], scenes)


@dataclass(frozen=True, eq=False)
class _Probes:
    """Inverted lists with which the features of a photo are matched.

    Args:
        words: (P,) sorted visual words.
        feature: (P,) row of the photo's feature.
        signs: (P,) uint64 signature of the feature relative to the word.
    """

    words: np.ndarray
    feature: np.ndarray
    signs: np.ndarray


def _probe_lists(found: Keypoints, vocabulary: Vocabulary) -> _Probes:
    reduced = vocabulary.reduce(found.descriptors)
    probed = vocabulary.nearest(reduced, min(NUM_WORDS, len(vocabulary.centres)))
    feature, word = np.repeat(np.arange(len(found)), probed.shape[1]), probed.ravel()
    order = np.argsort(word, kind="stable")
    return _Probes(word[order], feature[order], vocabulary.signatures(reduced[feature], word)[order])


def _near(segment: Segment, probes: _Probes) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Yield blocks of k near pairs: the features of the photo (k,), the Hamming distances (k,) of the pairs, and the
    rows (k, B) of the segment's features."""
    keys, starts = lists_of(segment)
    wanted, first = np.unique(probes.words, return_index=True)
    last = np.r_[first[1:], len(probes.words)]
    at = np.searchsorted(keys, wanted)
    there = np.flatnonzero(at < len(keys))
    there = there[keys[at[there]] == wanted[there]]
    block_of = starts[at[there]] // _BLOCK_ROWS
    for block in np.unique(block_of):
        chosen = there[block_of == block]
        low, high = int(starts[at[chosen[0]]]), int(starts[at[chosen[-1]] + 1])
        rows = np.ascontiguousarray(segment.rows(low, high))
        stored = np.ascontiguousarray(rows[:, _SIGNS]).view("<u8")[:, 0]
        sizes = (last - first)[chosen]
        probing = np.concatenate([np.arange(first[k], last[k]) for k in chosen])
        begin, end = (np.repeat(starts[at[chosen] + k], sizes) - low for k in range(2))
        probe, row, differ = near_signatures(probes.signs[probing], begin, end, stored, MAX_HAMMING)
        yield probes.feature[probing[probe]], differ, rows[row]


def _score_scenes(matches: _Matches) -> np.ndarray:
    """Return the weight of the matches with each scene, where each feature of the photo counts once."""
    order = np.lexsort((-matches.weight, matches.feature, matches.scene))
    scene, feature = matches.scene[order], matches.feature[order]
    first = np.r_[True, (scene[1:] != scene[:-1]) | (feature[1:] != feature[:-1])][: len(order)]
    return np.bincount(scene[first], matches.weight[order][first], minlength=len(matches.scenes))


def _best(scores: np.ndarray, count: int) -> list[int]:
    order = np.argsort(-scores, kind="stable")[:count]
    found: list[int] = order[scores[order] > 0].tolist()
    return found


def _consistent_weight(agree: np.ndarray, feature: np.ndarray, weight: np.ndarray) -> float:
    """Return the largest weight of all matches that agree with one match, where each feature of the photo counts
    once."""
    order = np.argsort(feature, kind="stable")
    first = np.flatnonzero(np.r_[True, np.diff(feature[order]) > 0])
    weights = np.where(agree[:, order], weight[order], 0.0)
    return float(np.maximum.reduceat(weights, first, axis=1).sum(1).max())


# --- rows ------------------------------------------------------------------------------------------------------------


def _pack_quats(quats: np.ndarray) -> np.ndarray:
    """Pack unit quaternions into (N, 4) int8, accurate to half a degree."""
    return np.round(quats * 127).astype(np.int8)


def _unpack_quats(packed: np.ndarray) -> np.ndarray:
    quats = packed.astype(np.float64)
    out: np.ndarray = quats / np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), 1e-9)
    return out
