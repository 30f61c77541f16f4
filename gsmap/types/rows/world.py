"""The world: where components lie in it, how well the observations fit, and what was measured."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from gsmap.types.rows.base import Row, coordinates
from gsmap.types.sim3 import Sim3


@dataclass(frozen=True, eq=False, kw_only=True)
class ResidualRow(Row):
    """How one observation of the world fits.

    Args:
        kind: ``point`` (a control point), ``image`` (one in one photo), ``fix`` (a position of a camera or scene) or
            ``bar`` (a distance).
        name: of the control point, the point and its photo, the photo, or the bar.
        scene: id of the scene that it speaks of; empty for a control point, which several may show.
        scene_name: its name; empty as above.
        use: ``used``, ``outlier`` (it contradicts the others, and was left out), ``check`` (held out) or ``unused``.
        error_m: east, north, up in metres, from where the survey has it to where the map has it; of a bar how much
            longer the map has it; empty where the map cannot tell, and of images.
        size_m: length of that; null where it is empty.
        sigma_m: standard deviations of ``error_m`` by what the map knows.
        error_px: of an image: column, row, from where it was picked to where the map has it.
        statistic: chi-square of the observation against all others; null where nothing else checks it.
        dof: degrees of freedom of that.
        reason: why it is an outlier or unused; empty where it is neither.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "kind": "kind",
        "name": "name",
        "scene_name": "scene",
        "use": "use",
        "error_mm": "error E N U, mm",
        "size_m": "size, m",
        "error_px": "error, px",
        "statistic": "chi2",
        "dof": "dof",
        "reason": "reason",
    }

    kind: str
    name: str
    scene: str
    scene_name: str
    use: str
    error_m: tuple[float, ...]
    size_m: float | None
    sigma_m: tuple[float, ...]
    error_px: tuple[float, ...]
    statistic: float | None
    dof: int
    reason: str

    @property
    def error_mm(self) -> str:
        """The error for people, in millimetres."""
        return " ".join(f"{1000 * value:.1f}" for value in self.error_m)


@dataclass(frozen=True, eq=False, kw_only=True)
class ContradictionRow(Row):
    """A group of observations that differs from another group by more than their common errors explain.

    Args:
        group: ``points`` (control points), ``photos`` (of captures), ``scenes`` (surveyed scenes) or ``bars``.
        against: the group that it contradicts; the same where a group contradicts itself.
        cause: the likeliest reason: ``altitude_zero``, ``feet`` (taken for metres), ``above_takeoff`` (heights above
            take-off), ``height_system`` (ellipsoidal against orthometric heights), ``vertical_shift`` or
            ``horizontal_shift`` (no known reason, another datum or flight), ``shape`` (of another flight or place),
            ``scale`` (another unit of length) or ``split`` (the group contradicts itself).
        other_causes: further reasons that explain it as well.
        kept: the side that is solved from: ``against``, ``group``, or ``none`` where nothing tells which is right.
        offset_m: east, north, up of the group less where the other group has it; empty of bars.
        sigma_m: standard deviations of ``offset_m``, common errors included; empty of bars.
        ratio: of bars, measured length by the length in the map; null of other groups.
        count: observations of the group that differ so.
        scenes: ids of the captures that they are of.
        scene_names: names of these captures.
        text: all this in a sentence.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "group": "group",
        "against": "against",
        "cause": "likely reason",
        "kept": "kept",
        "count": "observations",
        "offset": "offset E N U, m",
    }

    group: str
    against: str
    cause: str
    other_causes: tuple[str, ...]
    kept: str
    offset_m: tuple[float, ...]
    sigma_m: tuple[float, ...]
    ratio: float | None
    count: int
    scenes: tuple[str, ...]
    scene_names: tuple[str, ...]
    text: str

    @property
    def offset(self) -> str:
        """The offset for people, in metres."""
        return " ".join(f"{value:.2f}" for value in self.offset_m)


@dataclass(frozen=True, eq=False, kw_only=True)
class TieRow(Row):
    """Where a component of the map lies in the world.

    Args:
        component: its index, largest first.
        num_scenes: scenes in it.
        S_world_map: takes its frame to the world frame (metres east, north, up at ``origin``); null where the
            observations do not determine it.
        covariance: (7, 7) of that over [rotation (3, rad), translation (3, map unit), log scale] on the map's side;
            null as above.
        metres_per_unit: metres in a unit of its frame; null where nothing tells.
        scale_sigma: standard deviation of the logarithm of that; null where nothing tells.
        rms_m: root mean square of the errors of the control points, fixes and bars that were solved from; null where
            there are none.
        rms_check_m: the same of check points.
        num_outliers: observations that were left out.
        residuals: of all its observations.
        problem: what is missing for ``S_world_map``; empty where it is there.
        problem_code: ``undetermined`` (observations are missing), ``contradiction`` (groups contradict each other and
            none is to be preferred), ``unsolved`` (no finite solution), or empty where there is no problem.
        contradictions: groups of observations that contradict each other.
        notes: what a person should know.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "component": "component",
        "num_scenes": "scenes",
        "metres_per_unit": "m a unit",
        "rms_m": "RMS, m",
        "rms_check_m": "RMS of checks, m",
        "num_outliers": "outliers",
        "problem": "problem",
    }

    component: int
    num_scenes: int
    S_world_map: Sim3 | None
    covariance: np.ndarray | None
    metres_per_unit: float | None
    scale_sigma: float | None
    rms_m: float | None
    rms_check_m: float | None
    num_outliers: int
    residuals: tuple[ResidualRow, ...]
    problem: str
    problem_code: str
    contradictions: tuple[ContradictionRow, ...]
    notes: tuple[str, ...]


@dataclass(frozen=True, eq=False, kw_only=True)
class WorldReport(Row):
    """How a map is tied to the world.

    Args:
        crs: its coordinate reference system, as it was named; null where none was.
        crs_name: the system's own name.
        axes: of a coordinate in it, in order.
        own_heights: whether its heights are its own (a geoid's); else they are above the ellipsoid.
        heights: the unit and zero of its heights, such as US survey feet above the ellipsoid; empty where there is no
            CRS.
        height_unit_m: metres in that unit; null where there is no CRS.
        origin: latitude and longitude (deg) and ellipsoidal height (m) of the world frame's origin, on the datum of the
            CRS; null where there is none.
        components: those of which anything was observed.
        unseen: names of control points that no photo of the map shows.
        revision: number of the poses that this is of; null before the first.
        stale: whether observations have come or gone since: ``gsmap optimize`` solves again.
        notes: what a person should know.
    """

    columns: ClassVar[Mapping[str, str]] = {"crs": "CRS", "crs_name": "name"}

    crs: str | None
    crs_name: str
    axes: tuple[str, ...]
    own_heights: bool
    heights: str
    height_unit_m: float | None
    origin: tuple[float, ...] | None
    components: tuple[TieRow, ...]
    unseen: tuple[str, ...]
    revision: int | None
    stale: bool
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False, kw_only=True)
class PlaceRow(Row):
    """A point of the map, in every frame that it has.

    Args:
        said: how it was given.
        scene: id of the scene that it was picked in; null where it was given in the map or the world.
        scene_name: its name; null as above.
        component: whose frame ``map`` is in; null for a point of the world, unless only one component is tied to it.
        map: (3,) in that frame; null where the component is not known.
        metric: (3,) metres east, north, up of the world frame; null where the component is not tied to the world.
        world: (3,) in the CRS; null as above.
        sigma_m: (3,) standard deviations of ``metric`` east, north, up; null where they are not known.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "said": "point",
        "scene_name": "scene",
        "component": "component",
        "map": "map (map units)",
        "in_world": "world",
    }

    said: str
    scene: str | None
    scene_name: str | None
    component: int | None
    map: np.ndarray | None
    metric: np.ndarray | None
    world: np.ndarray | None
    sigma_m: np.ndarray | None

    @property
    def in_world(self) -> str | None:
        """World coordinates for people."""
        return coordinates(self.world)


@dataclass(frozen=True, eq=False, kw_only=True)
class MeasureReport(Row):
    """How far two points are apart.

    Args:
        distance_m: in metres.
        sigma_m: its standard deviation, of all that is known to be uncertain: metre, poses, picking.
        known_by: how its metre is known: ``world`` (the map is tied to it), or as in ``gsmap status``.
        a: one point.
        b: the other.
        crs: of their world coordinates; null where there is none.
        heights: the unit and zero of the heights in it, such as metres above the ellipsoid; null as above.
        notes: what the sigma leaves out, and what else a person should know.
    """

    columns: ClassVar[Mapping[str, str]] = {"distance_m": "distance, m", "sigma_m": "sigma, m", "known_by": "metre"}

    distance_m: float
    sigma_m: float
    known_by: str
    a: PlaceRow
    b: PlaceRow
    crs: str | None
    heights: str | None
    notes: tuple[str, ...]
