"""Refine a candidate pose by tracking patches of renders in the photo and by direct alignment."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from gsmap.geometry.projection import project
from gsmap.localize import covariance, direct_alignment, resection, tracking
from gsmap.localize.candidate_renders import GREY, SceneRender, downsample, downsample_mask, render_scenes, sample_mask
from gsmap.localize.distances import relative_distance
from gsmap.localize.map_scene import MapScene

MAX_SCENES = 3
"""Number of scenes that are rendered for a pose: those with most matches."""

FAR_PX, NEAR_PX = 32, 6
"""Search radii of the first round (renders of half size) and of the last round, in pixels of the full size."""

MIN_PATCHES = 8
"""Fewer patches do not constrain a pose."""

MIN_AGREEMENT = 0.1
"""If a repeated direct alignment agrees less, the photo shows another place (``tools/fit/localize.py``)."""

REPEAT_BELOW_AGREEMENT = 0.5
"""If a refinement agrees less, it is run once more from its own result."""

MAX_INLIER_PX = 2.0
"""Largest distance between an inlier patch and its prediction, for a photo of 480 pixels."""

_SCALE_STRIDE_PX = 8  # spacing of the rows and columns whose depths are averaged
_MAX_MOTION_PX = 0.5  # scenes are rendered again if their content moves farther than this ...
_SAME_PX = 1e-3  # smaller motions are rounding errors
_MAX_MOTION_BLURS = 0.5  # ... or, for direct alignment, farther than this many blurs


@dataclass(frozen=True, eq=False)
class ScaledPhoto:
    """A photo at the size at which it is localized.

    Args:
        rgb: (H, W, 3) float32 in [0, 1].
        grey: (H, W) float32.
        intrinsics_px: (4,) intrinsics at this size.
        focal_sigma: as in `gsmap.types.localization.Photo`.
        mask: (H, W) mask of valid pixels; None if all are valid.
    """

    rgb: np.ndarray
    grey: np.ndarray
    intrinsics_px: np.ndarray
    focal_sigma: float
    mask: np.ndarray | None = None

    @property
    def size_px(self) -> tuple[int, int]:
        return self.grey.shape[1], self.grey.shape[0]

    def halved(self) -> ScaledPhoto:
        """Return the photo at half its size."""
        rgb = downsample(self.rgb, 2)
        return ScaledPhoto(rgb, rgb @ GREY, self.intrinsics_px / 2, self.focal_sigma, downsample_mask(self.mask, 2))


@dataclass(frozen=True, eq=False)
class RefinedPose:
    """A refined camera pose with its measurements.

    Args:
        T_metric_camera: (4, 4) camera-to-component, metres.
        intrinsics_px: (4,) intrinsics at the photo's size.
        fit: the last least-squares fit to patches, with residuals from the pose; None with too few patches.
        covariance: (6, 6) covariance of the pose, metres; None if no measurement constrains it.
        pixels: (K, 2) tracked patches in the photo.
        points: (K, 3) positions of the patches, metres.
        scene: (K,) int, index of each patch's scene in ``renders``.
        num_tracked: number of patches that were searched for in the last round.
        agreement: correlation of render and photo at the start of the last direct alignment
            (`gsmap.localize.direct_alignment.DirectAlignment`); 0 without one.
        renders: renders from the pose or from nearby; empty if the photo shows another place.
    """

    T_metric_camera: np.ndarray
    intrinsics_px: np.ndarray
    fit: resection.LeastSquaresPose | None
    covariance: np.ndarray | None
    pixels: np.ndarray
    points: np.ndarray
    scene: np.ndarray
    num_tracked: int
    agreement: float
    renders: Sequence[SceneRender]

    @cached_property
    def scale(self) -> float:
        """Distance of the rendered content relative to the distances of a room (`gsmap.localize.distances`)."""
        depths = [one.depth_m[::_SCALE_STRIDE_PX, ::_SCALE_STRIDE_PX].ravel() for one in self.renders]
        return relative_distance(np.concatenate([np.zeros(0), *depths]))

    def inliers(self, size_px: tuple[int, int]) -> np.ndarray:
        """Return a (K,) mask of patches within `MAX_INLIER_PX` of their prediction."""
        if self.fit is None:
            return np.zeros(0, bool)
        out: np.ndarray = np.linalg.norm(self.fit.residuals_px, axis=1) < MAX_INLIER_PX * max(size_px) / 480
        return out


def refine_pose(
    photo: ScaledPhoto,
    T_metric_camera: np.ndarray,
    intrinsics_px: np.ndarray,
    scenes: Sequence[MapScene],
    is_hopeless: Callable[[RefinedPose], bool] = lambda refined: False,
) -> RefinedPose:
    """Track patches within a large radius, align renders directly, track patches again, and fuse both estimates.

    Patches are accurate where renders are sharp and have corners; direct alignment also holds where renders are blurred
    or show little but edges. A result that agrees little with the photo is refined once more.

    Args:
        intrinsics_px: (4,) intrinsics at the photo's size, as far as known.
        scenes: scenes that may show the place, sorted by their number of matches.
        is_hopeless: return whether a pose will be rejected, so that it is not refined once more.
    """
    scenes = scenes[:MAX_SCENES]
    found = _refine_once(photo, T_metric_camera, intrinsics_px, scenes)
    if found.fit is not None and found.agreement < REPEAT_BELOW_AGREEMENT and not is_hopeless(found):
        again = _refine_once(photo, found.T_metric_camera, found.intrinsics_px, scenes, found.renders)
        found = again if again.agreement > found.agreement else found
    if not found.renders:
        return found
    pose = found.T_metric_camera, found.intrinsics_px
    return replace(found, renders=render_scenes(scenes, *pose, photo.size_px, found.renders, _MAX_MOTION_PX))


def _refine_once(
    photo: ScaledPhoto,
    T_metric_camera: np.ndarray,
    intrinsics_px: np.ndarray,
    scenes: Sequence[MapScene],
    previous: Sequence[SceneRender] = (),
) -> RefinedPose:
    """Refine a pose once; renders in the result are those in which patches were tracked.

    Args:
        previous: renders at the photo's size from an earlier refinement, reused where the content moves little.
    """
    pose, lens = T_metric_camera, intrinsics_px
    free = (photo.intrinsics_px[0], photo.focal_sigma) if resection.is_free(photo.focal_sigma) else None
    half = photo.halved()

    renders = render_scenes(scenes, pose, lens / 2, half.size_px)
    patches = _track_patches(half, 0.5, renders, FAR_PX)
    if len(patches.pixels) >= MIN_PATCHES:  # RANSAC first, because patches found far away are often wrong
        robust = resection.resect(patches.pixels, patches.points, lens, photo.size_px, 0.0)
        start = pose if robust is None else robust.T_map_camera
        rough = resection.refine(patches.pixels, patches.points, start, lens, focal=free)
        pose, lens = rough.T_map_camera, rough.intrinsics_px

    # Direct alignment uses one scene: the scene with most patches or, with few patches, the scene that agrees most.
    counts = np.bincount(patches.scene, minlength=len(scenes))
    if counts.max() < MIN_PATCHES:
        renders = render_scenes(scenes, pose, lens / 2, half.size_px, renders, _SAME_PX)
        counts = direct_alignment.measure_agreements(half.rgb, renders, direct_alignment.BLUR_PX[0] / 2, half.mask)
    best = int(np.argmax(counts))
    aligned, agreement = None, 0.0
    for blur in direct_alignment.BLUR_PX:
        max_motion = _MAX_MOTION_BLURS * blur / 2
        renders = render_scenes(
            [scenes[best]], pose, lens / 2, half.size_px, [*renders, *previous], max_motion, with_displacement=True
        )
        focal = free and (free[0] / 2, free[1])
        found = direct_alignment.align(half.rgb, renders[0], pose, lens / 2, blur / 2, focal=focal, mask=half.mask)
        agreement = float(np.nan_to_num(found.agreement))
        if aligned is not None and found.agreement < MIN_AGREEMENT:
            return _unconstrained(pose, lens, agreement)
        if len(found.pixels):
            aligned, pose, lens = found, found.T_metric_camera, 2 * found.intrinsics_px

    earlier = [*renders, *previous]
    renders = render_scenes(scenes, pose, lens, photo.size_px, earlier, _MAX_MOTION_PX, with_displacement=True)
    patches = _track_patches(photo, 1.0, renders, NEAR_PX)
    known = None if aligned is None else covariance.alignment_covariance(aligned, half.size_px, photo.focal_sigma)
    fit: resection.LeastSquaresPose | None = None
    if len(patches.pixels) >= MIN_PATCHES:
        fit = resection.refine(patches.pixels, patches.points, pose, lens, focal=free)
        by_patches = covariance.patch_covariance(fit, patches.pixels, photo.size_px, photo.focal_sigma)
        if known is None:
            pose, lens, known = fit.T_map_camera, fit.intrinsics_px, by_patches
        else:
            pose, lens, known = _fuse(pose, lens, known, fit, by_patches)
        at, _ = project(patches.points, np.linalg.inv(pose), lens)
        fit = replace(fit, residuals_px=patches.pixels - at)
    if known is None:
        return _unconstrained(pose, lens, agreement)
    known = covariance.add_model_error(known[:6, :6] * covariance.agreement_scale(agreement) ** 2)
    return RefinedPose(
        pose,
        lens,
        fit,
        known,
        patches.pixels,
        patches.points,
        patches.scene,
        patches.num_tracked,
        agreement,
        renders,
    )


def _unconstrained(pose: np.ndarray, lens: np.ndarray, agreement: float) -> RefinedPose:
    """Return the result for a pose from which the map shows something other than the photo."""
    return RefinedPose(pose, lens, None, None, np.zeros((0, 2)), np.zeros((0, 3)), np.zeros(0, int), 0, agreement, [])


def _fuse(
    pose: np.ndarray, lens: np.ndarray, known: np.ndarray, fit: resection.LeastSquaresPose, by_patches: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fuse the poses of direct alignment and of patches by covariance intersection (Julier and Uhlmann 1997).

    Both estimates use the same images, so their errors are correlated by an unknown amount. A share of their squared
    difference is added to the covariance, because residuals do not reveal all errors.
    """
    dim = len(known)
    xi = np.r_[resection.relative_xi(pose, fit.T_map_camera), np.log(fit.intrinsics_px[0] / lens[0])][:dim]
    one, two = np.linalg.pinv(known, hermitian=True), np.linalg.pinv(by_patches, hermitian=True)
    both = np.linalg.pinv(one + two, hermitian=True)
    step = both @ two @ xi
    fused_lens = lens.copy()
    if dim == 7:
        fused_lens[:2] *= np.exp(step[6])
    fused = 2 * both + covariance.DIFFERENCE_WEIGHT * np.outer(xi, xi)
    return resection.retract_pose(pose, step[:6]), fused_lens, fused


@dataclass(frozen=True, eq=False)
class _TrackedPatches:
    """Patches of renders that were found in a photo; fields as in `RefinedPose`."""

    pixels: np.ndarray
    points: np.ndarray
    scene: np.ndarray
    num_tracked: int


def _track_patches(
    photo: ScaledPhoto, factor: float, renders: Sequence[SceneRender], radius_px: int
) -> _TrackedPatches:
    """Track patches of renders in a photo that is scaled by ``factor``; pixels in the result are at full size."""
    pixels, points, scene, num_tracked = [np.zeros((0, 2))], [np.zeros((0, 3))], [np.zeros(0, int)], 0
    for number, one in enumerate(renders):
        tracks = tracking.track(one.grey, one.smooth, photo.grey, int(np.ceil(radius_px * factor)))
        keep, valid = tracks.found, np.ones(len(tracks.found), bool)
        if photo.mask is not None:
            valid = sample_mask(photo.mask, tracks.render_px)
            keep = keep & valid & sample_mask(photo.mask, tracks.photo_px)
        num_tracked += int(valid.sum())
        pixels.append(tracks.photo_px[keep] / factor)
        points.append(one.corrected_points(tracks.render_px[keep]))
        scene.append(np.full(int(keep.sum()), number))
    return _TrackedPatches(np.concatenate(pixels), np.concatenate(points), np.concatenate(scene), num_tracked)
