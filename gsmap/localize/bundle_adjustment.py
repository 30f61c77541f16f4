"""Adjust photos of one place jointly: a bundle adjustment that uses the poses from the map as priors.

Features that several localized photos share are triangulated. Then photos without a pose are resected one after
another, if they show enough triangulated points, or points with a depth from the map. Finally one least-squares problem
estimates all poses and points from reprojection errors and the poses from the map.

Poses from the map have correlated errors, because maps bend and the content of renders is displaced; features of
neighbouring photos have correlated errors, too. Therefore covariances are computed with priors and feature noise that
are inflated with the number of photos. They are scaled by the disagreement of the adjustment with the poses from the
map (variance of unit weight).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from gsmap.geometry.projection import project
from gsmap.localize import resection

# Chosen by ``tools/fit/clips.py PLACES bundle``.
MIN_POINTS = 12
"""Smallest number of features of a photo that must agree with known points for the photo to be resected."""

MIN_SUPPORTERS = 2
"""Smallest number of photos that must each contribute half of these features, since repeated structures can mislead one
photo."""

MAX_ERROR_PX = 4.0
"""Largest reprojection error of an inlier, for a photo of 480 pixels."""

TOLERANCES = (2.0, 1.0)
"""Factors on `MAX_ERROR_PX` in successive adjustments."""

MAX_SHIFT_SIGMAS = 8.0
"""Largest difference of an adjusted pose from the pose from the map, in sigmas; a photo with a larger one is left
out."""

ROBUST_SIGMAS = 1.0
"""Scale of Cauchy's loss on features and on poses from the map."""

POSE_CORRELATION = 0.35
"""Correlation of the errors of poses from the map, for the covariance."""

CORRELATED_FEATURE_PX = 1.6
"""Standard deviation of a feature in pixels, for the covariance."""

VARIANCE_PRIOR = 4.0
"""Number of imaginary photos with the expected disagreement, in the variance of unit weight."""

_MIN_SINE = 0.02  # of the angle between the rays from which a point is triangulated
_MAX_POINTS = 150  # points per photo, those in most photos first
_FEATURE_PX = 1.0  # standard deviation of a feature
_DEPTH_SIGMA_M = 0.05  # of a point with a depth from the map
_DISAGREEMENT_WEIGHT = 2.5  # of the disagreement in the variance of unit weight
_CHI2_MEDIAN = 5.35  # of six degrees of freedom
_LENS_SIGMA = 0.03  # relative, of the median focal length from the map
_POINT_SIGMA_M = 10.0  # weak prior that keeps points determined after they lost their photos
_MIN_DEPTH_M = 0.1
_POSE, _POINT, _LENS = "x", "l", "k"


@dataclass(frozen=True, eq=False)
class BundlePhoto:
    """A photo as input of the adjustment.

    Args:
        pixels: (N, 2) positions of the photo's features.
        intrinsics_px: (4,) ``fx fy cx cy``.
        size_px: width and height.
        focal_sigma: as in `gsmap.types.localization.Photo`; photos of one size share a lens.
        T_metric_camera: (4, 4) pose from the map; None without one.
        covariance: (6, 6) covariance of that pose.
        rows, points: (n,) features that have a depth from the map, and their (n, 3) positions.
    """

    pixels: np.ndarray
    intrinsics_px: np.ndarray
    size_px: tuple[int, int]
    focal_sigma: float = 0.0
    T_metric_camera: np.ndarray | None = None
    covariance: np.ndarray | None = None
    rows: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    points: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))


@dataclass(frozen=True, eq=False)
class AdjustedPose:
    """The pose of a photo after the adjustment.

    Args:
        T_metric_camera: (4, 4).
        intrinsics_px: (4,).
        covariance: (6, 6) over [rot_rad, trans] on the camera's side.
        num_points: number of the photo's features in the adjustment.
        resected_from: photos from which the photo was resected, sorted by their number of common points; empty if it
            has a pose from the map.
    """

    T_metric_camera: np.ndarray
    intrinsics_px: np.ndarray
    covariance: np.ndarray
    num_points: int
    resected_from: tuple[int, ...] = ()


Matches = Mapping[tuple[int, int], tuple[np.ndarray, np.ndarray]]
"""Rows of matching features for each pair of photos, in both orders of the pair."""


def adjust_photos(photos: Sequence[BundlePhoto], matches: Matches) -> tuple[dict[int, AdjustedPose], list[int]]:
    """Adjust the photos that have poses from the map, and resect further photos from them; empty with fewer than two
    poses.

    Args:
        photos: in one frame, metres.

    Returns:
        The poses, and the photos that were left out because the adjustment moved them far from their pose from the map:
        one of the two poses is wrong.
    """
    photos = _share_lenses(photos)
    displaced: list[int] = []
    while sum(one.T_metric_camera is not None for one in photos) >= 2:
        at = {k: one.T_metric_camera for k, one in enumerate(photos) if one.T_metric_camera is not None}
        resected: dict[int, tuple[int, ...]] = {}
        tried: set[int] = set()
        at = _adjust(photos, at, resected, matches)
        while (best := _resect_next(photos, at, tried, matches)) is not None:
            tried.add(best.photo)
            resected[best.photo] = best.resected_from
            at = _adjust(photos, at | {best.photo: best.pose}, resected, matches)
        resected = {k: others for k, others in resected.items() if k in at}
        shifts = {k: _squared_shift(photos[k], pose) for k, pose in at.items() if k not in resected}
        worst = max(shifts, key=lambda k: shifts[k])
        if shifts[worst] <= MAX_SHIFT_SIGMAS**2:
            return _with_covariances(_BundleProblem.build(photos, at, resected, matches, TOLERANCES[-1])), displaced
        displaced.append(worst)
        photos[worst] = replace(photos[worst], T_metric_camera=None)
        matches = {pair: rows for pair, rows in matches.items() if worst not in pair}
    if displaced:  # the last two photos contradict each other, and nothing decides between them
        displaced += [k for k, one in enumerate(photos) if one.T_metric_camera is not None]
    return {}, displaced


def _share_lenses(photos: Sequence[BundlePhoto]) -> list[BundlePhoto]:
    """Set unknown focal lengths to the median of those that the map determined for photos of the same size."""
    out = list(photos)
    for size in {one.size_px for one in photos if resection.is_free(one.focal_sigma)}:
        same = [k for k, one in enumerate(photos) if one.size_px == size and resection.is_free(one.focal_sigma)]
        known = [photos[k].intrinsics_px for k in same if photos[k].T_metric_camera is not None]
        for k in same if known else []:
            out[k] = replace(photos[k], intrinsics_px=np.median(known, axis=0))
    return out


def _resect_next(
    photos: Sequence[BundlePhoto], at: Mapping[int, np.ndarray], tried: set[int], matches: Matches
) -> _ResectedPhoto | None:
    """Resect the photo that sees most known points, of all photos without a pose that were not tried before."""
    left = [k for k in range(len(photos)) if k not in at and k not in tried]
    if not left:
        return None
    structure = _triangulate(photos, at, _consistent_matches(photos, at, matches, TOLERANCES[-1]))
    found = [_resect(k, photos, at, structure, matches) for k in left]
    return max((one for one in found if one is not None), key=lambda one: one.num_points, default=None)


def _squared_shift(photo: BundlePhoto, pose: np.ndarray) -> float:
    """Return the squared Mahalanobis distance of a pose from the photo's pose from the map."""
    assert photo.T_metric_camera is not None
    assert photo.covariance is not None
    xi = resection.relative_xi(photo.T_metric_camera, pose)
    return float(xi @ np.linalg.solve(photo.covariance, xi))


def _rays(photo: BundlePhoto, pose: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return (K, 3) unit vectors towards the features at ``rows``."""
    fx, fy, cx, cy = photo.intrinsics_px
    x, y = photo.pixels[rows].T
    local = np.stack([(x - cx) / fx, (y - cy) / fy, np.ones(len(rows))], axis=1)
    out: np.ndarray = local @ pose[:3, :3].T
    return out / np.linalg.norm(out, axis=1, keepdims=True)


PairMatches = dict[tuple[int, int], tuple[np.ndarray, np.ndarray]]


def _consistent_matches(
    photos: Sequence[BundlePhoto], at: Mapping[int, np.ndarray], matches: Matches, tolerance: float
) -> PairMatches:
    """Return those matches of all pairs of photos whose rays meet in front of both cameras."""
    out = {}
    for k in at:
        for other in at:
            if other < k and (k, other) in matches:
                out[k, other] = _consistent_pair(k, other, photos, at, matches, tolerance)
    return out


def _consistent_pair(
    k: int,
    other: int,
    photos: Sequence[BundlePhoto],
    at: Mapping[int, np.ndarray],
    matches: Matches,
    tolerance: float,
) -> tuple[np.ndarray, np.ndarray]:
    rows, columns = matches[k, other]
    one, two = _rays(photos[k], at[k], rows), _rays(photos[other], at[other], columns)
    between = at[other][:3, 3] - at[k][:3, 3]
    cosine = (one * two).sum(1)
    sine = np.maximum(1 - cosine**2, 1e-9)
    along, back = one @ between, two @ between
    near = at[k][:3, 3] + ((along - cosine * back) / sine)[:, None] * one
    far = at[other][:3, 3] + ((cosine * along - back) / sine)[:, None] * two
    keep = np.ones(len(rows), bool)
    for number, of_photo in ((k, rows), (other, columns)):
        keep &= _is_inlier(photos[number], at[number], (near + far) / 2, of_photo, tolerance)
    return rows[keep], columns[keep]


def _is_inlier(
    photo: BundlePhoto, pose: np.ndarray, points: np.ndarray, rows: np.ndarray, tolerance: float
) -> np.ndarray:
    """Return a (K,) mask of points that lie in front of the camera and project to the features."""
    pixels, depth = project(points, np.linalg.inv(pose), photo.intrinsics_px)
    bar = tolerance * MAX_ERROR_PX * max(photo.size_px) / 480
    out: np.ndarray = (depth > _MIN_DEPTH_M) & (np.linalg.norm(pixels - photo.pixels[rows], axis=1) < bar)
    return out


@dataclass(frozen=True, eq=False)
class _Structure:
    """Points with their observations.

    Args:
        points: (T, 3) positions, sorted by their number of photos, largest first.
        photo, row, point: (M,) photo, feature and point of each of M observations.
    """

    points: np.ndarray
    photo: np.ndarray
    row: np.ndarray
    point: np.ndarray


def _triangulate(photos: Sequence[BundlePhoto], at: Mapping[int, np.ndarray], pairs: PairMatches) -> _Structure:
    """Triangulate the tracks of matched features."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    first = np.r_[0, np.cumsum([len(one.pixels) for one in photos])]
    edges = [np.stack([first[k] + a, first[other] + b]) for (k, other), (a, b) in pairs.items()]
    one, two = np.concatenate([np.zeros((2, 0), np.int64), *edges], axis=1)
    count = int(first[-1])
    _, of = connected_components(coo_matrix((np.ones(len(one)), (one, two)), (count, count)), directed=False)
    feature = np.unique(np.r_[one, two])
    photo = np.searchsorted(first, feature, side="right") - 1
    _, place, times = np.unique(of[feature] * len(photos) + photo, return_inverse=True, return_counts=True)
    unique = times[place] == 1  # two features of one photo in a track contradict each other
    feature, photo, of = feature[unique], photo[unique], of[feature][unique]
    of = np.unique(of, return_inverse=True)[1]
    rays = np.zeros((len(feature), 3))
    for k in np.unique(photo):
        of_photo = photo == k
        rays[of_photo] = _rays(photos[k], at[k], feature[of_photo] - first[k])
    centres = np.stack([at[k][:3, 3] for k in photo]) if len(photo) else np.zeros((0, 3))
    across = np.eye(3) - rays[:, :, None] * rays[:, None]
    total = int(of.max(initial=-1)) + 1
    normal, right = np.zeros((total, 3, 3)), np.zeros((total, 3))
    np.add.at(normal, of, across)
    np.add.at(right, of, np.einsum("nij,nj->ni", across, centres))
    determined = (np.linalg.eigvalsh(normal)[:, 0] > _MIN_SINE**2) if total else np.zeros(0, bool)
    points = np.zeros((total, 3))
    points[determined] = np.linalg.solve(normal[determined], right[determined][..., None])[..., 0]
    in_front = np.einsum("ni,ni->n", points[of] - centres, rays) > _MIN_DEPTH_M
    keep = determined[of] & in_front
    num_photos = np.bincount(of[keep], minlength=total)
    order = np.argsort(-num_photos, kind="stable")
    order = order[num_photos[order] >= 2][: _MAX_POINTS * len(photos)]
    renumbered = np.full(total, -1)
    renumbered[order] = np.arange(len(order))
    keep &= renumbered[of] >= 0
    return _Structure(points[order], photo[keep], (feature - first[photo])[keep], renumbered[of][keep])


@dataclass(frozen=True, eq=False)
class _ResectedPhoto:
    """A photo that was resected from others; fields as in `AdjustedPose`."""

    photo: int
    pose: np.ndarray
    num_points: int
    resected_from: tuple[int, ...]


def _resect(
    k: int, photos: Sequence[BundlePhoto], at: Mapping[int, np.ndarray], structure: _Structure, matches: Matches
) -> _ResectedPhoto | None:
    """Resect a photo from the points of photos with poses; return None with too few inliers."""
    rows, points, sources = [np.zeros(0, np.int64)], [np.zeros((0, 3))], [np.zeros(0, np.int64)]
    for other in at:
        of_other, positions = _known_points(k, other, photos, matches, structure)
        rows.append(of_other)
        points.append(positions)
        sources.append(np.full(len(of_other), other))
    row, point, source = np.concatenate(rows), np.concatenate(points), np.concatenate(sources)
    if len(np.unique(row)) < MIN_POINTS:
        return None
    photo = photos[k]
    found = resection.resect(photo.pixels[row], point, photo.intrinsics_px, photo.size_px, 0.0)
    if found is None or len(np.unique(row[found.inliers])) < MIN_POINTS:
        return None
    keep = found.inliers
    pose = resection.refine(photo.pixels[row[keep]], point[keep], found.T_map_camera, photo.intrinsics_px)
    counts = np.bincount(source[keep], minlength=len(photos))
    if (counts >= MIN_POINTS / 2).sum() < MIN_SUPPORTERS:
        return None
    resected_from = tuple(int(other) for other in np.argsort(-counts, kind="stable") if counts[other])
    return _ResectedPhoto(k, pose.T_map_camera, len(np.unique(row[keep])), resected_from)


def _known_points(
    k: int, other: int, photos: Sequence[BundlePhoto], matches: Matches, structure: _Structure | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return features of a photo that match known points of another photo, and the (n, 3) positions of these points:
    triangulated if ``structure`` is given, otherwise from the map's depth."""
    if (k, other) not in matches:
        return np.zeros(0, np.int64), np.zeros((0, 3))
    rows, columns = matches[k, other]
    positions = np.full((len(photos[other].pixels), 3), np.nan)
    positions[photos[other].rows] = photos[other].points
    if structure is not None:
        seen = structure.photo == other
        positions[structure.row[seen]] = structure.points[structure.point[seen]]
    known = np.isfinite(positions[columns, 0])
    return rows[known], positions[columns[known]]


@dataclass(frozen=True, eq=False)
class _BundleProblem:
    """A bundle adjustment problem.

    Args:
        at: pose of each photo.
        resected: for each resected photo, the photos from which it was resected.
        structure: triangulated points.
        lifted: points with a depth from the map that resected photos see.
    """

    photos: Sequence[BundlePhoto]
    at: Mapping[int, np.ndarray]
    resected: Mapping[int, tuple[int, ...]]
    structure: _Structure
    lifted: _Structure

    @classmethod
    def build(
        cls,
        photos: Sequence[BundlePhoto],
        at: Mapping[int, np.ndarray],
        resected: Mapping[int, tuple[int, ...]],
        matches: Matches,
        tolerance: float,
    ) -> _BundleProblem:
        """Collect the inliers, and drop resected photos that have too few of them."""
        structure = _triangulate(photos, at, _consistent_matches(photos, at, matches, tolerance))
        lifted = _lifted_points(photos, at, resected, structure, matches, tolerance)
        made = cls(photos, at, resected, structure, lifted)
        weak = [k for k in at if k in resected and made.num_points(k) < MIN_POINTS]
        if not weak:
            return made
        return cls.build(photos, {k: pose for k, pose in at.items() if k not in weak}, resected, matches, tolerance)

    def num_points(self, k: int) -> int:
        return int((self.structure.photo == k).sum() + (self.lifted.photo == k).sum())

    def free_lenses(self) -> list[BundlePhoto]:
        """Return one photo for each lens whose focal length is adjusted."""
        free = {
            self.photos[k].size_px: self.photos[k] for k in self.at if resection.is_free(self.photos[k].focal_sigma)
        }
        return [free[size] for size in sorted(free)]

    def lens_of(self, k: int) -> int | None:
        """Return the index of a photo's lens in `free_lenses`; None if its focal length is not adjusted."""
        sizes = [one.size_px for one in self.free_lenses()]
        return sizes.index(self.photos[k].size_px) if resection.is_free(self.photos[k].focal_sigma) else None

    def values(self) -> Any:
        import gtsam

        out = gtsam.Values()
        for k, pose in self.at.items():
            out.insert(gtsam.symbol(_POSE, k), gtsam.Pose3(pose))
        for number, photo in enumerate(self.free_lenses()):
            fx, fy, cx, cy = photo.intrinsics_px
            out.insert(gtsam.symbol(_LENS, number), gtsam.Cal3_S2(fx, fy, 0.0, cx, cy))
        for number, point in enumerate([*self.structure.points, *self.lifted.points]):
            out.insert(gtsam.symbol(_POINT, number), point)
        return out

    def graph(self, feature_px: float, prior_scale: float) -> Any:
        """Return the factor graph.

        Args:
            feature_px: standard deviation of a feature in pixels, for a photo of 480 pixels.
            prior_scale: factor on the covariances of poses from the map.
        """
        import gtsam

        structure, lifted = self.structure, self.lifted

        def robust(model: Any) -> Any:
            return gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Cauchy.Create(ROBUST_SIGMAS), model)

        out = gtsam.NonlinearFactorGraph()
        lens, noise = {}, {}
        for number, one in enumerate(self.free_lenses()):
            fx, fy, cx, cy = one.intrinsics_px
            sigmas = np.array([_LENS_SIGMA * fx, _LENS_SIGMA * fy, 1e-3, 1e-3, 1e-3])
            model = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
            out.add(gtsam.PriorFactorCal3_S2(gtsam.symbol(_LENS, number), gtsam.Cal3_S2(fx, fy, 0.0, cx, cy), model))
        free = {k: self.lens_of(k) for k in self.at}
        for k in self.at:
            photo, key = self.photos[k], gtsam.symbol(_POSE, k)
            if k not in self.resected:
                assert photo.covariance is not None
                prior = robust(gtsam.noiseModel.Gaussian.Covariance(prior_scale * photo.covariance))
                out.add(gtsam.PriorFactorPose3(key, gtsam.Pose3(np.asarray(photo.T_metric_camera)), prior))
            fx, fy, cx, cy = photo.intrinsics_px
            lens[k] = gtsam.Cal3_S2(fx, fy, 0.0, cx, cy)
            noise[k] = robust(gtsam.noiseModel.Isotropic.Sigma(2, feature_px * max(photo.size_px) / 480))
        for part, first, sigma in ((structure, 0, _POINT_SIGMA_M), (lifted, len(structure.points), _DEPTH_SIGMA_M)):
            near = gtsam.noiseModel.Isotropic.Sigma(3, sigma)
            for number, point in enumerate(part.points, first):
                out.add(gtsam.PriorFactorPoint3(gtsam.symbol(_POINT, number), point, near))
            for k, row, point in zip(part.photo.tolist(), part.row.tolist(), part.point.tolist(), strict=True):
                keys = gtsam.symbol(_POSE, k), gtsam.symbol(_POINT, first + point)
                pixel = self.photos[k].pixels[row].astype(np.float64)
                if (number_of_lens := free[k]) is None:
                    out.add(gtsam.GenericProjectionFactorCal3_S2(pixel, noise[k], *keys, lens[k]))
                else:
                    by_lens = gtsam.symbol(_LENS, number_of_lens)
                    out.add(gtsam.GeneralSFMFactor2Cal3_S2(pixel, noise[k], *keys, by_lens))
        return out

    def solve(self) -> Any:
        """Return the optimal values, or the initial values if the problem is singular."""
        import gtsam

        values = self.values()
        try:
            return gtsam.LevenbergMarquardtOptimizer(self.graph(_FEATURE_PX, 1.0), values).optimize()
        except RuntimeError:
            return values


def _adjust(
    photos: list[BundlePhoto],
    at: Mapping[int, np.ndarray],
    resected: Mapping[int, tuple[int, ...]],
    matches: Matches,
) -> dict[int, np.ndarray]:
    """Adjust poses with decreasing tolerances; return them, and update the lenses in ``photos``."""
    import gtsam

    for tolerance in TOLERANCES:
        problem = _BundleProblem.build(photos, at, resected, matches, tolerance)
        solved = problem.solve()
        at = {k: solved.atPose3(gtsam.symbol(_POSE, k)).matrix() for k in problem.at}
        lenses = [solved.atCal3_S2(gtsam.symbol(_LENS, n)) for n in range(len(problem.free_lenses()))]
        for k in at:
            if (number := problem.lens_of(k)) is not None:
                lens = lenses[number]
                photos[k] = replace(
                    photos[k], intrinsics_px=np.array([lens.fx(), lens.fy(), *photos[k].intrinsics_px[2:]])
                )
    return dict(at)


def _with_covariances(problem: _BundleProblem) -> dict[int, AdjustedPose]:
    """Return the poses of a solved problem with their covariances; empty if the problem is singular."""
    import gtsam

    by_map = {k: pose for k, pose in problem.at.items() if k not in problem.resected}
    try:
        graph = problem.graph(CORRELATED_FEATURE_PX, 1 + POSE_CORRELATION * (len(by_map) - 1))
        marginals = gtsam.Marginals(graph, problem.values())
        covariances = {k: marginals.marginalCovariance(gtsam.symbol(_POSE, k)) for k in problem.at}
    except RuntimeError:  # gtsam raises it for singular systems
        return {}
    scale = _variance_of_unit_weight(problem.photos, by_map)
    return {
        k: AdjustedPose(
            pose,
            problem.photos[k].intrinsics_px,
            scale * covariances[k],
            problem.num_points(k),
            problem.resected.get(k, ()),
        )
        for k, pose in problem.at.items()
    }


def _lifted_points(
    photos: Sequence[BundlePhoto],
    at: Mapping[int, np.ndarray],
    resected: Mapping[int, tuple[int, ...]],
    structure: _Structure,
    matches: Matches,
    tolerance: float,
) -> _Structure:
    """Return the points with a depth from the map for those features of resected photos that are not in the
    structure."""
    points, photo, rows = [np.zeros((0, 3))], [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    for k in (k for k in resected if k in at):
        free = np.ones(len(photos[k].pixels), bool)
        free[structure.row[structure.photo == k]] = False
        for other in at:
            of_photo, point = _known_points(k, other, photos, matches)
            of_photo, point = of_photo[free[of_photo]], point[free[of_photo]]
            keep = _is_inlier(photos[k], at[k], point, of_photo, tolerance)
            free[of_photo[keep]] = False
            points.append(point[keep])
            photo.append(np.full(int(keep.sum()), k))
            rows.append(of_photo[keep])
    position = np.concatenate(points)
    return _Structure(position, np.concatenate(photo), np.concatenate(rows), np.arange(len(position)))


def _variance_of_unit_weight(photos: Sequence[BundlePhoto], poses: Mapping[int, np.ndarray]) -> float:
    """Return the factor on covariances, from the disagreement of the poses from the map with the adjustment."""
    squared = [_squared_shift(photos[k], pose) for k, pose in poses.items()]
    disagreement = _DISAGREEMENT_WEIGHT * float(np.median(squared)) / _CHI2_MEDIAN
    return (VARIANCE_PRIOR + len(squared) * disagreement) / (VARIANCE_PRIOR + len(squared))
