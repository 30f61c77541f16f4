"""Rows about the world frame: georeferences of components, residuals of observations, and measurements."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from gsmap.types.rows.base import Row, coordinates
from gsmap.types.world import Contradiction, Residual, WorldPose


@dataclass(frozen=True, eq=False, kw_only=True)
class ResidualRow(Residual, Row):
    """The residual of one observation of the world.

    Args:
        scene_name: name of the scene; empty for a control point.
        size_m: length of ``error_m``; null if it is empty.
        reason_code: code of the reason, a key of `gsmap.reason_codes.REASONS`, or empty.
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

    scene_name: str
    size_m: float | None
    reason_code: str = ""

    @property
    def error_mm(self) -> str:
        """The error along each axis in millimetres, as text."""
        return " ".join(f"{1000 * value:.1f}" for value in self.error_m)


@dataclass(frozen=True, eq=False, kw_only=True)
class ResidualSummaryRow(Row):
    """The residuals of one kind of observation, in metres.

    Args:
        kind: ``point`` (used control points), ``check`` (points held out), ``fix`` (positions of cameras and scenes) or
            ``bar`` (distances).
        count: number of used observations; of check points, of all.
        num_outliers: number left out, because they contradict the others.
        rms_m: root mean square error east, north, up; of bars, one number.
        max_m: largest error along each of them.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "kind": "kind",
        "count": "count",
        "num_outliers": "outliers",
        "rms": "RMS E N U, m",
        "largest": "largest E N U, m",
    }

    kind: str
    count: int
    num_outliers: int
    rms_m: tuple[float, ...]
    max_m: tuple[float, ...]

    @property
    def rms(self) -> str:
        """The root mean square errors as text."""
        return " ".join(f"{value:.4f}" for value in self.rms_m)

    @property
    def largest(self) -> str:
        """The largest errors as text."""
        return " ".join(f"{value:.4f}" for value in self.max_m)


@dataclass(frozen=True, eq=False, kw_only=True)
class ContradictionRow(Contradiction, Row):
    """A group of observations that contradicts another group by more than the common errors of both groups explain.

    Args:
        scene_names: names of the captures.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "group": "group",
        "against": "against",
        "cause": "likely reason",
        "kept": "kept",
        "count": "observations",
        "offset": "offset E N U, m",
    }

    scene_names: tuple[str, ...]

    @property
    def offset(self) -> str:
        """The offset along east, north and up in metres, as text."""
        return " ".join(f"{value:.2f}" for value in self.offset_m)


@dataclass(frozen=True, eq=False, kw_only=True)
class GeoreferenceRow(WorldPose, Row):
    """The pose of a component in the world.

    Args:
        num_scenes: number of scenes.
        scale_sigma: standard deviation of the logarithm of ``metres_per_unit``; null if unknown.
        rms_m: root mean square error of the used control points, fixes and bars; null without any.
        rms_check_m: root mean square error of the check points; null without any.
        num_outliers: number of outliers.
        by_kind: summary of the residuals of each kind of observation.
        residuals: residuals of all its observations.
        contradictions: groups of observations that contradict each other.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "component": "component",
        "num_scenes": "scenes",
        "metres_per_unit": "m per unit",
        "rms_m": "RMS, m",
        "rms_check_m": "RMS of checks, m",
        "num_outliers": "outliers",
        "problem": "problem",
    }

    num_scenes: int
    scale_sigma: float | None
    rms_m: float | None
    rms_check_m: float | None
    num_outliers: int
    by_kind: tuple[ResidualSummaryRow, ...]
    residuals: tuple[ResidualRow, ...]
    contradictions: tuple[ContradictionRow, ...]


@dataclass(frozen=True, eq=False, kw_only=True)
class WorldReport(Row):
    """The georeference of a map.

    Args:
        crs: specified coordinate reference system; null without one.
        crs_name: official name of the CRS.
        axes: axes of its coordinates, in order.
        own_heights: true if the CRS has a vertical axis of its own (a geoid's); else heights are above the ellipsoid.
        heights: unit and zero of heights, such as US survey feet above the ellipsoid; empty without a CRS.
        height_unit_m: metres per unit of height; null without a CRS.
        origin: latitude and longitude (deg) and ellipsoidal height (m) of the world frame's origin, on the CRS's datum;
            null without a world frame.
        components: components with observations.
        unseen: names of control points without a pixel in a photo of the map.
        revision: number of the revision; null before the first.
        stale: true if observations have changed since: ``gsmap optimize`` solves again.
        notes: remarks.
    """

    columns: ClassVar[Mapping[str, str]] = {"crs": "CRS", "crs_name": "name"}

    crs: str | None
    crs_name: str
    axes: tuple[str, ...]
    own_heights: bool
    heights: str
    height_unit_m: float | None
    origin: tuple[float, ...] | None
    components: tuple[GeoreferenceRow, ...]
    unseen: tuple[str, ...]
    revision: int | None
    stale: bool
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False, kw_only=True)
class PointRow(Row):
    """A point with its coordinates in every frame of the map.

    Args:
        said: the point as given.
        scene: id of its scene; null for a point of the map or world.
        scene_name: name of its scene; null for a point of the map or world.
        component: component of ``map``; null for a point of the world, unless only one component is georeferenced.
        map: (3,) coordinates in the map; null if the component is unknown.
        metric: (3,) metres east, north, up of the world frame; null if the component is not georeferenced.
        world: (3,) coordinates in the CRS; null if the component is not georeferenced.
        sigma_m: (3,) standard deviations of ``metric`` east, north, up; null if unknown.
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
        """World coordinates as text."""
        return coordinates(self.world)


@dataclass(frozen=True, eq=False, kw_only=True)
class MeasureReport(Row):
    """The distance of two points.

    Args:
        distance_m: distance in metres.
        sigma_m: standard deviation of the distance from metric scale, poses and picking.
        known_by: source of the metric scale: ``world`` (georeferenced), or as in ``gsmap status``.
        a: the first point.
        b: the second point.
        crs: CRS of their world coordinates; null without one.
        heights: unit and zero of heights in the CRS, such as metres above the ellipsoid; null without a CRS.
        notes: remarks, such as errors that ``sigma_m`` leaves out.
    """

    columns: ClassVar[Mapping[str, str]] = {"distance_m": "distance, m", "sigma_m": "sigma, m", "known_by": "metre"}

    distance_m: float
    sigma_m: float
    known_by: str
    a: PointRow
    b: PointRow
    crs: str | None
    heights: str | None
    notes: tuple[str, ...]
