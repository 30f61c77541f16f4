"""Localize one photo: retrieve views, estimate candidate poses, refine them, and accept or reject the best pose."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from PIL import Image

from gsmap._native import place_points
from gsmap.geometry.filters import blur
from gsmap.geometry.uncertainty import max_sigmas
from gsmap.localize import covariance, evidence, feature_frames, matching, mismatch, probability, resection, verdict
from gsmap.localize.candidate_renders import GREY, sample_mask
from gsmap.localize.candidates import PoseCandidate, is_duplicate, match_views, propose_poses
from gsmap.localize.features import quantize, quantize_angles
from gsmap.localize.map_scene import MapScene
from gsmap.localize.params import Params
from gsmap.localize.refinement import RefinedPose, ScaledPhoto, refine_pose
from gsmap.localize.retrieval import ViewIndex, retrieve_views
from gsmap.methods.extractor import Extractor
from gsmap.reason_codes import reason
from gsmap.types.localization import Keypoints, LocalizationResult, Photo

MAX_ENLARGEMENT = 2.0
"""Largest factor by which small photos are enlarged, because patches and blurs have fixed sizes in pixels."""

SMOOTH_PX = 1.2
"""Blur of a photo before features are extracted, because renders have no finer detail."""

MORE_VIEWS = 5
"""Factor on ``max_views`` in the second attempt, which also uses features of the unblurred photo."""

HIGH_PROBABILITY = 0.97
"""Once a pose has this probability, only candidates with at least `RIVAL_INLIERS` of its inliers are refined."""

RIVAL_INLIERS = 0.5

MIN_COMPARED_PROBABILITY = 0.05
"""A pose whose best possible probability is lower is not refined once more or compared for mismatches."""

_SKIP_PROBABILITY = 0.5  # candidates whose matches agree with a pose of at least this probability are skipped
_OTHER_PLACE_M = 0.5  # smallest distance between poses at different places, at distances of a room
_OCCLUSION = 1.05  # largest ratio of a visible Gaussian's depth to the rendered depth


@dataclass(frozen=True, eq=False)
class EvaluatedPose:
    """A refined pose with its evidence.

    Args:
        candidate: the pose before refinement.
        refined: the refined pose.
        covariance: (6, 6) covariance of the pose, metres; None if too few measurements constrain it.
        evidence: pieces of evidence by name.
        probability: probability that the pose is correct.
    """

    candidate: PoseCandidate
    refined: RefinedPose
    covariance: np.ndarray | None
    evidence: Mapping[str, float]
    probability: float


def localize_photo(
    photo: Photo,
    index: ViewIndex,
    scenes: Mapping[str, MapScene],
    extractor: Extractor,
    params: Params,
    metres_per_unit: Mapping[int, float] | None = None,
) -> LocalizationResult:
    """Localize a photo in the map.

    Args:
        index: index of the views of the scenes.
        scenes: all scenes that the index names, by id.
        metres_per_unit: metres per unit of each component's frame; 1 by default.

    Returns:
        The pose in the frame and unit of its component, or the reason for rejecting it.
    """
    scaled, scale = scale_photo(photo, params.views.image_size_px)
    poses, rejection = evaluate_candidates(scaled, index, scenes, extractor, params)
    if not poses:
        return LocalizationResult(rejection, name=photo.name)
    rival = rival_probability(poses)
    return make_placement(photo.name, poses[0], rival, scaled, scale, scenes, params.verdict, metres_per_unit)


def make_placement(
    name: str,
    best: EvaluatedPose,
    rival: float,
    photo: ScaledPhoto,
    scale: np.ndarray,
    scenes: Mapping[str, MapScene],
    params: verdict.Params,
    metres_per_unit: Mapping[int, float] | None = None,
    min_inliers: int = verdict.MIN_INLIERS,
) -> LocalizationResult:
    """Accept or reject a pose, and convert it to the unit of its component.

    Args:
        rival: probability of the best pose at another place.
        scale: factors from `scale_photo`.
    """
    rejection = rejection_reason(best, rival, params, min_inliers)
    component = best.candidate.component
    metres = (metres_per_unit or {}).get(component, 1.0)
    evidence = {**best.evidence, "rival": rival}
    if rejection:
        return LocalizationResult(
            rejection, name=name, component=component, probability=best.probability, evidence=evidence
        )
    support, num_gaussians = _supporting_scenes(best, scenes, photo)
    pose = best.refined.T_metric_camera.copy()
    pose[:3, 3] /= metres
    assert best.covariance is not None
    known = covariance.add_scene_covariance(best.covariance, best.refined.T_metric_camera, support)
    unit = np.r_[np.ones(3), np.full(3, 1 / metres)]
    return LocalizationResult(
        "",
        pose,
        known * np.outer(unit, unit),
        component,
        tuple(scene.scene for scene, _ in support),
        best.probability,
        best.refined.intrinsics_px / scale,
        evidence,
        num_gaussians,
        name=name,
    )


def rejection_reason(
    best: EvaluatedPose, rival: float, params: verdict.Params, min_inliers: int = verdict.MIN_INLIERS
) -> str:
    """Return the reason why a pose is rejected; empty if it is accepted. See `make_placement`."""
    sigmas = max_sigmas(best.covariance)
    return verdict.rejection_reason(best.evidence, best.probability, sigmas, rival, params, min_inliers)


def scale_photo(photo: Photo, max_side_px: int) -> tuple[ScaledPhoto, np.ndarray]:
    """Scale a photo to the size of renders; return it with the (4,) factors on its intrinsics."""
    width, height = photo.size_px
    factor = min(MAX_ENLARGEMENT, max_side_px / max(width, height))
    rgb, scale = photo.rgb, np.ones(4)
    if factor != 1:
        size = (max(1, round(width * factor)), max(1, round(height * factor)))
        resampling, gap = (Image.Resampling.BOX, 3.0) if factor < 1 else (Image.Resampling.BICUBIC, None)
        rgb = np.asarray(Image.fromarray(rgb).resize(size, resampling, reducing_gap=gap))
        scale = np.tile([size[0] / width, size[1] / height], 2)
    real, mask = rgb.astype(np.float32) / 255, photo.known
    if mask is not None and factor != 1:  # a pixel that is partly masked counts as masked
        box = Image.fromarray(np.where(mask, 255, 0).astype(np.uint8))
        mask = np.asarray(box.resize(rgb.shape[1::-1], Image.Resampling.BOX)) == 255
    return ScaledPhoto(real, real @ GREY, photo.intrinsics_px * scale, photo.focal_sigma, mask), scale


def evaluate_candidates(
    photo: ScaledPhoto,
    index: ViewIndex,
    scenes: Mapping[str, MapScene],
    extractor: Extractor,
    params: Params,
) -> tuple[list[EvaluatedPose], str]:
    """Return the refined poses of the best candidates, the most probable first, and the reason if there are none."""
    if not len(index):
        return [], reason("no_views", "the map has no views to compare the photo with")
    out: list[EvaluatedPose] = []
    rejection = ""
    parts: list[Keypoints] = []
    # The second attempt is for photos that the first attempt does not localize.
    for max_views, smooth_px in ((params.max_views, SMOOTH_PX), (MORE_VIEWS * params.max_views, 0.0)):
        parts.append(extract_features(photo, extractor, smooth_px))
        found = concatenate_keypoints(parts)
        min_inliers = resection.min_inliers(photo.focal_sigma)
        if len(found) < min_inliers:
            return [], reason("too_few_features", f"the photo shows too little: {len(found)} features")
        candidates, num_matches = _candidates(photo, found, index, scenes, max_views)
        rejection = reason(
            "no_match",
            f"nothing in the map looks like it: {num_matches} features match, but no {min_inliers} of them agree on a "
            "pose",
        )
        new = [one for one in candidates if not any(is_duplicate(one, other.candidate) for other in out)]
        for candidate in new[: params.max_candidates]:
            certain = max((one.probability for one in out), default=0.0) >= HIGH_PROBABILITY
            if certain and candidate.num_inliers < RIVAL_INLIERS * out[0].candidate.num_inliers:
                break
            if not any(_agrees_with(candidate, one, photo) for one in out):
                out.append(evaluate_pose(photo, candidate, scenes, params.verdict.aliased_prior))
        if max((one.probability for one in out), default=0.0) >= params.verdict.min_probability:
            break
    return sorted(out, key=lambda one: -one.probability), rejection


def _agrees_with(candidate: PoseCandidate, found: EvaluatedPose, photo: ScaledPhoto) -> bool:
    """Return whether a candidate would be refined to a refined pose that is probable enough: it lies near that pose, or
    most of its matches are inliers of that pose."""
    if found.probability < _SKIP_PROBABILITY or candidate.component != found.candidate.component:
        return False
    if is_duplicate(candidate, replace(found.candidate, T_metric_camera=found.refined.T_metric_camera)):
        return True
    refined = (found.refined.T_metric_camera, found.refined.intrinsics_px, photo.size_px)
    inliers = resection.find_inliers(candidate.pixels, candidate.points, *refined)
    return bool(inliers.sum() > len(inliers) / 2)


def _candidates(
    photo: ScaledPhoto,
    found: Keypoints,
    index: ViewIndex,
    scenes: Mapping[str, MapScene],
    max_views: int,
) -> tuple[list[PoseCandidate], int]:
    """Return the candidate poses of a photo, and the number of its matches."""
    features = matching.FeatureSet(quantize(found.descriptors), quantize_angles(found))
    views = retrieve_views(index, found, photo.intrinsics_px, max_views)
    frames = feature_frames.camera_frames(found, photo.intrinsics_px)
    matches = match_views(features, frames, views, scenes)
    lens = photo.intrinsics_px, photo.size_px, photo.focal_sigma
    candidates = propose_poses(found.pixels, matches, *lens, has_angles=found.angles_rad is not None)
    return candidates, max((len(one.feature) for one in matches.values()), default=0)


def extract_features(photo: ScaledPhoto, extractor: Extractor, smooth_px: float) -> Keypoints:
    """Extract the features of a photo at valid pixels, after a blur of ``smooth_px``."""
    rgb = blur(photo.rgb, smooth_px) if smooth_px > 0 else photo.rgb
    found = extractor.extract((rgb * 255 + 0.5).astype(np.uint8))
    if photo.mask is None:
        return found
    keep = sample_mask(photo.mask, found.pixels)
    angles, sizes = (None if column is None else column[keep] for column in (found.angles_rad, found.sizes_px))
    return Keypoints(found.pixels[keep], found.descriptors[keep], angles, sizes)


def concatenate_keypoints(parts: Sequence[Keypoints]) -> Keypoints:
    """Concatenate keypoints, without their sizes; angles are kept if all parts have them."""
    angles = [part.angles_rad for part in parts if part.angles_rad is not None]
    return Keypoints(
        np.concatenate([part.pixels for part in parts]),
        np.concatenate([part.descriptors for part in parts]),
        np.concatenate(angles) if len(angles) == len(parts) else None,
    )


def evaluate_pose(
    photo: ScaledPhoto, candidate: PoseCandidate, scenes: Mapping[str, MapScene], aliased_prior: float
) -> EvaluatedPose:
    """Refine a candidate pose, compare the photo with renders from it, and compute its probability.

    Args:
        aliased_prior: see `gsmap.localize.verdict.Params`.
    """
    of_candidate = [scenes[scene] for scene in candidate.scenes]
    model = probability.load_model()

    def evidence_of(refined: RefinedPose) -> dict[str, float]:
        return probability.refinement_evidence(photo, refined, max_sigmas(refined.covariance), candidate.num_inliers)

    def is_hopeless(refined: RefinedPose) -> bool:
        best_case = model.probability(evidence_of(refined), aliased_prior, optimistic=True)
        return best_case < MIN_COMPARED_PROBABILITY

    start = candidate.T_metric_camera, candidate.intrinsics_px
    refined = refine_pose(photo, *start, of_candidate, is_hopeless)
    known, pieces = refined.covariance, evidence_of(refined)
    mismatches = mismatch.mismatch_map(photo.rgb, [] if is_hopeless(refined) else refined.renders, photo.mask)
    comparison = evidence.compare(photo.rgb, refined.renders, mismatches, mask=photo.mask)
    coarse = evidence.compare_coarsely(photo.rgb, refined.renders, mismatches, photo.mask)
    pieces |= probability.render_evidence(comparison, coarse, mismatches)
    return EvaluatedPose(candidate, refined, known, pieces, model.probability(pieces, aliased_prior))


def rival_probability(poses: Sequence[EvaluatedPose]) -> float:
    """Return the probability of the best pose at another place than the first pose; 0 without such a pose."""
    best = poses[0]
    for other in poses[1:]:
        far = np.linalg.norm(best.refined.T_metric_camera[:3, 3] - other.refined.T_metric_camera[:3, 3])
        scale = min(best.refined.scale, other.refined.scale)
        if other.candidate.component != best.candidate.component or far > _OTHER_PLACE_M * scale:
            return other.probability
    return 0.0


def _supporting_scenes(
    best: EvaluatedPose, scenes: Mapping[str, MapScene], photo: ScaledPhoto
) -> tuple[list[tuple[MapScene, float]], int]:
    """Return scenes with their shares of the inlier patches, the largest share first, and the number of visible
    Gaussians."""
    inliers = best.refined.inliers(photo.size_px)
    counts = np.bincount(best.refined.scene[inliers], minlength=len(best.refined.renders))
    if not counts.any():  # the pose comes from other photos: weigh scenes by the content that they render there
        counts = np.array([int((one.alpha > 0.5).sum()) for one in best.refined.renders])
    order = [k for k in np.argsort(-counts, kind="stable") if counts[k]]
    support = [(scenes[best.refined.renders[k].scene], counts[k] / counts.sum()) for k in order]
    return support, sum(_count_visible(scene, best.refined, photo) for scene, _ in support)


def _count_visible(scene: MapScene, refined: RefinedPose, photo: ScaledPhoto) -> int:
    camera = scene.camera(refined.T_metric_camera, refined.intrinsics_px, photo.size_px)
    gaussians, index = scene.chunked.seen_from(camera)
    ranges = index.visible_ranges(camera.T_camera_frame[0], camera.intrinsics_px[0], *camera.sizes_px[0].tolist())
    one = next(render for render in refined.renders if render.scene == scene.scene)
    far = _OCCLUSION / np.float32(scene.S_metric_scene.scale) * one.depth_m
    pose, lens = camera.T_camera_frame[0], np.ascontiguousarray(camera.intrinsics_px[0], np.float64)
    count = 0
    for start, stop in ranges.tolist():
        _, row, column, depth = place_points(gaussians.means[start:stop], pose, lens, *photo.size_px, nearest=0.0)
        count += int((depth <= far[row, column]).sum())
    return count
