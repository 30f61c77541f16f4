"""From a rough pose to a sharp one: the map rendered from there, found again in the photo and laid over it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gsmap.geometry.projection import project
from gsmap.localize import aligning, covariance, displacing, evidence, features, resection, tracking
from gsmap.localize.looks import GREY, Look, at_pixels, look, smaller, wholly
from gsmap.localize.placed import PlacedFeatures


@dataclass(frozen=True)
class Params:
    """How often the map is rendered, and how far patches are looked for.

    Args:
        far_px: how far away patches of the first renders, which have half the size of the picture, are looked for; in
            pixels of its full size.
        near_px: ... and those of the last ones, which have its full size.
        max_scenes: that are rendered, those with most matches first.
        min_found: fewer patches say nothing of the pose.
        min_agreement: where a render that was laid over the photo once agrees with it less than this when it is laid
            over it again, the photo shows another place; made places say where (``tools/fit/localize.py``).
        settle_again_under: a pose from which a render agrees less than this is settled once more from where it came to
            lie; that is kept where the render agrees better then.
        again_px: scenes are rendered again once what they show has moved by more than this ...
        again_blurs: ... or, where renders are laid over the photo, by more than so many times their blur.
    """

    far_px: int = 32
    near_px: int = 6
    max_scenes: int = 3
    min_found: int = 8
    min_agreement: float = 0.1
    settle_again_under: float = 0.5
    again_px: float = 0.5
    again_blurs: float = 0.5


@dataclass(frozen=True, eq=False)
class Picture:
    """A photo as localisation works on it: small enough, and grey as well.

    Args:
        rgb: (H, W, 3) float32 in [0, 1].
        grey: (H, W) float32.
        intrinsics_px: (4,) of this size.
        focal_sigma: as in `gsmap.types.localization.Photo`.
        known: (H, W) bool: pixels that show the place; None where all may.
    """

    rgb: np.ndarray
    grey: np.ndarray
    intrinsics_px: np.ndarray
    focal_sigma: float
    known: np.ndarray | None = None

    @property
    def size_px(self) -> tuple[int, int]:
        return self.grey.shape[1], self.grey.shape[0]

    def halved(self) -> Picture:
        rgb = smaller(self.rgb, 2)
        return Picture(rgb, rgb @ GREY, self.intrinsics_px / 2, self.focal_sigma, wholly(self.known, 2))


@dataclass(frozen=True, eq=False)
class Settled:
    """A pose that was sharpened, and by what.

    Args:
        T_metric_camera: (4, 4) camera-to-component, metres.
        intrinsics_px: (4,) of the picture's size.
        fit: the last adjustment to patches, with residuals from the pose; None where too few were found.
        covariance: (6, 6) of the pose, metres; None where nothing tells.
        pixels: (K, 2) where its patches were found.
        points: (K, 3) their places, metres.
        scene: (K,) int, whose patches they are, among ``looks``.
        tried: how many patches were looked for in the last round.
        agreement: how well a render agreed with the photo when it was laid over it for the last time, before it moved
            (`gsmap.localize.aligning.Aligned`); 0 where none was.
        looks: renders from the pose, or from so near that it makes no difference; none where nothing was found from
            the first.
    """

    T_metric_camera: np.ndarray
    intrinsics_px: np.ndarray
    fit: resection.Refined | None
    covariance: np.ndarray | None
    pixels: np.ndarray
    points: np.ndarray
    scene: np.ndarray
    tried: int
    agreement: float
    looks: Sequence[Look]


def settle(
    picture: Picture,
    T_metric_camera: np.ndarray,
    intrinsics_px: np.ndarray,
    scenes: Sequence[PlacedFeatures],
    params: Params,
    lifting: features.Params,
    tracks: tracking.Params,
    poses: resection.Params,
    laying: aligning.Params,
    displaced: displacing.Params,
    known: covariance.Params,
) -> Settled:
    """Find patches from far, lay renders over the photo, find patches again; what both tell is one pose.

    Patches are exact where renders are sharp and have corners; what is laid over whole holds where they are blurred, or
    show little but edges. From a rough pose that may not lead all the way: where the render agrees little, once more.

    Args:
        picture: of the photo.
        intrinsics_px: (4,) of the picture's size, as far as they are known.
        scenes: that may show the place, those that matter most first.
    """
    rest = scenes, params, lifting, tracks, poses, laying, displaced, known
    found = _settled(picture, T_metric_camera, intrinsics_px, *rest)
    if found.fit is None or found.agreement >= params.settle_again_under:
        return found
    again = _settled(picture, found.T_metric_camera, found.intrinsics_px, *rest)
    return again if again.agreement > found.agreement else found


def _settled(
    picture: Picture,
    T_metric_camera: np.ndarray,
    intrinsics_px: np.ndarray,
    scenes: Sequence[PlacedFeatures],
    params: Params,
    lifting: features.Params,
    tracks: tracking.Params,
    poses: resection.Params,
    laying: aligning.Params,
    displaced: displacing.Params,
    known: covariance.Params,
) -> Settled:
    """`settle`, once."""
    pose, lens = T_metric_camera, intrinsics_px
    scenes = scenes[: params.max_scenes]
    free = (picture.intrinsics_px[0], picture.focal_sigma) if resection.is_free(picture.focal_sigma) else None
    half = picture.halved()

    looks = look(scenes, pose, lens / 2, half.size_px, lifting)
    patches = _found_again(half, 0.5, looks, params.far_px, tracks)
    if len(patches.pixels) >= params.min_found:  # some of what was found far away is wrong
        sure = resection.resect(patches.pixels, patches.points, lens, picture.size_px, 0.0, poses)
        start = pose if sure is None else sure.T_map_camera
        rough = resection.refine(patches.pixels, patches.points, start, lens, poses, focal=free)
        pose, lens = rough.T_map_camera, rough.intrinsics_px

    # The scene that is laid over it: that with most patches; where they are few, the one that agrees most.
    counts = np.bincount(patches.scene, minlength=len(scenes))
    if counts.max() < params.min_found:
        looks = look(scenes, pose, lens / 2, half.size_px, lifting)
        counts = aligning.agreements(half.rgb, looks, laying.blur_px[0] / 2, laying, half.known)
    best = int(np.argmax(counts))
    aligned, agreement = None, 0.0
    for blur in laying.blur_px:
        again_px = params.again_blurs * blur / 2
        looks = look([scenes[best]], pose, lens / 2, half.size_px, lifting, looks, again_px, displaced)
        (one,) = looks
        focal = free and (free[0] / 2, free[1])
        laid = aligning.align(half.rgb, one, pose, lens / 2, blur / 2, laying, focal=focal, known=half.known)
        agreement = float(np.nan_to_num(laid.agreement))
        if aligned is not None and laid.agreement < params.min_agreement:
            return _nowhere(pose, lens, agreement)
        if len(laid.pixels):
            aligned, pose, lens = laid, laid.T_metric_camera, 2 * laid.intrinsics_px

    looks = look(scenes, pose, lens, picture.size_px, lifting, displaced=displaced)
    patches = _found_again(picture, 1.0, looks, params.near_px, tracks)
    told = None if aligned is None else covariance.of_aligned(aligned, half.size_px, known, picture.focal_sigma)
    fit: resection.Refined | None = None
    if len(patches.pixels) >= params.min_found:
        fit = resection.refine(patches.pixels, patches.points, pose, lens, poses, focal=free)
        by_patches = covariance.of_patches(fit, patches.pixels, picture.size_px, known, picture.focal_sigma)
        if told is None:
            pose, lens, told = fit.T_map_camera, fit.intrinsics_px, by_patches
        else:
            pose, lens, told = _between(pose, lens, told, fit, by_patches, known.differing)
        at, _ = project(patches.points, np.linalg.inv(pose), lens)
        fit = replace(fit, residuals_px=patches.pixels - at)
    if told is None:
        return _nowhere(pose, lens, agreement)
    told = told * covariance.doubt_of(agreement, known.disagreeing) ** 2
    return Settled(
        pose,
        lens,
        fit,
        covariance.with_hidden(told[:6, :6], known),
        patches.pixels,
        patches.points,
        patches.scene,
        patches.tried,
        agreement,
        look(scenes, pose, lens, picture.size_px, lifting, looks, params.again_px),
    )


def _nowhere(pose: np.ndarray, lens: np.ndarray, agreement: float) -> Settled:
    """What is said of a pose from which the map shows something else than the photo."""
    return Settled(pose, lens, None, None, np.zeros((0, 2)), np.zeros((0, 3)), np.zeros(0, int), 0, agreement, [])


def _between(
    pose: np.ndarray,
    lens: np.ndarray,
    told: np.ndarray,
    fit: resection.Refined,
    by_patches: np.ndarray,
    differing: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A pose and that of patches as one, each by what is known of it.

    They saw the same pictures, so they err together in part: the covariance is as if each told half (covariance
    intersection, Julier and Uhlmann 1997). Residuals do not tell all: a share of what the two differ by is added.
    """
    dim = len(told)
    xi = np.r_[resection.moved_by(pose, fit.T_map_camera), np.log(fit.intrinsics_px[0] / lens[0])][:dim]
    mine, theirs = np.linalg.pinv(told, hermitian=True), np.linalg.pinv(by_patches, hermitian=True)
    both = np.linalg.pinv(mine + theirs, hermitian=True)
    step = both @ theirs @ xi
    moved_lens = lens.copy()
    if dim == 7:
        moved_lens[:2] *= np.exp(step[6])
    return resection.moved(pose, step[:6]), moved_lens, 2 * both + differing * np.outer(xi, xi)


@dataclass(frozen=True, eq=False)
class _Patches:
    """Patches of renders that were found again in a photo; as in `Settled`."""

    pixels: np.ndarray
    points: np.ndarray
    scene: np.ndarray
    tried: int


def _found_again(
    seen: Picture,
    factor: float,
    looks: Sequence[Look],
    reach_px: int,
    tracks: tracking.Params,
) -> _Patches:
    """Patches of renders in a photo that is so many times its full size; pixels are those of the full size."""
    found, places, whose, tried = [np.zeros((0, 2))], [np.zeros((0, 3))], [np.zeros(0, int)], 0
    for place, one in enumerate(looks):
        hits = tracking.track(one.grey, one.sound, seen.grey, int(np.ceil(reach_px * factor)), tracks)
        keep, asked = hits.found, np.ones(len(hits.found), bool)
        if seen.known is not None:
            asked = at_pixels(seen.known, hits.render_px)
            keep = keep & asked & at_pixels(seen.known, hits.photo_px)
        tried += int(asked.sum())
        found.append(hits.photo_px[keep] / factor)
        places.append(one.places(hits.render_px[keep]))
        whose.append(np.full(int(keep.sum()), place))
    return _Patches(np.concatenate(found), np.concatenate(places), np.concatenate(whose), tried)


def inliers(settled: Settled, params: evidence.Params, size_px: tuple[int, int]) -> np.ndarray:
    """(K,) bool: patches that lie where the pose predicts them."""
    if settled.fit is None:
        return np.zeros(0, bool)
    bar = params.inlier_px * max(size_px) / 480
    out: np.ndarray = np.linalg.norm(settled.fit.residuals_px, axis=1) < bar
    return out
