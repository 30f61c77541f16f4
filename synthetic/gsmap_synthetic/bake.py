"""Bake surfaces into a skin: every texel's colour under the place's lamps, looked up by ray casting.

Light is computed once per surface point (direct light with soft shadows, one bounce, a little ambient) and stored as
colour, so a point looks the same from everywhere: what a static, diffuse scene looks like to a camera.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from gsmap._native import QuadRays
from gsmap_synthetic.surfaces import Surfaces

_LEVELS = 4
_LIGHT_STEP_M = 0.15
_TETRAHEDRON = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / np.sqrt(3)


@dataclass(frozen=True, eq=False)
class Skin:
    """Textured quads ready to be looked at.

    Args:
        corners: (Q, 4, 3) float64 corners p00, p10, p11, p01, place frame.
        texels: per level of detail, (T, 3) uint8 display colours of all quads one after another, rows along u.
        offsets: per level, (Q,) where each quad's texels start.
        widths, heights: per level, (Q,) texels along u and v.
        texel_m: edge of a texel of the finest level.
        owners: (Q,) the object a quad belongs to, -1 for none.
        leaves: (Q,) the door whose leaf a quad belongs to, -1 for all that stays.
        shut: the doors that are shut; the leaves of others are not there.
    """

    corners: np.ndarray
    texels: tuple[np.ndarray, ...]
    offsets: tuple[np.ndarray, ...]
    widths: tuple[np.ndarray, ...]
    heights: tuple[np.ndarray, ...]
    texel_m: float
    leaves: np.ndarray
    owners: np.ndarray
    shut: frozenset[int] = frozenset()

    def with_shut(self, doors: Iterable[int]) -> Skin:
        """The same skin with these doors shut and all others open."""
        return replace(self, shut=frozenset(doors))

    @cached_property
    def present(self) -> np.ndarray:
        """Indices of the quads that are there: all but the leaves of open doors."""
        return np.flatnonzero((self.leaves < 0) | np.isin(self.leaves, list(self.shut)))

    def mesh(self) -> tuple[np.ndarray, np.ndarray]:
        """(4n, 3) float32 vertices and (2n, 3) uint32 triangles of the n quads that are there."""
        return self.corners[self.present].reshape(-1, 3).astype(np.float32), _triangles(len(self.present))

    @cached_property
    def _rays(self):
        return QuadRays(self.corners[self.present])

    def cast(self, origins: np.ndarray, directions: np.ndarray):
        """First hits of rays (n, 3): distance in units of the direction (inf for none), quad index, and its (s, t)."""
        distance, triangle, b1, b2 = self._rays.cast(*rays(origins, directions))
        triangle = np.maximum(triangle, 0)
        first = triangle % 2 == 0  # (p00, p10, p11), the other is (p00, p11, p01)
        s, t = np.where(first, b1 + b2, b1), np.where(first, b2, b1 + b2)
        return distance, self.present[triangle // 2], s, t

    def colour(self, quad: np.ndarray, s: np.ndarray, t: np.ndarray, footprint_m: np.ndarray) -> np.ndarray:
        """(n, 3) float32 display colours in [0, 1] at (s, t) of quads, averaged over about ``footprint_m``."""
        level = np.clip(np.round(np.log2(np.maximum(footprint_m, 1e-6) / self.texel_m)), 0, _LEVELS - 1).astype(int)
        out = np.empty((len(quad), 3), np.float32)
        for k in range(_LEVELS):
            pick = np.flatnonzero(level == k)
            q, w, h = quad[pick], self.widths[k][quad[pick]], self.heights[k][quad[pick]]
            x = np.clip((s[pick] * w).astype(np.int64), 0, w - 1)
            y = np.clip((t[pick] * h).astype(np.int64), 0, h - 1)
            out[pick] = self.texels[k][self.offsets[k][q] + y * w + x]
        return out / np.float32(255)


def _triangles(count: int) -> np.ndarray:
    base = 4 * np.arange(count, dtype=np.uint32)[:, None]
    return (base[:, :, None] + np.array([[0, 1, 2], [0, 2, 3]], np.uint32)).reshape(-1, 3)


def rays(origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return origins and directions (n, 3) as `QuadRays` takes them."""
    return np.ascontiguousarray(origins, np.float64), np.ascontiguousarray(directions, np.float64)


def bake(
    surfaces: Surfaces,
    *,
    texel_m: float = 0.008,
    progress: Callable[[float, str], None] | None = None,
) -> Skin:
    """Paint and light every quad of ``surfaces``."""
    report = progress or (lambda fraction, text: None)
    corners = np.stack(surfaces.corners)
    sizes = np.array(surfaces.sizes_m)
    report(0.0, "painting surfaces")
    albedo = [_paint(surfaces, q, texel_m) for q in range(len(corners))]
    report(0.5, "lighting surfaces")
    leaves = np.array(surfaces.leaves)
    grids, light = _light(surfaces, corners, sizes, np.stack([a.mean((0, 1)) for a in albedo]))
    report(0.8, "baking colours")
    ends = np.cumsum([g[0] * g[1] for g in grids])
    images = []
    for q, paint in enumerate(albedo):
        nu, nv = grids[q]
        lit = _enlarge(light[ends[q] - nu * nv : ends[q]].reshape(nv, nu, 3), *paint.shape[:2])
        glow = surfaces.glows[q]
        images.append(_display(paint * (lit * (1 - glow) + 1.1 * glow)))
    texels, offsets, widths, heights = _pack(images)
    return Skin(corners, texels, offsets, widths, heights, texel_m, leaves, np.array(surfaces.owners))


def _paint(surfaces: Surfaces, q: int, texel_m: float) -> np.ndarray:
    """(h, w, 3) float32 linear-light albedo of one quad."""
    (width, height), (u0, v0) = surfaces.sizes_m[q], surfaces.origins_m[q]
    w, h = max(1, round(width / texel_m)), max(1, round(height / texel_m))
    u, v = np.meshgrid((np.arange(w) + 0.5) * (width / w), (np.arange(h) + 0.5) * (height / h))
    return surfaces.materials[q](u.astype(np.float32) + u0, v.astype(np.float32) + v0, (width, height)).astype(
        np.float32
    )


def mean_albedo(surfaces: Surfaces, quads: Iterable[int]) -> np.ndarray:
    """(3,) linear-light colour of some quads, averaged over their area."""
    painted = [_paint(surfaces, q, 0.05).reshape(-1, 3) for q in quads]
    return np.concatenate(painted).mean(0)


def _light(surfaces: Surfaces, corners, sizes, mean_albedo):
    """Irradiance on a coarse grid of every quad: the grids' (nu, nv) and all values (P, 3), normalised in exposure."""
    standing = np.flatnonzero(np.array(surfaces.leaves) < 0)  # Doors stand open while the lamps shine.
    scene = QuadRays(corners[standing])
    grids = np.clip(np.ceil(sizes / _LIGHT_STEP_M).astype(int) + 1, 2, 64)
    at, facing = [], []
    for q, (nu, nv) in enumerate(grids):
        s, t = (a[..., None] for a in np.meshgrid(np.linspace(0.03, 0.97, nu), np.linspace(0.03, 0.97, nv)))
        p00, p10, p11, p01 = corners[q]
        at.append(((1 - s) * (1 - t) * p00 + s * (1 - t) * p10 + s * t * p11 + (1 - s) * t * p01).reshape(-1, 3))
        normal = np.cross(p11 - p00, p01 - p10)
        facing.append(np.broadcast_to(normal / max(np.linalg.norm(normal), 1e-12), at[-1].shape))
    points, normals = np.concatenate(at), np.concatenate(facing)
    points = points + 0.004 * normals
    light = _direct(scene, surfaces.lamps, points, normals)

    # One bounce: what cosine-distributed rays meet, with that quad's mean colour and mean light.
    starts = np.concatenate([[0], np.cumsum(grids.prod(1))[:-1]])
    radiosity = mean_albedo * np.add.reduceat(light, starts) / grids.prod(1)[:, None]
    radiosity += 1.2 * mean_albedo * np.array(surfaces.glows)[:, None]
    bounce = np.zeros_like(light)
    num_rays = 24
    directions = _hemisphere(num_rays)
    tangent = np.cross(normals, np.where(np.abs(normals[:, 2:]) > 0.9, [1.0, 0, 0], [0, 0, 1.0]))
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-12)
    bitangent = np.cross(normals, tangent)
    for x, y, z in directions:
        _, triangle, _, _ = scene.cast(*rays(points, x * tangent + y * bitangent + z * normals))
        found = triangle >= 0
        bounce[found] += radiosity[standing[triangle[found] // 2]] / num_rays
    total = light + 1.5 * bounce + 0.04
    # A point inside other furniture is dark for a reason; expose for the ones that are not.
    return grids, (total * (0.85 / np.median(total[total.mean(1) > 0.1]))).astype(np.float32)


def _direct(scene, lamps, points, normals) -> np.ndarray:
    """Light straight from the lamps, each a small ball sampled 4 times for soft shadows."""

    light = np.zeros((len(points), 3))
    for position, colour, radius in lamps:
        near = np.flatnonzero(np.linalg.norm(points - position, axis=1) < 8.0)
        for corner in _TETRAHEDRON:
            way = position + radius * corner - points[near]
            distance = np.linalg.norm(way, axis=1)
            cosine = (way * normals[near]).sum(1) / distance
            lit = np.flatnonzero(cosine > 0)
            lit = lit[scene.occluded(*rays(points[near[lit]], way[lit]), 0.98) == 0]
            light[near[lit]] += 0.25 * colour * (cosine[lit] / (distance[lit] ** 2 + 0.15))[:, None]
    return light


def _hemisphere(count: int) -> np.ndarray:
    """Cosine-distributed directions around +z, stratified (a sunflower)."""
    k = np.arange(count) + 0.5
    r, phi = np.sqrt(k / count), k * np.pi * (3 - np.sqrt(5))
    return np.stack([r * np.cos(phi), r * np.sin(phi), np.sqrt(1 - r * r)], axis=1)


def _enlarge(grid: np.ndarray, height: int, width: int) -> np.ndarray:
    """Bilinear interpolation of a (nv, nu, 3) grid spanning a quad to its (height, width) texels."""
    nv, nu = grid.shape[:2]
    y, x = (np.arange(height) + 0.5) / height * (nv - 1), (np.arange(width) + 0.5) / width * (nu - 1)
    y0, x0 = np.minimum(y.astype(int), nv - 2), np.minimum(x.astype(int), nu - 2)
    fy, fx = (y - y0).astype(np.float32)[:, None, None], (x - x0).astype(np.float32)[None, :, None]
    rows = grid[y0] * (1 - fy) + grid[y0 + 1] * fy
    return rows[:, x0] * (1 - fx) + rows[:, x0 + 1] * fx


def _display(linear: np.ndarray) -> np.ndarray:
    """Display colours of linear light: a soft shoulder, then gamma."""
    return (1.0 - np.exp(-1.15 * linear)) ** np.float32(1 / 2.2)


def _pack(images: list[np.ndarray]):
    """Texels, offsets, widths and heights of each level of detail of all images, see `Skin`."""
    texels, offsets, widths, heights = [], [], [], []
    for level in range(_LEVELS):
        if level:
            images = [_half(image) for image in images]
        widths.append(np.array([i.shape[1] for i in images]))
        heights.append(np.array([i.shape[0] for i in images]))
        areas = widths[-1] * heights[-1]
        offsets.append(np.concatenate([[0], np.cumsum(areas)[:-1]]))
        flat = np.concatenate([i.reshape(-1, 3) for i in images])
        texels.append(np.clip(np.round(flat * 255), 0, 255).astype(np.uint8))
    return tuple(texels), tuple(offsets), tuple(widths), tuple(heights)


def _half(image: np.ndarray) -> np.ndarray:
    """The image at half resolution (box filter; odd edges repeat their last texel)."""
    h, w = image.shape[:2]
    if h % 2 and h > 1:
        image = np.concatenate([image, image[-1:]])
    if w % 2 and w > 1:
        image = np.concatenate([image, image[:, -1:]], axis=1)
    rows = image if h == 1 else 0.5 * (image[0::2] + image[1::2])
    return rows if w == 1 else 0.5 * (rows[:, 0::2] + rows[:, 1::2])
