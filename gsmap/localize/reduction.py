"""Reduce a scene to what localization needs, for small maps.

Every view keeps the same number of features, the first of its extractor, so that the whole scene stays covered.
View-dependent colour and Gaussians that contribute little to the scene's own views are dropped; the remaining Gaussians
are merged (`gsmap.export.levels`) until they fit the size. Then both are packed (`gsmap.localize.packed_features`,
`gsmap.localize.packed_gaussians`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsmap.geometry.sh import SH_C0
from gsmap.geometry.transforms import sh_basis
from gsmap.localize.map_scene import MapScene
from gsmap.render import render
from gsmap.types import Cameras, Gaussians
from gsmap.types.localization import SceneFeatures

FEATURES_FRACTION = 0.35
"""Share of a scene's bytes for features; the rest is for Gaussians."""

MIN_FEATURES = 40
"""With fewer features per view hardly any photo is localized."""

MIN_GAUSSIANS_FRACTION = 0.15
"""With a smaller share of the visible Gaussians renders are full of holes."""

MIN_BLENDING_WEIGHT = 0.02
"""A Gaussian is dropped if its largest blending weight in any view is smaller."""

REFINE_BELOW_FRACTION = 0.5
"""If a smaller share of the Gaussians remains, merged Gaussians are fitted to renders; with more, merging alone is
closer."""

REFINE_STEPS, REFINE_VIEWS = 100, 32
"""Number of iterations of that fit, and of views that it uses."""

_VIEWS, _VIEW_SIDE_PX = 32, 240  # number and size of the own views in which blending weights are measured


def measure_visibility(scene: MapScene, cameras: Cameras | None) -> tuple[np.ndarray, Gaussians]:
    """Measure the blending weights of a scene's Gaussians in the scene's own views.

    Args:
        cameras: cameras of the scene, in its frame and unit; by default the cameras of its features.

    Returns:
        The (N,) float32 largest blending weight of each Gaussian in any view; and the Gaussians with one colour each,
        the mean colour in these views.
    """
    own = cameras if cameras is not None and len(cameras) else scene.features.cameras
    small = own.evenly(_VIEWS).resized(_VIEW_SIDE_PX)
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


def limit_features(features: SceneFeatures, total: int) -> SceneFeatures:
    """Keep at most ``total`` features: the first features of each view, evenly over views."""
    counts = np.sort(np.diff(features.starts))
    # What is left for this and all larger views, if the smaller views are complete.
    rest = total - np.r_[0, np.cumsum(counts)[:-1]]
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


def remove_features(features: SceneFeatures, means: np.ndarray, removed: np.ndarray) -> SceneFeatures:
    """Remove the features whose nearest Gaussian is removed; ``means`` (N, 3) and ``removed`` (N,) describe the
    Gaussians."""
    from scipy.spatial import cKDTree

    _, nearest = cKDTree(means).query(features.points)
    keep = ~removed[nearest]
    before = np.r_[0, np.cumsum(keep)]
    return replace(
        features,
        starts=before[features.starts].astype(np.int64),
        points=features.points[keep],
        descriptors=features.descriptors[keep],
        angles=features.angles[keep],
    )
