"""Segmenter without a network: parts of the surface, as seen in renders.

The surface is cut into parts once, in 3D (Felzenszwalb and Huttenlocher 2004, "Efficient graph-based image
segmentation", on a neighbour graph of the Gaussians with colour and normal differences as weights). The mask of a part
in a view consists of the pixels that Gaussians of the part dominate, so the masks of one part agree over all views.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmap._native import graph_parts
from gsmap.describe.cloud import downsample, local_planes
from gsmap.geometry.neighbours import nearest_neighbours, nearest_of
from gsmap.settings.ranges import require_range
from gsmap.types.views import Mask, PointCloud, SceneContext, View

VERSION = 2
MODELS: tuple[str, ...] = ()
_NUM_SAMPLES = 20000  # the surface is thinned to about this many points before it is cut
_MIN_SHARE = 0.001  # parts with a smaller share of the samples join their most similar neighbour
_MIN_AREA = 0.002  # masks with a smaller share of the image are dropped
_LIGHTNESS_WEIGHT = 0.5  # of L* relative to a* and b*: shading separates surfaces less than hue
_LAB_SCALE = 5.0  # L*a*b* difference that counts as an edge of weight 1
_TURN_WEIGHT = 3.0  # weight of an edge between perpendicular normals


@dataclass(frozen=True)
class Params:
    """Settings of the built-in segmenter.

    Args:
        scale: Parameter k of Felzenszwalb's segmentation, positive; larger makes fewer and larger parts.
    """

    scale: float = 6.0

    def __post_init__(self) -> None:
        require_range(self, "(0, inf]", "scale")


def make(context: SceneContext, params: Params) -> BuiltinSegmenter:
    """Cut the surface of a scene; see `gsmap.methods.segmenter`."""
    return BuiltinSegmenter(params, context.cloud, context.num_gaussians)


class BuiltinSegmenter:
    """Masks of the surface's parts."""

    is_thread_safe = True

    def __init__(self, params: Params, cloud: PointCloud, num_gaussians: int) -> None:
        self.part_of_gaussian = np.full(num_gaussians + 1, -1)  # the last row is for pixels where nothing was drawn
        if len(cloud):
            self.part_of_gaussian[cloud.index] = cut_surface(cloud, params)

    def segment(self, view: View) -> list[Mask]:
        """Return one mask for each connected blob of pixels that the Gaussians of a part dominate."""
        from scipy import ndimage  # imported here, as the recipe key does not need it

        parts = self.part_of_gaussian[view.dominant_id]
        parts[view.alpha < 0.5] = -1
        masks = []
        for part, place in enumerate(ndimage.find_objects(parts + 1)):
            if place is None:
                continue
            window = tuple(slice(max(0, s.start - 1), s.stop + 1) for s in place)
            if parts[window].size < _MIN_AREA * parts.size:
                continue
            # Closing by a pixel bridges single Gaussians of other parts within a part.
            pixels = _over_3x3(np.logical_and, _over_3x3(np.logical_or, np.pad(parts[window] == part, 2)))
            labels, count = ndimage.label(pixels)
            sizes = np.bincount(labels.ravel(), minlength=count + 1)[1:]
            for i in np.flatnonzero(sizes >= _MIN_AREA * parts.size):
                blob = np.zeros(parts.shape, bool)
                blob[window] = labels == i + 1
                masks.append(Mask(blob, float(view.alpha[blob].mean() * sizes[i] / sizes.sum()), part))
        return masks


def _over_3x3(join: np.ufunc, pixels: np.ndarray) -> np.ndarray:
    """Join each pixel (H, W) with its 8 neighbours; the result has no border pixels (H - 2, W - 2)."""
    rows = join(join(pixels[:-2], pixels[1:-1]), pixels[2:])
    joined: np.ndarray = join(join(rows[:, :-2], rows[:, 1:-1]), rows[:, 2:])
    return joined


def cut_surface(cloud: PointCloud, params: Params) -> np.ndarray:
    """Segment the cloud into parts; return the (N,) part of each point, numbered from 0."""
    # The cell size is such that the surface covers about _NUM_SAMPLES cells.
    cell = float(np.sqrt(cloud.areas.sum() / _NUM_SAMPLES)) or 1e-9
    points, lab = downsample(cloud.points, cloud.lab, cell)
    if len(points) < 16:
        return np.zeros(len(cloud), np.int64)
    normals, _ = local_planes(points, 16)
    distance, neighbours = nearest_neighbours(points, min(9, len(points)))
    a = np.repeat(np.arange(len(points)), neighbours.shape[1] - 1)
    b = neighbours[:, 1:].ravel()
    once = (a < b) | ~(neighbours[b] == a[:, None]).any(1)
    near = distance[:, 1:].ravel() < 3 * cell
    a, b = a[once & near], b[once & near]
    lab = lab[neighbours].mean(1)  # the colour of a single Gaussian is noisy
    difference = (lab[a] - lab[b]) * [_LIGHTNESS_WEIGHT, 1.0, 1.0]
    turn = 1 - np.abs((normals[a] * normals[b]).sum(1))
    weight = np.linalg.norm(difference, axis=1) / _LAB_SCALE + _TURN_WEIGHT * turn
    parts = felzenszwalb(len(points), a, b, weight, params.scale, max(4, int(_MIN_SHARE * len(points))))
    return parts[nearest_of(points, cloud.points)[1]]


def felzenszwalb(
    count: int, a: np.ndarray, b: np.ndarray, weight: np.ndarray, scale: float, min_size: int
) -> np.ndarray:
    """Segment a graph (Felzenszwalb and Huttenlocher 2004); return the (count,) component of each node.

    Edges, in order of weight, join components whose internal differences allow it. Then components smaller than
    ``min_size`` are joined along their lightest edges.
    """
    order = np.argsort(weight, kind="stable")
    ends = [np.ascontiguousarray(end[order], np.int64) for end in (a, b)]
    part = graph_parts(count, *ends, np.ascontiguousarray(weight[order], np.float64), scale, min_size)
    return np.unique(part, return_inverse=True)[1]
