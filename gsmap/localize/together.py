"""Several photographs of one place, or a clip: whoever is placed helps the others.

Photographs match each other far better than renders. Once one is placed, the map's depth from there lifts its
features to the map, and the next photo finds its pose by them, to be sharpened and judged on renders like any other.
What a photo shows itself and what its neighbours show are evidence together: where two photos are tied to each other by
matches, both are right or both are wrong. In the end all that are placed are adjusted at once, and others are found
by several of them (`gsmap.localize.bundle`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gsmap.localize import bundle, matching, probability, resection
from gsmap.localize.candidates import Candidate, near_to
from gsmap.localize.features import quantised, turns
from gsmap.localize.localizing import (
    Judged,
    judged_pose,
    judged_poses,
    photo_features,
    placement,
    prepared,
    refusal,
    rival_of,
)
from gsmap.localize.looks import at_pixels, look
from gsmap.localize.params import Params
from gsmap.localize.placed import PlacedFeatures
from gsmap.localize.retrieval import ViewIndex
from gsmap.localize.settling import Picture
from gsmap.localize.words import words_for
from gsmap.methods.extractor import Extractor
from gsmap.types.localization import Keypoints, LocalizationResult, Photo


@dataclass(eq=False)
class Shot:
    """A photo on its way.

    Args:
        photo: as it was given.
        picture, scale: as it is worked on (`gsmap.localize.localizing.prepared`).
        found, described: its features.
        judged: poses that were looked into, the one that is believed first.
        why: there is none, where there is none.
        helped: whether it has helped its neighbours from the pose that it has now.
        led: whether the map shows nothing of it where others say that it lies.
        apart: whether others lead it far from where the map places it.
    """

    photo: Photo
    picture: Picture
    scale: np.ndarray
    found: Keypoints
    described: matching.Described
    judged: list[Judged]
    why: str
    helped: bool = False
    led: bool = False
    apart: bool = False

    @property
    def best(self) -> Judged | None:
        return self.judged[0] if self.judged else None

    @property
    def probability(self) -> float:
        return self.judged[0].probability if self.judged else 0.0


def localize_together(
    photos: Sequence[Photo],
    index: ViewIndex,
    scenes: Mapping[str, PlacedFeatures],
    extractor: Extractor,
    params: Params,
    metres_per_unit: Mapping[int, float] | None = None,
) -> list[LocalizationResult]:
    """Find photographs of one place that overlap each other; see `gsmap.localize.localize_photo`.

    Returns:
        A placement for each, in order.
    """
    shots, near, ties = looked_into(photos, index, scenes, extractor, params)
    _adjust(shots, near, scenes, params, ties)
    out = []
    for shot, one in zip(shots, _believed(shots, ties, params), strict=True):
        if one is None:
            out.append(LocalizationResult(shot.photo.name, shot.why))
            continue
        best, rival, bars = one
        said = placement(shot.photo.name, best, rival, shot.picture, shot.scale, scenes, bars, metres_per_unit)
        if shot.apart and said.is_placed:
            why = "ambiguous: other photographs lead it elsewhere"
            said = LocalizationResult(
                said.name, why, component=said.component, probability=said.probability, evidence=said.evidence
            )
        out.append(said)
    return out


def looked_into(
    photos: Sequence[Photo],
    index: ViewIndex,
    scenes: Mapping[str, PlacedFeatures],
    extractor: Extractor,
    params: Params,
) -> tuple[list[Shot], list[list[int]], dict[tuple[int, int], bool]]:
    """Photographs with the poses that were looked into, the neighbours of each, and which of them are tied."""
    shots = [_shot(photo, index, scenes, extractor, params) for photo in photos]
    near = _neighbours(shots, params.together.neighbours)
    ties: dict[tuple[int, int], bool] = {}
    while True:
        ready = [k for k, shot in enumerate(shots) if not shot.helped and shot.probability >= params.together.anchor]
        if not ready:
            return shots, near, ties
        k = max(ready, key=lambda one: shots[one].probability)
        shots[k].helped = True
        _help(k, shots, near[k], scenes, params, ties)


def _believed(
    shots: Sequence[Shot], ties: Mapping[tuple[int, int], bool], params: Params
) -> list[tuple[Judged, float, Params] | None]:
    """Of each photo its best pose, as probable as its own evidence and that of the others make it, that of a rival at
    another place, where those that it is tied to would have to be as well, and the bars for it; None where there is no
    pose."""
    out: list[tuple[Judged, float, Params] | None] = []
    rivals = [rival_of(shot.judged, params) if shot.judged else 0.0 for shot in shots]
    sure = [0.0 if shot.led else shot.probability - rival for shot, rival in zip(shots, rivals, strict=True)]
    others = elsewhere(sure, ties, params)
    probable_of = probabilities(shots, ties, params)
    for shot, probable, rival, with_others in zip(shots, probable_of, rivals, others, strict=True):
        if shot.best is None:
            out.append(None)
            continue
        best, bars = replace(shot.best, probability=probable), params
        if probable > shot.probability:  # what it lacks itself, those that it is tied to show
            bars = replace(params, verdict=replace(params.verdict, min_inliers=0))
        out.append((best, rival * with_others, bars))
    return out


def elsewhere(sure: Sequence[float], ties: Mapping[tuple[int, int], bool], params: Params) -> list[float]:
    """Of each photo, how probable it is that those that it is tied to may be at another place with it.

    Args:
        sure: of each photo, by how much its place is more probable than the best other one.
    """
    out = []
    for k in range(len(sure)):
        tied = _tied(k, ties, params.together.tie)[1:]
        others = sorted((worth * max(sure[one], 0.0) for one, worth in tied), reverse=True)
        out.append(float(np.prod([1 - one for one in others[:2]])))
    return out


def _adjust(
    shots: Sequence[Shot],
    near: Sequence[Sequence[int]],
    scenes: Mapping[str, PlacedFeatures],
    params: Params,
    ties: dict[tuple[int, int], bool],
) -> None:
    """Adjust the photos that clear the bars at once, and find others by them."""
    by_component: dict[int, list[int]] = {}
    left: set[int] = set()
    for k, one in enumerate(_believed(shots, ties, params)):
        if one is None or refusal(*one):
            left.add(k)
        else:
            by_component.setdefault(one[0].candidate.component, []).append(k)
    by_component = {component: mine for component, mine in by_component.items() if len(mine) > 1}
    if not by_component:
        return
    matches = matches_of(shots, near, params)
    for component, mine in sorted(by_component.items(), key=lambda one: -len(one[1])):
        take_part = sorted([*mine, *left])
        known = [shown(shots[k], k in mine) for k in take_part]
        number = {k: place for place, k in enumerate(take_part)}
        among = {(number[a], number[b]): same for (a, b), same in matches.items() if a in number and b in number}
        adjusted, apart = bundle.adjusted(known, among, params.bundle, params.resection)
        for place in apart:
            shots[take_part[place]].apart = True
        for place, pose in adjusted.items():
            k, by = take_part[place], [take_part[other] for other in pose.by]
            _move(shots[k], pose, component, shots[by[0]].judged[0].candidate.scenes if by else (), scenes, params)
            ties.update({(other, k): True for other in by[:2]})
            left.discard(k)


def matches_of(shots: Sequence[Shot], near: Sequence[Sequence[int]], params: Params) -> bundle.Matches:
    """The features that photos share with their neighbours."""
    out: dict[tuple[int, int], tuple[np.ndarray, np.ndarray]] = {}
    for k, other in sorted({(max(k, other), min(k, other)) for k, others in enumerate(near) for other in others}):
        rows, columns = matching.matched(shots[k].described, shots[other].described, params.matching)
        out[k, other], out[other, k] = (rows, columns), (columns, rows)
    return out


def shown(shot: Shot, placed: bool) -> bundle.Shown:
    """A photo as it is adjusted with others."""
    picture = shot.picture
    pixels = shot.found.pixels.astype(np.float64)
    if not placed:
        return bundle.Shown(pixels, picture.intrinsics_px, picture.size_px, picture.focal_sigma)
    best = shot.judged[0]
    points, rows = _lifted(shot, best)
    pose, lens = best.settled.T_metric_camera, best.settled.intrinsics_px
    return bundle.Shown(pixels, lens, picture.size_px, picture.focal_sigma, pose, best.covariance, rows, points)


def _move(
    shot: Shot,
    adjusted: bundle.Adjusted,
    component: int,
    shown_by: tuple[str, ...],
    scenes: Mapping[str, PlacedFeatures],
    params: Params,
) -> None:
    """Give a photo the pose that all say; where others found it, what the map shows there is evidence as for any other.

    Args:
        shown_by: scenes that the photo which says most of it shows, where others found it.
    """
    pose, lens = adjusted.T_metric_camera, adjusted.intrinsics_px
    if not adjusted.by:
        best = shot.judged[0]
    else:
        start = Candidate(component, pose, lens, adjusted.num_points, shown_by)
        best = judged_pose(shot.picture, start, scenes, params)
        shot.led = best.settled.covariance is None or not _same(best, start, params)
        if shot.led:
            seen = [scenes[scene] for scene in shown_by[: params.settling.max_scenes]]
            looks = look(seen, pose, lens, shot.picture.size_px, params.features)
            best = replace(best, candidate=start, settled=replace(best.settled, fit=None, looks=looks))
        shot.judged.insert(0, best)
    settled = replace(best.settled, T_metric_camera=pose, intrinsics_px=lens)
    shot.judged[0] = replace(best, settled=settled, covariance=adjusted.covariance)


def _shot(
    photo: Photo, index: ViewIndex, scenes: Mapping[str, PlacedFeatures], extractor: Extractor, params: Params
) -> Shot:
    picture, scale = prepared(photo, params)
    found = photo_features(picture, extractor, 0.0)  # photos hold what renders do not
    described = matching.Described(quantised(found.descriptors), turns(found))
    judged, why = judged_poses(picture, index, scenes, extractor, params)
    return Shot(photo, picture, scale, found, described, judged, why)


def _neighbours(shots: Sequence[Shot], count: int) -> list[list[int]]:
    """Of each photo those that look most alike, and those given just before and after it."""
    vectors = np.stack([words_of(shot.found) for shot in shots])
    cosines = vectors @ vectors.T
    np.fill_diagonal(cosines, -2)
    out = []
    for k in range(len(shots)):
        alike = np.argsort(-cosines[k], kind="stable")[: min(count, len(shots) - 1)].tolist()
        beside = [one for one in (k - 1, k + 1) if 0 <= one < len(shots)]
        out.append(list(dict.fromkeys([*beside, *alike])))
    return out


def words_of(found: Keypoints) -> np.ndarray:
    """(W,) unit vector of how many features are of each word; the root, since what repeats itself says little."""
    words = words_for(found.descriptors.shape[1])
    word = words.nearest(words.shortened(found.descriptors))[:, 0]
    counts = np.sqrt(np.bincount(word, minlength=len(words.centres)))
    out: np.ndarray = counts / max(float(np.linalg.norm(counts)), 1e-9)
    return out


def _help(
    k: int,
    shots: Sequence[Shot],
    near: Sequence[int],
    scenes: Mapping[str, PlacedFeatures],
    params: Params,
    ties: dict[tuple[int, int], bool],
) -> None:
    """Give a photo's neighbours poses by its features, and keep those that are more probable than what they had."""
    helper = shots[k]
    assert helper.best is not None
    points, known = _lifted(helper, helper.best)
    if not len(known):
        return
    mine = matching.Described(helper.described.descriptors[known], helper.described.angles[known])
    for other in near:
        shot = shots[other]
        rows, columns = matching.matched(shot.described, mine, params.matching)
        pixels, places = shot.found.pixels[rows], points[columns]
        pose = resection.resect(
            pixels, places, shot.picture.intrinsics_px, shot.picture.size_px, shot.picture.focal_sigma, params.resection
        )
        if pose is None or len(np.unique(rows[pose.inliers])) < params.together.min_tie:
            continue
        component, agree = helper.best.candidate.component, pose.inliers
        lent = resection.refine(pixels[agree], places[agree], pose.T_map_camera, pose.intrinsics_px, params.resection)
        count = len(np.unique(rows[agree]))
        start = Candidate(component, lent.T_map_camera, pose.intrinsics_px, count, helper.best.candidate.scenes)
        if shot.best is not None and _same(shot.best, start, params):
            ties[k, other] = True
            continue
        judged = judged_pose(shot.picture, start, scenes, params)
        if judged.settled.covariance is None or not _same(judged, start, params):
            continue  # the map shows something else there, or leads away: another photo's features alone are not enough
        if max(judged.probability, helper.probability) >= shot.probability:
            shot.judged, shot.helped = [judged, *shot.judged], False
            ties[k, other] = True


def _lifted(shot: Shot, best: Judged) -> tuple[np.ndarray, np.ndarray]:
    """(n, 3) places of a placed photo's features by the depth of the scene that shows most there, and their rows."""
    pixels = shot.found.pixels
    points, known = np.zeros((len(pixels), 3)), np.zeros(len(pixels), bool)
    for one in best.settled.looks:
        new = at_pixels(one.sound, pixels) & ~known
        points[new] = one.points(pixels[new])
        known |= new
    rows = np.flatnonzero(known)
    return points[rows], rows


def _same(judged: Judged, candidate: Candidate, params: Params) -> bool:
    """Whether a pose that was looked into is the one that another photo says."""
    settled = replace(judged.candidate, T_metric_camera=judged.settled.T_metric_camera)
    return near_to(settled, candidate, params.resection)


def probabilities(shots: Sequence[Shot], ties: Mapping[tuple[int, int], bool], params: Params) -> list[float]:
    """Of each photo, that it is right.

    That matches are there by chance, its own evidence speaks against or that of the two surest that it is tied to: only
    what a photo shows itself counts for others, less what the ties between them are worth, so that no two make each
    other surer in a circle. That the place is a room that looks alike holds for all of them or for none, tied or not:
    what each shows for and against that adds up, that of others in part, since they show much the same.
    """
    bars, model = params.verdict, probability.model()
    own, rooms = np.zeros((2, len(shots)))
    for k, shot in enumerate(shots):
        if shot.best is not None and not shot.led:
            told = shot.best.evidence
            own[k] = model.probability(told, bars.prior / (1 - bars.alike), 0.0)
            rooms[k] = model.alike.log_odds(told)
    bound = params.together.most
    lends = params.together.shared * own * np.clip(rooms - params.together.usual, -bound, bound)
    out = []
    for k in range(len(shots)):
        reached = _tied(k, ties, params.together.tie)
        others = sorted((worth * own[one] for one, worth in reached[1:]), reverse=True)[:2]
        chance = (1 - own[k]) * np.prod([1 - probable for probable in others])
        alike = bars.alike / bars.prior * np.exp(-(rooms[k] + lends.sum() - lends[k]))
        out.append(0.0 if shots[k].best is None else float(1 / (1 + chance / (1 - chance) + alike)))
    return out


def _tied(k: int, ties: Mapping[tuple[int, int], bool], tie: float) -> list[tuple[int, float]]:
    """A photo, and those that it is tied to, over others as well; what the ties between are worth."""
    reached, fringe = {k: 1.0}, [k]
    while fringe:
        at = fringe.pop()
        for (a, b), holds in ties.items():
            if holds and at in (a, b):
                other = b if at == a else a
                worth = reached[at] * tie
                if worth > reached.get(other, 0.0):
                    reached[other] = worth
                    fringe.append(other)
    return list(reached.items())
