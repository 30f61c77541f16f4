"""What the merged map must look like: renders of each capture, alone, from its own cameras, and kept photographs."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from gsmap.geometry.boxes import inside
from gsmap.geometry.projection import in_image, project
from gsmap.merge import photos
from gsmap.merge.changes import Settled, newest_first
from gsmap.merge.placed import share_in_view
from gsmap.merge.sights import surface_axes
from gsmap.render import Rendering, render
from gsmap.types import Cameras, Gaussians, PlacedScene
from gsmap.types.progress import Progress

WEIGHT_UNIT = 0.1  # of `References.visible_pixels`, for what dominates no pixel: always less than one pixel


MAX_VIEWS, PHOTO_WEIGHT = 360, 4.0  # defaults of `render_references`
_MIN_TILE_FRACTION = 0.02  # of a view that must show the tile
_FULL_TILE_FRACTION = 0.25  # from which on a view is used once in every pass; with less, in proportion
_MARGIN_PX = 6  # around what counts of a view, for the windows of SSIM
_MAX_PHOTOS = 120  # of a tile; those in which most of it lies


@dataclass(frozen=True, eq=False)
class References:
    """V pictures to reproduce.

    Args:
        cameras: V cameras, map frame, cropped to what counts.
        images: V pictures (H, W, 3) uint8.
        weights: V maps (H, W) uint8, 255 where the picture is to be believed and 0 where it says nothing: where the
            capture saw nothing, and outside the tile.
        scene: (V,) which scene each was rendered from, or shows what it shows.
        view_weights: (V,) how often to use each view in one pass over all; at most once what was rendered.
        visible_pixels: per scene (N,) float32: in how many pixels of its own views each Gaussian dominates; where
            it dominates none, `WEIGHT_UNIT` times its largest weight in any pixel; 1 for all where there are no views.
        num_photos: how many of the pictures are photographs.
    """

    cameras: Cameras
    images: list[np.ndarray]
    weights: list[np.ndarray]
    scene: np.ndarray
    view_weights: np.ndarray
    visible_pixels: list[np.ndarray]
    num_photos: int = 0

    def __len__(self) -> int:
        return len(self.images)


def render_references(
    scenes: Sequence[PlacedScene],
    bounds: np.ndarray | None,
    halo_m: float,
    longest_side_px: int,
    settled: Settled | None,
    progress: Progress,
    *,
    max_views: int = MAX_VIEWS,
    photo_weight: float = PHOTO_WEIGHT,
) -> References:
    """Render each scene from its own cameras; keep the views that show enough of the tile.

    A camera of one capture says nothing about what that capture never saw: pixels count as far as the capture itself
    covers them. For a tile they count where the surface seen lies inside it or within half the halo, so that what is
    at the border is held from both sides, and they show what lies within the halo alone: what glimmers through from
    beyond is not there when the tile is fitted, and must not be made up for. ``settled`` (`gsmap.merge.changes`) knows
    where the pictures of a scene are overruled. Photographs count where they show what their scene shows
    (`gsmap.merge.photos`).
    """
    near = [inside(scene.gaussians.means, bounds, halo_m) for scene in scenes]
    pieces = [scene.gaussians if n.all() else scene.gaussians[n] for scene, n in zip(scenes, near, strict=True)]
    todo = [
        (i, int(c), scene.cameras[int(c)].resized(longest_side_px))
        for i, (scene, piece) in enumerate(zip(scenes, pieces, strict=True))
        if scene.cameras is not None
        for c in np.flatnonzero(share_in_view(scene.cameras, piece.means) > 0)
    ]
    todo = _best_views(todo, scenes, pieces, max_views)
    cameras, images, weights, kept, shares = [], [], [], [], []
    pixels, sure = ([np.zeros(len(scene.gaussians), dtype=np.int64) for scene in scenes] for _ in range(2))
    largest = [np.zeros(len(scene.gaussians), dtype=np.float32) for scene in scenes]
    sights = [
        scene.sights(longest_side_px)
        if scene.sights is not None and (settled is None or not settled.is_disputed(i))
        else None
        for i, scene in enumerate(scenes)
    ]
    todo.sort(key=lambda one: (one[0], () if (shared := sights[one[0]]) is None else shared.cell(one[1]), one[1]))
    for done, (i, c, camera) in enumerate(todo):
        progress(done / len(todo), "rendering the captures")
        disputed = None
        if (shared := sights[i]) is not None:
            sight = shared.of(c)
            shared.count(sight, pixels[i], largest[i])
            if not shared.touches(sight, bounds, halo_m / 2):
                continue
            depth = shared.depth(sight)
        else:
            seen = render(scenes[i].gaussians, camera, max_weight=True)
            disputed = settled.overruled_pixels(i, camera) if settled is not None and settled.is_disputed(i) else None
            _count(seen, disputed, pixels[i], sure[i], largest[i])
            depth = seen.depth[0]
        counts = inside_pixels(camera, depth, bounds, halo_m / 2)
        if disputed is not None:
            counts &= ~disputed
        if counts.mean() < _MIN_TILE_FRACTION:  # a weight is at most 1
            continue
        window = _window(counts, _MARGIN_PX)
        if shared is None and pieces[i] is scenes[i].gaussians:
            colour, alpha = seen.colour[0][window], seen.alpha[0][window]
        else:
            local = render(pieces[i], _cropped(camera, window), depth=False, dominant_id=False)
            colour, alpha = local.colour[0], local.alpha[0]
        weight = alpha * counts[window]
        share = float(weight.sum() / counts.size)
        if share < _MIN_TILE_FRACTION:
            continue
        cameras.append(_cropped(camera, window))
        images.append(np.round(np.clip(colour, 0, 1) * 255).astype(np.uint8))
        weights.append(np.round(np.clip(weight, 0, 1) * 255).astype(np.uint8))
        kept.append(i)
        shares.append(share)
    num_rendered = len(kept)
    for i, one in _photos(scenes, pieces, longest_side_px) if photo_weight else ():
        counts = one.counts & inside_pixels(one.camera, one.depth, bounds, halo_m / 2)
        if settled is not None and settled.is_disputed(i):
            counts &= ~settled.overruled_pixels(i, one.camera)
        share = float(counts.mean())
        if share < _MIN_TILE_FRACTION:
            continue
        window = _window(counts, _MARGIN_PX)
        cameras.append(_cropped(one.camera, window))
        images.append(np.ascontiguousarray(one.image[window]))
        weights.append(np.where(counts[window], 255, 0).astype(np.uint8))
        kept.append(i)
        shares.append(share)
    often = np.minimum(1.0, np.array(shares) / _FULL_TILE_FRACTION)
    often[num_rendered:] *= photo_weight
    return References(
        _joined(cameras),
        images,
        weights,
        scene=np.array(kept, dtype=np.int64),
        view_weights=often,
        visible_pixels=[
            _visible_pixels(np.where(s > 0, p, 0) if shared is None else p, w, whole=bounds is None)
            for p, s, w, shared in zip(pixels, sure, largest, sights, strict=True)
        ],
        num_photos=len(kept) - num_rendered,
    )


def _photos(
    scenes: Sequence[PlacedScene],
    pieces: Sequence[Gaussians],
    longest_side_px: int,
) -> Iterator[tuple[int, photos.Shown]]:
    """Photographs that may show the tile and are to be believed, with the scene of each."""
    asked = [
        (i, photo, share)
        for i, (scene, piece) in enumerate(zip(scenes, pieces, strict=True))
        for photo in scene.photos
        if (share := float(share_in_view(photo.camera, piece.means)[0])) > 0
    ]
    if len(asked) > _MAX_PHOTOS:
        most = np.argsort([-share for _, _, share in asked], kind="stable")[:_MAX_PHOTOS]
        asked = [asked[row] for row in sorted(most)]
    for i, photo, _ in asked:
        one = photos.shown(photo, scenes[i], longest_side_px)
        if one is not None:
            yield i, one


_SAMPLE = 600  # points by which views are chosen, where there are too many


def _best_views(
    todo: list[tuple[int, int, Cameras]], scenes: Sequence[PlacedScene], pieces: Sequence[Gaussians], count: int
) -> list[tuple[int, int, Cameras]]:
    """At most ``count`` of the views: one after another which adds most to what the others see, in their order.

    A view adds to each point in its picture what it has in pixels a metre there, less for every view that has the point
    already, and less for a capture the older it is.
    """
    if len(todo) <= count:
        return todo
    together = np.concatenate([piece.means for piece in pieces])
    points = together[:: max(1, len(together) // _SAMPLE)].astype(np.float64)
    age = {i: rank for rank, i in enumerate(newest_first(scenes))}
    sharpness = np.zeros((len(todo), len(points)), dtype=np.float32)
    for row, (i, _, camera) in enumerate(todo):
        pixels, depth = project(points, camera.T_camera_frame[0], camera.intrinsics_px[0])
        seen = in_image(pixels, depth, camera.sizes_px[0], near=0.1)
        # What is nearer than a metre is not seen that much better.
        sharpness[row, seen] = 1 / np.maximum(depth[seen], 1.0) / (1 + 0.1 * age[i])
    often = np.zeros(len(points), dtype=np.float32)
    chosen = []
    for _ in range(count):
        best = int(np.argmax(sharpness @ (1 / (1 + often))))
        chosen.append(best)
        often += sharpness[best] > 0
        sharpness[best] = -1
    return [todo[row] for row in sorted(chosen)]


def _count(
    seen: Rendering, disputed: np.ndarray | None, pixels: np.ndarray, sure: np.ndarray, largest: np.ndarray
) -> None:
    """What shows where something was taken away was never seen there: it counts for nothing."""
    shown = seen.dominant_id[0]
    pixels += np.bincount(shown[shown >= 0], minlength=len(pixels))
    undisputed = shown >= 0 if disputed is None else (shown >= 0) & ~disputed
    sure += np.bincount(shown[undisputed], minlength=len(pixels))
    np.maximum(largest, seen.max_weight, out=largest)


def _window(counts: np.ndarray, margin_px: int) -> tuple[slice, slice]:
    """The part of a picture that counts, with a margin for windows of SSIM."""
    spans = []
    for axis in (1, 0):
        used = np.flatnonzero(counts.any(axis=axis))
        low, high = int(used[0]) - margin_px, int(used[-1]) + 1 + margin_px
        spans.append(slice(max(0, low), min(counts.shape[1 - axis], high)))
    return spans[0], spans[1]


def _cropped(camera: Cameras, window: tuple[slice, slice]) -> Cameras:
    rows, columns = window
    intrinsics = camera.intrinsics_px - [0, 0, columns.start, rows.start]
    size = [[columns.stop - columns.start, rows.stop - rows.start]]
    return Cameras(camera.T_frame_camera, intrinsics, np.array(size), camera.names)


def _visible_pixels(pixels: np.ndarray, largest: np.ndarray, whole: bool) -> np.ndarray:
    """See `References.visible_pixels`.

    What no view saw shows nothing of a whole capture; of a piece of one, other views may have seen it, so it goes after
    what is seen and yet dominates nothing.
    """
    if not largest.any():
        return np.ones(len(pixels), dtype=np.float32)
    unseen = 0.0 if whole else 0.5
    return np.where(pixels > 0, pixels, np.where(largest > 0, WEIGHT_UNIT * largest, unseen)).astype(np.float32)


def view_schedule(view_weights: np.ndarray, steps: int, seed: int) -> np.ndarray:
    """(steps,) which view to use at each step: each in proportion to its weight, spread evenly over time."""
    rng = np.random.default_rng(seed)
    times, views = [], []
    for view, rate in enumerate(view_weights / view_weights.sum()):
        count = int(np.ceil(steps * rate)) + 1
        # Every view takes its turn once per 1/rate steps, at a phase of its own each time.
        times.append((np.arange(count) + rng.random(count)) / rate)
        views.append(np.full(count, view))
    return np.concatenate(views)[np.argsort(np.concatenate(times), kind="stable")][:steps]


def inside_pixels(camera: Cameras, depth: np.ndarray, bounds: np.ndarray | None, band_m: float) -> np.ndarray:
    """(H, W) bool, whether the surface seen in each pixel of a depth map lies in the bounds grown by a band."""
    if bounds is None:
        return np.ones(depth.shape, dtype=bool)
    found: np.ndarray = depth > 0
    for low, high, along in zip(bounds[0] - band_m, bounds[1] + band_m, surface_axes(camera, depth), strict=True):
        found &= (along >= low) & (along < high)
    return found


def _joined(cameras: list[Cameras]) -> Cameras:
    if not cameras:
        return Cameras(np.zeros((0, 4, 4)), np.zeros((0, 4)), np.zeros((0, 2)))
    return Cameras(
        np.concatenate([c.T_frame_camera for c in cameras]),
        np.concatenate([c.intrinsics_px for c in cameras]),
        np.concatenate([c.sizes_px for c in cameras]),
        tuple(str(i) for i in range(len(cameras))),
    )
