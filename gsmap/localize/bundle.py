"""Photographs of one place adjusted at once: by what the map says of each, and by what several of them show.

Photographs match each other far better than renders of a map. Features that several placed ones share are triangulated
by their poses; whoever shows enough of these, or of what the map's depth says of a placed photo's features, is found by
them, one after another. In the end all poses and points are one least-squares problem (bundle adjustment): what each
photo shows of the points, and what the map said of each pose.

What the map says of neighbours errs alike, as a map bends and renders displace; and photographs find a feature beside
where it is in the same way. So covariances are those of a problem in which poses by the map are known less well, the
more there are of them, and features less well too; and they are scaled by how well these poses agree with how the
photographs lie to each other (the variance of unit weight).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from gsmap.errors import ConfigError
from gsmap.geometry.projection import project
from gsmap.localize import resection

_EXPECTED = 5.35  # median of chi squared, of six degrees of freedom
_POSE, _POINT, _LENS = "x", "l", "k"
_SAME_LENS = 0.03  # how well the middle of those that the map says is known, by share
_ANYWHERE_M = 10.0
_NEAR_M = 0.1  # nothing that a photo shows is nearer


@dataclass(frozen=True)
class Params:
    """How photographs are adjusted at once.

    Args:
        min_points: features of a photo that must agree with places that other photos say, for it to be found by them,
            of ...
        supporters: ... so many that each say half of these at least: what repeats itself fools one.
        max_error_px: of a feature that agrees, at a picture of 480 pixels; ...
        loose: ... times this, in one adjustment after another.
        max_off: a photo that is led by more sigmas from where the map placed it takes no part.
        min_sine: points are triangulated where the rays to them differ by so much.
        max_points: in the adjustment, for each photo; those that most photos show.
        feature_px: how well a feature is found ...
        doubt: ... and from so many times that on it counts less, as poses by the map do from so many of their sigmas.
        lifted_m: how well the map's depth says where a feature of one photo lies.
        alike: how much of their errors poses by the map share, for the covariance ...
        alike_px: ... for which features are found no better than this.
        weight: of how much poses by the map disagree with the adjustment, in the scale of the covariance, ...
        usual: ... beside so many of them as if they disagreed as usual.
    """

    min_points: int = 12
    supporters: int = 2
    max_error_px: float = 4.0
    loose: tuple[float, ...] = (2.0, 1.0)
    max_off: float = 8.0
    min_sine: float = 0.02
    max_points: int = 150
    feature_px: float = 1.0
    doubt: float = 1.0
    lifted_m: float = 0.05
    alike: float = 0.35
    alike_px: float = 1.6
    weight: float = 2.5
    usual: float = 4.0

    def __post_init__(self) -> None:
        if not self.loose or min(self.loose) <= 0:
            raise ConfigError(f"loose is one factor or more, each above 0, got {self.loose}", code="out_of_range")
        for name in ("max_error_px", "max_off", "feature_px", "doubt", "lifted_m", "alike_px"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"{name} must be positive, got {getattr(self, name)}", code="out_of_range")
        for name in ("min_sine", "alike", "weight", "usual", "max_points"):
            if not getattr(self, name) >= 0:
                raise ConfigError(f"{name} must not be negative, got {getattr(self, name)}", code="out_of_range")


@dataclass(frozen=True, eq=False)
class Shown:
    """A photo, as it is adjusted.

    Args:
        pixels: (N, 2) of its features.
        intrinsics_px: (4,).
        size_px: width and height.
        focal_sigma: as in `gsmap.types.localization.Photo`; photos of one size were taken with one lens.
        T_metric_camera: (4, 4), by the map; None where that says nothing.
        covariance: (6, 6) of that.
        rows, points: (n,) features whose place the map's depth says from there, and (n, 3) these places.
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
class Adjusted:
    """A photo's pose by all of them.

    Args:
        T_metric_camera: (4, 4).
        intrinsics_px: (4,).
        covariance: (6, 6) over [rot_rad, trans] on the camera's side.
        num_points: features of it that took part.
        by: photos that it was found by, those that share most features first; none of one that the map placed.
    """

    T_metric_camera: np.ndarray
    intrinsics_px: np.ndarray
    covariance: np.ndarray
    num_points: int
    by: tuple[int, ...] = ()


Matches = Mapping[tuple[int, int], tuple[np.ndarray, np.ndarray]]
"""Of pairs of photos the rows of features that are the same; both orders of a pair."""


def adjusted(
    photos: Sequence[Shown], matches: Matches, params: Params, poses: resection.Params
) -> tuple[dict[int, Adjusted], list[int]]:
    """The photos that the map places, and those that these lead to; none where it places fewer than two.

    Args:
        photos: in one frame, metres.

    Returns:
        The poses; and photos that others led far from where the map placed them, and that took no part: what the map
        says of these or of the others is wrong.
    """
    photos = _with_one_lens(photos)
    apart: list[int] = []
    while sum(one.T_metric_camera is not None for one in photos) >= 2:
        at = {k: one.T_metric_camera for k, one in enumerate(photos) if one.T_metric_camera is not None}
        by: dict[int, tuple[int, ...]] = {}
        tried: set[int] = set()
        at = _moved(photos, at, by, matches, params)
        while (best := _next(photos, at, tried, matches, params, poses)) is not None:
            tried.add(best.photo)
            by[best.photo] = best.by
            at = _moved(photos, at | {best.photo: best.pose}, by, matches, params)
        by = {k: whom for k, whom in by.items() if k in at}
        off = {k: _off(photos[k], pose) for k, pose in at.items() if k not in by}
        worst = max(off, key=lambda k: off[k])
        if off[worst] <= params.max_off**2:
            return _known(_Problem.of(photos, at, by, matches, params.loose[-1], params)), apart
        apart.append(worst)
        photos[worst] = replace(photos[worst], T_metric_camera=None)
        matches = {pair: rows for pair, rows in matches.items() if worst not in pair}
    if apart:  # no two are left that agree, and which of the last is wrong nobody says
        apart += [k for k, one in enumerate(photos) if one.T_metric_camera is not None]
    return {}, apart


def _with_one_lens(photos: Sequence[Shown]) -> list[Shown]:
    """The photos; those of unknown focal length with the middle one of those of their size that the map places."""
    out = list(photos)
    for size in {one.size_px for one in photos if resection.is_free(one.focal_sigma)}:
        mine = [k for k, one in enumerate(photos) if one.size_px == size and resection.is_free(one.focal_sigma)]
        said = [photos[k].intrinsics_px for k in mine if photos[k].T_metric_camera is not None]
        for k in mine if said else []:
            out[k] = replace(photos[k], intrinsics_px=np.median(said, axis=0))
    return out


def _next(
    photos: Sequence[Shown],
    at: Mapping[int, np.ndarray],
    tried: set[int],
    matches: Matches,
    params: Params,
    poses: resection.Params,
) -> _Found | None:
    """Of the photos that have no pose, and were not tried, the one that most that is known of the others places."""
    left = [k for k in range(len(photos)) if k not in at and k not in tried]
    if not left:
        return None
    structure = _triangulated(photos, at, _links(photos, at, matches, params.loose[-1], params), params)
    found = [_found(k, photos, at, structure, matches, params, poses) for k in left]
    return max((one for one in found if one is not None), key=lambda one: one.num_points, default=None)


def _off(photo: Shown, pose: np.ndarray) -> float:
    """How far from where the map placed it a photo has come to lie: squared, in sigmas of that."""
    assert photo.T_metric_camera is not None
    assert photo.covariance is not None
    xi = resection.moved_by(photo.T_metric_camera, pose)
    return float(xi @ np.linalg.solve(photo.covariance, xi))


def _rays(photo: Shown, pose: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """(K, 3) unit vectors towards features, in the frame."""
    fx, fy, cx, cy = photo.intrinsics_px
    x, y = photo.pixels[rows].T
    local = np.stack([(x - cx) / fx, (y - cy) / fy, np.ones(len(rows))], axis=1)
    out: np.ndarray = local @ pose[:3, :3].T
    return out / np.linalg.norm(out, axis=1, keepdims=True)


Links = dict[tuple[int, int], tuple[np.ndarray, np.ndarray]]


def _links(
    photos: Sequence[Shown],
    at: Mapping[int, np.ndarray],
    matches: Matches,
    loose: float,
    params: Params,
) -> Links:
    """Matches of all pairs of photos whose rays meet before both of them."""
    out = {}
    for k in at:
        for other in at:
            if other < k and (k, other) in matches:
                out[k, other] = _agreeing(k, other, photos, at, matches, loose, params)
    return out


def _agreeing(
    k: int,
    other: int,
    photos: Sequence[Shown],
    at: Mapping[int, np.ndarray],
    matches: Matches,
    loose: float,
    params: Params,
) -> tuple[np.ndarray, np.ndarray]:
    mine, theirs = matches[k, other]
    one, two = _rays(photos[k], at[k], mine), _rays(photos[other], at[other], theirs)
    between = at[other][:3, 3] - at[k][:3, 3]
    cosine = (one * two).sum(1)
    sine = np.maximum(1 - cosine**2, 1e-9)
    along, back = one @ between, two @ between
    near = at[k][:3, 3] + ((along - cosine * back) / sine)[:, None] * one
    far = at[other][:3, 3] + ((cosine * along - back) / sine)[:, None] * two
    keep = np.ones(len(mine), bool)
    for number, rows in ((k, mine), (other, theirs)):
        keep &= _near(photos[number], at[number], (near + far) / 2, rows, loose, params)
    return mine[keep], theirs[keep]


def _near(
    photo: Shown, pose: np.ndarray, points: np.ndarray, rows: np.ndarray, loose: float, params: Params
) -> np.ndarray:
    """(K,) bool: points that a photo's features may show from a pose."""
    pixels, depth = project(points, np.linalg.inv(pose), photo.intrinsics_px)
    bar = loose * params.max_error_px * max(photo.size_px) / 480
    out: np.ndarray = (depth > _NEAR_M) & (np.linalg.norm(pixels - photo.pixels[rows], axis=1) < bar)
    return out


@dataclass(frozen=True, eq=False)
class _Structure:
    """Points, and the features that show them.

    Args:
        points: (T, 3), those that most photos show first.
        photo, row, point: (M,) which feature of which photo shows which.
    """

    points: np.ndarray
    photo: np.ndarray
    row: np.ndarray
    point: np.ndarray


def _triangulated(
    photos: Sequence[Shown],
    at: Mapping[int, np.ndarray],
    links: Links,
    params: Params,
) -> _Structure:
    """The points that linked features show."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    first = np.r_[0, np.cumsum([len(one.pixels) for one in photos])]
    pairs = [np.stack([first[k] + a, first[other] + b]) for (k, other), (a, b) in links.items()]
    one, two = np.concatenate([np.zeros((2, 0), np.int64), *pairs], axis=1)
    count = int(first[-1])
    _, of = connected_components(coo_matrix((np.ones(len(one)), (one, two)), (count, count)), directed=False)
    feature = np.unique(np.r_[one, two])
    photo = np.searchsorted(first, feature, side="right") - 1
    _, place, times = np.unique(of[feature] * len(photos) + photo, return_inverse=True, return_counts=True)
    alone = times[place] == 1  # a photo that shows a point twice does not say where
    feature, photo, of = feature[alone], photo[alone], of[feature][alone]
    of = np.unique(of, return_inverse=True)[1]
    rays = np.zeros((len(feature), 3))
    for k in np.unique(photo):
        mine = photo == k
        rays[mine] = _rays(photos[k], at[k], feature[mine] - first[k])
    centres = np.stack([at[k][:3, 3] for k in photo]) if len(photo) else np.zeros((0, 3))
    across = np.eye(3) - rays[:, :, None] * rays[:, None]
    total = int(of.max(initial=-1)) + 1
    normal, right = np.zeros((total, 3, 3)), np.zeros((total, 3))
    np.add.at(normal, of, across)
    np.add.at(right, of, np.einsum("nij,nj->ni", across, centres))
    sound = (np.linalg.eigvalsh(normal)[:, 0] > params.min_sine**2) if total else np.zeros(0, bool)
    points = np.zeros((total, 3))
    points[sound] = np.linalg.solve(normal[sound], right[sound][..., None])[..., 0]
    ahead = np.einsum("ni,ni->n", points[of] - centres, rays) > _NEAR_M
    keep = sound[of] & ahead
    shown = np.bincount(of[keep], minlength=total)
    order = np.argsort(-shown, kind="stable")
    order = order[shown[order] >= 2][: params.max_points * len(photos)]
    renumbered = np.full(total, -1)
    renumbered[order] = np.arange(len(order))
    keep &= renumbered[of] >= 0
    return _Structure(points[order], photo[keep], (feature - first[photo])[keep], renumbered[of][keep])


@dataclass(frozen=True, eq=False)
class _Found:
    """A photo that is found by others; as in `Adjusted`."""

    photo: int
    pose: np.ndarray
    num_points: int
    by: tuple[int, ...]


def _found(
    k: int,
    photos: Sequence[Shown],
    at: Mapping[int, np.ndarray],
    structure: _Structure,
    matches: Matches,
    params: Params,
    poses: resection.Params,
) -> _Found | None:
    """A photo by what placed ones show; None where too little of it agrees."""
    rows, points, whose = [np.zeros(0, np.int64)], [np.zeros((0, 3))], [np.zeros(0, np.int64)]
    for other in at:
        mine, places = _places_by(k, other, photos, matches, structure)
        rows.append(mine)
        points.append(places)
        whose.append(np.full(len(mine), other))
    row, point, of = np.concatenate(rows), np.concatenate(points), np.concatenate(whose)
    if len(np.unique(row)) < params.min_points:
        return None
    photo = photos[k]
    found = resection.resect(photo.pixels[row], point, photo.intrinsics_px, photo.size_px, 0.0, poses)
    if found is None or len(np.unique(row[found.inliers])) < params.min_points:
        return None
    agree = found.inliers
    pose = resection.refine(photo.pixels[row[agree]], point[agree], found.T_map_camera, photo.intrinsics_px, poses)
    counts = np.bincount(of[agree], minlength=len(photos))
    if (counts >= params.min_points / 2).sum() < params.supporters:
        return None
    by = tuple(int(other) for other in np.argsort(-counts, kind="stable") if counts[other])
    return _Found(k, pose.T_map_camera, len(np.unique(row[agree])), by)


def _places_by(
    k: int, other: int, photos: Sequence[Shown], matches: Matches, structure: _Structure | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Features of a photo that another one shares whose places are known, and (n, 3) these: by what several show, if
    that is given, or by the map's depth from the other one."""
    if (k, other) not in matches:
        return np.zeros(0, np.int64), np.zeros((0, 3))
    mine, theirs = matches[k, other]
    places = np.full((len(photos[other].pixels), 3), np.nan)
    places[photos[other].rows] = photos[other].points
    if structure is not None:
        seen = structure.photo == other
        places[structure.row[seen]] = structure.points[structure.point[seen]]
    said = np.isfinite(places[theirs, 0])
    return mine[said], places[theirs[said]]


@dataclass(frozen=True, eq=False)
class _Problem:
    """Poses, and what is known of them.

    Args:
        at: the poses of photos.
        by: of those that others found, these.
        structure: points that several show.
        lifted: places that the map's depth says of features that such photos share with others.
    """

    photos: Sequence[Shown]
    at: Mapping[int, np.ndarray]
    by: Mapping[int, tuple[int, ...]]
    structure: _Structure
    lifted: _Structure
    params: Params

    @classmethod
    def of(
        cls,
        photos: Sequence[Shown],
        at: Mapping[int, np.ndarray],
        by: Mapping[int, tuple[int, ...]],
        matches: Matches,
        loose: float,
        params: Params,
    ) -> _Problem:
        """What agrees with the poses; without photos that were found by what does not hold."""
        structure = _triangulated(photos, at, _links(photos, at, matches, loose, params), params)
        lifted = _lifted(photos, at, by, structure, matches, loose, params)
        made = cls(photos, at, by, structure, lifted, params)
        weak = [k for k in at if k in by and made.num_points(k) < params.min_points]
        if not weak:
            return made
        return cls.of(photos, {k: pose for k, pose in at.items() if k not in weak}, by, matches, loose, params)

    def num_points(self, k: int) -> int:
        return int((self.structure.photo == k).sum() + (self.lifted.photo == k).sum())

    def free_lenses(self) -> list[Shown]:
        """A photo by each lens whose focal length is adjusted."""
        free = {
            self.photos[k].size_px: self.photos[k] for k in self.at if resection.is_free(self.photos[k].focal_sigma)
        }
        return [free[size] for size in sorted(free)]

    def lens_of(self, k: int) -> int | None:
        """Which of these took a photo."""
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

    def graph(self, feature_px: float, less_sure: float) -> Any:
        """The factors, with features found so well and covariances of poses by the map so many times as large."""
        import gtsam

        params, structure, lifted = self.params, self.structure, self.lifted

        def doubted(model: Any) -> Any:
            return gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Cauchy.Create(params.doubt), model)

        out = gtsam.NonlinearFactorGraph()
        lens, noise = {}, {}
        for number, one in enumerate(self.free_lenses()):
            fx, fy, cx, cy = one.intrinsics_px
            sigmas = np.array([_SAME_LENS * fx, _SAME_LENS * fy, 1e-3, 1e-3, 1e-3])
            about = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
            out.add(gtsam.PriorFactorCal3_S2(gtsam.symbol(_LENS, number), gtsam.Cal3_S2(fx, fy, 0.0, cx, cy), about))
        free = {k: self.lens_of(k) for k in self.at}
        for k in self.at:
            photo, key = self.photos[k], gtsam.symbol(_POSE, k)
            if k not in self.by:
                assert photo.covariance is not None
                known = doubted(gtsam.noiseModel.Gaussian.Covariance(less_sure * photo.covariance))
                out.add(gtsam.PriorFactorPose3(key, gtsam.Pose3(np.asarray(photo.T_metric_camera)), known))
            fx, fy, cx, cy = photo.intrinsics_px
            lens[k] = gtsam.Cal3_S2(fx, fy, 0.0, cx, cy)
            noise[k] = doubted(gtsam.noiseModel.Isotropic.Sigma(2, feature_px * max(photo.size_px) / 480))
        # Points may lie anywhere, but somewhere: one that left what shows it would be fixed by nothing.
        for part, first, sigma in ((structure, 0, _ANYWHERE_M), (lifted, len(structure.points), params.lifted_m)):
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

    def solved(self) -> Any:
        """Values that fit best; those that there are, where something is not fixed."""
        import gtsam

        values = self.values()
        try:
            return gtsam.LevenbergMarquardtOptimizer(self.graph(self.params.feature_px, 1.0), values).optimize()
        except RuntimeError:
            return values


def _moved(
    photos: list[Shown],
    at: Mapping[int, np.ndarray],
    by: Mapping[int, tuple[int, ...]],
    matches: Matches,
    params: Params,
) -> dict[int, np.ndarray]:
    """The poses adjusted to each other, and lenses with them, first by all that about agrees."""
    import gtsam

    for loose in params.loose:
        problem = _Problem.of(photos, at, by, matches, loose, params)
        solved = problem.solved()
        at = {k: solved.atPose3(gtsam.symbol(_POSE, k)).matrix() for k in problem.at}
        lenses = [solved.atCal3_S2(gtsam.symbol(_LENS, n)) for n in range(len(problem.free_lenses()))]
        for k in at:
            if (number := problem.lens_of(k)) is not None:
                lens = lenses[number]
                photos[k] = replace(
                    photos[k], intrinsics_px=np.array([lens.fx(), lens.fy(), *photos[k].intrinsics_px[2:]])
                )
    return dict(at)


def _known(problem: _Problem) -> dict[int, Adjusted]:
    """The poses of a problem that is solved, with their covariances; none where something is not fixed."""
    import gtsam

    params, placed = problem.params, {k: pose for k, pose in problem.at.items() if k not in problem.by}
    try:
        graph = problem.graph(params.alike_px, 1 + params.alike * (len(placed) - 1))
        known = gtsam.Marginals(graph, problem.values())
        covariances = {k: known.marginalCovariance(gtsam.symbol(_POSE, k)) for k in problem.at}
    except RuntimeError:  # gtsam's word for it
        return {}
    scale = _variance_of_unit_weight(problem.photos, placed, params)
    return {
        k: Adjusted(
            pose, problem.photos[k].intrinsics_px, scale * covariances[k], problem.num_points(k), problem.by.get(k, ())
        )
        for k, pose in problem.at.items()
    }


def _lifted(
    photos: Sequence[Shown],
    at: Mapping[int, np.ndarray],
    by: Mapping[int, tuple[int, ...]],
    structure: _Structure,
    matches: Matches,
    loose: float,
    params: Params,
) -> _Structure:
    """Places that the map's depth says of features which photos that were found by others share with placed ones."""
    points, whose, rows = [np.zeros((0, 3))], [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    for k in (k for k in by if k in at):
        free = np.ones(len(photos[k].pixels), bool)
        free[structure.row[structure.photo == k]] = False
        for other in at:
            mine, point = _places_by(k, other, photos, matches)
            mine, point = mine[free[mine]], point[free[mine]]
            agree = _near(photos[k], at[k], point, mine, loose, params)
            free[mine[agree]] = False
            points.append(point[agree])
            whose.append(np.full(int(agree.sum()), k))
            rows.append(mine[agree])
    place = np.concatenate(points)
    return _Structure(place, np.concatenate(whose), np.concatenate(rows), np.arange(len(place)))


def _variance_of_unit_weight(photos: Sequence[Shown], out: Mapping[int, np.ndarray], params: Params) -> float:
    """By what covariances are multiplied, after how poses by the map disagree with the adjustment."""
    squared = [_off(photos[k], pose) for k, pose in out.items()]
    disagree = params.weight * float(np.median(squared)) / _EXPECTED
    return (params.usual + len(squared) * disagree) / (params.usual + len(squared))
