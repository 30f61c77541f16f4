"""What is known both in the map and in the world before anything is bent: whether it determines where the map lies."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gsmap.errors import InputError
from gsmap.geometry.umeyama import umeyama
from gsmap.optimize.params import SurveyParams
from gsmap.optimize.survey_system import Active, System
from gsmap.optimize.survey_terms import SurveyTerms
from gsmap.types import Sim3

NOTHING = (
    "position, rotation and scale are not determined: it takes three control points that photos of the map show, or "
    "positions of cameras or scenes, that are not on one line"
)


@dataclass(frozen=True, eq=False)
class Places:
    """P places known in the map and in the world.

    Args:
        names: for people. in_map, in_world: (P, 3).
        sigma_m: (P,) of each by itself. reach_m: (P,) with what it is off by together with others.
        rows: (P,) of the control point; -1 of a fix.
    """

    names: tuple[str, ...]
    in_map: np.ndarray
    in_world: np.ndarray
    sigma_m: np.ndarray
    reach_m: np.ndarray
    rows: np.ndarray

    def __getitem__(self, keep: np.ndarray) -> Places:
        names = tuple(name for name, k in zip(self.names, keep.tolist(), strict=True) if k)
        arrays = (self.in_map, self.in_world, self.sigma_m, self.reach_m, self.rows)
        return Places(names, *(array[keep] for array in arrays))

    def missing(self, params: SurveyParams) -> str | None:
        """What they do not determine, and what would; None where they determine everything."""
        n = len(self.names)
        if not n:
            return NOTHING
        if n == 1:
            return (
                f"rotation and scale are not determined: only {self.names[0]} is known both in the map and in the "
                "world; add two more that are not on one line with it"
            )
        sigma = float(np.sqrt((self.sigma_m**2).mean()))
        spread = np.minimum(*[_spread(points, size) for points, size in self._in_metres()])
        if spread[0] < 3 * sigma:
            return (
                f"rotation and scale are not determined: {_listed(self.names)} lie at one place within their errors; "
                f"add others further off than {3 * sigma:.2g} m"
            )
        limit = np.radians(params.max_rotation_sigma_deg)
        if n == 2 or spread[1] < sigma / limit:
            turn = (
                "" if n == 2 else f" (known to {min(180.0, float(np.degrees(sigma / max(spread[1], 1e-12)))):.2g} deg)"
            )
            return (
                f"rotation about the line through {_listed(self.names)} is not determined{turn}: add a control point "
                f"or position at least {sigma / limit:.2g} m off that line, better as far as they are apart"
            )
        return None

    def _in_metres(self) -> list[tuple[np.ndarray, float]]:
        """World and map, the map as large as the world: a blunder may put on a line what is not, or the reverse."""
        size = float(np.median(np.linalg.norm(self.in_map - np.median(self.in_map, axis=0), axis=1)))
        true = float(np.median(np.linalg.norm(self.in_world - np.median(self.in_world, axis=0), axis=1)))
        return [(self.in_world, 1.0), (self.in_map, true / size if size > 0 and true > 0 else 1.0)]

    def robust_fit(self, params: SurveyParams) -> tuple[Sim3, np.ndarray]:
        """``S_world_map`` that most of them agree with, and (P,) bool which do.

        Every triple is tried, or so many of them; what agrees is what lies within its error and the drift of a map.
        """
        n = len(self.names)
        middle = np.median(self.in_world, axis=0)
        extent = 2 * float(np.median(np.linalg.norm(self.in_world - middle, axis=1)))
        bar = 5 * self.reach_m + params.drift_share * extent
        triples = list(itertools.combinations(range(n), 3)) if n <= 15 else self._drawn(params.draws)
        best, least = None, np.inf
        for three in triples:
            rows = list(three)
            try:
                S = umeyama(self.in_world[rows], self.in_map[rows], with_scale=True)
            except InputError:
                continue
            if _spread(self.in_map[rows], 1.0)[1] < 0.02 * _spread(self.in_map[rows], 1.0)[0]:
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
        return [tuple(rng.choice(len(self.names), 3, replace=False).tolist()) for _ in range(count)]

    def _off(self, S: Sim3) -> np.ndarray:
        out: np.ndarray = np.linalg.norm(S.apply(self.in_map) - self.in_world, axis=1)
        return out

    def gross(self, near: np.ndarray, terms: SurveyTerms) -> Active:
        """Observations that are far from what most agree on: left out before anything is bent to them."""
        points = np.zeros(len(terms.points), dtype=bool)
        of_points = self.rows >= 0
        points[self.rows[of_points & ~near]] = True
        none = np.zeros(len(terms.images), dtype=bool), np.zeros(len(terms.bars), dtype=bool)
        return points, none[0], ~near[~of_points], none[1]


def known_places(system: System) -> Places:
    """What is known both in the map and in the world, as it lies before anything is bent."""
    terms, x = system.terms, system.terms.start(system.scenes, Sim3.identity())
    in_map, _, told = terms.triangulated(x, system.usable[1])
    chosen = np.flatnonzero(told & ~system.is_check)
    names = [f"control point {terms.points[k].name}" for k in chosen.tolist()]
    names += [f"{fix.name} of a scene" for fix in terms.fixes]
    world = [terms.points[k].position for k in chosen.tolist()] + [fix.position for fix in terms.fixes]
    sigmas = [max(terms.points[k].sigma_m) for k in chosen.tolist()]
    reach = sigmas + [float(np.hypot(max(f.sigma_m) + max(f.common_sigma_m), f.sea_level_sigma_m)) for f in terms.fixes]
    sigmas = sigmas + [max(fix.sigma_m) for fix in terms.fixes]
    places = np.concatenate([in_map[chosen], terms.fix_points(system.scenes)])
    return Places(
        tuple(names),
        places,
        np.array(world, dtype=np.float64).reshape(-1, 3),
        np.array(sigmas, dtype=np.float64),
        np.array(reach, dtype=np.float64),
        np.r_[chosen, np.full(len(terms.fixes), -1)],
    )


def _spread(points: np.ndarray, size: float) -> np.ndarray:
    """(3,) root of the sum of squares along the principal axes, largest first."""
    found = np.linalg.svd((points - points.mean(0)) * size, compute_uv=False)
    return np.r_[found, np.zeros(3)][:3]


def _listed(names: Sequence[str], most: int = 4) -> str:
    shown = list(names[:most])
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return (", ".join(shown[:-1]) + " and " + shown[-1] if len(shown) > 1 and not more else ", ".join(shown)) + more
