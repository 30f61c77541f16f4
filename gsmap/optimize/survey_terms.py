"""Observations of the world as least-squares terms over scene poses, and the unknowns that they add.

Unknowns are scene poses ``S_map_scene``, the component's ``S_world_map``, control points (world frame), cameras of
localized photos, and the errors that fixes share: offset and drift of a capture, and the sea level. Steps are on the
source side, as everywhere; a point ``x`` in the source frame moves by ``G(x) step`` with ``G(x) = [-skew(x), I, x]``.

All observations are stored as arrays by kind of term.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from gsmap.geometry.rotations import skew
from gsmap.geometry.similarities import Similarities, commutator, exp
from gsmap.types import Sim3
from gsmap.types.world import ControlPoint, ImagePoint, PositionFix, ScaleBar, Survey

_FAR = 1e6  # m: sigma of a weak term of every point, which keeps the system regular where a point has no other term
_BEHIND = 1e3  # residual of a point behind the camera, in standard deviations
# Drift as a share of the common sigma: GNSS errors last hours, a flight 15 minutes (Gauss-Markov, 2 h: 0.48).
_DRIFT = 0.5
_CORRECTED = 0.5  # m: a receiver with a smaller sigma has corrections (RTK, PPK)


@dataclass(frozen=True, eq=False)
class Unknowns:
    """Estimate of all unknowns.

    Args:
        scenes: N poses.
        world: ``S_world_map``, as one row.
        points: (K, 3) positions in the world frame.
        cameras: M poses in the scene frame.
        offsets: (B, 3) common errors of fixes in standard deviations: offsets of groups, their drifts, and the sea
            level.
    """

    scenes: Similarities
    world: Similarities
    points: np.ndarray
    cameras: Similarities
    offsets: np.ndarray

    def moved(self, step: np.ndarray, dim: int) -> Unknowns:
        """Return the estimate after a step over all columns, see `Columns`."""
        n, k, m = len(self.scenes), len(self.points), len(self.cameras)
        ends = np.cumsum([n * dim, 7, 3 * k, 6 * m])
        scenes, world, points, cameras, offsets = np.split(step, ends)
        return Unknowns(
            (self.scenes @ exp(scenes.reshape(n, dim))).orthonormalised(),
            (self.world @ exp(world.reshape(1, 7))).orthonormalised(),
            self.points + points.reshape(k, 3),
            (self.cameras @ exp(cameras.reshape(m, 6))).orthonormalised(),
            self.offsets + offsets.reshape(-1, 3),
        )


@dataclass(frozen=True)
class Columns:
    """Column layout of a step: scenes (``dim`` columns each), world (7), points (3), cameras (6), offsets (3)."""

    num_scenes: int
    dim: int
    num_points: int
    num_cameras: int
    num_offsets: int

    @property
    def world(self) -> int:
        return self.num_scenes * self.dim

    @property
    def points(self) -> int:
        return self.world + 7

    @property
    def cameras(self) -> int:
        return self.points + 3 * self.num_points

    @property
    def offsets(self) -> int:
        return self.cameras + 6 * self.num_cameras

    @property
    def size(self) -> int:
        return self.offsets + 3 * self.num_offsets


@dataclass(frozen=True, eq=False)
class Terms:
    """G whitened terms of one kind, each of m rows.

    Args:
        kind: kind of observation, as in `Residual`; empty for edges, priors, cameras and offsets.
        residuals: (G, m) residuals.
        parts: (first column (G,), derivative (G, m, width)) for each unknown; a first column of -1 means no unknown.
        valid: (G,) mask, False if the term is meaningless at this estimate (a point behind the camera).
    """

    kind: str
    residuals: np.ndarray
    parts: tuple[tuple[np.ndarray, np.ndarray], ...]
    valid: np.ndarray

    @cached_property
    def squares(self) -> np.ndarray:
        """Compute the chi-square (G,) of each term by itself."""
        out: np.ndarray = (self.residuals**2).sum(1)
        return out

    def rows(self, size: int) -> np.ndarray:
        """Expand the derivatives to dense rows (G, m, size) over all columns; only for few terms."""
        g, m = self.residuals.shape
        out = np.zeros((g, m, size))
        for first, J in self.parts:
            for k in np.flatnonzero(first >= 0).tolist():
                out[k, :, first[k] : first[k] + J.shape[2]] += J[k]
        return out


@dataclass(frozen=True, eq=False)
class SurveyTerms:
    """The observations of one component as arrays.

    Args:
        scene_ids: N ids, in the order of the scenes of `Unknowns`.
        dim: number of unknowns of a scene's pose, 6 or 7.
        points, images, fixes, bars: the observations, with positions in the world frame.
    """

    scene_ids: tuple[str, ...]
    dim: int
    points: tuple[ControlPoint, ...]
    images: tuple[ImagePoint, ...]
    fixes: tuple[PositionFix, ...]
    bars: tuple[ScaleBar, ...]

    @classmethod
    def of(cls, survey: Survey, scene_ids: Sequence[str], dim: int) -> SurveyTerms:
        """Select the observations of the scenes of one component; points that no photo of these scenes shows are left
        out."""
        mine = set(scene_ids)
        known = {point.name for point in survey.points}
        images = tuple(i for i in survey.images if i.scene in mine and i.point in known)
        seen = {image.point for image in images}
        return cls(
            tuple(scene_ids),
            dim,
            tuple(point for point in survey.points if point.name in seen),
            images,
            tuple(fix for fix in survey.fixes if fix.scene in mine),
            tuple(bar for bar in survey.bars if set(bar.scenes) <= mine),
        )

    def __bool__(self) -> bool:
        return bool(self.points or self.fixes or self.bars)

    @property
    def columns(self) -> Columns:
        return Columns(len(self.scene_ids), self.dim, len(self.points), len(self._camera_rows), self._loads[1])

    @cached_property
    def _row(self) -> dict[str, int]:
        return {scene: k for k, scene in enumerate(self.scene_ids)}

    @cached_property
    def _point_row(self) -> dict[str, int]:
        return {point.name: k for k, point in enumerate(self.points)}

    @cached_property
    def image_points(self) -> np.ndarray:
        """(I,) index of the point that each image shows."""
        return np.array([self._point_row[i.point] for i in self.images], dtype=np.int64)

    @cached_property
    def image_scenes(self) -> np.ndarray:
        """(I,) index of the scene to which each image's camera belongs."""
        return np.array([self._row[i.scene] for i in self.images], dtype=np.int64)

    @cached_property
    def _uncertain(self) -> dict[tuple[str, str], ImagePoint]:
        """First image of each photo with an uncertain camera, by (scene, photo)."""
        out: dict[tuple[str, str], ImagePoint] = {}
        for image in self.images:
            if image.camera_covariance is not None:
                out.setdefault((image.scene, image.image), image)
        return out

    @cached_property
    def _camera_rows(self) -> dict[tuple[str, str], int]:
        return {photo: k for k, photo in enumerate(self._uncertain)}

    @cached_property
    def _image_cameras(self) -> np.ndarray:
        """(I,) index of the camera of each image, -1 if the camera is exact."""
        return np.array([self._camera_rows.get((i.scene, i.image), -1) for i in self.images], dtype=np.int64)

    @cached_property
    def fix_groups(self) -> list[tuple[str, bool]]:
        """(F) group of each fix with a common error: its scene, and whether its receiver has corrections.

        The errors of receivers with corrections and of receivers without are independent, even in one capture.
        """
        return [(f.scene, float(np.hypot(f.sigma_m[0], f.common_sigma_m[0])) < _CORRECTED) for f in self.fixes]

    @cached_property
    def _loads(self) -> tuple[list[tuple[np.ndarray, np.ndarray]], int]:
        """For each kind of common error (offset, drift, sea level) return the row of each fix, -1 if none, and (F, 3)
        metres per standard deviation; also return the number of rows.

        Each fix has its own sigma of the common error, so that a poor fix does not degrade the others.
        """
        sigmas = np.array([_per_axis(f.common_sigma_m) for f in self.fixes]).reshape(-1, 3)
        sea = np.array([[0.0, 0.0, f.sea_level_sigma_m] for f in self.fixes]).reshape(-1, 3)
        groups = sorted({g for g, s in zip(self.fix_groups, sigmas, strict=True) if s.any()})
        row = {group: k for k, group in enumerate(groups)}
        own = np.array([row.get(g, -1) for g in self.fix_groups], dtype=np.int64)
        along = np.zeros(len(self.fixes))
        for k in range(len(groups)):
            mine = sorted(np.flatnonzero(own == k).tolist(), key=lambda i: _natural(self.fixes[i].name))
            along[mine] = np.linspace(-0.5, 0.5, len(mine)) if len(mine) > 1 else 0.0
        drift = np.where(own >= 0, own + len(groups), -1)
        level = np.where(sea[:, 2] > 0, 2 * len(groups), -1)
        kinds = [(own, sigmas), (drift, _DRIFT * along[:, None] * sigmas), (level, sea)]
        return kinds, 2 * len(groups) + int(sea.any())

    def start(self, scenes: Similarities, world: Sim3) -> Unknowns:
        """Initialize points at their surveyed positions, cameras as localized, and common errors as zero."""
        cameras = [Sim3.from_matrix(image.T_scene_camera) for image in self._uncertain.values()]
        return Unknowns(
            scenes,
            Similarities.stack([world]),
            np.array([point.position for point in self.points], dtype=np.float64).reshape(-1, 3),
            Similarities.stack(cameras),
            np.zeros((self._loads[1], 3)),
        )

    # --- terms -------------------------------------------------------------------------------------------------------

    def observations(self, x: Unknowns) -> tuple[Terms, Terms, Terms, Terms]:
        """Return the terms of points, images, fixes and bars."""
        return self._points(x), self._images(x), self._fixes(x), self._bars(x)

    def others(self, x: Unknowns, at: Unknowns) -> tuple[Terms, ...]:
        """Return the terms of localized cameras and of common errors, and very weak terms of the points.

        Args:
            at: points from which the steps of points are measured.
        """
        columns, k = self.columns, len(self.points)
        points = Terms(
            "",
            (x.points - at.points) / _FAR,
            ((columns.points + 3 * np.arange(k), np.tile(np.eye(3) / _FAR, (k, 1, 1))),),
            np.ones(k, dtype=bool),
        )
        start = Similarities.stack([Sim3.from_matrix(i.T_scene_camera) for i in self._uncertain.values()])
        m = len(start)
        roots = np.array([_whitener(np.asarray(i.camera_covariance)) for i in self._uncertain.values()])
        roots = roots.reshape(m, 6, 6)
        off = (start.inverse() @ x.cameras).log()
        ad = commutator(off)
        back = (np.eye(7) + ad / 2 + ad @ ad / 12)[:, :6, :6]  # as for edges
        cameras = Terms(
            "",
            np.einsum("kij,kj->ki", roots, off[:, :6]),
            ((columns.cameras + 6 * np.arange(m), roots @ back),),
            np.ones(m, dtype=bool),
        )
        b = self._loads[1]
        offsets = Terms(
            "",
            x.offsets,
            ((columns.offsets + 3 * np.arange(b), np.tile(np.eye(3), (b, 1, 1))),),
            np.ones(b, dtype=bool),
        )
        return points, cameras, offsets

    def _points(self, x: Unknowns) -> Terms:
        weights = np.array([1 / _per_axis(point.sigma_m) for point in self.points]).reshape(-1, 3)
        surveyed = np.array([point.position for point in self.points], dtype=np.float64).reshape(-1, 3)
        first = self.columns.points + 3 * np.arange(len(self.points))
        J = weights[:, :, None] * np.eye(3)
        return Terms("point", (x.points - surveyed) * weights, ((first, J),), np.ones(len(self.points), dtype=bool))

    def _images(self, x: Unknowns) -> Terms:
        columns, scenes, cams = self.columns, self.image_scenes, self._image_cameras
        count = len(self.images)
        if not count:
            return Terms("image", np.zeros((0, 3)), (), np.zeros(0, dtype=bool))
        world, P = x.world[np.zeros(count, dtype=np.int64)], x.points[self.image_points]
        in_map = world.inverse().apply(P)
        pose = x.scenes[scenes]
        in_scene = pose.inverse().apply(in_map)
        camera = self.cameras_at(x)
        in_camera = camera.inverse().apply(in_scene)
        # First the step of each frame itself, then the chain towards the camera.
        to_scene = _linear(pose.inverse())
        to_camera = _linear(camera.inverse())
        by_world = to_camera @ to_scene @ -_moves(in_map)
        by_point = to_camera @ to_scene @ _linear(world.inverse())
        by_pose = to_camera @ -_moves(in_scene)[:, :, : self.dim]
        by_camera = -_moves(in_camera)[:, :, :6]
        fx, fy, cx, cy = np.array([i.intrinsics_px for i in self.images], dtype=np.float64).T
        picked = np.array([i.pixel for i in self.images], dtype=np.float64)
        size = np.linalg.norm(in_camera, axis=1)
        valid = in_camera[:, 2] > 1e-3 * size
        z = np.where(valid, in_camera[:, 2], np.maximum(size, 1e-9))
        u, v = fx * in_camera[:, 0] / z + cx, fy * in_camera[:, 1] / z + cy
        weight = np.array([1 / i.sigma_px for i in self.images])
        depth = np.array([np.nan if i.depth is None else i.depth for i in self.images], dtype=np.float64)
        far = np.array([0.0 if i.depth is None else 1 / i.depth_sigma for i in self.images])
        r = np.stack([(u - picked[:, 0]) * weight, (v - picked[:, 1]) * weight, np.zeros(count)], axis=1)
        r[:, 2] = np.where(far > 0, (in_camera[:, 2] - np.nan_to_num(depth)) * far, 0.0)
        D = np.zeros((count, 3, 3))
        D[:, 0, 0], D[:, 0, 2] = fx / z * weight, -fx * in_camera[:, 0] / z**2 * weight
        D[:, 1, 1], D[:, 1, 2] = fy / z * weight, -fy * in_camera[:, 1] / z**2 * weight
        D[:, 2, 2] = far
        D[~valid] = 0.0
        r[~valid] = _BEHIND
        none = np.full(count, -1)
        parts = (
            (scenes * self.dim, D @ by_pose),
            (np.full(count, columns.world), D @ by_world),
            (columns.points + 3 * self.image_points, D @ by_point),
            (np.where(cams >= 0, columns.cameras + 6 * cams, none), D @ by_camera),
        )
        return Terms("image", r, parts, valid)

    def cameras_at(self, x: Unknowns) -> Similarities:
        """Return the (I) camera poses of all images, each in its scene's frame."""
        rows = np.flatnonzero(self._image_cameras >= 0)
        exact = self._exact_cameras
        return exact.replaced(rows, x.cameras[self._image_cameras[rows]]) if len(rows) else exact

    @cached_property
    def _exact_cameras(self) -> Similarities:
        return Similarities.stack([Sim3.from_matrix(image.T_scene_camera) for image in self.images])

    def image_errors_px(self, x: Unknowns) -> np.ndarray:
        """Compute reprojection errors (I, 2) in pixels."""
        terms = self._images(x)
        sigmas = np.array([image.sigma_px for image in self.images])
        out: np.ndarray = terms.residuals[:, :2] * sigmas[:, None]
        return out

    def _fixes(self, x: Unknowns) -> Terms:
        count, columns = len(self.fixes), self.columns
        if not count:
            return Terms("fix", np.zeros((0, 3)), (), np.zeros(0, dtype=bool))
        scenes = np.array([self._row[fix.scene] for fix in self.fixes], dtype=np.int64)
        points = np.array([fix.point for fix in self.fixes], dtype=np.float64)
        measured = np.array([fix.position for fix in self.fixes], dtype=np.float64)
        weights = np.array([1 / _per_axis(fix.sigma_m) for fix in self.fixes])
        pose, world = x.scenes[scenes], x.world[np.zeros(count, dtype=np.int64)]
        in_map = pose.apply(points)
        loads, _ = self._loads
        off = np.zeros((count, 3))
        for rows, metres in loads:
            off[rows >= 0] += metres[rows >= 0] * x.offsets[rows[rows >= 0]]
        residual = (world.apply(in_map) + off - measured) * weights
        turn = _linear(world)
        parts = (
            (scenes * self.dim, weights[:, :, None] * (turn @ _linear(pose) @ _moves(points)[:, :, : self.dim])),
            (np.full(count, columns.world), weights[:, :, None] * (turn @ _moves(in_map))),
            *(
                (np.where(rows >= 0, columns.offsets + 3 * rows, -1), (weights * metres)[:, :, None] * np.eye(3))
                for rows, metres in loads
            ),
        )
        return Terms("fix", residual, parts, np.ones(count, dtype=bool))

    def fix_points(self, scenes: Similarities) -> np.ndarray:
        """Return the (F, 3) positions of fixes in the map."""
        rows = np.array([self._row[fix.scene] for fix in self.fixes], dtype=np.int64)
        return scenes[rows].apply(np.array([fix.point for fix in self.fixes], dtype=np.float64).reshape(-1, 3))

    def _bars(self, x: Unknowns) -> Terms:
        count, columns = len(self.bars), self.columns
        if not count:
            return Terms("bar", np.zeros((0, 1)), (), np.zeros(0, dtype=bool))
        rows = np.array([[self._row[scene] for scene in bar.scenes] for bar in self.bars], dtype=np.int64)
        ends = np.array([bar.points for bar in self.bars], dtype=np.float64)
        poses = [x.scenes[rows[:, k]] for k in (0, 1)]
        in_map = [pose.apply(ends[:, k]) for k, pose in enumerate(poses)]
        span = in_map[0] - in_map[1]
        across = np.linalg.norm(span, axis=1)
        along = span / np.maximum(across, 1e-300)[:, None]
        scale = float(np.exp(x.world.log_scales[0]))
        length = scale * across
        sigma = np.array([bar.sigma_m for bar in self.bars])
        sizes = np.stack([np.exp(pose.log_scales) for pose in poses], axis=1)
        measured = np.array([bar.length_m for bar in self.bars])
        # Metres are defined by the bar: by the estimate, a larger world would reduce the weight of its own errors.
        metres = (measured / np.maximum(across, 1e-300))[:, None]
        picked = np.array([bar.point_sigmas for bar in self.bars]) * sizes * metres
        weight = 1 / np.sqrt(sigma**2 + (picked**2).sum(1))
        by_end = [
            (scale * weight)[:, None, None] * along[:, None, :] @ _linear(pose) @ _moves(ends[:, k])[:, :, : self.dim]
            for k, pose in enumerate(poses)
        ]
        by_world = np.zeros((count, 1, 7))
        by_world[:, 0, 6] = length * weight
        parts = (
            (rows[:, 0] * self.dim, by_end[0]),
            (rows[:, 1] * self.dim, -by_end[1]),
            (np.full(count, columns.world), by_world),
        )
        return Terms("bar", ((length - measured) * weight)[:, None], parts, np.ones(count, dtype=bool))

    # --- points from photos alone ------------------------------------------------------------------------------------

    def triangulate(self, x: Unknowns, use: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Triangulate points from photos alone, with all poses fixed.

        The point of two or more rays is their least-squares intersection; a single ray gives its intersection with the
        rendered surface.

        Args:
            use: (I,) mask of the images to use.

        Returns:
            (K, 3) positions in the world frame, (K, 3, 3) covariances due to picking alone, and a (K,) mask of the
            points that the photos determine.
        """
        world = x.world[np.zeros(len(self.images), dtype=np.int64)]
        full = world @ x.scenes[self.image_scenes] @ self.cameras_at(x) if len(self.images) else world
        points, covariances, flags = x.points.copy(), np.zeros((len(self.points), 3, 3)), []
        for k in range(len(self.points)):
            mine = np.flatnonzero((self.image_points == k) & use)
            found = self._meeting(full[mine], [self.images[i] for i in mine.tolist()])
            flags.append(found is not None)
            if found is not None:
                points[k] = found
        determined = np.array(flags, dtype=bool)
        at = replace(x, points=points)
        for _ in range(10):
            terms = self._images(at)
            J = terms.parts[2][1] if len(self.images) else np.zeros((0, 3, 3))
            live = use & terms.valid
            H, g = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3))
            np.add.at(H, self.image_points[live], np.einsum("iab,iac->ibc", J[live], J[live]))
            np.add.at(g, self.image_points[live], np.einsum("iab,ia->ib", J[live], terms.residuals[live]))
            determined &= np.array([np.linalg.cond(h) < 1e12 if h.any() else False for h in H], dtype=bool)
            step = np.zeros_like(points)
            step[determined] = -np.linalg.solve(H[determined], g[determined][:, :, None])[:, :, 0]
            at = replace(at, points=at.points + step)
            if np.abs(step).max(initial=0) < 1e-9:
                break
        covariances[determined] = np.linalg.inv(H[determined]) if len(points) else covariances[determined]
        return at.points, covariances, determined

    def _meeting(self, cameras: Similarities, images: Sequence[ImagePoint]) -> np.ndarray | None:
        """Return a first estimate of the intersection of rays; None if they are too few or parallel and no surface is
        known."""
        if not images:
            return None
        centres = cameras.translations
        rays = np.array([_ray(image) for image in images])
        turned = np.einsum("nij,nj->ni", cameras.rotations, rays)
        unit = turned / np.linalg.norm(turned, axis=1, keepdims=True)
        away = np.eye(3) - unit[:, :, None] * unit[:, None, :]
        H = away.sum(0)
        if len(images) >= 2 and np.linalg.eigvalsh(H)[0] > 1e-5 * len(images):
            met: np.ndarray = np.linalg.solve(H, np.einsum("nij,nj->i", away, centres))
            if ((met - centres) * unit).sum(1).min() > 0:
                return met
        for k, image in enumerate(images):
            if image.depth is not None:
                seen: np.ndarray = centres[k] + turned[k] * image.depth * float(np.exp(cameras.log_scales[k]))
                return seen
        return None


def _ray(image: ImagePoint) -> np.ndarray:
    fx, fy, cx, cy = np.asarray(image.intrinsics_px, dtype=np.float64)
    return np.array([(image.pixel[0] - cx) / fx, (image.pixel[1] - cy) / fy, 1.0])


def _per_axis(sigma_m: tuple[float, float]) -> np.ndarray:
    return np.array([sigma_m[0], sigma_m[0], sigma_m[1]], dtype=np.float64)


def _natural(name: str) -> list[tuple[int, int, str]]:
    """Return a sort key that puts names in natural order: 2 before 10."""
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in re.split(r"(\d+)", name)]


def _linear(poses: Similarities) -> np.ndarray:
    """Compute the matrices ``s R`` (N, 3, 3) of poses."""
    out: np.ndarray = poses.rotations * np.exp(poses.log_scales)[:, None, None]
    return out


def _moves(points: np.ndarray) -> np.ndarray:
    """Compute the derivatives (N, 3, 7) of points with respect to a step of their frame: ``[-skew(x), I, x]``."""
    out = np.zeros((len(points), 3, 7))
    out[:, :, :3] = -skew(points)
    out[:, :, 3:6] = np.eye(3)
    out[:, :, 6] = points
    return out


def _whitener(covariance: np.ndarray) -> np.ndarray:
    """Compute ``L^-1`` (6, 6), the whitening matrix of a covariance ``L L^T``."""
    out: np.ndarray = np.linalg.inv(np.linalg.cholesky((covariance + covariance.T) / 2))
    return out
