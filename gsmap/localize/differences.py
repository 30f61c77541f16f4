"""Find regions of a localized photo that differ from the map.

Each supporting scene is rendered from the photo's pose. First a robust line per channel (`gsmap.compare.colours`)
adapts the render's colours to the photo's light. Then hues are compared, because shading does not change them;
lightness is compared only where neither a smooth light field nor an equal pattern explains a difference. A pixel is
compared only if its surface is known: opaque, farther from edges than the uncertainty of the pose, and seen by the
capture's own cameras from a similar direction. A pixel differs only if it differs from all scenes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import binary_dilation, binary_erosion, gaussian_filter, label, uniform_filter

from gsmap.compare.colours import Balance, balance
from gsmap.geometry.projection import in_image, project
from gsmap.localize.candidate_renders import GREY, SceneRender, render_scenes
from gsmap.localize.localization import scale_photo
from gsmap.localize.map_scene import MapScene
from gsmap.localize.refinement import MAX_SCENES
from gsmap.types import Cameras
from gsmap.types.change import ChangeKind
from gsmap.types.localization import Photo

_HALF_PX = 6  # half width of the patches over which differences are averaged
_MIN_CHROMA, _CHROMA_SPREADS = 0.1, 4.0  # smallest difference of hue: absolute, and in robust standard deviations
_MIN_LIGHTNESS, _LIGHTNESS_SPREADS = 0.11, 5.0  # the same for lightness, without the light field
_LIGHT_FIELD_PX = 40.0  # standard deviation of the blur that estimates the light field
_SAME_PATTERN = 0.4  # if patterns correlate more, a difference of lightness is due to light
_MIN_STRENGTH = 1.6  # mean difference of a region, in units of the thresholds
_CAPTURE_VIEWS, _CAPTURE_VIEW_SIDE_PX = 32, 128
_MIN_CAPTURE_VIEWS = 2  # number of capture views that must have seen a surface
_SURFACE_M, _SURFACE_FRACTION = 0.05, 0.03  # tolerance of depths: absolute, and per depth
_MAX_TURN_DEG = 60.0  # between the viewing directions of the photo and of a capture view
_MIN_SHARE = 0.05  # share of the photo that a scene must cover to be compared ...
_MIN_AGREEING = 0.5  # ... and share of the compared pixels that must agree; with fewer the scene shows another place
_MIN_COLOUR = 0.02  # lower limit of colours in logarithms
_MAP_ERROR_PX = 1.0  # position error of a render from an exact pose
_RECOLOURED_PATTERN = 0.6  # median correlation of patterns in a recoloured region
_RIM_PX = 4  # half width of the outline of a region
_OUTLINE_RATIO = 1.4  # an outline belongs to photo or render if its contrast there is larger by this factor


@dataclass(frozen=True, eq=False)
class ChangedRegion:
    """A region of a photo that differs from the map.

    Args:
        box_px: ``x0 y0 x1 y1`` in pixels of the original photo.
        share: share of the photo that the region covers.
        strength: mean difference, in units of the largest difference that light and noise explain.
        kind: ``appeared`` (the photo shows something in front of the map's surface), ``disappeared`` (content of the
            map is gone), ``recoloured`` or ``replaced``; a guess from a single photo.
        mask: (H, W) mask of the region, at the size of the comparison.
        point: (3,) median of the map's surface in the region, metres, in the frame of the component.
        scene: id of the scene with which the photo is compared.
    """

    box_px: np.ndarray
    share: float
    strength: float
    kind: ChangeKind
    mask: np.ndarray
    point: np.ndarray
    scene: str


@dataclass(frozen=True, eq=False)
class PhotoComparison:
    """Comparison of a localized photo with the map.

    Args:
        regions: changed regions, the strongest first.
        compared_fraction: share of the photo that is compared.
        compared: (H, W) mask of the pixels that are compared.
        agrees: (H, W) mask of the compared pixels that agree with the map.
        rendered: (H, W, 3) float32 render of the map, adapted to the light of the photo.
        points: (H, W, 3) float64 surface of the map in metres; NaN at pixels that are not compared.
        scale: (4,) factors from the photo's intrinsics to those at this size.
    """

    regions: tuple[ChangedRegion, ...]
    compared_fraction: float
    compared: np.ndarray
    agrees: np.ndarray
    rendered: np.ndarray
    points: np.ndarray
    scale: np.ndarray


@dataclass(frozen=True, eq=False)
class CaptureViews:
    """The own cameras of a scene, in its frame and unit, with the (h, w) depth image of each; 0 means no surface."""

    cameras: tuple[Cameras, ...]
    depths: tuple[np.ndarray, ...]


def render_capture_views(scene: MapScene, cameras: Cameras | None) -> CaptureViews:
    """Render the depth of a scene from its own cameras; without cameras the result is empty."""
    if cameras is None or not len(cameras):
        return CaptureViews((), ())
    small = cameras.evenly(_CAPTURE_VIEWS).resized(_CAPTURE_VIEW_SIDE_PX)
    views = tuple(small[i] for i in range(len(small)))
    seen = [scene.render(view) for view in views]
    return CaptureViews(views, tuple(np.where(one.alpha[0] > 0.8, one.depth[0], np.float32(0)) for one in seen))


def compare_photo(
    photo: Photo,
    T_metric_camera: np.ndarray,
    covariance: np.ndarray,
    intrinsics_px: np.ndarray,
    scenes: Sequence[MapScene],
    capture_views: Mapping[str, CaptureViews],
    image_size_px: int,
    min_change_fraction: float,
) -> PhotoComparison:
    """Compare a localized photo with renders of the map.

    Args:
        T_metric_camera: (4, 4) camera-to-component, metres.
        covariance: (6, 6) over [rot_rad, trans_m], on the camera's side.
        intrinsics_px: (4,) intrinsics at the original size of the photo.
        scenes: scenes that support the photo's pose, the strongest support first.
        capture_views: result of `render_capture_views`, by scene id.
        image_size_px: longer side of the compared images.
        min_change_fraction: smallest share of the photo that a region covers.
    """
    scaled, scale = scale_photo(photo, image_size_px)
    lens = intrinsics_px * scale
    rgb = gaussian_filter(scaled.rgb, (_MAP_ERROR_PX, _MAP_ERROR_PX, 0))  # renders have no finer detail
    shape = scaled.grey.shape
    best = np.full(shape, np.inf, np.float32)
    pattern = np.full(shape, -1.0, np.float32)
    rendered, scene_of = scaled.rgb.copy(), np.full(shape, -1)
    points = np.full((*shape, 3), np.nan)
    renders = render_scenes(scenes[:MAX_SCENES], T_metric_camera, lens, scaled.size_px)
    for number, one in enumerate(renders):
        positions = _all_points(one)
        sigma_px = _uncertainty_px(one.depth_m, covariance, lens)
        usable = _away_from_edges(one.smooth, sigma_px)
        if scaled.mask is not None:
            usable &= scaled.mask
        rows = np.flatnonzero(usable)
        if len(rows) < _MIN_SHARE * usable.size:
            continue
        seen = np.zeros(usable.size, bool)
        seen[rows] = _is_observed(
            scenes[number], capture_views[one.scene], positions.reshape(-1, 3)[rows], T_metric_camera
        )
        known = seen.reshape(shape)
        if known.mean() < _MIN_SHARE:
            continue
        line = balance(one.rgb[known], rgb[known])
        difference, correlation = _measure_difference(line, one.rgb, rgb, known, sigma_px)
        compared = known & (uniform_filter(known.astype(np.float32), 2 * _HALF_PX + 1) > 0.6)
        if not compared.any() or (difference[compared] <= 1).mean() < _MIN_AGREEING:
            continue
        better = compared & (difference < best)
        best[better], pattern[better], scene_of[better] = difference[better], correlation[better], number
        rendered[better] = line.applied(one.rgb)[better]
        points[better] = positions[better]
    compared = np.isfinite(best)
    masks = _connected_regions(best, compared, min_change_fraction)
    regions = [_describe_region(mask, best, pattern, rendered, points, scene_of, renders, rgb, scale) for mask in masks]
    regions = sorted(
        (one for one in regions if one.strength >= _MIN_STRENGTH), key=lambda one: -one.strength * one.share
    )
    agrees = compared & (best <= 1)
    return PhotoComparison(tuple(regions), float(compared.mean()), compared, agrees, rendered, points, scale)


def _all_points(one: SceneRender) -> np.ndarray:
    """Return the (H, W, 3) positions of all pixels of a render, in metres."""
    height, width = one.grey.shape
    pixels = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1).reshape(-1, 2)
    return one.points(pixels).reshape(height, width, 3)


def _uncertainty_px(depth_m: np.ndarray, covariance: np.ndarray, lens: np.ndarray) -> np.ndarray:
    """Return the (H, W) standard deviation in pixels of the surface at each pixel, in the least certain direction."""
    turn, shift = (float(np.linalg.eigvalsh(covariance[p, p])[-1].clip(0)) for p in (slice(3), slice(3, 6)))
    out: np.ndarray = lens[0] * np.sqrt(turn + shift / np.maximum(depth_m, 0.1) ** 2)
    return out


def _away_from_edges(smooth: np.ndarray, sigma_px: np.ndarray) -> np.ndarray:
    """Return an (H, W) mask of pixels that are smooth everywhere within two standard deviations of the pose."""
    out = smooth.copy()
    for step in range(1, 9):
        wide = 2 * sigma_px + _MAP_ERROR_PX > step + 2  # smooth pixels keep a few pixels from edges
        if not wide.any():
            break
        out &= ~wide | binary_erosion(smooth, iterations=step, border_value=1)
    return out


def _is_observed(
    scene: MapScene, capture_views: CaptureViews, points: np.ndarray, T_metric_camera: np.ndarray
) -> np.ndarray:
    """Return a (K,) mask of points (metres) that the scene's own cameras saw from a direction similar to the
    camera's."""
    S = scene.S_metric_scene.inverse()
    at, here, unit = S.apply(points), S.apply(T_metric_camera[:3, 3]), scene.S_metric_scene.scale
    direction = at - here
    direction /= np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-9)
    count = np.zeros(len(at), np.int64)
    min_cosine = np.cos(np.radians(_MAX_TURN_DEG))
    for camera, depth in zip(capture_views.cameras, capture_views.depths, strict=True):
        pixels, z = project(at, camera.T_camera_frame[0], camera.intrinsics_px[0])
        rows = np.flatnonzero(in_image(pixels, z, camera.sizes_px[0], near=0.05 / unit))
        column, row = pixels[rows].astype(np.int64).T
        surface, z = depth[row, column], z[rows]
        own = (surface > 0) & (np.abs(surface - z) < _SURFACE_M / unit + _SURFACE_FRACTION * z)
        rows = rows[own]
        rays = at[rows] - camera.centers[0]
        rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-9)
        count[rows] += (rays * direction[rows]).sum(1) > min_cosine
    out: np.ndarray = count >= _MIN_CAPTURE_VIEWS
    return out


def _measure_difference(
    line: Balance, rendered: np.ndarray, photo: np.ndarray, known: np.ndarray, sigma_px: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the (H, W) differences, in units of the largest difference that light and noise explain, and the (H, W)
    correlations of patterns."""
    side = 2 * _HALF_PX + 1
    weight = known.astype(np.float32)
    share = np.maximum(uniform_filter(weight, side), 1e-3)

    def mean(values: np.ndarray) -> np.ndarray:
        out: np.ndarray = uniform_filter(np.where(known, values, 0).astype(np.float32), side) / share
        return out

    chroma, light = line.differences(rendered, photo, known)
    field = gaussian_filter(light * weight, _LIGHT_FIELD_PX) / np.maximum(
        gaussian_filter(weight, _LIGHT_FIELD_PX), 1e-3
    )
    hue = mean(np.maximum(np.abs(chroma[..., 0]), np.abs(chroma[..., 1])))
    bright = mean(np.abs(light - field))
    correlation = _correlate_patterns(line.applied(rendered), photo, sigma_px[known], side)
    out = hue / max(_MIN_CHROMA, _CHROMA_SPREADS * line.chroma_spread)
    bright = bright / max(_MIN_LIGHTNESS, _LIGHTNESS_SPREADS * line.lightness_spread)
    return np.maximum(out, np.where(correlation < _SAME_PATTERN, bright, 0)).astype(np.float32), correlation


def _correlate_patterns(rendered: np.ndarray, photo: np.ndarray, sigma_px: np.ndarray, side: int) -> np.ndarray:
    """Return the (H, W) correlation of patches, the best over all shifts within the uncertainty of the pose."""
    a, b = (np.log(x @ GREY + _MIN_COLOUR).astype(np.float64) for x in (rendered, photo))
    reach = int(np.clip(np.ceil(2 * np.median(sigma_px)), 1, 3)) if len(sigma_px) else 1
    mean_a, mean_b = uniform_filter(a, side), uniform_filter(b, side)
    spread_a = np.maximum(uniform_filter(a * a, side) - mean_a**2, 1e-5)
    spread_b = np.maximum(uniform_filter(b * b, side) - mean_b**2, 1e-5)
    best = np.full(a.shape, -1.0)
    for dy in range(-reach, reach + 1):
        for dx in range(-reach, reach + 1):
            moved = [np.roll(x, (dy, dx), (0, 1)) for x in (a, mean_a, spread_a)]
            both = uniform_filter(moved[0] * b, side) - moved[1] * mean_b
            best = np.maximum(best, both / np.sqrt(moved[2] * spread_b))
    return best.astype(np.float32)


def _connected_regions(difference: np.ndarray, compared: np.ndarray, min_fraction: float) -> list[np.ndarray]:
    """Return masks of the connected, sufficiently large regions that differ."""
    differs = compared & (difference > 1)
    labels, count = label(differs)
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    return [labels == k for k in range(1, count + 1) if sizes[k] >= min_fraction * difference.size]


def _describe_region(
    mask: np.ndarray,
    difference: np.ndarray,
    pattern: np.ndarray,
    rendered: np.ndarray,
    points: np.ndarray,
    scene_of: np.ndarray,
    renders: Sequence[SceneRender],
    photo: np.ndarray,
    scale: np.ndarray,
) -> ChangedRegion:
    row, column = np.nonzero(mask)
    box = np.array([column.min(), row.min(), column.max() + 1, row.max() + 1], np.float64) / scale[[0, 1, 0, 1]]
    counts = np.bincount(scene_of[mask], minlength=len(renders))
    return ChangedRegion(
        box,
        float(mask.mean()),
        float(np.minimum(difference[mask], 4).mean()),
        _classify(mask, rendered, photo, float(np.median(pattern[mask]))),
        mask,
        np.median(points[mask], axis=0),
        renders[int(counts.argmax())].scene,
    )


def _classify(mask: np.ndarray, rendered: np.ndarray, photo: np.ndarray, pattern: float) -> ChangeKind:
    """Classify a region: its outline is visible in the photo, in the map, or in both."""
    if pattern > _RECOLOURED_PATTERN:
        return "recoloured"
    rim = binary_dilation(mask, iterations=_RIM_PX) & ~binary_erosion(mask, iterations=_RIM_PX)
    edges = []
    for rgb in (photo, rendered):
        smooth = gaussian_filter(rgb, (2, 2, 0))
        steps = np.sqrt(sum(g**2 for g in np.gradient(smooth, axis=(0, 1))))
        edges.append(float(np.quantile(steps.max(-1)[rim], 0.75)))
    in_photo, in_map = edges
    if in_photo > _OUTLINE_RATIO * in_map:
        return "appeared"
    return "disappeared" if in_map > _OUTLINE_RATIO * in_photo else "replaced"
