"""Localize several photos of one place, or the frames of a clip, together.

Photos match each other far better than they match renders. The map's depth lifts the features of a localized photo to
3D; neighbouring photos are resected from these points, then refined and verified on renders as any photo. Matches link
photos: linked poses are correct or wrong together, so their evidence is combined. Finally the accepted poses are
adjusted jointly, and further photos are resected from several accepted photos (`gsmap.localize.bundle_adjustment`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gsmap.localize import bundle_adjustment, matching, probability, resection, verdict
from gsmap.localize.candidate_renders import render_scenes, sample_mask
from gsmap.localize.candidates import PoseCandidate, is_duplicate
from gsmap.localize.features import quantize, quantize_angles
from gsmap.localize.localization import (
    EvaluatedPose,
    evaluate_candidates,
    evaluate_pose,
    extract_features,
    make_placement,
    rejection_reason,
    rival_probability,
    scale_photo,
)
from gsmap.localize.map_scene import MapScene
from gsmap.localize.params import Params
from gsmap.localize.refinement import MAX_SCENES, ScaledPhoto
from gsmap.localize.retrieval import ViewIndex
from gsmap.localize.vocabulary import load_vocabulary
from gsmap.methods.extractor import Extractor
from gsmap.types.localization import Keypoints, LocalizationResult, Photo

NEIGHBOURS = 6
"""Number of most similar photos with which each photo is matched."""

MIN_LINK_FEATURES = 20
"""Smallest number of inliers with the features of another photo for both photos to be linked."""

HELPER_PROBABILITY = 0.3
"""A photo whose pose has at least this probability proposes poses to its neighbours."""

# Chosen by ``tools/fit/clips.py``.
LINK_PROBABILITY = 0.97
"""Probability that the relative pose of two linked photos is correct."""

SHARED_EVIDENCE = 0.75
"""Share of a photo's log-odds against an aliased room that counts for other photos, since photos show similar
content."""

EXPECTED_LOG_ODDS = 1.75
"""Typical log-odds against an aliased room of a photo of a mapped place; lower log-odds are evidence against other
photos."""

MAX_LOG_ODDS = 4.0
"""Largest log-odds that one photo adds to another."""


@dataclass(eq=False)
class PhotoState:
    """A photo during joint localization.

    Args:
        photo: the photo as given.
        scaled, scale: result of `gsmap.localize.localization.scale_photo`.
        found, features: features of the photo.
        poses: evaluated poses, the preferred pose first.
        reason: reason why there is no pose.
        helped: the photo has proposed poses to its neighbours from its present pose.
        unsupported: the map does not show the photo at the pose from other photos.
        displaced: other photos give a pose far from the pose from the map.
    """

    photo: Photo
    scaled: ScaledPhoto
    scale: np.ndarray
    found: Keypoints
    features: matching.FeatureSet
    poses: list[EvaluatedPose]
    reason: str
    helped: bool = False
    unsupported: bool = False
    displaced: bool = False

    @property
    def best(self) -> EvaluatedPose | None:
        return self.poses[0] if self.poses else None

    @property
    def probability(self) -> float:
        return self.poses[0].probability if self.poses else 0.0


Links = dict[tuple[int, int], bool]
"""Pairs of photos with consistent poses."""


def localize_together(
    photos: Sequence[Photo],
    index: ViewIndex,
    scenes: Mapping[str, MapScene],
    extractor: Extractor,
    params: Params,
    metres_per_unit: Mapping[int, float] | None = None,
) -> list[LocalizationResult]:
    """Localize overlapping photos of one place; see `gsmap.localize.localize_photo`.

    Returns:
        The results, in the order of the photos.
    """
    states, near, links = evaluate_photos(photos, index, scenes, extractor, params)
    _adjust(states, near, scenes, params.verdict, links)
    out = []
    for state, one in zip(states, _combine_evidence(states, links, params.verdict.aliased_prior), strict=True):
        if one is None:
            out.append(LocalizationResult(state.reason, name=state.photo.name))
            continue
        best, rival, min_inliers = one
        found = make_placement(
            state.photo.name,
            best,
            rival,
            state.scaled,
            state.scale,
            scenes,
            params.verdict,
            metres_per_unit,
            min_inliers,
        )
        if state.displaced and found.is_placed:
            found = LocalizationResult(
                "ambiguous: other photos place it elsewhere",
                name=found.name,
                component=found.component,
                probability=found.probability,
                evidence=found.evidence,
            )
        out.append(found)
    return out


def evaluate_photos(
    photos: Sequence[Photo],
    index: ViewIndex,
    scenes: Mapping[str, MapScene],
    extractor: Extractor,
    params: Params,
) -> tuple[list[PhotoState], list[list[int]], Links]:
    """Evaluate the poses of photos, including proposals from neighbouring photos; return states, neighbours and
    links."""
    states = [_evaluate_photo(photo, index, scenes, extractor, params) for photo in photos]
    near = _find_neighbours(states)
    links: Links = {}
    while True:
        ready = [k for k, one in enumerate(states) if not one.helped and one.probability >= HELPER_PROBABILITY]
        if not ready:
            return states, near, links
        k = max(ready, key=lambda one: states[one].probability)
        states[k].helped = True
        _propose_to_neighbours(k, states, near[k], scenes, params.verdict.aliased_prior, links)


def _combine_evidence(
    states: Sequence[PhotoState], links: Mapping[tuple[int, int], bool], aliased_prior: float
) -> list[tuple[EvaluatedPose, float, int] | None]:
    """For each photo return its best pose with three values, or None without a pose: the probability of the pose from
    all photos, the probability of a rival place, and the number of inliers that the pose needs.

    A rival place counts to the extent that the linked photos may lie there as well.
    """
    out: list[tuple[EvaluatedPose, float, int] | None] = []
    rivals = [rival_probability(state.poses) if state.poses else 0.0 for state in states]
    leads = [
        0.0 if state.unsupported else state.probability - rival for state, rival in zip(states, rivals, strict=True)
    ]
    elsewhere = rival_factors(leads, links)
    combined = combine_probabilities(states, links, aliased_prior)
    for state, probable, rival, factor in zip(states, combined, rivals, elsewhere, strict=True):
        if state.best is None:
            out.append(None)
            continue
        # Linked photos compensate for missing inliers of a photo.
        min_inliers = 0 if probable > state.probability else verdict.MIN_INLIERS
        out.append((replace(state.best, probability=probable), rival * factor, min_inliers))
    return out


def rival_factors(leads: Sequence[float], links: Mapping[tuple[int, int], bool]) -> list[float]:
    """For each photo return the probability that its linked photos may be at another place as well.

    Args:
        leads: for each photo, the probability of its place minus the probability of the best other place.
    """
    out = []
    for k in range(len(leads)):
        linked = _linked(k, links)[1:]
        others = sorted((weight * max(leads[one], 0.0) for one, weight in linked), reverse=True)
        out.append(float(np.prod([1 - one for one in others[:2]])))
    return out


def _adjust(
    states: Sequence[PhotoState],
    near: Sequence[Sequence[int]],
    scenes: Mapping[str, MapScene],
    params: verdict.Params,
    links: Links,
) -> None:
    """Adjust the accepted photos of each component jointly, and resect further photos from them."""
    by_component: dict[int, list[int]] = {}
    left: set[int] = set()
    for k, one in enumerate(_combine_evidence(states, links, params.aliased_prior)):
        if one is None or rejection_reason(one[0], one[1], params, one[2]):
            left.add(k)
        else:
            by_component.setdefault(one[0].candidate.component, []).append(k)
    by_component = {component: accepted for component, accepted in by_component.items() if len(accepted) > 1}
    if not by_component:
        return
    matches = match_neighbours(states, near)
    for component, accepted in sorted(by_component.items(), key=lambda one: -len(one[1])):
        chosen = sorted([*accepted, *left])
        photos = [bundle_photo(states[k], k in accepted) for k in chosen]
        number = {k: place for place, k in enumerate(chosen)}
        among = {(number[a], number[b]): rows for (a, b), rows in matches.items() if a in number and b in number}
        adjusted, displaced = bundle_adjustment.adjust_photos(photos, among)
        for place in displaced:
            states[chosen[place]].displaced = True
        for place, pose in adjusted.items():
            k, resected_from = chosen[place], [chosen[other] for other in pose.resected_from]
            of_scenes = states[resected_from[0]].poses[0].candidate.scenes if resected_from else ()
            _set_adjusted_pose(states[k], pose, component, of_scenes, scenes, params.aliased_prior)
            links.update({(other, k): True for other in resected_from[:2]})
            left.discard(k)


def match_neighbours(states: Sequence[PhotoState], near: Sequence[Sequence[int]]) -> bundle_adjustment.Matches:
    """Match the features of each photo with the features of its neighbours."""
    out: dict[tuple[int, int], tuple[np.ndarray, np.ndarray]] = {}
    for k, other in sorted({(max(k, other), min(k, other)) for k, others in enumerate(near) for other in others}):
        rows, columns = matching.match_features(states[k].features, states[other].features)
        out[k, other], out[other, k] = (rows, columns), (columns, rows)
    return out


def bundle_photo(state: PhotoState, accepted: bool) -> bundle_adjustment.BundlePhoto:
    """Return a photo as input of the bundle adjustment."""
    scaled = state.scaled
    pixels = state.found.pixels.astype(np.float64)
    if not accepted:
        return bundle_adjustment.BundlePhoto(pixels, scaled.intrinsics_px, scaled.size_px, scaled.focal_sigma)
    best = state.poses[0]
    points, rows = _lift_features(state, best)
    pose, lens = best.refined.T_metric_camera, best.refined.intrinsics_px
    return bundle_adjustment.BundlePhoto(
        pixels, lens, scaled.size_px, scaled.focal_sigma, pose, best.covariance, rows, points
    )


def _set_adjusted_pose(
    state: PhotoState,
    adjusted: bundle_adjustment.AdjustedPose,
    component: int,
    of_scenes: tuple[str, ...],
    scenes: Mapping[str, MapScene],
    aliased_prior: float,
) -> None:
    """Set a photo's adjusted pose; if the photo was resected from other photos, evaluate the pose on renders first.

    Args:
        of_scenes: scenes of the photo with most common points, if this photo was resected.
    """
    pose, lens = adjusted.T_metric_camera, adjusted.intrinsics_px
    if not adjusted.resected_from:
        best = state.poses[0]
    else:
        start = PoseCandidate(component, pose, lens, adjusted.num_points, of_scenes)
        best = evaluate_pose(state.scaled, start, scenes, aliased_prior)
        state.unsupported = best.refined.covariance is None or not _still_at(best, start)
        if state.unsupported:
            chosen = [scenes[scene] for scene in of_scenes[:MAX_SCENES]]
            renders = render_scenes(chosen, pose, lens, state.scaled.size_px)
            best = replace(best, candidate=start, refined=replace(best.refined, fit=None, renders=renders))
        state.poses.insert(0, best)
    refined = replace(best.refined, T_metric_camera=pose, intrinsics_px=lens)
    state.poses[0] = replace(best, refined=refined, covariance=adjusted.covariance)


def _evaluate_photo(
    photo: Photo, index: ViewIndex, scenes: Mapping[str, MapScene], extractor: Extractor, params: Params
) -> PhotoState:
    scaled, scale = scale_photo(photo, params.views.image_size_px)
    found = extract_features(scaled, extractor, 0.0)  # photos share detail that renders lack
    features = matching.FeatureSet(quantize(found.descriptors), quantize_angles(found))
    poses, reason = evaluate_candidates(scaled, index, scenes, extractor, params)
    return PhotoState(photo, scaled, scale, found, features, poses, reason)


def _find_neighbours(states: Sequence[PhotoState]) -> list[list[int]]:
    """For each photo return the photos just before and after it, and the most similar photos."""
    vectors = np.stack([word_histogram(state.found) for state in states])
    cosines = vectors @ vectors.T
    np.fill_diagonal(cosines, -2)
    out = []
    for k in range(len(states)):
        similar = np.argsort(-cosines[k], kind="stable")[: min(NEIGHBOURS, len(states) - 1)].tolist()
        adjacent = [one for one in (k - 1, k + 1) if 0 <= one < len(states)]
        out.append(list(dict.fromkeys([*adjacent, *similar])))
    return out


def word_histogram(found: Keypoints) -> np.ndarray:
    """Return the (W,) square roots of visual word counts, of unit length; the root reduces the weight of repeated
    words."""
    vocabulary = load_vocabulary(found.descriptors.shape[1])
    word = vocabulary.nearest(vocabulary.reduce(found.descriptors))[:, 0]
    counts = np.sqrt(np.bincount(word, minlength=len(vocabulary.centres)))
    out: np.ndarray = counts / max(float(np.linalg.norm(counts)), 1e-9)
    return out


def _propose_to_neighbours(
    k: int,
    states: Sequence[PhotoState],
    near: Sequence[int],
    scenes: Mapping[str, MapScene],
    aliased_prior: float,
    links: Links,
) -> None:
    """Resect a photo's neighbours from its lifted features, and replace their poses where the new poses are more
    probable."""
    helper = states[k]
    assert helper.best is not None
    points, known = _lift_features(helper, helper.best)
    if not len(known):
        return
    lifted = matching.FeatureSet(helper.features.descriptors[known], helper.features.angles[known])
    for other in near:
        state = states[other]
        rows, columns = matching.match_features(state.features, lifted)
        pixels, matched = state.found.pixels[rows], points[columns]
        scaled = state.scaled
        pose = resection.resect(pixels, matched, scaled.intrinsics_px, scaled.size_px, scaled.focal_sigma)
        if pose is None or len(np.unique(rows[pose.inliers])) < MIN_LINK_FEATURES:
            continue
        component, inliers = helper.best.candidate.component, pose.inliers
        fit = resection.refine(pixels[inliers], matched[inliers], pose.T_map_camera, pose.intrinsics_px)
        count = len(np.unique(rows[inliers]))
        start = PoseCandidate(component, fit.T_map_camera, pose.intrinsics_px, count, helper.best.candidate.scenes)
        if state.best is not None and _still_at(state.best, start):
            links[k, other] = True
            continue
        evaluated = evaluate_pose(scaled, start, scenes, aliased_prior)
        if evaluated.refined.covariance is None or not _still_at(evaluated, start):
            continue  # features of another photo do not suffice without support from the map
        if max(evaluated.probability, helper.probability) >= state.probability:
            state.poses, state.helped = [evaluated, *state.poses], False
            links[k, other] = True


def _lift_features(state: PhotoState, best: EvaluatedPose) -> tuple[np.ndarray, np.ndarray]:
    """Return the (n, 3) positions of a photo's features from the depth of its supporting scenes, and the rows of the
    features."""
    pixels = state.found.pixels
    points, known = np.zeros((len(pixels), 3)), np.zeros(len(pixels), bool)
    for one in best.refined.renders:
        new = sample_mask(one.smooth, pixels) & ~known
        points[new] = one.points(pixels[new])
        known |= new
    rows = np.flatnonzero(known)
    return points[rows], rows


def _still_at(evaluated: EvaluatedPose, candidate: PoseCandidate) -> bool:
    """Return whether a refined pose is near a candidate."""
    refined = replace(evaluated.candidate, T_metric_camera=evaluated.refined.T_metric_camera)
    return is_duplicate(refined, candidate)


def combine_probabilities(
    states: Sequence[PhotoState], links: Mapping[tuple[int, int], bool], aliased_prior: float
) -> list[float]:
    """For each photo return the probability that its pose is correct, given the evidence of all photos.

    Evidence against an unrelated place comes from the photo itself and from the two most probable photos linked to it.
    Photos pass on only their own evidence, weighted by the links, so they cannot confirm each other in a circle. An
    aliased room is the same for all photos, linked or not: the log-odds against it add up, where other photos count in
    part.
    """
    model = probability.load_model()
    own, rooms = np.zeros((2, len(states)))
    for k, state in enumerate(states):
        if state.best is not None and not state.unsupported:
            own[k] = model.probability(state.best.evidence, 0.0, probability.PRIOR / (1 - aliased_prior))
            rooms[k] = model.aliased.log_odds(state.best.evidence)
    shared = SHARED_EVIDENCE * own * np.clip(rooms - EXPECTED_LOG_ODDS, -MAX_LOG_ODDS, MAX_LOG_ODDS)
    out = []
    for k in range(len(states)):
        linked = _linked(k, links)
        others = sorted((weight * own[one] for one, weight in linked[1:]), reverse=True)[:2]
        chance = (1 - own[k]) * np.prod([1 - probable for probable in others])
        aliased = aliased_prior / probability.PRIOR * np.exp(-(rooms[k] + shared.sum() - shared[k]))
        out.append(0.0 if states[k].best is None else float(1 / (1 + chance / (1 - chance) + aliased)))
    return out


def _linked(k: int, links: Mapping[tuple[int, int], bool]) -> list[tuple[int, float]]:
    """Return a photo and all photos that are linked to it, directly or through other photos, with the probability of
    the links."""
    reached, fringe = {k: 1.0}, [k]
    while fringe:
        at = fringe.pop()
        for (a, b), holds in links.items():
            if holds and at in (a, b):
                other = b if at == a else a
                weight = reached[at] * LINK_PROBABILITY
                if weight > reached.get(other, 0.0):
                    reached[other] = weight
                    fringe.append(other)
    return list(reached.items())
