"""Measure evidence for or against a pose from renders of both scenes: free space, coinciding surfaces and local
colours."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from gsmap.geometry.transforms import transform_cameras
from gsmap.register.surface import Surface
from gsmap.register.view_cache import ViewCache, ViewImage
from gsmap.render import Rendering, render
from gsmap.types import Sim3

_RADIUS_M = 0.08  # surfaces closer than this coincide
# Depths disagree where they differ by more than the sum of both tolerances, in metres and as a share of the depth.
_DEPTH_TOLERANCE_M = 0.10
_DEPTH_TOLERANCE = 0.02
# Depth of the free space in front of a surface in a synthesized view. Farther from the surface space may be unobserved,
# as no camera of the capture need have looked there.
_SYNTHESIZED_REACH_M = 1.0
_MIN_ALPHA = 0.5  # a fainter pixel shows no surface
# Patterns are compared within patches of _PATTERN_PX pixels where both scenes show one, that is, where RGB in [0, 1]
# has a standard deviation of _MIN_PATTERN. They differ where their correlation is below _PATTERN_CORRELATION and far
# below that of the whole pair.
_PATTERN_PX = 8
_MIN_PATTERN = 0.05
_PATTERN_CORRELATION = 0.1
_PATCH_PX = 16  # colours are compared after the mean over a patch of this size is removed ...
_CELL_M = 0.4  # ... and over a cell of this size for scenes without cameras
_MIN_SEEN = 100  # cameras of a scene that see fewer Gaussians of the other scene are ignored
NUM_CAMERAS = 6  # of each scene, chosen to see most of the other scene
MAX_POINTS = 12_000  # of each scene that are tested for coincidence
OPPONENT = np.array([[0.299, 0.587, 0.114], [1.0, -1.0, 0.0], [0.5, 0.5, -1.0]]).T  # lightness and two chromas of RGB


@dataclass(frozen=True)
class PoseEvidence:
    """Evidence for or against a pose.

    Args:
        overlap: share of one scene's surface cells that coincide with the other scene; the smaller of both directions.
        num_coinciding: source cells that coincide with the target.
        free_space_violation: of one scene's surface Gaussians that the other scene's cameras observe, the share that
            lies in free space and not on an observed surface; the larger of both directions. NaN if the cameras observe
            none. Gaussians behind a surface are occluded and not counted.
        num_seen: number of observed Gaussians, the smaller of both directions; 0 if one direction is missing.
        num_judged: number of observed Gaussians in the direction of ``free_space_violation``.
        colour_correlation: correlation of the colours of both scenes' renders where their depths agree. The mean of
            each patch is subtracted, so neither exposure nor the brightness of whole surfaces counts. Mean over
            lightness and two chromas, the smaller of the available directions; without cameras, the correlation over
            coinciding cells.
        colour_t: significance of the correlation, in standard deviations over patches.
        disagreement: share of the surface area observed in both scenes that differs: it lies in free space or has a
            different pattern. Both directions together; NaN if no camera observes any. It is close to 0 for two
            captures of a place within an hour, whatever the overlap, and larger for changed and aliased places.
        seen_m2: the surface area observed in both scenes, in square metres.
    """

    overlap: float = 0.0
    num_coinciding: int = 0
    free_space_violation: float = float("nan")
    num_seen: int = 0
    colour_correlation: float = 0.0
    colour_t: float = 0.0
    disagreement: float = float("nan")
    seen_m2: float = 0.0
    num_judged: int = 0


Views = tuple[ViewCache, float] | None
"""Cached renders of a scene and metres per unit of the scene; None for a scene without cameras."""


def measure(
    target: Surface,
    source: Surface,
    pose: Sim3,
    views: tuple[Views, Views] = (None, None),
    *,
    num_cameras: int = NUM_CAMERAS,
    max_points: int = MAX_POINTS,
) -> PoseEvidence:
    """Measure the evidence for the pose ``S_target_source`` of two scenes.

    A few cameras of each scene render both scenes: the cameras' own scene entirely, the other scene's surface alone.
    Haze and floaters of the other scene, which its own cameras do not show, would occlude everything from elsewhere.

    Args:
        target, source: surfaces, in metres; so is the pose.
        views: views of the target and of the source.
        num_cameras: number of cameras of each scene, chosen to see most of the other scene.
        max_points: largest number of points of each scene that are tested for coincidence.
    """
    rows_t, rows_s = target.sample(max_points), source.sample(max_points)
    forward, back = pose.apply(source.coarse[0][rows_s]), pose.inverse().apply(target.coarse[0][rows_t])
    distance, row = target.nearest(forward, _RADIUS_M)
    hit = np.isfinite(distance)
    hit_back = np.isfinite(source.nearest(back, _RADIUS_M)[0])
    overlap = min(float(hit.mean()), float(hit_back.mean())) if len(hit) and len(hit_back) else 0.0
    both_ways = [
        None if own is None else _cross_view(*own, other, other_pose, points, num_cameras)
        for own, other, other_pose, points in (
            (views[0], source, pose, forward),
            (views[1], target, pose.inverse(), back),
        )
    ]
    observers = [stats for stats in both_ways if stats is not None and stats.num_seen >= _MIN_SEEN]
    colours = [stats.colour_correlation() for stats in observers]
    if views == (None, None):
        cells = np.floor(forward[hit] / _CELL_M).astype(int)
        cell = np.unique(cells, axis=0, return_inverse=True)[1].ravel()
        camera_free = CrossViewStats.of(0)
        camera_free.add_colours(
            _opponent_colours(target.coarse[1][row[hit]]), _opponent_colours(source.coarse[1][rows_s[hit]]), cell
        )
        colours = [camera_free.colour_correlation()]
    areas = np.sum([stats.areas_m2() for stats in observers], axis=0) if observers else np.zeros(3)
    worst = max(observers, key=lambda stats: stats.free_space_violation, default=None)
    return PoseEvidence(
        overlap=overlap,
        num_coinciding=int(hit.sum()),
        free_space_violation=float("nan") if worst is None else worst.free_space_violation,
        num_seen=min(stats.num_seen for stats in observers) if len(observers) == 2 else 0,
        colour_correlation=min((correlation for correlation, _ in colours), default=0.0),
        colour_t=min((t for _, t in colours), default=0.0),
        disagreement=float(areas[:2].sum() / areas[2]) if areas[2] > 0 else float("nan"),
        seen_m2=float(areas[2]),
        num_judged=0 if worst is None else worst.num_seen,
    )


@dataclass
class CrossViewStats:
    """Comparison of a scene with renders by the cameras of another scene: flags of the scene's Gaussians, and sums of
    colours over patches."""

    in_front: np.ndarray
    agrees: np.ndarray
    products: list[np.ndarray] = field(default_factory=list)  # (patches, 3) each
    squares: np.ndarray = field(default_factory=lambda: np.zeros((2, 3)))
    area_m2: np.ndarray = field(default_factory=lambda: np.zeros(0))  # of each Gaussian, where it was seen best
    # Rows, areas and mean correlations of the Gaussians in each view, as `add_pixels` computes them.
    patterns: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = field(default_factory=list)

    @classmethod
    def of(cls, count: int) -> CrossViewStats:
        return cls(np.zeros(count, bool), np.zeros(count, bool), area_m2=np.zeros(count))

    @property
    def num_seen(self) -> int:
        return int((self.in_front | self.agrees).sum())

    @property
    def free_space_violation(self) -> float:
        return float((self.in_front & ~self.agrees).sum()) / self.num_seen

    def areas_m2(self) -> np.ndarray:
        """Return the (3,) areas of surface in free space, of surface with a different pattern, and of all observed
        surface."""
        through = self.area_m2[self.in_front & ~self.agrees].sum()
        observed = self.area_m2[self.in_front | self.agrees].sum()
        if not self.patterns:
            return np.array([through, 0.0, observed])
        gaussian, area_m2, correlation = (np.concatenate(rows) for rows in zip(*self.patterns, strict=True))
        # Patterns of a noisy capture correlate badly everywhere; a pattern differs only if its correlation is well
        # below that.
        middle, upper = np.quantile(correlation, [0.5, 0.75])
        differs = correlation < min(_PATTERN_CORRELATION, middle - 3 * (upper - middle))
        other = np.zeros(len(self.area_m2))
        np.maximum.at(other, gaussian[differs], area_m2[differs])
        return np.array([through, np.minimum(other, self.area_m2)[self.agrees].sum(), observed])

    def add_pixels(self, gaussian: np.ndarray, area_m2: np.ndarray, correlation: np.ndarray) -> None:
        """Add the pixels of one view.

        Args:
            gaussian: (N,) Gaussian that dominates each pixel.
            area_m2: (N,) surface area of each pixel.
            correlation: (N,) correlation between the patterns of both scenes around each pixel; NaN without a pattern.
        """
        rows, which = np.unique(gaussian, return_inverse=True)
        area = np.bincount(which, area_m2)
        self.area_m2[rows] = np.maximum(self.area_m2[rows], area)
        finite = np.isfinite(correlation)
        if finite.any():
            count = np.bincount(which[finite], minlength=len(rows))
            sums = np.bincount(which[finite], correlation[finite], minlength=len(rows))
            has = count > 0
            self.patterns.append(
                (rows[has], np.bincount(which[finite], area_m2[finite], len(rows))[has], (sums[has] / count[has]))
            )

    def add_colours(self, a: np.ndarray, b: np.ndarray, patch: np.ndarray) -> None:
        """Add lightness and chromas (N, 3) of the same pixels in both scenes; ``patch`` (N,) is the index of each
        pixel's patch."""
        if not len(a):
            return
        a, b = _subtract_means(a, patch), _subtract_means(b, patch)
        self.products.append(_sums(a * b, patch))
        self.squares += (a**2).sum(0), (b**2).sum(0)

    def colour_correlation(self) -> tuple[float, float]:
        """Return the correlation and its t statistic over patches; 0 and 0 where nothing was compared."""
        norm = np.sqrt(self.squares.prod(0))
        if not self.products or not norm.all():
            return 0.0, 0.0
        sums = (np.concatenate(self.products) / norm).mean(1)
        return float(sums.sum()), float(sums.sum() / np.sqrt((sums**2).sum()))


def _cross_view(
    views: ViewCache, unit_m: float, other: Surface, pose: Sim3, points: np.ndarray, num_cameras: int
) -> CrossViewStats:
    """Compare a scene with another scene, moved into its frame by ``pose`` (metres), through its cameras.

    Args:
        points: (N, 3) moved points of the other scene, by which cameras are selected.
    """
    if other.splats is None or not len(other):
        return CrossViewStats.of(0)
    stats = CrossViewStats.of(len(other))
    into_other = pose.inverse() @ Sim3(np.eye(3), np.zeros(3), unit_m)
    for row in views.select_views(points / unit_m, num_cameras):
        camera = transform_cameras(views.cameras[[row]], into_other)
        seen = render(other.splats, camera, index=other.index, backend="native")  # as in `ViewCache`
        focal_px = float(np.sqrt(camera.intrinsics_px[0, :2].prod()))
        reach_m = np.inf if row < views.num_own else _SYNTHESIZED_REACH_M
        _compare(stats, views.image(row), unit_m, seen, pose.scale, focal_px, reach_m)
    return stats


def _compare(
    stats: CrossViewStats,
    own: ViewImage,
    unit_m: float,
    other: Rendering,
    scale: float,
    focal_px: float,
    reach_m: float,
) -> None:
    """Compare both renders of one view; the factors ``unit_m`` and ``scale`` convert the two depth images to metres.

    Args:
        reach_m: space farther than this in front of the surface may be unobserved.
    """
    depth, other_depth = own.depth * unit_m, other.depth[0] * scale
    solid = np.isfinite(depth)
    near, far = _depth_range(depth, solid)
    tolerance = _DEPTH_TOLERANCE_M + _DEPTH_TOLERANCE * np.where(solid, depth, 0)
    both = solid & (other.alpha[0] > _MIN_ALPHA)
    in_front = both & (other_depth < near - tolerance)
    agrees = both & ~in_front & (other_depth <= far + tolerance)
    in_front[in_front] = near[in_front] - other_depth[in_front] <= reach_m  # elsewhere both may be infinite
    assert other.dominant_id is not None
    stats.in_front[other.dominant_id[0][in_front]] = True
    stats.agrees[other.dominant_id[0][agrees]] = True
    rows, columns = np.nonzero(agrees)
    patch = rows // _PATCH_PX * -(-agrees.shape[1] // _PATCH_PX) + columns // _PATCH_PX
    a, b = _opponent_colours(own.colour[agrees]), _opponent_colours(other.colour[0][agrees])
    stats.add_colours(a, b, patch)
    pattern = np.full(agrees.shape, np.nan)
    patch = rows // _PATTERN_PX * -(-agrees.shape[1] // _PATTERN_PX) + columns // _PATTERN_PX
    pattern[agrees] = _pattern_correlation(a, b, patch)
    observed = in_front | agrees
    area_m2 = (other_depth[observed] / focal_px) ** 2
    stats.add_pixels(other.dominant_id[0][observed], area_m2, pattern[observed])


def _pattern_correlation(a: np.ndarray, b: np.ndarray, patch: np.ndarray) -> np.ndarray:
    """Return the (N,) correlation of colours within each pixel's patch; NaN unless both scenes show a pattern."""
    if not len(a):
        return np.zeros(0)
    count = np.bincount(patch)
    a, b = _subtract_means(a, patch), _subtract_means(b, patch)
    aa, bb, ab = (_sums(x * y, patch).sum(1) for x, y in ((a, a), (b, b), (a, b)))
    patterned = (np.minimum(aa, bb) > count * _MIN_PATTERN**2) & (count > _PATTERN_PX**2 // 2)
    out: np.ndarray = np.where(patterned, ab / np.sqrt(np.maximum(aa * bb, 1e-12)), np.nan)[patch]
    return out


def _opponent_colours(colours: np.ndarray) -> np.ndarray:
    """Return (N, 3) lightness and two chromas of RGB."""
    out: np.ndarray = np.clip(colours, 0.0, 1.0) @ OPPONENT
    return out


def _subtract_means(values: np.ndarray, patch: np.ndarray) -> np.ndarray:
    """Subtract the mean of each patch from values (N, 3)."""
    means = _sums(values, patch) / np.maximum(np.bincount(patch), 1)[:, None]
    return values - means[patch]


def _sums(values: np.ndarray, group: np.ndarray) -> np.ndarray:
    return np.stack([np.bincount(group, v) for v in values.T], axis=1)


def _depth_range(depth: np.ndarray, solid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and highest depth in the 3 x 3 neighbourhood of each pixel, which tolerates a shift by a pixel
    at an edge."""
    from scipy.ndimage import maximum_filter, minimum_filter

    low = minimum_filter(np.where(solid, depth, np.inf), 3, mode="nearest")
    return low, maximum_filter(np.where(solid, depth, -np.inf), 3, mode="nearest")
