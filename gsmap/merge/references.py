"""Reference views of a merged tile: renders of each scene from its own cameras, and kept photos."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from gsmap.geometry.boxes import inside
from gsmap.geometry.projection import in_image, project
from gsmap.geometry.threads import map_ahead
from gsmap.merge import photos
from gsmap.merge.changes import ResolvedScenes, newest_first
from gsmap.merge.overlap import share_in_view
from gsmap.merge.reference_view_cache import surface_axes
from gsmap.merge.sharpness import Compared, SharpnessComparison, SharpnessWeights, compared_views
from gsmap.render import ChunkIndex, Rendering, render
from gsmap.types import Cameras, Gaussians, PosedScene
from gsmap.types.progress import Progress

# Factor in `References.visible_pixels` for Gaussians that dominate no pixel: they count less than one pixel.
WEIGHT_UNIT = 0.1


MAX_VIEWS, PHOTO_WEIGHT = 360, 4.0  # defaults of `render_references`
_MIN_TILE_FRACTION = 0.02  # smallest share of a view that must show the tile
_FULL_TILE_FRACTION = 0.25  # with at least this share a view is used once in every pass, otherwise in proportion
_STRIDE_PX = 8  # sharpness is looked up at every eighth pixel along each axis
_MIN_COMPARED_WEIGHT = 0.95  # smallest weight of a pixel in which the sharpness of scenes is compared
_MARGIN_PX = 6  # margin around the valid pixels of a view, for the windows of SSIM
_MAX_PHOTOS = 120  # of a tile: the photos that show most of it


@dataclass(frozen=True, eq=False)
class References:
    """V reference views.

    Args:
        cameras: V cameras in the map frame, cropped to the valid pixels.
        images: V images (H, W, 3) uint8.
        weights: V maps (H, W) uint8, 255 for fully valid pixels, 0 where the scene is empty and outside the tile.
        scene: (V,) scene of each view.
        view_weights: (V,) number of uses of each view in one pass over all views; at most 1 for rendered views.
        visible_pixels: per scene, the (N,) float32 number of pixels of the scene's own views that each Gaussian
            dominates. A Gaussian that dominates none has `WEIGHT_UNIT` times its largest weight in any pixel; without
            views all have 1.
        num_photos: number of views that are photos.
        sharpness: weight of each scene by place; lower where another scene is sharper.
    """

    cameras: Cameras
    images: list[np.ndarray]
    weights: list[np.ndarray]
    scene: np.ndarray
    view_weights: np.ndarray
    visible_pixels: list[np.ndarray]
    num_photos: int = 0
    sharpness: SharpnessWeights = field(default_factory=lambda: SharpnessWeights({}))

    def __len__(self) -> int:
        return len(self.images)


@dataclass(frozen=True, eq=False)
class _View:
    """A rendered reference view; see `References`. ``points`` are those of `_coarse_points`."""

    camera: Cameras
    image: np.ndarray
    weight: np.ndarray
    share: float
    points: np.ndarray
    compared: Compared


def render_references(
    scenes: Sequence[PosedScene],
    bounds: np.ndarray | None,
    halo_m: float,
    longest_side_px: int,
    settled: ResolvedScenes | None,
    progress: Progress,
    *,
    max_views: int = MAX_VIEWS,
    photo_weight: float = PHOTO_WEIGHT,
) -> References:
    """Render each scene from its own cameras, and keep the views that show enough of the tile.

    Pixels are weighted by the scene's own opacity. For a tile, a pixel is valid if its surface lies inside the tile or
    within half the halo, so that the border is constrained from both sides. Only Gaussians within the halo are
    rendered, because farther Gaussians are absent when the tile is fitted.

    Args:
        scenes: scenes in the map frame.
        bounds: (2, 3) box of the tile; None for everything.
        halo_m: width of the tile's surroundings.
        longest_side_px: longest side of the views.
        settled: resolved changes, which give the outdated pixels of views (`gsmap.merge.changes`); None without
            changes.
        progress: called with the fraction done in [0, 1] and the current step.
        max_views: largest number of rendered views.
        photo_weight: number of uses of a photo in every pass, relative to a rendered view; 0 ignores photos.
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
    cameras, images, weights, kept, shares, places = [], [], [], [], [], []
    reference_views = [
        scene.reference_views(longest_side_px)
        if scene.reference_views is not None and (settled is None or not settled.is_disputed(i))
        else None
        for i, scene in enumerate(scenes)
    ]
    # Per Gaussian, or per key of the shared views.
    counted = [
        len(scene.gaussians if shared is None else shared.keys)
        for scene, shared in zip(scenes, reference_views, strict=True)
    ]
    pixels, sure = ([np.zeros(count, dtype=np.int64) for count in counted] for _ in range(2))
    largest = [np.zeros(count, dtype=np.float32) for count in counted]
    todo.sort(
        key=lambda one: (one[0], () if (shared := reference_views[one[0]]) is None else shared.cell(one[1]), one[1])
    )
    indices = [ChunkIndex.build(piece) for piece in pieces]
    whole_indices = [
        index if piece is scene.gaussians else ChunkIndex.build(scene.gaussians)
        for index, piece, scene in zip(indices, pieces, scenes, strict=True)
    ]
    comparison, compared = SharpnessComparison(pieces, indices), compared_views([i for i, _, _ in todo])
    lock = threading.Lock()  # what scenes keep of their views and changes is not made for threads

    def make_view(one: tuple[int, tuple[int, int, Cameras]]) -> tuple[int, _View | None]:
        done, (i, c, camera) = one
        disputed = None
        if (shared := reference_views[i]) is not None:
            with lock:
                sight = shared.of(c)
                shared.count(sight, pixels[i], largest[i])
                if not shared.touches(sight, bounds, halo_m / 2):
                    return i, None
                depth = shared.depth(sight)
        else:
            seen = render(scenes[i].gaussians, camera, max_weight=True, index=whole_indices[i])
            if settled is not None and settled.is_disputed(i):
                with lock:
                    disputed = settled.outdated_pixels(i, camera)
            with lock:
                _count(seen, disputed, pixels[i], sure[i], largest[i])
            depth = seen.depth[0]
        counts = inside_pixels(camera, depth, bounds, halo_m / 2)
        if disputed is not None:
            counts &= ~disputed
        if counts.mean() < _MIN_TILE_FRACTION:  # a weight is at most 1
            return i, None
        window = _window(counts)
        if shared is None and pieces[i] is scenes[i].gaussians:
            colour, alpha = seen.colour[0][window], seen.alpha[0][window]
        else:
            local = render(pieces[i], _cropped(camera, window), depth=False, dominant_id=False, index=indices[i])
            colour, alpha = local.colour[0], local.alpha[0]
        weight = alpha * counts[window]
        share = float(weight.sum() / counts.size)
        if share < _MIN_TILE_FRACTION:
            return i, None
        camera, depth, colour = _cropped(camera, window), depth[window], np.clip(colour, 0, 1)
        parts = comparison.compare(i, camera, colour, depth, weight > _MIN_COMPARED_WEIGHT) if done in compared else {}
        image, weight = np.round(colour * 255).astype(np.uint8), np.round(np.clip(weight, 0, 1) * 255).astype(np.uint8)
        return i, _View(camera, image, weight, share, _coarse_points(camera, depth), parts)

    for done, (i, view) in enumerate(map_ahead(make_view, enumerate(todo))):
        progress(done / len(todo), "rendering reference views")
        if view is None:
            continue
        cameras.append(view.camera)
        images.append(view.image)
        weights.append(view.weight)
        kept.append(i)
        shares.append(view.share)
        places.append(view.points)
        comparison.add(view.compared)
    num_rendered = len(kept)
    for i, one in _photos(scenes, pieces, longest_side_px) if photo_weight else ():
        counts = one.counts & inside_pixels(one.camera, one.depth, bounds, halo_m / 2)
        if settled is not None and settled.is_disputed(i):
            counts &= ~settled.outdated_pixels(i, one.camera)
        share = float(counts.mean())
        if share < _MIN_TILE_FRACTION:
            continue
        window = _window(counts)
        cameras.append(_cropped(one.camera, window))
        images.append(np.ascontiguousarray(one.image[window]))
        weights.append(np.where(counts[window], 255, 0).astype(np.uint8))
        kept.append(i)
        shares.append(share)
    often = np.minimum(1.0, np.array(shares) / _FULL_TILE_FRACTION)
    sharpness = comparison.weights()
    for row, (i, points) in enumerate(zip(kept, places, strict=False)):
        often[row] *= _apply(weights[row], sharpness.at(i, points))
    often[num_rendered:] *= photo_weight
    return References(
        _concatenate_cameras(cameras),
        images,
        weights,
        scene=np.array(kept, dtype=np.int64),
        view_weights=often,
        visible_pixels=[
            _visible_pixels(np.where(s > 0, p, 0), w, whole=bounds is None)
            if shared is None
            else _visible_pixels(p, w, whole=bounds is None)[shared.key_of]
            for p, s, w, shared in zip(pixels, sure, largest, reference_views, strict=True)
        ],
        num_photos=len(kept) - num_rendered,
        sharpness=sharpness,
    )


def _photos(
    scenes: Sequence[PosedScene],
    pieces: Sequence[Gaussians],
    longest_side_px: int,
) -> Iterator[tuple[int, photos.PhotoReference]]:
    """Yield photos that show the tile and agree with their scene, each with the index of the scene."""
    candidates = [
        (i, photo, share)
        for i, (scene, piece) in enumerate(zip(scenes, pieces, strict=True))
        for photo in scene.photos
        if (share := float(share_in_view(photo.camera, piece.means)[0])) > 0
    ]
    if len(candidates) > _MAX_PHOTOS:
        most = np.argsort([-share for _, _, share in candidates], kind="stable")[:_MAX_PHOTOS]
        candidates = [candidates[row] for row in sorted(most)]
    for i, photo, _ in candidates:
        one = photos.make_photo_reference(photo, scenes[i], longest_side_px)
        if one is not None:
            yield i, one


_SAMPLE = 600  # number of points by which views are selected if there are too many views


def _best_views(
    todo: list[tuple[int, int, Cameras]], scenes: Sequence[PosedScene], pieces: Sequence[Gaussians], count: int
) -> list[tuple[int, int, Cameras]]:
    """Select at most ``count`` views greedily by coverage, and return them in their original order.

    The gain of a view is the sum over visible points of its resolution in pixels per metre; it is lower for points with
    more selected views, and for older scenes.
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
        # The gain of resolution is limited to that at a distance of a metre.
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
    """Add the pixels that each Gaussian dominates to ``pixels``, undisputed ones to ``sure``; update ``largest``."""
    dominant = seen.dominant_id[0]
    shown = np.bincount(dominant[dominant >= 0], minlength=len(pixels))
    pixels += shown
    if disputed is not None:
        shown = np.bincount(dominant[(dominant >= 0) & ~disputed], minlength=len(pixels))
    sure += shown
    np.maximum(largest, seen.max_weight, out=largest)


def _coarse_points(camera: Cameras, depth: np.ndarray) -> np.ndarray:
    """Return the (h, w, 3) float32 surface points of every `_STRIDE_PX`-th pixel of a depth image."""
    return np.stack(surface_axes(camera, depth, _STRIDE_PX), axis=-1)


def _apply(weights: np.ndarray, coarse: np.ndarray) -> float:
    """Multiply the uint8 pixel weights (H, W) of a view in place by factors of every `_STRIDE_PX`-th pixel; return the
    ratio of the sums after and before."""
    height, width = weights.shape
    before = weights.sum(dtype=np.int64)
    fine = coarse.astype(np.float32).repeat(_STRIDE_PX, 0)[:height].repeat(_STRIDE_PX, 1)[:, :width]
    fine *= weights
    weights[:] = np.rint(fine, out=fine)
    return float(weights.sum(dtype=np.int64) / max(before, 1))


def _window(counts: np.ndarray) -> tuple[slice, slice]:
    """Return the bounding window of the valid pixels, with a margin for the windows of SSIM."""
    spans = []
    for axis in (1, 0):
        used = np.flatnonzero(counts.any(axis=axis))
        low, high = int(used[0]) - _MARGIN_PX, int(used[-1]) + 1 + _MARGIN_PX
        spans.append(slice(max(0, low), min(counts.shape[1 - axis], high)))
    return spans[0], spans[1]


def _cropped(camera: Cameras, window: tuple[slice, slice]) -> Cameras:
    rows, columns = window
    intrinsics = camera.intrinsics_px - [0, 0, columns.start, rows.start]
    size = [[columns.stop - columns.start, rows.stop - rows.start]]
    return Cameras(camera.T_frame_camera, intrinsics, np.array(size), camera.names)


def _visible_pixels(pixels: np.ndarray, largest: np.ndarray, whole: bool) -> np.ndarray:
    """Compute `References.visible_pixels` for one scene.

    Unobserved Gaussians count 0 in a whole scene. In a piece of a scene further views may observe them, so there they
    count half a pixel.
    """
    if not largest.any():
        return np.ones(len(pixels), dtype=np.float32)
    unseen = 0.0 if whole else 0.5
    return np.where(pixels > 0, pixels, np.where(largest > 0, WEIGHT_UNIT * largest, unseen)).astype(np.float32)


def view_schedule(view_weights: np.ndarray, steps: int, seed: int) -> np.ndarray:
    """Return the (steps,) view of each step; views occur in proportion to their weights, spread evenly over time."""
    rng = np.random.default_rng(seed)
    times, views = [], []
    for view, rate in enumerate(view_weights / view_weights.sum()):
        count = int(np.ceil(steps * rate)) + 1
        # Every view is used once in each interval of 1/rate steps, at a random phase.
        times.append((np.arange(count) + rng.random(count)) / rate)
        views.append(np.full(count, view))
    return np.concatenate(views)[np.argsort(np.concatenate(times), kind="stable")][:steps]


def inside_pixels(camera: Cameras, depth: np.ndarray, bounds: np.ndarray | None, band_m: float) -> np.ndarray:
    """Return an (H, W) mask of pixels of a depth image whose surface lies in the bounds enlarged by a band."""
    if bounds is None:
        return np.ones(depth.shape, dtype=bool)
    found: np.ndarray = depth > 0
    for low, high, along in zip(bounds[0] - band_m, bounds[1] + band_m, surface_axes(camera, depth), strict=True):
        found &= (along >= low) & (along < high)
    return found


def _concatenate_cameras(cameras: list[Cameras]) -> Cameras:
    if not cameras:
        return Cameras(np.zeros((0, 4, 4)), np.zeros((0, 4)), np.zeros((0, 2)))
    return Cameras(
        np.concatenate([c.T_frame_camera for c in cameras]),
        np.concatenate([c.intrinsics_px for c in cameras]),
        np.concatenate([c.sizes_px for c in cameras]),
        tuple(str(i) for i in range(len(cameras))),
    )
