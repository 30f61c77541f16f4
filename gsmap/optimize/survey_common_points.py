"""Collect the points common to the map and the world before the georeferenced solve, and find what they leave
undetermined."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gsmap.errors import InputError
from gsmap.geometry.rotations import skew
from gsmap.geometry.umeyama import umeyama
from gsmap.optimize.survey_system import System
from gsmap.types import Sim3
from gsmap.types.world import PositionFix

NOTHING = (
    "position, rotation and scale are not determined: add three control points that photos of the map show, or three "
    "positions of cameras or scenes, that are not on one line"
)
MAX_ROTATION_SIGMA_DEG = 5.0  # a component with a less certain rotation is not georeferenced
MAX_LOG_SCALE_SIGMA = 0.1  # the same limit for its log scale
_DRIFT_SHARE = 0.03  # of the extent of a map, by which drift may deform it
_DRAWS = 500  # number of triples of points that are tried as a first estimate if there are too many to try all
SURVEYED = "survey"  # name of the fix of a scene's origin; the fixes of photos have other names


@dataclass(frozen=True, eq=False)
class CommonPoints:
    """P points with known positions in the map and in the world.

    Args:
        names: names for messages.
        in_map, in_world: (P, 3) positions.
        own_m: (P, 3) standard deviations of each point's independent error.
        common_m: (P, 3) standard deviations of the error that a point shares with its unit.
        sea_m: (P,) standard deviation of the sea level, an error that all points measured from it share.
        kinds: (P,) ``points``, ``photos`` or ``scenes``.
        rows: (P,) row among the control points or fixes.
        units: (P,) unit of each point: the photos of one capture are a unit, any other point is a unit of its own.
        sources: (P,) source of each point; control points, surveyed scenes, photos with corrections and photos without
            corrections are one source each.
    """

    names: tuple[str, ...]
    in_map: np.ndarray
    in_world: np.ndarray
    own_m: np.ndarray
    common_m: np.ndarray
    sea_m: np.ndarray
    kinds: np.ndarray
    rows: np.ndarray
    units: np.ndarray
    sources: np.ndarray

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, keep: np.ndarray) -> CommonPoints:
        rows = np.flatnonzero(keep) if keep.dtype == bool else keep
        arrays = (self.in_map, self.in_world, self.own_m, self.common_m, self.sea_m)
        labels = (self.kinds, self.rows, self.units, self.sources)
        return CommonPoints(tuple(self.names[k] for k in rows.tolist()), *(one[rows] for one in (*arrays, *labels)))

    def reach_m(self) -> np.ndarray:
        """Compute the standard deviations (P, 3) of the points, including the errors that a point shares with
        others."""
        out = np.hypot(self.own_m, self.common_m)
        out[:, 2] = np.hypot(out[:, 2], self.sea_m)
        return out

    def missing(self, S: Sim3 | None = None) -> str | None:
        """Explain what the points leave undetermined, and what would determine it; None if they determine everything.

        Args:
            S: ``S_world_map`` near the answer; without it only the number of points is checked.
        """
        n = len(self)
        if not n:
            return NOTHING
        if n == 1:
            return (
                f"rotation and scale are not determined: only {self.names[0]} has a position both in the map and in "
                "the world; add two more control points or positions that are not on one line with it"
            )
        best = float((1 / self.own_m.max(1) ** 2).mean() ** -0.5)
        limit = np.radians(MAX_ROTATION_SIGMA_DEG)
        turns, scale = (np.array([0.0, 0.0, np.pi]), 0.0) if S is None else self._sigmas(S)
        if scale > MAX_LOG_SCALE_SIGMA or turns[1] > limit:
            return (
                f"rotation and scale are not determined: {_listed(self.names)} lie at one place within their errors; "
                f"add control points or positions more than {3 * best:.2g} m away"
            )
        if n == 2 or (S is not None and turns[2] > limit):
            turn = "" if n == 2 else f" (standard deviation {min(180.0, float(np.degrees(turns[2]))):.2g} deg)"
            return (
                f"rotation about the line through {_listed(self.names)} is not determined{turn}: add a control point "
                f"or position at least {best / limit:.2g} m away from that line, better as far as these points are "
                "apart"
            )
        return None

    def _sigmas(self, S: Sim3) -> tuple[np.ndarray, float]:
        """Compute the standard deviations of the rotation about its principal axes (3,), smallest first, and of the log
        scale.

        The information of all points is summed, with common errors as unknowns.
        """
        q = S.apply(self.in_map)
        q = q - q.mean(0)
        size = float(np.abs(q).max()) or 1.0
        by = np.zeros((len(q), 3, 8))
        by[:, :, :3], by[:, :, 3:6], by[:, :, 6] = -skew(q) / size, np.eye(3), q / size
        by[:, 2, 7] = self.sea_m
        weights = self.own_m**-2
        H = np.einsum("pai,pa,paj->ij", by, weights, by)
        H[7, 7] += 1
        _, unit = np.unique(self.units, return_inverse=True)
        shared = np.zeros((unit.max() + 1, 8, 3))
        np.add.at(shared, unit, np.einsum("pai,pa->pia", by, weights * self.common_m))
        known = np.ones((unit.max() + 1, 3))
        np.add.at(known, unit, weights * self.common_m**2)
        H -= np.einsum("uia,ua,uja->ij", shared, 1 / known, shared)
        root = np.sqrt(np.maximum(np.diag(H), 1e-18 * np.diag(H).max()))
        covariance = np.linalg.inv(H / root / root[:, None] + 1e-12 * np.eye(8)) / root / root[:, None]
        turns = np.sqrt(np.maximum(0, np.linalg.eigvalsh(covariance[:3, :3]))) / size
        return turns, float(np.sqrt(max(0.0, covariance[6, 6]))) / size

    def robust_fit(self) -> tuple[Sim3, np.ndarray]:
        """Fit the ``S_world_map`` that most points agree with; also return a (P,) mask of the points that agree.

        Every triple of points is tried, or `_DRAWS` of them; a point agrees if its residual is within its error and the
        drift of the map. Errors that all points share do not count.

        Raises:
            InputError: no similarity fits, because all points coincide.
        """
        n = len(self)
        middle = np.median(self.in_world, axis=0)
        extent = 2 * float(np.median(np.linalg.norm(self.in_world - middle, axis=1)))
        reach = self.own_m.max(1) + (self.common_m.max(1) if len(np.unique(self.units)) > 1 else 0.0)
        reach = np.hypot(reach, self.sea_m if self.sea_m.min() == 0 else 0.0)
        bar = 5 * reach + _DRIFT_SHARE * extent
        triples = list(itertools.combinations(range(n), 3)) if n <= 15 else self._drawn(_DRAWS)
        best, least = None, np.inf
        for three in triples:
            rows = list(three)
            try:
                S = umeyama(self.in_world[rows], self.in_map[rows], with_scale=True)
            except InputError:
                continue
            if _spread(self.in_map[rows])[1] < 0.02 * _spread(self.in_map[rows])[0]:
                continue
            cost = float(np.minimum(self._off(S) / bar, 1).sum())
            if cost < least - 1e-9:
                best, least = S, cost
        if best is None:
            best = umeyama(self.in_world, self.in_map, with_scale=True)
        near = self._off(best) < bar
        for _ in range(5):
            if near.sum() < 3:
                break
            best = umeyama(self.in_world[near], self.in_map[near], with_scale=True, weights=bar[near] ** -2)
            again = self._off(best) < bar
            if (again == near).all():
                break
            near = again
        return best, near

    def _drawn(self, count: int) -> list[tuple[int, ...]]:
        rng = np.random.default_rng(0)
        return [tuple(rng.choice(len(self), 3, replace=False).tolist()) for _ in range(count)]

    def _off(self, S: Sim3) -> np.ndarray:
        out: np.ndarray = np.linalg.norm(S.apply(self.in_map) - self.in_world, axis=1)
        return out

    def misfit_m(self) -> float:
        """Compute the RMS residual of the best similarity."""
        off = umeyama(self.in_world, self.in_map, with_scale=True).apply(self.in_map) - self.in_world
        return float(np.sqrt((off**2).sum(1).mean()))

    def noise_m(self, *, sea: bool = True) -> float:
        """Compute the largest residual that the stated errors and drift of the map explain: three standard deviations
        and 0.2 % of the extent.

        Args:
            sea: include the error of the sea level, which some of the points share.
        """
        reach = self.reach_m() if sea else np.hypot(self.own_m, self.common_m)
        extent = float(np.linalg.norm(np.ptp(self.in_world[:, :2], axis=0)))
        return 3 * float(np.sqrt((reach**2).sum(1).mean())) + 0.002 * extent

    def moved(self, rows: np.ndarray, by_m: np.ndarray) -> CommonPoints:
        """Return all points, where the world positions of the points at ``rows`` are moved by ``by_m`` (n, 3) or
        (3,)."""
        in_world = self.in_world.copy()
        in_world[rows] += by_m
        return replace(self, in_world=in_world)


def collect_common_points(system: System) -> CommonPoints:
    """Collect all common points of a component, before observations deform the map."""
    terms, x = system.terms, system.terms.start(system.scenes, Sim3.identity())
    in_map, _, determined = terms.triangulate(x, system.usable[1])
    chosen = np.flatnonzero(determined & ~system.is_check)
    points, fixes = [terms.points[k] for k in chosen.tolist()], terms.fixes
    kinds = ["points"] * len(points) + [fix_kind(fix) for fix in fixes]
    captures = {group: k for k, group in enumerate(sorted(set(terms.fix_groups)))}
    units = list(range(len(points)))
    units += [
        len(points) + (captures[group] if fix_kind(fix) == "photos" else len(captures) + k)
        for k, (fix, group) in enumerate(zip(fixes, terms.fix_groups, strict=True))
    ]
    corrected = [True] * len(points) + [
        group[1] if fix_kind(fix) == "photos" else True for fix, group in zip(fixes, terms.fix_groups, strict=True)
    ]
    sources = sorted(set(zip(kinds, corrected, strict=True)))
    zeros = [(0.0, 0.0)] * len(points)
    positions = [point.position for point in points] + [fix.position for fix in fixes]
    return CommonPoints(
        tuple([f"control point {p.name}" for p in points] + [f"{fix.name} of a scene" for fix in fixes]),
        np.concatenate([in_map[chosen], terms.fix_points(system.scenes)]),
        np.array(positions, dtype=np.float64).reshape(-1, 3),
        _axes([point.sigma_m for point in points] + [fix.sigma_m for fix in fixes]),
        _axes(zeros + [fix.common_sigma_m for fix in fixes]),
        np.array([0.0] * len(points) + [fix.sea_level_sigma_m for fix in fixes]),
        np.array(kinds, dtype="<U6"),
        np.r_[chosen, np.arange(len(fixes))].astype(np.int64),
        np.array(units, dtype=np.int64),
        np.array([sources.index(key) for key in zip(kinds, corrected, strict=True)], dtype=np.int64),
    )


def fix_kind(fix: PositionFix) -> str:
    """Return the group of observations to which a fix belongs."""
    return "scenes" if fix.name == SURVEYED else "photos"


def _axes(sigmas_m: Sequence[tuple[float, float]]) -> np.ndarray:
    """Expand horizontal and vertical standard deviations to three axes (P, 3)."""
    return np.array(sigmas_m, dtype=np.float64).reshape(-1, 2)[:, [0, 0, 1]]


def _spread(points: np.ndarray) -> np.ndarray:
    """Compute the root of the sum of squares of points (P, 3) along their principal axes (3,), largest first."""
    found = np.linalg.svd(points - points.mean(0), compute_uv=False)
    return np.r_[found, np.zeros(3)][:3]


def _listed(names: Sequence[str], most: int = 4) -> str:
    shown = list(names[:most])
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return (", ".join(shown[:-1]) + " and " + shown[-1] if len(shown) > 1 and not more else ", ".join(shown)) + more
