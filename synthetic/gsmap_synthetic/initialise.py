"""Where a trainer starts: Gaussians laid on the surfaces that depth frames show."""

from __future__ import annotations

import numpy as np

from gsmap.errors import InputError
from gsmap.geometry.rotations import matrices_to_quats
from gsmap.geometry.sh import sh0_of_rgb
from gsmap.types import Gaussians
from gsmap_synthetic.capture import Frames

_EVEN = 0.02  # Weight of a blank surface against one of that contrast per pixel.
_REACH = 0.6


def from_depth(frames: Frames, count: int, seed: int = 0) -> Gaussians:
    """``count`` flat Gaussians on the surface the depth frames show, more of them where the picture has detail.

    Every second pixel is back-projected, points are averaged in small cells, and cells are drawn with a weight that
    grows with local contrast. Each Gaussian gets the mean colour of the cells nearest to it, lies along the surface
    and reaches half way to its neighbours.

    Raises:
        InputError: frames without depth, or with almost none.
    """
    from scipy.spatial import cKDTree

    points, colours, normals, detail = _back_project(frames)
    if len(points) < 100:
        raise InputError(f"only {len(points)} pixels have a usable depth: check the depth's unit and the poses")
    points, colours, normals, detail, hits = _average_in_cells(points, colours, normals, detail, count)
    # What few pixels show, from afar or in passing, needs few Gaussians: the loss counts pixels too.
    weight = (_EVEN + detail) * np.minimum(1.0, hits / np.median(hits))
    chosen = _draw_evenly(weight, count, seed)
    means = points[chosen]
    tree = cKDTree(means)
    owner = tree.query(points)[1]
    total = np.bincount(owner, minlength=len(means))[:, None]
    mean_colours = np.stack([np.bincount(owner, colours[:, k], len(means)) for k in range(3)], axis=1) / total
    # On a plane with one Gaussian per area a, the eighth neighbour is about 1.6 sqrt(a) away: reach sets sigma to
    # _REACH of sqrt(a), which leaves no holes. A lone speck must not become a beach ball.
    reach = _REACH / 1.6 * tree.query(means, k=min(9, len(means)))[0][:, -1]
    reach = np.minimum(reach, 4 * np.median(reach))
    scales = np.stack([reach, reach, np.maximum(0.2 * reach, 1e-4)], axis=1)
    n = len(means)
    return Gaussians(
        means,
        matrices_to_quats(_frames_of_normals(normals[chosen])),
        np.log(scales),
        np.full(n, np.log(0.9 / 0.1)),
        sh0_of_rgb(mean_colours)[:, None, :],
    )


def from_features(frames: Frames, count: int, seed: int = 0) -> Gaussians:
    """``count`` round Gaussians where the picture has most contrast, as a trainer starts from the triangulated features
    of a few photographs: blank surfaces and the sky have none.

    Raises:
        InputError: frames without depth, or with almost none.
    """
    from scipy.spatial import cKDTree

    points, colours, _, detail = _back_project(frames)
    if len(points) < 100:
        raise InputError(f"only {len(points)} pixels have a usable depth: check the depth's unit and the poses")
    rng = np.random.default_rng([seed, 9])
    weight = np.maximum(detail - np.quantile(detail, 0.6), 0)
    chosen = rng.choice(len(points), count, replace=False, p=weight / weight.sum())
    apart = cKDTree(points[chosen]).query(points[chosen], k=4)[0][:, 1:].mean(1)
    reach = 0.7 * np.clip(apart, *np.quantile(apart, [0.05, 0.95]))
    n = len(chosen)
    sh = sh0_of_rgb(colours[chosen])[:, None, :]
    return Gaussians(
        points[chosen], np.tile([1.0, 0, 0, 0], (n, 1)), np.log(np.tile(reach[:, None], 3)), np.zeros(n), sh
    )


def from_colour(frames: Frames, count: int, near: float, far: float, seed: int = 0) -> Gaussians:
    """``count`` Gaussians at random depths along random pixels' rays, for frames without depth (units of the poses)."""
    rng = np.random.default_rng([seed, 6])
    c, h, w = frames.images.shape[:3]
    view, y, x = rng.integers(c, size=count), rng.integers(h, size=count), rng.integers(w, size=count)
    depth = near * (far / near) ** rng.uniform(size=count)
    fx, fy, cx, cy = frames.cameras.intrinsics_px[view].T
    local = np.stack([(x + 0.5 - cx) / fx, (y + 0.5 - cy) / fy, np.ones(count)], axis=1) * depth[:, None]
    pose = frames.cameras.T_frame_camera[view]
    means = np.einsum("nij,nj->ni", pose[:, :3, :3], local) + pose[:, :3, 3]
    scales = np.repeat((2.0 * depth / fx * np.sqrt(c * h * w / count) * 0.25)[:, None], 3, axis=1)
    quats = np.tile([1.0, 0, 0, 0], (count, 1))
    sh = sh0_of_rgb(frames.images[view, y, x] / 255.0)[:, None, :]
    return Gaussians(means, quats, np.log(scales), np.full(count, np.log(0.1 / 0.9)), sh)


def _back_project(frames: Frames, stride: int = 2):
    """Points, colours, surface normals (facing the camera) and local contrast of every ``stride``-th pixel."""
    if frames.depths_m is None:
        raise InputError("these frames have no depth: give depth images, or start from colour alone")
    parts = []
    for i in range(len(frames)):
        depth, image = frames.depths_m[i], frames.images[i].astype(np.float32) / 255
        fx, fy, cx, cy = frames.cameras.intrinsics_px[i]
        y, x = np.mgrid[0 : depth.shape[0], 0 : depth.shape[1]]
        local = np.stack([(x + 0.5 - cx) / fx, (y + 0.5 - cy) / fy, np.ones_like(depth)], axis=-1) * depth[..., None]
        du, dv = _central(local, 1), _central(local, 0)
        normal = np.cross(du, dv)
        length = np.linalg.norm(normal, axis=-1)
        # At a jump in depth the differences span nothing real: leave such pixels out.
        jump = np.maximum(np.abs(du[..., 2]), np.abs(dv[..., 2])) > 0.06 * depth
        normal /= np.maximum(length, 1e-12)[..., None]
        normal *= np.where((normal * local).sum(-1, keepdims=True) > 0, -1, 1)
        contrast = np.sqrt((_central(image, 1) ** 2 + _central(image, 0) ** 2).sum(-1))
        use = (depth > 0) & ~jump & (length > 0) & (x % stride == i % stride) & (y % stride == (i // 2) % stride)
        pose = frames.cameras.T_frame_camera[i]
        points = local[use] @ pose[:3, :3].T + pose[:3, 3]
        parts.append((points, image[use], normal[use] @ pose[:3, :3].T, contrast[use]))
    return tuple(np.concatenate(p) for p in zip(*parts, strict=True))


def _central(image: np.ndarray, axis: int) -> np.ndarray:
    """Central difference along an axis, edges repeated."""
    padded = np.pad(image, [(1, 1) if a == axis else (0, 0) for a in range(image.ndim)], mode="edge")
    first = [slice(None)] * image.ndim
    last = list(first)
    first[axis], last[axis] = slice(0, -2), slice(2, None)
    return 0.5 * (padded[tuple(last)] - padded[tuple(first)])


def _average_in_cells(points, colours, normals, detail, count):
    """Means over cubic cells small enough that about five times ``count`` of them are occupied."""
    extent = np.ptp(points, axis=0).max()
    low, high = extent / 4096, extent / 8
    for _ in range(12):
        cell = np.sqrt(low * high)
        inverse, occupied = _cells(points, cell)
        low, high = (cell, high) if occupied > 5 * count else (low, cell)
        if 4.4 * count < occupied < 5.6 * count:
            break
    total = np.bincount(inverse, minlength=occupied)

    def mean(a):
        return np.stack([np.bincount(inverse, a[:, k], occupied) for k in range(a.shape[1])], axis=1) / total[:, None]

    normal = mean(normals)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    return mean(points), mean(colours), normal, mean(detail[:, None])[:, 0], total


def _cells(points: np.ndarray, cell: float) -> tuple[np.ndarray, int]:
    key = np.floor((points - points.min(0)) / cell).astype(np.int64)
    code = np.zeros(len(key), np.int64)
    for bit in range(int(key.max()).bit_length()):  # Z-order: neighbours in space are neighbours in the list of cells.
        for axis in range(3):
            code |= ((key[:, axis] >> bit) & 1) << (3 * bit + axis)
    unique, inverse = np.unique(code, return_inverse=True)
    return inverse, len(unique)


def _draw_evenly(weight: np.ndarray, count: int, seed: int) -> np.ndarray:
    """Indices of ``count`` items in proportion to weight, spread evenly along their order: no clumps, no gaps."""
    ends = np.cumsum(weight)
    start = np.random.default_rng([seed, 6]).uniform()
    return np.unique(
        np.searchsorted(ends, (np.arange(count) + start) * (ends[-1] / count), side="right").clip(max=len(ends) - 1)
    )


def _frames_of_normals(normals: np.ndarray) -> np.ndarray:
    """(N, 3, 3) rotations whose third axis is the normal."""
    helper = np.where(np.abs(normals[:, :1]) < 0.8, [1.0, 0, 0], [0, 1.0, 0])
    x = np.cross(helper, normals)
    x /= np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-12)
    z = normals
    bad = np.linalg.norm(z, axis=1) < 0.5
    x[bad], z = [1, 0, 0], np.where(bad[:, None], [0, 0, 1.0], z)
    return np.stack([x, np.cross(z, x), z], axis=2)
