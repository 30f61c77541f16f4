"""Select the groups of observations with common errors that agree, and explain the groups that contradict.

Control points, the photos of a capture, surveyed scenes and scale bars each have common errors, so no number of photos
outweighs a control point. The most precise source that alone determines the component is the reference. Every other
group is predicted from the reference, including the uncertainty of its common errors. A group that agrees is used; a
group that does not is reported with its shift and likely cause. See docs/design/0024-world-frame.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from gsmap.errors import InputError
from gsmap.optimize.survey_common_points import NOTHING, CommonPoints, collect_common_points
from gsmap.optimize.survey_report import Solution, SurveyFailure
from gsmap.optimize.survey_shifts import (
    FEET,
    GROUPS,
    CommonShift,
    altitudes,
    average_shifts,
    cluster_shifts,
    describe_contradiction,
    estimate_shift,
    format_causes,
    is_unmeasured,
    likely_causes,
)
from gsmap.optimize.survey_snooping import MAX_ROUNDS, describe_weakness, exclude_outliers, initial_points
from gsmap.optimize.survey_system import GATE_PROBABILITY, Active, Factor, System
from gsmap.optimize.survey_terms import Unknowns
from gsmap.types import Sim3
from gsmap.types.world import UNSOLVED, Contradiction, WorldFrame

# Groups whose sigmas differ by less than this factor are equally precise; a majority is larger by this factor.
_EQUAL = 2.0
_SPECIFIC = ("altitude_zero", "feet", "above_takeoff")  # causes that leave a characteristic pattern in the heights


@dataclass(frozen=True, eq=False)
class _PartialSolution:
    """A solution from some of the common points.

    Args:
        rows: rows of the points that the solution may use.
    """

    x: Unknowns
    active: Active
    factor: Factor
    rows: np.ndarray


@dataclass(frozen=True, eq=False)
class _ContradictingGroup:
    """A group that contradicts the reference.

    Args:
        rows: rows of the group's points.
        whole: most of the group's source contradicts the reference.
        if_wrong: likely causes if the group is wrong.
        if_right: likely causes if the reference is wrong.
    """

    rows: np.ndarray
    shift: CommonShift
    whole: bool
    if_wrong: tuple[str, ...]
    if_right: tuple[str, ...]


@dataclass(eq=False)
class _ContradictionLog:
    """Contradictions found so far, and the points that each of them excludes."""

    found: list[Contradiction] = field(default_factory=list)
    rows: list[np.ndarray] = field(default_factory=list)
    reasons: dict[tuple[str, int], str] = field(default_factory=dict)

    def add(self, one: Contradiction, places: CommonPoints, rows: np.ndarray | None = None) -> None:
        if one not in self.found:
            self.found.append(one)
            self.rows.append(np.zeros(0, dtype=np.int64) if rows is None else rows)
        for kind, row in zip(places.kinds.tolist(), places.rows.tolist(), strict=True):
            self.reasons["point" if kind == "points" else "fix", row] = one.text


def solve_groups(system: System, frame: WorldFrame | None) -> Solution | SurveyFailure:
    """Georeference a component by the groups of observations that agree, or return which observations are missing or
    contradictory."""
    places = collect_common_points(system)
    if frame is None or not len(places):
        return SurveyFailure(NOTHING, "undetermined")
    return _GroupSolver(system, places, frame).solve()


class _GroupSolver:
    def __init__(self, system: System, places: CommonPoints, frame: WorldFrame) -> None:
        self.system, self.places, self.frame = system, places, frame
        self.contradictions = _ContradictionLog()

    def solve(self) -> Solution | SurveyFailure:
        left = self._measured(np.arange(len(self.places)))
        while True:
            found = self._reference(left)
            if isinstance(found, str):
                return self._failure(found)
            reference, left = found
            rivals, agreeing = self._compared(reference, left)
            wrong = self._resolved(reference, rivals, agreeing)
            if isinstance(wrong, SurveyFailure):
                return wrong
            if wrong is None:
                break
            left = wrong  # the reference itself is wrong: go on without it
        self._explain(reference)
        return self._all(reference, agreeing)

    def _explain(self, reference: _PartialSolution) -> None:
        """Compare each source that contradicts itself with the reference; their difference may reveal the cause."""
        own = str(self.places.kinds[reference.rows[0]])
        for k, (one, rows) in enumerate(zip(self.contradictions.found, self.contradictions.rows, strict=True)):
            if one.cause == "split" and one.kept == "none" and len(rows) >= 2:
                some = self.places[rows]
                terms = self.system.terms.observations(reference.x)
                shift = estimate_shift(self.system, terms, reference.factor, some, used=False)
                if shift.log_p < np.log(1 - GATE_PROBABILITY):
                    why = likely_causes(some, replace(shift, shaped=True), self.frame, self._ground(reference.rows))
                    found = describe_contradiction(some, self._scenes(rows), shift, own, why, "against")
                    others = tuple(dict.fromkeys([*found.other_causes, "split", *one.other_causes]))
                    others = tuple(cause for cause in others if cause != found.cause)
                    self.contradictions.found[k] = replace(found, other_causes=others, text=f"{one.text}; {found.text}")

    # --- the reference -----------------------------------------------------------------------------------------------

    def _measured(self, rows: np.ndarray) -> np.ndarray:
        """Drop photos whose device did not measure the altitude."""
        keep = np.ones(len(rows), dtype=bool)
        for unit in np.unique(self.places.units[rows]):
            mine = rows[self.places.units[rows] == unit]
            some = self.places[mine]
            if some.kinds[0] == "photos" and some.common_m.any() and is_unmeasured(some, self.frame):
                keep &= self.places.units[rows] != unit
        if not keep.all():
            some, scenes = self.places[rows[~keep]], self._scenes(rows[~keep])
            text = (
                f"the altitudes of {len(some)} photos of {len(set(scenes))} captures are 0: the device did not "
                "measure them"
            )
            one = Contradiction(
                "photos", "photos", "altitude_zero", count=len(some), scenes=tuple(sorted(set(scenes))), text=text
            )
            self.contradictions.add(one, some)
        return rows[keep]

    def _scenes(self, rows: np.ndarray) -> list[str]:
        some = self.places[rows]
        fixes = self.system.terms.fixes
        return [
            fixes[row].scene
            for kind, row in zip(some.kinds.tolist(), some.rows.tolist(), strict=True)
            if kind != "points"
        ]

    def _sources(self, rows: np.ndarray) -> list[np.ndarray]:
        """Group rows by source, the most precise source first."""
        sources = self.places.sources[rows]
        groups = [rows[sources == source] for source in np.unique(sources)]
        return sorted(groups, key=lambda one: self._sigma_m(one))

    def _sigma_m(self, rows: np.ndarray, axis: int | None = None) -> float:
        reach = self.places[rows].reach_m()
        return float(np.median(np.linalg.norm(reach, axis=1) if axis is None else reach[:, axis]))

    def _reference(self, rows: np.ndarray) -> tuple[_PartialSolution, np.ndarray] | str:
        """Solve from the most precise source that alone determines the component, or from all sources; also return the
        remaining rows.

        Sources that contradict themselves are left out.
        """
        problem, sources = "", self._sources(rows)
        for mine in sources:
            found = self._alone(mine)
            if isinstance(found, _PartialSolution):
                return found, rows
            if isinstance(found, Contradiction):
                self.contradictions.add(found, self.places[mine], mine)
                rows = rows[~np.isin(rows, mine)]
            else:
                problem = problem or found
        remaining = self._sources(rows)
        if not len(remaining):
            return self.contradictions.found[-1].text if self.contradictions.found else problem or NOTHING
        if len(remaining) == 1 and len(sources) == 1:
            return problem
        found = self._alone(rows, bars=True)
        if isinstance(found, Contradiction):
            self.contradictions.add(found, self.places[rows])
            return found.text
        return found if isinstance(found, str) else (found, rows)

    def _alone(self, rows: np.ndarray, *, bars: bool = False) -> _PartialSolution | Contradiction | str:
        """Solve from some points alone; or return their contradiction, or a text about missing observations."""
        some = self.places[rows]
        if (missing := some.missing()) is not None:
            return missing
        try:
            world, near = some.robust_fit()
        except InputError:
            return some.missing(Sim3.identity()) or NOTHING
        if not near.all() and (split := self._in_feet(rows)) is not None:
            return split
        missing = some[near].missing(world)
        if missing is not None:
            return missing if near.all() else self._contradicted(rows[~near], rows[near], world, missing)
        x = self.system.terms.start(self.system.scenes, world)
        x = replace(x, points=initial_points(self.system, x))
        allowed = self._allowed(rows, bars=bars)
        gross = tuple(a & ~b for a, b in zip(allowed, self._allowed(rows[near], bars=bars), strict=True))
        try:
            x, active = exclude_outliers(self.system, x, allowed, gross)  # type: ignore[arg-type]
            x, active, factor, rows_kept = self._without_units(x, active, rows)
        except (np.linalg.LinAlgError, RuntimeError):
            return UNSOLVED
        tie = _PartialSolution(x, active, factor, rows_kept)
        split = self._split(tie, rows)
        if split is not None:
            return split
        return describe_weakness(self.system, factor) or tie

    def _contradicted(self, rows: np.ndarray, others: np.ndarray, world: Sim3, missing: str) -> Contradiction:
        """Describe points that contradict other points, which are too few to georeference the component.

        Args:
            world: the similarity with which the other points agree.
        """
        some = self.places[rows]
        off = np.median(some.in_world - world.apply(some.in_map), axis=0)
        shift = CommonShift(off, np.diag(np.median(some.reach_m(), axis=0)) ** 2, 0.0, rows >= 0)
        group, against = self._most(rows), self._most(others if len(others) else rows)
        why = likely_causes(some, shift, self.frame, self._ground(others))
        if group == against:
            why = ("split", *why)
        else:
            back = likely_causes(self.places[others], replace(shift, shift_m=-off), self.frame, self._ground(rows))
            if set(back) & set(_SPECIFIC) and not set(why) & set(_SPECIFIC):
                rows, shift, group, against, why = others, replace(shift, shift_m=-off), against, group, back
        scenes = tuple(sorted(set(self._scenes(rows))))
        sigma = tuple(np.sqrt(np.diag(shift.covariance)).tolist())
        text = f"{missing} ({GROUPS[group]} contradict {GROUPS[against]}: {format_causes(why)})"
        return Contradiction(
            group, against, why[0], why[1:], "none", tuple(shift.shift_m.tolist()), sigma, None, len(rows), scenes, text
        )

    def _most(self, rows: np.ndarray) -> str:
        """Return the most frequent kind of the points at ``rows``."""
        kinds, counts = np.unique(self.places.kinds[rows], return_counts=True)
        return str(kinds[np.argmax(counts)])

    def _allowed(self, rows: np.ndarray, *, bars: bool) -> Active:
        some, usable = self.places[rows], self.system.usable
        points, fixes = np.zeros_like(usable[0]), np.zeros_like(usable[2])
        points[some.rows[some.kinds == "points"]] = True
        fixes[some.rows[some.kinds != "points"]] = True
        return points, usable[1].copy(), fixes, usable[3] & bars

    def _is_active(self, active: Active, rows: np.ndarray) -> np.ndarray:
        """Return an (n,) mask of the points that the solution uses."""
        some = self.places[rows]
        out = np.zeros(len(rows), dtype=bool)
        of_points = some.kinds == "points"
        out[of_points], out[~of_points] = active[0][some.rows[of_points]], active[2][some.rows[~of_points]]
        return out

    def _without_units(
        self, x: Unknowns, active: Active, rows: np.ndarray
    ) -> tuple[Unknowns, Active, Factor, np.ndarray]:
        """Apply data snooping to captures: exclude photos whose common error exceeds the stated common error, the worst
        first."""
        for _ in range(MAX_ROUNDS):
            factor, terms = self.system.factor(x, self.system.as_weights(active)), self.system.terms.observations(x)
            use = rows[self._is_active(active, rows)]
            use = use[self.places.kinds[use] == "photos"]
            units = np.unique(self.places.units[use])
            worst, out = np.log((1 - GATE_PROBABILITY) / max(1, len(units))), None
            for unit in units:
                mine = use[self.places.units[use] == unit]
                if len(mine) >= 2:
                    log_p = estimate_shift(self.system, terms, factor, self.places[mine], used=True).log_p
                    if log_p < worst - 1e-9:
                        worst, out = log_p, unit
            if out is None:
                return x, active, factor, rows
            rows = rows[self.places.units[rows] != out]
            allowed = self._allowed(rows, bars=False)
            fixes = active[2] & allowed[2]
            if not (fixes.any() or active[0].any()):
                return x, active, factor, rows
            active = active[0], active[1], fixes, active[3]
            x, active = exclude_outliers(
                self.system, x, (active[0], active[1], allowed[2], active[3]),
                (~active[0], ~active[1], allowed[2] & ~fixes, ~active[3]),
            )  # fmt: skip
        return x, active, self.system.factor(x, self.system.as_weights(active)), rows

    def _split(self, tie: _PartialSolution, rows: np.ndarray) -> Contradiction | None:
        """Return the contradiction if the excluded points are too many, or agree too well with each other, to be
        blunders."""
        use = self._is_active(tie.active, rows)
        units, unit = np.unique(self.places.units[rows], return_inverse=True)
        kept = np.bincount(unit, use, len(units)) * 2 > np.bincount(unit, minlength=len(units))
        if kept.all():
            return None
        if (feet := self._in_feet(rows)) is not None:
            return feet
        dropped = [rows[unit == k] for k in np.flatnonzero(~kept).tolist()]
        terms = self.system.terms.observations(tie.x)
        shifts = [estimate_shift(self.system, terms, tie.factor, self.places[mine], used=False) for mine in dropped]
        groups = cluster_shifts(shifts, GATE_PROBABILITY)
        largest = max(len(groups[0]), self._elsewhere(np.concatenate(dropped)))
        if kept.sum() > len(dropped) and (largest == 1 or kept.sum() >= _EQUAL * largest):
            for group in groups:
                self._blunder([dropped[k] for k in group.tolist()], [shifts[k] for k in group.tolist()], rows)
            return None
        some = np.concatenate([dropped[k] for k in groups[0].tolist()])
        shift = average_shifts([shifts[k] for k in groups[0].tolist()])
        one = describe_contradiction(
            self.places[some], self._scenes(some), shift, str(self.places.kinds[rows[0]]), ("split",), "none"
        )
        if len(some) > 1:
            why = likely_causes(self.places[some], shift, self.frame, self._ground(rows))
            if self._fits_in_feet(rows, 0.9 / FEET):
                why = tuple(dict.fromkeys(["feet", *why]))
            one = replace(one, other_causes=why)
        return replace(
            one, text=f"{one.text} ({len(rows) - len(some)} against {len(some)}): cannot tell which are correct"
        )

    def _blunder(self, dropped: Sequence[np.ndarray], shifts: Sequence[CommonShift], rows: np.ndarray) -> None:
        """Record a minority of several points that share a contradiction with their own source."""
        mine = np.concatenate(dropped)
        if len(mine) < 2:
            return
        some, shift = self.places[mine], average_shifts(shifts)
        why = likely_causes(some, shift, self.frame, self._ground(rows))
        kind = str(self.places.kinds[rows[0]])
        self.contradictions.add(describe_contradiction(some, self._scenes(mine), shift, kind, why, "against"), some)

    def _elsewhere(self, rows: np.ndarray) -> int:
        """Count the units of some points that agree on a similarity of their own."""
        if len(rows) < 4:
            return 0
        try:
            _, near = self.places[rows].robust_fit()
        except InputError:
            return 0
        return len(np.unique(self.places.units[rows[near]])) if near.sum() >= 4 else 0

    def _in_feet(self, rows: np.ndarray) -> Contradiction | None:
        """Return a contradiction if points fit the map only after their heights are converted from or to feet."""
        some = self.places[rows]
        if len(some) < 4:
            return None
        # Smaller heights make blunders smaller by the same factor, so the conversion must explain more than that.
        if not self._fits_in_feet(rows, 2 / FEET):
            return None
        kind, scenes = str(some.kinds[0]), self._scenes(rows)
        text = (
            f"the heights of {len(some)} {GROUPS[kind]} match the shape of the map only if they are feet taken for "
            "metres"
        )
        return Contradiction(kind, kind, "feet", count=len(some), scenes=tuple(sorted(set(scenes))), text=text)

    def _fits_in_feet(self, rows: np.ndarray, better: float) -> bool:
        """Return whether heights converted from or to feet fit the map within their errors, and better by a factor."""
        some = self.places[rows]
        left = min(self._converted(rows, factor)[rows].misfit_m() for factor in (FEET, 1 / FEET))
        return bool(some.misfit_m() > better * left and left < some.noise_m(sea=False))

    def _converted(self, rows: np.ndarray, factor: float) -> CommonPoints:
        """Return all points, with the altitudes of the points at ``rows`` multiplied by a factor."""
        own = altitudes(self.frame, self.places[rows].in_world)
        return self.places.moved(rows, np.outer(own * (factor - 1), [0, 0, 1]))

    def _ground(self, rows: np.ndarray) -> np.ndarray | None:
        """Return the altitudes of the marks on the ground among some points; None if there are none."""
        marks = self.places[rows[self.places.kinds[rows] == "points"]]
        return altitudes(self.frame, marks.in_world) if len(marks) else None

    # --- every other group -------------------------------------------------------------------------------------------

    def _compared(self, reference: _PartialSolution, left: np.ndarray) -> tuple[list[_ContradictingGroup], np.ndarray]:
        """Compare groups with the reference: return the groups that contradict it, and the rows of the points that
        agree with it."""
        rivals: list[_ContradictingGroup] = []
        agreeing: list[np.ndarray] = []
        terms = self.system.terms.observations(reference.x)
        sources = np.unique(self.places.sources[reference.rows])
        for mine in self._sources(left[~np.isin(self.places.sources[left], sources)]):
            units = [mine[self.places.units[mine] == unit] for unit in np.unique(self.places.units[mine])]
            shifts = [
                estimate_shift(self.system, terms, reference.factor, self.places[unit], used=False) for unit in units
            ]
            alpha = np.log((1 - GATE_PROBABILITY) / len(units))
            bad = [k for k, one in enumerate(shifts) if one.log_p < alpha or not one.shaped]
            # A common shift of a source also excludes units of that source that alone are just below the gate.
            bad += [k for k, one in enumerate(shifts) if k not in bad and any(_is_similar(one, shifts[j]) for j in bad)]
            good = [k for k in range(len(units)) if k not in bad]
            agreeing += [units[k][shifts[k].agree] for k in good]
            if bad:
                rivals += self._rivals([units[k] for k in bad], [shifts[k] for k in bad], len(good), reference)
        return rivals, np.concatenate([np.zeros(0, dtype=np.int64), *agreeing])

    def _rivals(
        self, units: Sequence[np.ndarray], shifts: Sequence[CommonShift], num_good: int, reference: _PartialSolution
    ) -> list[_ContradictingGroup]:
        """Form groups of two or more points with a common shift; single points are blunders and excluded."""
        unshaped = [k for k, one in enumerate(shifts) if not one.shaped]
        shaped = [k for k in range(len(shifts)) if k not in unshaped]
        sets = [np.array(unshaped)] if unshaped else []
        sets += [np.array(shaped)[one] for one in cluster_shifts([shifts[k] for k in shaped], GATE_PROBABILITY)]
        out = []
        for some in sets:
            rows = np.concatenate([units[k] for k in some.tolist()])
            if len(rows) < 2:
                continue
            shift = average_shifts([shifts[k] for k in some.tolist()])
            used = reference.rows[self._is_active(reference.active, reference.rows)]
            wrong = likely_causes(self.places[rows], shift, self.frame, self._ground(used))
            back = replace(shift, shift_m=-shift.shift_m)
            # A wrong reference deforms the component, so the shape of the component is no evidence.
            right = likely_causes(self.places[used], replace(back, shaped=True), self.frame, self._ground(rows))
            together = np.concatenate([used, rows])
            shifted = self.places.moved(rows, -shift.shift_m)[together].misfit_m()
            converted = self._converted(used, FEET)[together].misfit_m()
            if shifted > 2 * converted and converted < self.places[together].noise_m():
                right, wrong = ("feet",), tuple(why for why in wrong if why not in _SPECIFIC) or ("vertical_shift",)
            out.append(_ContradictingGroup(rows, shift, len(some) > num_good, wrong, right))
        return out

    def _resolved(
        self, reference: _PartialSolution, rivals: Sequence[_ContradictingGroup], agreeing: np.ndarray
    ) -> np.ndarray | SurveyFailure | None:
        """Decide between the reference and the groups that contradict it.

        Returns:
            None if the reference is correct; the rows to continue with if the reference is wrong; or a failure.
        """
        used = reference.rows[self._is_active(reference.active, reference.rows)]
        own = str(self.places.kinds[used[0]])
        named: list[tuple[Contradiction, CommonPoints]] = []
        for rival in rivals:
            some, scenes = self.places[rival.rows], self._scenes(rival.rows)
            axis = 2 if abs(rival.shift.shift_m[2]) >= np.linalg.norm(rival.shift.shift_m[:2]) else 0
            size = float(np.linalg.norm(rival.shift.shift_m[2:] if axis == 2 else rival.shift.shift_m[:2]))
            ratio = self._sigma_m(rival.rows, axis) / self._sigma_m(used, axis)
            supported = any(
                self._sigma_m(agreeing[self.places.kinds[agreeing] == kind], axis) < size / 3
                for kind in np.unique(self.places.kinds[agreeing])
            )
            seconded = any(
                other.whole
                and self.places.kinds[other.rows[0]] != some.kinds[0]
                and np.linalg.norm(other.shift.shift_m - rival.shift.shift_m) < 0.2 * size
                for other in rivals
            )
            marked, own_marked = (any(why in _SPECIFIC for why in one) for one in (rival.if_wrong, rival.if_right))
            equal = 1 / _EQUAL < ratio < _EQUAL
            if rival.whole and own_marked and not (marked or equal or supported):
                back = replace(rival.shift, shift_m=-rival.shift.shift_m)
                wrong, its = self.places[reference.rows], self._scenes(reference.rows)
                one = describe_contradiction(wrong, its, back, str(some.kinds[0]), rival.if_right, "against")
                self.contradictions.add(one, wrong)
                keep = self.places.sources != self.places.sources[used[0]]
                return np.setdiff1d(np.flatnonzero(keep), self._left_out())
            precise = ratio >= _EQUAL and not (marked and own_marked)
            marked = marked and not (own_marked or equal)
            if supported or not rival.whole or ((precise or marked) and not seconded):
                named.append((describe_contradiction(some, scenes, rival.shift, own, rival.if_wrong, "against"), some))
                continue
            both = tuple(dict.fromkeys([*rival.if_wrong, *rival.if_right]))
            one = describe_contradiction(some, scenes, rival.shift, own, both, "none")
            one = replace(one, text=f"{one.text} Cannot tell which are correct")
            self.contradictions.add(one, some)
            return self._failure(one.text)
        for one, some in named:
            self.contradictions.add(one, some)
        return None

    def _left_out(self) -> np.ndarray:
        """Return the rows of the points that a contradiction has excluded."""
        kinds = np.where(self.places.kinds == "points", "point", "fix")
        pairs = zip(kinds.tolist(), self.places.rows.tolist(), strict=True)
        return np.flatnonzero([pair in self.contradictions.reasons for pair in pairs])

    def _failure(self, problem: str) -> SurveyFailure:
        found = self.contradictions.found
        if not found:
            return SurveyFailure(problem, "unsolved" if problem == UNSOLVED else "undetermined")
        texts = dict.fromkeys([*(one.text for one in found), problem])
        return SurveyFailure("; ".join(texts), "contradiction", tuple(found))

    # --- everything that agrees --------------------------------------------------------------------------------------

    def _all(self, reference: _PartialSolution, agreeing: np.ndarray) -> Solution:
        """Solve with all groups that agree; or with the reference alone, if more stays undetermined with all groups."""
        rows = np.concatenate([reference.rows, agreeing])
        bars = self._bars(reference)
        best = reference
        if len(agreeing) or bars.any():
            allowed = (*self._allowed(rows, bars=False)[:3], bars)
            start = self._is_active(reference.active, reference.rows)
            gross = self._allowed(reference.rows[~start], bars=False)
            gross = (gross[0], allowed[1] & ~reference.active[1], gross[2], np.zeros_like(bars))
            try:
                x, active = exclude_outliers(self.system, reference.x, allowed, gross)
                x, active, factor, kept = self._without_units(x, active, rows)
                lost = start.sum() > 2 * self._is_active(active, reference.rows).sum()
                if not (lost or describe_weakness(self.system, factor)):
                    best = _PartialSolution(x, active, factor, kept)
                    self._name_units(best, np.setdiff1d(rows, kept))
            except (np.linalg.LinAlgError, RuntimeError):
                pass
        return Solution(
            best.x, best.active, best.factor, tuple(self.contradictions.found), dict(self.contradictions.reasons)
        )

    def _name_units(self, tie: _PartialSolution, rows: np.ndarray) -> None:
        """Record the captures that the last step excluded."""
        terms = self.system.terms.observations(tie.x)
        for unit in np.unique(self.places.units[rows]):
            mine = rows[self.places.units[rows] == unit]
            shift = estimate_shift(self.system, terms, tie.factor, self.places[mine], used=False)
            self._blunder([mine], [shift], tie.rows)

    def _bars(self, reference: _PartialSolution) -> np.ndarray:
        """Return a (G,) mask of the scale bars to use; bars that contradict the reference by a common factor are
        recorded."""
        bars = self.system.terms.bars
        if not bars:
            return np.zeros(0, dtype=bool)
        terms = self.system.terms.observations(reference.x)[3]
        tests = self.system.tests(reference.x, reference.active, reference.factor)
        bad = tests.log_p[3] < np.log(1 - GATE_PROBABILITY)
        if not bad.any():
            return ~bad
        # Both values are whitened: the residual, and the derivative of a bar's length in the map by the log scale.
        ratios = np.maximum(1 - terms.residuals[:, 0] / terms.parts[2][1][:, 0, 6], 1e-9)
        same = bad & (np.abs(np.log(ratios / np.median(ratios[bad]))) < 0.02)
        if same.sum() < 2 or same.sum() <= (~bad).sum():
            return ~bad
        ratio = float(np.median(ratios[same]))
        feet = abs(np.log(ratio) - np.log(FEET)) < 0.02 or abs(np.log(ratio) + np.log(FEET)) < 0.02
        cause = "feet" if feet else "scale"
        own = str(self.places.kinds[reference.rows[0]])
        text = (
            f"{int(same.sum())} scale bars give {ratio:.4g} times the length that the {GROUPS[own]} give: "
            f"{format_causes([cause])}"
        )
        self.contradictions.add(
            Contradiction("bars", own, cause, (), "against", (), (), ratio, int(same.sum()), (), text),
            self.places[np.zeros(0, dtype=np.int64)],
        )
        for k in np.flatnonzero(bad).tolist():
            self.contradictions.reasons["bar", k] = text
        return ~bad


def _is_similar(one: CommonShift, other: CommonShift) -> bool:
    off = np.linalg.norm(one.shift_m - other.shift_m)
    return other.shaped and bool(off < 0.3 * np.linalg.norm(other.shift_m))
