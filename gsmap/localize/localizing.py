"""One photograph: where it was taken, how well that is known, or why nothing is said."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from PIL import Image

from gsmap.localize import covariance, evidence, matching, probability, resection, turned, unlike, verdict
from gsmap.localize.candidates import Candidate, candidates, matches_by_component, near_to
from gsmap.localize.features import quantised, turns
from gsmap.localize.filters import blurred
from gsmap.localize.looks import GREY, at_pixels
from gsmap.localize.params import Params
from gsmap.localize.placed import PlacedFeatures
from gsmap.localize.retrieval import ViewIndex, most_alike
from gsmap.localize.settling import Picture, Settled, inliers, settle
from gsmap.methods.extractor import Extractor
from gsmap.reason_codes import reason
from gsmap.types.localization import Keypoints, LocalizationResult, Photo


@dataclass(frozen=True, eq=False)
class Judged:
    """A pose of a photo that was looked into.

    Args:
        candidate: the rough pose.
        settled: the sharp one.
        covariance: (6, 6), metres; None where too little was found.
        evidence: by name.
        probability: of all of it.
    """

    candidate: Candidate
    settled: Settled
    covariance: np.ndarray | None
    evidence: Mapping[str, float]
    probability: float


def localize_photo(
    photo: Photo,
    index: ViewIndex,
    scenes: Mapping[str, PlacedFeatures],
    extractor: Extractor,
    params: Params,
    metres_per_unit: Mapping[int, float] | None = None,
) -> LocalizationResult:
    """Find a photograph in the map.

    Views that look like it are matched with it, poses that these matches agree on are sharpened on renders of the map,
    and the best one is judged by what the map shows from there.

    Args:
        index: of the views that may show it.
        scenes: by id, all that the index names.
        metres_per_unit: of the frame of each component; 1 where it is not named.

    Returns:
        The pose in the frame and unit of its component, or the reason why there is none.
    """
    picture, scale = prepared(photo, params)
    judged, why = judged_poses(picture, index, scenes, extractor, params)
    if not judged:
        return LocalizationResult(photo.name, why)
    return placement(photo.name, judged[0], rival_of(judged, params), picture, scale, scenes, params, metres_per_unit)


def placement(
    name: str,
    best: Judged,
    rival: float,
    picture: Picture,
    scale: np.ndarray,
    scenes: Mapping[str, PlacedFeatures],
    params: Params,
    metres_per_unit: Mapping[int, float] | None = None,
) -> LocalizationResult:
    """What is said of a pose that was looked into.

    Args:
        rival: probability of the best pose at another place.
        scale: of `prepared`.
    """
    why = refusal(best, rival, params)
    component = best.candidate.component
    metres = (metres_per_unit or {}).get(component, 1.0)
    told = {**best.evidence, "rival": rival}
    if why:
        return LocalizationResult(name, why, component=component, probability=best.probability, evidence=told)
    support, seen = _support(best, scenes, params, picture)
    pose = best.settled.T_metric_camera.copy()
    pose[:3, 3] /= metres
    assert best.covariance is not None
    known = covariance.with_scene(best.covariance, best.settled.T_metric_camera, support)
    unit = np.r_[np.ones(3), np.full(3, 1 / metres)]
    return LocalizationResult(
        name,
        "",
        pose,
        known * np.outer(unit, unit),
        component,
        tuple(scene.scene for scene, _ in support),
        best.settled.intrinsics_px / scale,
        best.probability,
        told,
        seen,
    )


def refusal(best: Judged, rival: float, params: Params) -> str:
    """Why a pose that was looked into is not said; empty where it is. See `placement`."""
    return verdict.judge(best.evidence, best.probability, sigmas_of(best.covariance), rival, params.verdict)


def prepared(photo: Photo, params: Params) -> tuple[Picture, np.ndarray]:
    """The photo as it is worked on, and by what (4,) intrinsics of the original are multiplied to be of that."""
    width, height = photo.size_px
    factor = min(params.max_enlarged, params.views.image_size_px / max(width, height))
    rgb, scale = photo.rgb, np.ones(4)
    if factor != 1:
        size = (max(1, round(width * factor)), max(1, round(height * factor)))
        how, gap = (Image.Resampling.BOX, 3.0) if factor < 1 else (Image.Resampling.BICUBIC, None)
        rgb = np.asarray(Image.fromarray(rgb).resize(size, how, reducing_gap=gap))
        scale = np.tile([size[0] / width, size[1] / height], 2)
    real, known = rgb.astype(np.float32) / 255, photo.known
    if known is not None and factor != 1:  # a pixel that is hidden in part is hidden
        box = Image.fromarray(np.where(known, 255, 0).astype(np.uint8))
        known = np.asarray(box.resize(rgb.shape[1::-1], Image.Resampling.BOX)) == 255
    return Picture(real, real @ GREY, photo.intrinsics_px * scale, photo.focal_sigma, known), scale


def judged_poses(
    picture: Picture,
    index: ViewIndex,
    scenes: Mapping[str, PlacedFeatures],
    extractor: Extractor,
    params: Params,
) -> tuple[list[Judged], str]:
    """Poses that were looked into, the most probable first; and why there are none."""
    if not len(index):
        return [], "the map shows nothing to compare it with"
    out: list[Judged] = []
    why = ""
    smooth = params.matching.smooth_px
    parts: list[Keypoints] = []
    # First what is as fine as renders are; where that places it nowhere, more views, and what is finer as well.
    for views, finer in ((params.matching.views, smooth), (params.matching.more_views, 0.0)):
        parts.append(photo_features(picture, extractor, finer))
        found = all_of(parts)
        fewest = resection.fewest(picture.focal_sigma, params.resection)
        if len(found) < fewest:
            return [], f"it shows too little: {len(found)} features"
        rough, most = _rough_poses(picture, found, index, scenes, replace(params.matching, views=views), params)
        why = reason(
            "no_match", f"nothing in the map looks like it: {most} features match, no {fewest} agree on a pose"
        )
        new = [one for one in rough if not any(near_to(one, other.candidate, params.resection) for other in out)]
        for candidate in new[: params.max_candidates]:
            sure = max((one.probability for one in out), default=0.0) >= params.sure
            if sure and candidate.num_inliers < params.rival_inliers * out[0].candidate.num_inliers:
                break
            if not any(_settles_at(candidate, one, picture, params) for one in out):
                out.append(judged_pose(picture, candidate, scenes, params))
        if max((one.probability for one in out), default=0.0) >= params.verdict.min_probability:
            break
    return sorted(out, key=lambda one: -one.probability), why


def _settles_at(candidate: Candidate, found: Judged, picture: Picture, params: Params) -> bool:
    """Whether a rough pose is that of a place that was found: most of its matches agree with the sharp pose as well."""
    if found.probability < params.skip_from or candidate.component != found.candidate.component:
        return False
    settled = (found.settled.T_metric_camera, found.settled.intrinsics_px, picture.size_px)
    agree = resection.agreeing(candidate.pixels, candidate.points, *settled, params.resection)
    return bool(agree.sum() > len(agree) / 2)


def _rough_poses(
    picture: Picture,
    found: Keypoints,
    index: ViewIndex,
    scenes: Mapping[str, PlacedFeatures],
    matched: matching.Params,
    params: Params,
) -> tuple[list[Candidate], int]:
    """Poses that matches agree on, and how many matches there were."""
    described = matching.Described(quantised(found.descriptors), turns(found))
    views = most_alike(index, found, picture.intrinsics_px, matched.views, params.retrieval)
    frames = turned.in_camera(found, picture.intrinsics_px)
    matches = matches_by_component(described, frames, views, scenes, matched)
    lens = picture.intrinsics_px, picture.size_px, picture.focal_sigma
    known = found.angles_rad is not None
    rough = candidates(found.pixels, matches, *lens, params.resection, angles_known=known)
    return rough, max((len(one.feature) for one in matches.values()), default=0)


def photo_features(picture: Picture, extractor: Extractor, smooth_px: float) -> Keypoints:
    """Features of a photo where it shows the place, without what is finer than renders are."""
    rgb = blurred(picture.rgb, smooth_px) if smooth_px > 0 else picture.rgb
    found = extractor.extract((rgb * 255 + 0.5).astype(np.uint8))
    if picture.known is None:
        return found
    keep = at_pixels(picture.known, found.pixels)
    angles, sizes = (None if column is None else column[keep] for column in (found.angles_rad, found.sizes_px))
    return Keypoints(found.pixels[keep], found.descriptors[keep], angles, sizes)


def all_of(parts: Sequence[Keypoints]) -> Keypoints:
    turned = [part.angles_rad for part in parts if part.angles_rad is not None]
    return Keypoints(
        np.concatenate([part.pixels for part in parts]),
        np.concatenate([part.descriptors for part in parts]),
        np.concatenate(turned) if len(turned) == len(parts) else None,
    )


def judged_pose(picture: Picture, candidate: Candidate, scenes: Mapping[str, PlacedFeatures], params: Params) -> Judged:
    """A rough pose, sharpened and compared with what the map shows there."""
    settled = settled_pose(picture, candidate, scenes, params)
    known, asked, model = settled.covariance, params.evidence, probability.model()
    before = params.verdict.prior, params.verdict.alike
    told = probability.evidence_of_settling(picture, settled, sigmas_of(known), candidate.num_inliers, asked)
    hopeless = model.probability(told, *before, at_best=True) < asked.ask_from
    rgb, shows = picture.rgb, picture.known
    other = unlike.unlike(rgb, [] if hopeless else settled.looks, asked.likely, shows)
    comparison = evidence.compare(rgb, settled.looks, asked, other, known=shows)
    coarse = evidence.compare_coarsely(rgb, settled.looks, asked, other, shows)
    told |= probability.evidence_of_looks(comparison, coarse, other, asked)
    return Judged(candidate, settled, known, told, model.probability(told, *before))


def settled_pose(
    picture: Picture, candidate: Candidate, scenes: Mapping[str, PlacedFeatures], params: Params
) -> Settled:
    """A rough pose, sharpened."""
    return settle(
        picture,
        candidate.T_metric_camera,
        candidate.intrinsics_px,
        [scenes[scene] for scene in candidate.scenes],
        params.settling,
        params.features,
        params.tracking,
        params.resection,
        params.aligning,
        params.displacing,
        params.covariance,
    )


def sigmas_of(covariance: np.ndarray | None) -> tuple[float, float]:
    """Largest standard deviation of rotation (rad) and translation; inf of none."""
    if covariance is None:
        return np.inf, np.inf
    turn, shift = (
        float(np.sqrt(np.linalg.eigvalsh(covariance[part, part])[-1].clip(0))) for part in (slice(3), slice(3, 6))
    )
    return turn, shift


def rival_of(judged: Sequence[Judged], params: Params) -> float:
    """The probability of the best pose that is another place than the best one's; 0 where there is none."""
    best = judged[0]
    for other in judged[1:]:
        far = np.linalg.norm(best.settled.T_metric_camera[:3, 3] - other.settled.T_metric_camera[:3, 3])
        apart = other.candidate.component != best.candidate.component or far > params.apart_m
        if apart:
            return other.probability
    return 0.0


def _support(
    best: Judged, scenes: Mapping[str, PlacedFeatures], params: Params, picture: Picture
) -> tuple[list[tuple[PlacedFeatures, float]], int]:
    """The scenes in which patches were found again, with their shares, most first; and how many of their Gaussians the
    photo shows.
    """
    kept = inliers(best.settled, params.evidence, picture.size_px)
    counts = np.bincount(best.settled.scene[kept], minlength=len(best.settled.looks))
    if not counts.any():  # found by other photos: what the map has there
        counts = np.array([int((one.alpha > 0.5).sum()) for one in best.settled.looks])
    order = [k for k in np.argsort(-counts, kind="stable") if counts[k]]
    held = [(scenes[best.settled.looks[k].scene], counts[k] / counts.sum()) for k in order]
    return held, sum(_num_seen(scene, best.settled, picture) for scene, _ in held)


def _num_seen(scene: PlacedFeatures, settled: Settled, picture: Picture) -> int:
    from gsmap.geometry.projection import in_image, project

    camera = scene.camera(settled.T_metric_camera, settled.intrinsics_px, picture.size_px)
    means = scene.gaussians.means
    pixels, depth = project(means, camera.T_camera_frame[0], camera.intrinsics_px[0])
    inside = np.flatnonzero(in_image(pixels, depth, camera.sizes_px[0]))
    one = next(look for look in settled.looks if look.scene == scene.scene)
    column, row = pixels[inside].astype(np.int64).T
    return int((depth[inside] * scene.S_metric_scene.scale <= 1.05 * one.depth_m[row, column]).sum())
