"""Which of a scene localisation needs, where few bytes are to be had: what of it shows, and features of every view.

Features of a view are kept in the order in which its extractor gave them, as many of every view: views are far apart,
so what is kept covers what the scene shows. Gaussians that hardly show in the scene's own pictures go, and so does what
depends on the direction; the others are merged (`gsmap.export.levels`) as far as must be. What is kept is rounded and
packed (`gsmap.localize.packed_features`, `gsmap.localize.packed_gaussians`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gsmap.geometry.sh import SH_C0
from gsmap.geometry.transforms import sh_basis
from gsmap.localize.placed import PlacedFeatures
from gsmap.render import render
from gsmap.types import Cameras, Gaussians
from gsmap.types.localization import SceneFeatures


@dataclass(frozen=True)
class Params:
    """How a small map is made.

    Args:
        features_share: of a scene's bytes; the rest are Gaussians.
        min_features: of a view. With fewer, hardly a photograph is found.
        min_gaussians: share of those that show in the scene's own pictures. With fewer, renders are full of holes.
        pictures: of its own in which Gaussians are weighed, evenly along its path.
        longest_side_px: size of these.
        min_weight: a Gaussian that nowhere makes up this share of a pixel goes in any case.
        refine_below: where less than this share of the Gaussians is left, they are fitted to renders of what they stand
            for; where more is, merging alone is nearer.
        refine_steps: of that fit, ...
        refine_views: ... from so many of the scene's cameras.
    """

    features_share: float = 0.35
    min_features: int = 40
    min_gaussians: float = 0.15
    pictures: int = 32
    longest_side_px: int = 240
    min_weight: float = 0.02
    refine_below: float = 0.5
    refine_steps: int = 100
    refine_views: int = 32


def shown(scene: PlacedFeatures, cameras: Cameras | None, params: Params) -> tuple[np.ndarray, Gaussians]:
    """How the Gaussians of a scene show in its own pictures.

    Args:
        cameras: of the scene, its frame and unit; with none, the views that photographs are found by.

    Returns:
        (N,) float32 the largest share of a pixel that each makes up, in any picture; and the Gaussians in one colour
        each, the mean of what they show.
    """
    own = cameras if cameras is not None and len(cameras) else scene.features.cameras
    small = own.evenly(params.pictures).resized(params.longest_side_px)
    gaussians = scene.gaussians
    largest = np.zeros(len(gaussians), np.float32)
    colours, total = np.zeros((len(gaussians), 3)), np.zeros((len(gaussians), 1))
    for row in range(len(small)):
        seen = render(gaussians, small[row], depth=False, dominant_id=False, max_weight=True, backend="native")
        np.maximum(largest, seen.max_weight, out=largest)
        rows = np.flatnonzero(seen.max_weight > 0)
        away = gaussians.means[rows] - small.centers[row]
        basis = sh_basis(away / np.linalg.norm(away, axis=1, keepdims=True), gaussians.sh_degree)
        weight = seen.max_weight[rows, None]
        colours[rows] += weight * np.einsum("nk,nkc->nc", basis, gaussians.sh[rows]) / SH_C0
        total[rows] += weight
    mean = np.where(total > 0, colours / np.maximum(total, 1e-12), gaussians.sh[:, 0])
    return largest, replace(gaussians, sh=mean[:, None].astype(np.float32))


def fewer(features: SceneFeatures, total: int) -> SceneFeatures:
    """So many features at most, those that came first in each view: as many of every view that has them."""
    counts = np.sort(np.diff(features.starts))
    rest = total - np.r_[0, np.cumsum(counts)[:-1]]  # for these and all larger ones, once the smaller are whole
    most = int(np.max(np.minimum(rest // np.arange(len(counts), 0, -1), counts), initial=1))
    rows = [np.arange(a, min(b, a + most)) for a, b in zip(features.starts[:-1], features.starts[1:], strict=True)]
    keep = np.concatenate([np.zeros(0, np.int64), *rows])
    return replace(
        features,
        starts=np.r_[0, np.cumsum([len(part) for part in rows])].astype(np.int64),
        points=features.points[keep],
        descriptors=features.descriptors[keep],
        angles=features.angles[keep],
    )


def without(features: SceneFeatures, means: np.ndarray, left_out: np.ndarray) -> SceneFeatures:
    """Features but those on Gaussians that are left out: whose nearest one (of means (N, 3)) is among these (N,)."""
    from scipy.spatial import cKDTree

    _, nearest = cKDTree(means).query(features.points)
    keep = ~left_out[nearest]
    before = np.r_[0, np.cumsum(keep)]
    return replace(
        features,
        starts=before[features.starts].astype(np.int64),
        points=features.points[keep],
        descriptors=features.descriptors[keep],
        angles=features.angles[keep],
    )
