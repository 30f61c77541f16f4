"""What a placed photograph shows otherwise than the map does there.

The map is rendered from the photograph's pose, each scene alone. Light differs between any two days: a robust line per
channel (`gsmap.compare.colours`) takes the colours of the render to those of the photo first, and what is left is
compared by hue, which shading leaves alone; by lightness only where neither a smooth field of light nor the same
pattern in another light explains it. A pixel counts only where its surface is known: opaque, away from edges by as much
as the pose is uncertain there, and looked at by the capture's own cameras from about that side. Where any scene shows
what the photo shows, nothing differs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import binary_dilation, binary_erosion, gaussian_filter, label, uniform_filter

from gsmap.compare.colours import Balance, balance
from gsmap.geometry.projection import in_image, project
from gsmap.localize.differing import Params
from gsmap.localize.localizing import prepared
from gsmap.localize.looks import GREY, Look, look
from gsmap.localize.params import Params as LocalizeParams
from gsmap.localize.placed import PlacedFeatures
from gsmap.render import render
from gsmap.types import Cameras
from gsmap.types.change import ChangeKind
from gsmap.types.localization import Photo

_FLOOR = 0.02  # of colours whose logarithm is taken
_FEWEST_EYES = 2
_ROUND = 1.0  # pixels that patches are off however sure the pose is: the map's own error


@dataclass(frozen=True, eq=False)
class Region:
    """A part of a photograph that shows something else than the map.

    Args:
        box_px: ``x0 y0 x1 y1`` in pixels of the photo itself.
        share: of the picture.
        strength: mean difference in units of what light and noise explain; more is surer.
        kind: ``appeared`` (something stands there that the map has not), ``disappeared`` (what the map has there is
            gone), ``recoloured`` or ``replaced``: as far as one photograph can tell.
        mask: (H, W) bool, at the size that the photo was worked on.
        point: (3,) the middle of what the map has there, metres, its component's frame.
        scene: id of the one that shows it.
    """

    box_px: np.ndarray
    share: float
    strength: float
    kind: ChangeKind
    mask: np.ndarray
    point: np.ndarray
    scene: str


@dataclass(frozen=True, eq=False)
class Differences:
    """A photograph beside the map.

    Args:
        regions: the strongest first.
        judged: share of the picture that could be compared.
        compared: (H, W) bool, which.
        agrees: (H, W) bool: of these, where the map shows the same.
        shown: (H, W, 3) float32 what the map shows there, in the light of the photo.
        points: (H, W, 3) float64 surface of the map, metres; NaN where it could not be compared.
        scale: (4,) by what intrinsics of the photo are multiplied to be of these sizes.
    """

    regions: tuple[Region, ...]
    judged: float
    compared: np.ndarray
    agrees: np.ndarray
    shown: np.ndarray
    points: np.ndarray
    scale: np.ndarray


@dataclass(frozen=True, eq=False)
class Eyes:
    """What a scene's own cameras saw: cameras of its frame and unit, and the depth (h, w) of each, 0 for nothing."""

    cameras: tuple[Cameras, ...]
    depths: tuple[np.ndarray, ...]


def open_eyes(scene: PlacedFeatures, cameras: Cameras | None, params: Params) -> Eyes:
    """Render a scene through its own cameras; without cameras it has looked at nothing."""
    if cameras is None or not len(cameras):
        return Eyes((), ())
    small = cameras.evenly(params.eyes).resized(params.eyes_px)
    views = tuple(small[i] for i in range(len(small)))
    seen = [render(scene.gaussians, view, dominant_id=False, backend="native") for view in views]
    return Eyes(views, tuple(np.where(one.alpha[0] > 0.8, one.depth[0], np.float32(0)) for one in seen))


def compare_photo(
    photo: Photo,
    T_metric_camera: np.ndarray,
    covariance: np.ndarray,
    intrinsics_px: np.ndarray,
    scenes: Sequence[PlacedFeatures],
    eyes: Mapping[str, Eyes],
    params: LocalizeParams,
) -> Differences:
    """Compare a placed photograph with what the map shows there.

    Args:
        T_metric_camera: (4, 4) camera-to-component, metres.
        covariance: (6, 6) over [rot_rad, trans_m], camera's side.
        intrinsics_px: (4,) of the photo's own size.
        scenes: that support its pose, who supports most first.
        eyes: of `open_eyes`, by scene id.
    """
    told = params.differences
    picture, scale = prepared(photo, params)
    lens = intrinsics_px * scale
    grey = gaussian_filter(picture.rgb, (_ROUND, _ROUND, 0))  # renders show nothing so fine
    shape = picture.grey.shape
    best = np.full(shape, np.inf, np.float32)
    pattern = np.full(shape, -1.0, np.float32)
    shown, whose = picture.rgb.copy(), np.full(shape, -1)
    points = np.full((*shape, 3), np.nan)
    looks = look(scenes[: params.settling.max_scenes], T_metric_camera, lens, picture.size_px, params.features)
    for number, one in enumerate(looks):
        places = _points(one, T_metric_camera, lens)
        off = _uncertainty_px(one.depth_m, covariance, lens)
        usable = _away_from_edges(one.sound, off)
        if picture.known is not None:
            usable &= picture.known
        rows = np.flatnonzero(usable)
        if len(rows) < told.min_share * usable.size:
            continue
        looked = np.zeros(usable.size, bool)
        looked[rows] = _looked_at(scenes[number], eyes[one.scene], places.reshape(-1, 3)[rows], T_metric_camera, told)
        known = looked.reshape(shape)
        if known.mean() < told.min_share:
            continue
        line = balance(one.rgb[known], grey[known])
        apart, alike = _apart(line, one.rgb, grey, known, off, told)
        judged = known & (uniform_filter(known.astype(np.float32), 2 * told.half_px + 1) > 0.6)
        if not judged.any() or (apart[judged] <= 1).mean() < told.min_agreeing:
            continue
        better = judged & (apart < best)
        best[better], pattern[better], whose[better] = apart[better], alike[better], number
        shown[better] = line.applied(one.rgb)[better]
        points[better] = places[better]
    compared = np.isfinite(best)
    found = _regions(best, compared, told)
    regions = [_region(mask, best, pattern, shown, points, whose, looks, grey, scale) for mask in found]
    regions = sorted(
        (one for one in regions if one.strength >= told.min_strength), key=lambda one: -one.strength * one.share
    )
    return Differences(tuple(regions), float(compared.mean()), compared, compared & (best <= 1), shown, points, scale)


def _points(one: Look, T_metric_camera: np.ndarray, lens: np.ndarray) -> np.ndarray:
    """(H, W, 3) places of all pixels of a look, metres."""
    height, width = one.grey.shape
    pixels = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1).reshape(-1, 2)
    return one.points(pixels).reshape(height, width, 3)


def _uncertainty_px(depth_m: np.ndarray, covariance: np.ndarray, lens: np.ndarray) -> np.ndarray:
    """(H, W) pixels by which the surface at each pixel may lie off (one standard deviation of the worst direction)."""
    turn, shift = (float(np.linalg.eigvalsh(covariance[p, p])[-1].clip(0)) for p in (slice(3), slice(3, 6)))
    out: np.ndarray = lens[0] * np.sqrt(turn + shift / np.maximum(depth_m, 0.1) ** 2)
    return out


def _away_from_edges(sound: np.ndarray, off_px: np.ndarray) -> np.ndarray:
    """Pixels around which all is sound, as far as two standard deviations of the pose reach."""
    out = sound.copy()
    for step in range(1, 9):  # beyond that nothing near an edge is left anyhow
        wide = 2 * off_px + _ROUND > step + 2  # soundness itself keeps a few pixels from edges
        if not wide.any():
            break
        out &= ~wide | binary_erosion(sound, iterations=step, border_value=1)
    return out


def _looked_at(
    scene: PlacedFeatures, eyes: Eyes, points: np.ndarray, T_metric_camera: np.ndarray, params: Params
) -> np.ndarray:
    """(K,) bool of points (metres): whether the scene's own cameras saw them from about the side of a camera."""
    S = scene.S_metric_scene.inverse()
    at, here, unit = S.apply(points), S.apply(T_metric_camera[:3, 3]), scene.S_metric_scene.scale
    way = at - here
    way /= np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-9)
    count = np.zeros(len(at), np.int64)
    least = np.cos(np.radians(params.max_turn_deg))
    for camera, depth in zip(eyes.cameras, eyes.depths, strict=True):
        pixels, z = project(at, camera.T_camera_frame[0], camera.intrinsics_px[0])
        rows = np.flatnonzero(in_image(pixels, z, camera.sizes_px[0], near=0.05 / unit))
        column, row = pixels[rows].astype(np.int64).T
        surface, z = depth[row, column], z[rows]
        own = (surface > 0) & (np.abs(surface - z) < params.tolerance_m / unit + params.tolerance * z)
        rows = rows[own]
        theirs = at[rows] - camera.centers[0]
        theirs /= np.maximum(np.linalg.norm(theirs, axis=1, keepdims=True), 1e-9)
        count[rows] += (theirs * way[rows]).sum(1) > least
    out: np.ndarray = count >= _FEWEST_EYES
    return out


def _apart(
    line: Balance, shown: np.ndarray, photo: np.ndarray, known: np.ndarray, off_px: np.ndarray, params: Params
) -> tuple[np.ndarray, np.ndarray]:
    """(H, W) how far a photo lies from a render in units of what light and noise explain; how patterns correlate."""
    side = 2 * params.half_px + 1
    weight = known.astype(np.float32)
    share = np.maximum(uniform_filter(weight, side), 1e-3)

    def mean(values: np.ndarray) -> np.ndarray:
        out: np.ndarray = uniform_filter(np.where(known, values, 0).astype(np.float32), side) / share
        return out

    chroma, light = line.differences(shown, photo, known)
    field = gaussian_filter(light * weight, params.light_px) / np.maximum(
        gaussian_filter(weight, params.light_px), 1e-3
    )
    hue = mean(np.maximum(np.abs(chroma[..., 0]), np.abs(chroma[..., 1])))
    bright = mean(np.abs(light - field))
    alike = _pattern(line.applied(shown), photo, off_px[known], side)
    out = hue / max(params.min_chroma, params.chroma_spreads * line.chroma_spread)
    bright = bright / max(params.min_lightness, params.lightness_spreads * line.lightness_spread)
    return np.maximum(out, np.where(alike < params.same_pattern, bright, 0)).astype(np.float32), alike


def _pattern(shown: np.ndarray, photo: np.ndarray, off_px: np.ndarray, side: int) -> np.ndarray:
    """(H, W) best correlation of patches within the pixels that a pose may be off."""
    a, b = (np.log(x @ GREY + _FLOOR).astype(np.float64) for x in (shown, photo))
    reach = int(np.clip(np.ceil(2 * np.median(off_px)), 1, 3)) if len(off_px) else 1
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


def _regions(apart: np.ndarray, compared: np.ndarray, params: Params) -> list[np.ndarray]:
    """Masks of the connected parts that differ and are large enough."""
    differs = compared & (apart > 1)
    labels, count = label(differs)
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    return [labels == k for k in range(1, count + 1) if sizes[k] >= params.min_area * apart.size]


def _region(
    mask: np.ndarray,
    apart: np.ndarray,
    pattern: np.ndarray,
    shown: np.ndarray,
    points: np.ndarray,
    whose: np.ndarray,
    looks: Sequence[Look],
    photo: np.ndarray,
    scale: np.ndarray,
) -> Region:
    row, column = np.nonzero(mask)
    box = np.array([column.min(), row.min(), column.max() + 1, row.max() + 1], np.float64) / scale[[0, 1, 0, 1]]
    counts = np.bincount(whose[mask], minlength=len(looks))
    return Region(
        box,
        float(mask.mean()),
        float(np.minimum(apart[mask], 4).mean()),
        _kind(mask, shown, photo, float(np.median(pattern[mask]))),
        mask,
        np.median(points[mask], axis=0),
        looks[int(counts.argmax())].scene,
    )


def _kind(mask: np.ndarray, shown: np.ndarray, photo: np.ndarray, pattern: float) -> ChangeKind:
    """What one picture can tell: by whether the region's outline is one of the photo, of the map, or of both."""
    if pattern > _SAME:
        return "recoloured"
    rim = binary_dilation(mask, iterations=_RIM) & ~binary_erosion(mask, iterations=_RIM)
    edges = []
    for rgb in (photo, shown):
        smooth = gaussian_filter(rgb, (2, 2, 0))
        steps = np.sqrt(sum(g**2 for g in np.gradient(smooth, axis=(0, 1))))
        edges.append(float(np.quantile(steps.max(-1)[rim], 0.75)))
    in_photo, in_map = edges
    if in_photo > _OUTLINED * in_map:
        return "appeared"
    return "disappeared" if in_map > _OUTLINED * in_photo else "replaced"


_SAME = 0.6
_RIM = 4
_OUTLINED = 1.4
"""So much stronger an outline is in one of the two than in the other, to be only its own."""
