"""Parse and check coordinate reference systems with PROJ, and convert coordinates to geodetic ones and back."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from gsmap.errors import ConfigError, InputError

ECEF = "EPSG:4978"
WGS84 = "EPSG:4979"


@dataclass(frozen=True)
class Crs:
    """A coordinate reference system, with axes in the order easting, northing, height.

    Args:
        text: ``EPSG:N``, ``EPSG:N+M`` (with a height system), a PROJ string or WKT, as specified.
    """

    text: str

    @cached_property
    def named(self) -> Any:
        """The specified system, as a pyproj CRS."""
        from pyproj import CRS
        from pyproj.exceptions import CRSError

        try:
            found = CRS.from_user_input(self.text)
        except CRSError as error:
            raise ConfigError(
                f"PROJ knows no coordinate reference system {_short(self.text)}: pass one such as EPSG:25832, "
                "EPSG:25832+7837 (with its height system) or EPSG:4326",
                code="invalid_crs",
            ) from error
        horizontal = found.sub_crs_list[0] if found.is_compound else found
        if not (horizontal.is_projected or horizontal.is_geographic or horizontal.is_geocentric):
            raise ConfigError(
                f"{_short(self.text)} has no horizontal positions on the Earth ({found.type_name}): a system of "
                "heights alone, or the local grid of a site, cannot georeference a map",
                code="unsupported_crs",
            )
        if horizontal.geodetic_crs is None:
            raise ConfigError(f"{_short(self.text)} does not specify a datum", code="unsupported_crs")
        return found

    @cached_property
    def full(self) -> Any:
        """The system with heights: ellipsoidal heights in metres if it has none of its own; see `z_to_full`."""
        return self.named.to_3d()

    @cached_property
    def geodetic(self) -> Any:
        """The geodetic system on the same datum and prime meridian: longitude, latitude (deg) and ellipsoidal height
        (m)."""
        from pyproj import CRS

        if self.named.is_geocentric:  # PROJ has no geographic system for the datum of such a system
            return CRS.from_user_input(WGS84) if self.named.to_epsg() == 4978 else self._bare
        found = self.named.geodetic_crs.to_3d()
        if [axis.unit_name for axis in found.axis_info] == ["degree", "degree", "metre"]:
            return found
        # Convert systems in grads (NTF Paris) or feet (+vunits) to degrees and metres on the same datum.
        system = CRS.from_user_input(WGS84).to_json_dict()["coordinate_system"]
        json = found.to_json_dict() | {"coordinate_system": system}
        json.pop("id", None)
        return CRS.from_json_dict(json)

    @cached_property
    def _bare(self) -> Any:
        raise ConfigError(
            f"{_short(self.text)} is an Earth-centred system on a datum of its own: use {ECEF} or a projected system",
            code="unsupported_crs",
        )

    @property
    def name(self) -> str:
        """Name of the system."""
        return str(self.named.name)

    @property
    def projected_epsg(self) -> int | None:
        """EPSG code of the projected system of eastings and northings; None if it has none."""
        return self._horizontal.to_epsg() if self._horizontal.is_projected else None

    @property
    def unit_m(self) -> float:
        """Metres per unit of eastings and northings; radians per unit of longitude and latitude."""
        return float(self._horizontal.axis_info[0].unit_conversion_factor)

    @property
    def has_own_heights(self) -> bool:
        """True if heights are in a system of the CRS (a geoid, a tide) rather than above the ellipsoid."""
        return bool(self.named.is_compound or self.named.is_vertical)

    @property
    def axes(self) -> tuple[str, str, str]:
        """Names of the axes, in the order in which gsmap uses coordinates."""
        if self.named.is_geocentric:
            return "X", "Y", "Z"
        plan = ("longitude", "latitude") if self._horizontal.is_geographic else ("easting", "northing")
        return (*plan, "height")

    @property
    def _horizontal(self) -> Any:
        return self.named.sub_crs_list[0] if self.named.is_compound else self.named

    @cached_property
    def z_to_full(self) -> float:
        """Factor from the specified heights to the heights of `full`.

        Heights of a projected system without a vertical axis are in the unit of its horizontal axes (for example feet),
        as surveyors use them; PROJ would interpret them as metres.
        """
        plan_only = len(self.named.axis_info) == 2 and self.named.is_projected
        return float(self.named.axis_info[0].unit_conversion_factor) if plan_only else 1.0

    @property
    def height_unit_m(self) -> float:
        """Metres per unit of specified heights."""
        return float(self.full.axis_info[2].unit_conversion_factor) * self.z_to_full

    @property
    def heights(self) -> str:
        """Unit and zero of heights as text, such as ``US survey feet (0.3048006 m) above the ellipsoid (GRS 1980)``."""
        axis = self.named.axis_info[0] if self.z_to_full != 1 else self.full.axis_info[2]
        unit = axis.unit_name.replace("foot", "feet") if "foot" in axis.unit_name else f"{axis.unit_name}s"
        if axis.unit_conversion_factor != 1:
            unit = f"{unit} ({axis.unit_conversion_factor:.7g} m)"
        if self.named.is_geocentric:
            return f"none: X, Y, Z in {unit} from the Earth's centre"
        if self.has_own_heights:
            side = "below" if axis.direction == "down" else "above"
            return f"{unit} {side} the geoid of {self.full.sub_crs_list[-1].name}"
        return f"{unit} above the ellipsoid ({self.geodetic.ellipsoid.name})"

    def to_geodetic(self, points: np.ndarray) -> np.ndarray:
        """Convert (N, 3) coordinates to longitude, latitude (deg) and ellipsoidal height (m) on the system's datum.

        Raises:
            InputError: a coordinate is outside the projection's domain.
            ConfigError: the height system needs a grid file that is not installed.
        """
        points = np.asarray(points, dtype=np.float64).reshape(-1, 3) * [1.0, 1.0, self.z_to_full]
        return _through(self.full, self.geodetic, points, self.text)

    def from_geodetic(self, points: np.ndarray) -> np.ndarray:
        """Invert `to_geodetic`."""
        return _through(self.geodetic, self.full, points, self.text) / [1.0, 1.0, self.z_to_full]

    def check_area(self, points: np.ndarray, names: list[str], margin_deg: float) -> None:
        """Raise `InputError` for the first of (N, 3) coordinates that is outside the system's area of use."""
        area = self._horizontal.area_of_use or self.named.area_of_use
        lonlat = self.to_geodetic(points)[:, :2]
        if area is None:
            return
        meridian = self.geodetic.prime_meridian  # areas of use are relative to Greenwich
        lonlat[:, 0] += np.degrees(meridian.longitude * meridian.unit_conversion_factor)
        beyond_lat = np.maximum(area.south - lonlat[:, 1], lonlat[:, 1] - area.north)
        width = (area.east - area.west) % 360 or 360.0
        along = (lonlat[:, 0] - area.west) % 360
        beyond_lon = np.where(along <= width, 0.0, np.minimum(along - width, 360 - along))
        off = np.flatnonzero((beyond_lat > margin_deg) | (beyond_lon > margin_deg))
        if len(off):
            lon, lat = lonlat[off[0]]
            raise InputError(
                f"{names[off[0]]} lies at {lat:.4f} N {lon:.4f} E, outside the area of use of {_short(self.text)} "
                f"({self.name}, {area.name.split(':')[0]}): are the axes swapped, or is it another system?",
                code="outside_crs",
            )


@lru_cache(maxsize=64)
def crs(text: str) -> Crs:
    """Parse a coordinate reference system.

    Raises:
        ConfigError: PROJ does not know the system, or it has no horizontal coordinates.
    """
    if not isinstance(text, str) or not text.strip() or len(text) > 20_000:
        raise ConfigError("a coordinate reference system must be EPSG:N, a PROJ string or WKT", code="invalid_crs")
    found = Crs(text.strip())
    found.named  # noqa: B018  # raises for an invalid system
    return found


def transform_datum(source: Crs, target: Crs, points: np.ndarray) -> np.ndarray:
    """Transform (N, 3) geodetic coordinates (`Crs.to_geodetic`) from the datum of one system to the datum of another.

    Raises:
        ConfigError: PROJ knows no transformation, or its grid file is not installed; less accurate transformations are
            never used instead.
    """
    if source.geodetic == target.geodetic:
        return np.array(points, dtype=np.float64)
    if len(points) and (grid := _better_grid(source.geodetic, target.geodetic, points)) is not None:
        raise _needs(f"{source.text} to {target.text}", grid)
    return _through(source.geodetic, target.geodetic, points, f"{source.text} to {target.text}")


@lru_cache(maxsize=64)
def _transformer(source: str, target: str, text: str) -> Any:
    from pyproj import CRS, Transformer
    from pyproj.exceptions import ProjError

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # less accurate transformations are rejected below
            return Transformer.from_crs(
                CRS.from_wkt(source), CRS.from_wkt(target), always_xy=True, allow_ballpark=False, only_best=True
            )
    except ProjError as error:
        raise _no_way(text, error) from error


def _through(source: Any, target: Any, points: np.ndarray, text: str) -> np.ndarray:
    from pyproj.exceptions import ProjError

    points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    if not len(points):
        return points
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = np.stack(_transformer(source.to_wkt(), target.to_wkt(), text).transform(*points.T), axis=1)
    except ProjError as error:
        raise _no_way(text, error) from error
    bad = ~np.isfinite(found).all(1)
    if bad.any():
        if (grid := _missing_grid(source, target)) is not None:
            raise _needs(text, grid)
        where = ", ".join(f"{x:.10g}" for x in points[int(np.argmax(bad))])
        raise InputError(
            f"{where} has no valid coordinates in {_short(text)}: are the axes swapped, or is it another system?",
            code="outside_crs",
        )
    return found


def _missing_grid(source: Any, target: Any) -> str | None:
    """Return a missing grid file of the best transformation between two systems, if no transformation has all its grid
    files."""
    from pyproj.transformer import TransformerGroup

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        ways = TransformerGroup(source, target, always_xy=True, allow_ballpark=False)
    lacking = [] if ways.transformers else [grid for way in ways.unavailable_operations for grid in way.grids]
    return next((str(grid.short_name) for grid in lacking if not grid.available), None)


def _better_grid(source: Any, target: Any, points: np.ndarray) -> str | None:
    """Return the missing grid file of the best transformation between two datums at geodetic points (N, 3), where PROJ
    would take a less accurate one.

    Datums that count as equal by convention (NAD83 or GDA94 and WGS 84) stay so.
    """
    (west, south), (east, north) = np.floor(points[:, :2].min(0)), np.ceil(points[:, :2].max(0))
    if not (-180 <= west <= east <= 180 and -90 <= south <= north <= 90):
        return None
    return _lacking_grid(source.to_wkt(), target.to_wkt(), float(west), float(south), float(east), float(north))


@lru_cache(maxsize=64)
def _lacking_grid(source: str, target: str, *area_deg: float) -> str | None:
    from pyproj import CRS
    from pyproj.transformer import AreaOfInterest, TransformerGroup

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        ways = TransformerGroup(
            CRS.from_wkt(source),
            CRS.from_wkt(target),
            always_xy=True,
            allow_ballpark=False,
            area_of_interest=AreaOfInterest(*area_deg),
        )
    if ways.best_available or not ways.unavailable_operations or not ways.transformers:
        return None
    if any("proj=noop" in way.definition for way in ways.transformers):
        return None
    best = ways.unavailable_operations[0]
    used = min((way.accuracy for way in ways.transformers if way.accuracy >= 0), default=float("inf"))
    lacking = [grid for grid in best.grids if not grid.available]
    return str(lacking[0].short_name) if lacking and 0 <= best.accuracy < used else None


def _no_way(text: str, error: Exception) -> ConfigError:
    message = str(error)
    if "Grid " in message:
        return _needs(text, message.split("Grid ", 1)[1].split(" ", 1)[0])
    return ConfigError(f"PROJ knows no exact transformation from {_short(text)}: {message}", code="no_exact_transform")


def _needs(text: str, grid: str) -> ConfigError:
    return ConfigError(
        f"{_short(text)} needs the grid file {grid}, which is not installed: run pyproj sync --file {grid} or, if "
        "heights are ellipsoidal, name the system without its heights",
        code="grid_missing",
    )


def _short(text: str) -> str:
    return text if len(text) <= 60 else f"{text[:57]}..."
