"""Georeferencing: the coordinate reference system, observations of the world, and the estimated poses in the world.

World coordinates are in a *CRS*: longitude or easting first, then latitude or northing, then height (what PROJ calls
``always_xy``), with the height in the CRS's own vertical axis; where it has none, above the ellipsoid, in the unit of
easting and northing. No graph is solved in them: a projection bends and stretches lengths, and eight digits before the
point cost the last of float64. The *world frame* is Euclidean, metres along east, north and up at an origin near the
data (`WorldFrame`); ``S_world_map`` maps a component of the map into it.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from gsmap.errors import InputError
from gsmap.types.sim3 import Sim3

LOCAL = "local"
"""The name used instead of a CRS for coordinates east, north, up in metres of the world frame."""


@dataclass(frozen=True)
class WorldFrame:
    """The Euclidean frame in which the map is solved: metres along east, north and up from an origin.

    Args:
        crs: the CRS of the map's input and output, ``EPSG:N`` or WKT.
        latitude_deg, longitude_deg, height_m: the origin, on the ellipsoid of that CRS's datum.
    """

    crs: str
    latitude_deg: float
    longitude_deg: float
    height_m: float

    def __post_init__(self) -> None:
        if not np.isfinite([self.latitude_deg, self.longitude_deg, self.height_m]).all():
            raise InputError("the origin of a world frame must be finite", code="invalid_vector")


OBSERVATION_KINDS = ("frame", "point", "image", "fix", "bar")


# --- what was observed ------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class ControlPoint:
    """A ground control point: a marked point with surveyed world coordinates.

    Args:
        name: unique in the map.
        crs: of ``position``; ``local`` once it is in the world frame.
        position: (3,) x y z in it.
        sigma_m: (2,) standard deviations of the survey, horizontal (per axis) and vertical.
        check: true for a check point, which is not used in the solve.
    """

    name: str
    crs: str
    position: np.ndarray
    sigma_m: tuple[float, float] = (0.01, 0.01)
    check: bool = False

    def __post_init__(self) -> None:
        _finite(f"control point {self.name}", self.position, 3)
        _positive(f"control point {self.name}", *self.sigma_m)


@dataclass(frozen=True, eq=False)
class ImagePoint:
    """The pixel at which a photo shows a control point, with the photo's camera.

    Args:
        point: name of the control point.
        image: name of the photo.
        scene: id of the scene whose frame the camera is in.
        pixel: (2,) column, row; the first pixel's centre is .5 .5.
        sigma_px: standard deviation per axis, of the picking and of the camera that it was picked in.
        T_scene_camera: (4, 4).
        intrinsics_px: (4,) ``fx fy cx cy``.
        camera_covariance: (6, 6) of the camera over [rotation (3, rad), translation (3, scene unit)] on the camera's
            side; None where the camera is a scene's own.
        depth: depth of the surface along the camera's z, in the scene's unit; None if nothing was rendered.
        depth_sigma: its standard deviation.
    """

    point: str
    image: str
    scene: str
    pixel: np.ndarray
    sigma_px: float
    T_scene_camera: np.ndarray
    intrinsics_px: np.ndarray
    camera_covariance: np.ndarray | None = None
    depth: float | None = None
    depth_sigma: float = float("inf")

    def __post_init__(self) -> None:
        where = f"control point {self.point} in {self.image}"
        _finite(where, self.pixel, 2)
        _finite(where, self.T_scene_camera, 4, 4)
        _finite(where, self.intrinsics_px, 4)
        _positive(where, self.sigma_px, *np.asarray(self.intrinsics_px, dtype=float)[:2])
        if self.camera_covariance is not None:
            _finite(where, self.camera_covariance, 6, 6)
        if self.depth is not None:
            _positive(where, self.depth, self.depth_sigma)


@dataclass(frozen=True, eq=False)
class PositionFix:
    """A measured world position of one point of a scene: a camera's GNSS fix, or the surveyed origin of the scene.

    Args:
        name: unique within its scene: of the photo, or ``survey``.
        scene: id.
        point: (3,) in the scene's frame.
        crs: of ``position``; ``local`` once it is in the world frame.
        position: (3,) x y z in it.
        sigma_m: (2,) standard deviations, horizontal (per axis) and vertical, each fix by itself.
        common_sigma_m: (2,) standard deviations of the error shared by all fixes of a scene (satellites, antenna). It
            may drift by half of that from the first to the last fix, in the order of their names.
        sea_level_sigma_m: standard deviation of the height reference against that of the CRS, shared by all fixes of a
            map; 0 if they agree.
    """

    name: str
    scene: str
    point: np.ndarray
    crs: str
    position: np.ndarray
    sigma_m: tuple[float, float]
    common_sigma_m: tuple[float, float] = (0.0, 0.0)
    sea_level_sigma_m: float = 0.0

    def __post_init__(self) -> None:
        where = f"the position of {self.name} in scene {self.scene}"
        _finite(where, self.point, 3)
        _finite(where, self.position, 3)
        _positive(where, *self.sigma_m)
        common = (*self.common_sigma_m, self.sea_level_sigma_m)
        if not (np.isfinite(common).all() and min(common) >= 0):
            raise InputError(f"{where} needs common sigmas of at least 0, got {common}", code="invalid_observation")


@dataclass(frozen=True, eq=False)
class ScaleBar:
    """A measured distance between two points, each of which was picked in a scene.

    Args:
        name: unique in the map.
        scenes: ids of the scenes that the ends were picked in.
        points: (2, 3) the ends, each in the frame of its scene.
        point_sigmas: (2,) standard deviations of the picking, per axis, in the scenes' units.
        length_m, sigma_m: the distance.
    """

    name: str
    scenes: tuple[str, str]
    points: np.ndarray
    point_sigmas: tuple[float, float]
    length_m: float
    sigma_m: float

    def __post_init__(self) -> None:
        _finite(f"scale bar {self.name}", self.points, 2, 3)
        _positive(f"scale bar {self.name}", self.length_m, self.sigma_m, *self.point_sigmas)
        if self.scenes[0] == self.scenes[1] and np.allclose(self.points[0], self.points[1], rtol=0, atol=1e-12):
            raise InputError(f"scale bar {self.name} has two equal ends: pick two points", code="invalid_observation")


@dataclass(frozen=True, eq=False)
class Survey:
    """All observations of the world; a solver takes them with positions in the world frame (``crs`` is ``local``).

    Args:
        frame: the world frame; None until a CRS is specified.
    """

    frame: WorldFrame | None = None
    points: tuple[ControlPoint, ...] = ()
    images: tuple[ImagePoint, ...] = ()
    fixes: tuple[PositionFix, ...] = ()
    bars: tuple[ScaleBar, ...] = ()

    def __bool__(self) -> bool:
        return bool(self.points or self.fixes or self.bars)

    def scenes(self) -> set[str]:
        """Return the ids of all scenes with observations."""
        found = {image.scene for image in self.images} | {fix.scene for fix in self.fixes}
        return found.union(*(bar.scenes for bar in self.bars))


# --- what was solved --------------------------------------------------------------------------------------------------

UNSOLVED = "the observations have no solution: they contradict each other, or the registrations, beyond measure"
"""The problem of a component whose least squares diverge or are singular; its edges alone then give its poses."""

RESIDUAL_KINDS = ("point", "image", "fix", "bar")
RESIDUAL_USES = ("used", "outlier", "check", "unused")


@dataclass(frozen=True)
class Residual:
    """The residual of one observation.

    Args:
        kind: ``point`` (a control point), ``image`` (its pixel in one photo), ``fix`` (a position of a camera or scene)
            or ``bar`` (a distance).
        name: name of the control point, the point and its photo, the photo, or the bar.
        scene: id of the scene; empty for a control point, which several scenes may show.
        use: ``used``, ``outlier`` (contradicts the others, left out), ``check`` (held out) or ``unused``.
        error_m: east, north, up in metres from the surveyed to the estimated position; for a bar the estimated minus
            the measured length; empty if unknown and for images.
        sigma_m: standard deviations of ``error_m``.
        error_px: for an image, column and row from the picked to the estimated position.
        statistic: chi-square against all other observations, by Baarda's data snooping; None without redundancy.
        dof: degrees of freedom of ``statistic``.
        reason: reason why it is an outlier or unused, or empty.
    """

    kind: str
    name: str
    scene: str
    use: str
    error_m: tuple[float, ...] = ()
    sigma_m: tuple[float, ...] = ()
    error_px: tuple[float, ...] = ()
    statistic: float | None = None
    dof: int = 0
    reason: str = ""

    def __post_init__(self) -> None:
        if self.kind not in RESIDUAL_KINDS or self.use not in RESIDUAL_USES:
            raise InputError(
                f"unknown kind or use of a residual: {self.kind!r}, {self.use!r}", code="invalid_observation"
            )


GROUP_KINDS = ("points", "photos", "scenes", "bars")
CAUSES = (
    "altitude_zero",
    "feet",
    "above_takeoff",
    "height_system",
    "vertical_shift",
    "horizontal_shift",
    "shape",
    "scale",
    "split",
)
"""Likely causes of a contradiction: altitudes are 0; heights or lengths are in feet; heights are above take-off;
ellipsoidal against orthometric heights; a vertical or horizontal shift without a known reason; positions whose shape is
not that of the map (of another flight or place); lengths in another unit; a group that contradicts itself."""
KEPT = ("group", "against", "none")
PROBLEMS = ("", "undetermined", "contradiction", "unsolved")


@dataclass(frozen=True)
class Contradiction:
    """A group of observations that contradicts another group by more than the common errors of both groups explain.

    Args:
        group: ``points`` (control points), ``photos`` (of captures), ``scenes`` (surveyed scenes) or ``bars``.
        against: contradicted group; the same group if it contradicts itself.
        cause: the likeliest reason: ``altitude_zero``, ``feet`` (taken for metres), ``above_takeoff`` (heights above
            take-off), ``height_system`` (ellipsoidal against orthometric heights), ``vertical_shift`` or
            ``horizontal_shift`` (no known reason, another datum or flight), ``shape`` (of another flight or place),
            ``scale`` (another unit of length) or ``split`` (the group contradicts itself).
        other_causes: further reasons that explain it as well.
        kept: side that is used: ``against``, ``group``, or ``none`` if nothing decides.
        offset_m: east, north, up of the group relative to the other group; empty for bars.
        sigma_m: standard deviations of ``offset_m``, common errors included; empty for bars.
        ratio: for bars, measured length divided by the length in the map; None for other groups.
        count: number of contradicting observations of the group.
        scenes: ids of their captures.
        text: description in one sentence.
    """

    group: str
    against: str
    cause: str
    other_causes: tuple[str, ...] = ()
    kept: str = "none"
    offset_m: tuple[float, ...] = ()
    sigma_m: tuple[float, ...] = ()
    ratio: float | None = None
    count: int = 0
    scenes: tuple[str, ...] = ()
    text: str = ""

    def __post_init__(self) -> None:
        causes = {self.cause, *self.other_causes}
        if not ({self.group, self.against} <= set(GROUP_KINDS) and causes <= set(CAUSES) and self.kept in KEPT):
            raise InputError(
                f"unknown group, cause or kept side of a contradiction: {self.group!r}, {self.against!r}, {causes}, "
                f"{self.kept!r}",
                code="invalid_observation",
            )


@dataclass(frozen=True, eq=False)
class WorldPose:
    """The pose of a component in the world.

    Args:
        component: component index, largest first.
        S_world_map: component to world frame (metres east, north, up at its origin); None if the observations do not
            determine it.
        covariance: (7, 7) of ``S_world_map`` over [rotation (3, rad), translation (3, map unit), log scale] on the
            map's side, with the scene that holds the component's frame taken as exact; None if it is not determined.
        metres_per_unit: metres per unit of the component's frame; None if unknown.
        problem: reason why ``S_world_map`` is missing, or empty.
        problem_code: ``undetermined`` (observations are missing), ``contradiction`` (groups of observations contradict
            each other and nothing decides), ``unsolved`` (no finite solution), or empty.
        notes: remarks.
    """

    component: int
    S_world_map: Sim3 | None = None
    covariance: np.ndarray | None = None
    metres_per_unit: float | None = None
    problem: str = ""
    problem_code: str = ""
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Georeference(WorldPose):
    """The pose of a component in the world, with the observations that it was solved from.

    Args:
        scale_sigma: standard deviation of the logarithm of ``metres_per_unit``.
        frame: the world frame; None if only lengths were observed.
        residuals: residuals of all observations of the component.
        contradictions: groups of observations that contradict each other.
        point_scatter: factor by which the stated standard deviations of control points were multiplied.
        variance_factor: factor by which ``covariance`` was multiplied, because observations scatter.
    """

    scale_sigma: float = float("inf")
    frame: WorldFrame | None = None
    residuals: tuple[Residual, ...] = field(default=())
    contradictions: tuple[Contradiction, ...] = ()
    point_scatter: float = 1.0
    variance_factor: float = 1.0

    def __post_init__(self) -> None:
        if self.problem_code not in PROBLEMS:
            raise InputError(
                f"unknown problem code of a georeference: {self.problem_code!r}", code="invalid_observation"
            )

    def left_out(self) -> set[tuple[str, str, str]]:
        """Return (kind, name, scene) of each observation that the solution does not use."""
        return {(r.kind, r.name, r.scene) for r in self.residuals if r.use != "used"}


def _finite(where: str, values: np.ndarray, *shape: int) -> None:
    found = np.asarray(values, dtype=np.float64)
    if found.shape != shape or not np.isfinite(found).all():
        raise InputError(f"{where} needs finite numbers of shape {shape}, got {found.shape}", code="shape_mismatch")


def _positive(where: str, *values: float) -> None:
    for value in values:
        if not (np.isfinite(value) and value > 0):
            raise InputError(
                f"{where} needs finite positive sigmas and lengths, got {value}", code="invalid_observation"
            )
