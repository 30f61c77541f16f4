"""The world frame: metres along east, north and up at an origin, and its way to coordinates of a CRS.

Euclidean throughout: a point goes from a CRS to longitude, latitude and height on that CRS's datum, from there to
Earth-centred coordinates of the same ellipsoid, and from there by one rotation and shift into the frame, each exactly
and each point by itself. Grid convergence, scale factor and the Earth's curvature are thus in the coordinates, where
they belong, and not in the map. A quadrangle of 10 km in UTM would else be off by metres.
"""

from __future__ import annotations

import numpy as np

from gsmap.types import Sim3
from gsmap.types.world import WorldFrame
from gsmap.world.crs import ECEF, between, crs


def frame_at(crs_text: str, points: np.ndarray) -> WorldFrame:
    """A frame for data at (N, 3) coordinates of a CRS: its origin is their middle, rounded."""
    system = crs(crs_text)
    lon, lat, height = np.median(system.to_geodetic(points), axis=0)
    return WorldFrame(system.text, float(np.round(lat, 4)), float(np.round(lon, 4)), float(np.round(height)))


def to_frame(frame: WorldFrame, points: np.ndarray, crs_text: str | None = None) -> np.ndarray:
    """(N, 3) east, north, up in metres, of coordinates in a CRS (by default the frame's own)."""
    system, own = crs(crs_text or frame.crs), crs(frame.crs)
    geodetic = between(system, own, system.to_geodetic(points))
    out: np.ndarray = (_ecef(frame, geodetic) - _origin(frame)) @ _axes(frame)
    return out


def of_frame(frame: WorldFrame, points: np.ndarray, crs_text: str | None = None) -> np.ndarray:
    """The reverse of `to_frame`."""
    system, own = crs(crs_text or frame.crs), crs(frame.crs)
    ecef = np.asarray(points, dtype=np.float64).reshape(-1, 3) @ _axes(frame).T + _origin(frame)
    return system.of_geodetic(between(own, system, _geodetic(frame, ecef)))


def moved(frame: WorldFrame, other: WorldFrame) -> Sim3:
    """``T_frame_other``: the same places in another frame of the same datum, or nearly so in one of another.

    Between datums it is that of the neighbourhood of the other's origin.
    """
    corners = np.array([[0.0, 0, 0], [1000, 0, 0], [0, 1000, 0], [0, 0, 1000]])
    found = to_frame(frame, of_frame(other, corners), other.crs)
    return _rigid(found, corners)


def T_ecef_frame(frame: WorldFrame) -> Sim3:
    """Takes the frame to Earth-centred, Earth-fixed metres on WGS 84 (EPSG:4978), as 3D Tiles and globes want it.

    Exact where the CRS's datum is a rigid motion or nearly from WGS 84 (all modern ones); else that of the
    neighbourhood of the origin.
    """
    corners = np.array([[0.0, 0, 0], [1000, 0, 0], [0, 1000, 0], [0, 0, 1000]])
    return _rigid(of_frame(frame, corners, ECEF), corners)


def _rigid(target: np.ndarray, corners: np.ndarray) -> Sim3:
    """By what three axes of a kilometre become: on another datum they are a little skewed and longer."""
    u, _, vt = np.linalg.svd((target[1:] - target[0]).T @ (corners[1:] - corners[0]))
    return Sim3(u @ vt, target[0])


def _ellipsoid(frame: WorldFrame) -> tuple[float, float]:
    """Semi-major axis in metres and the square of the eccentricity."""
    ellipsoid = crs(frame.crs).geodetic.ellipsoid
    a, b = ellipsoid.semi_major_metre, ellipsoid.semi_minor_metre
    return float(a), float(1 - (b / a) ** 2)


def _axes(frame: WorldFrame) -> np.ndarray:
    """(3, 3) whose columns are east, north and up in Earth-centred axes."""
    lat, lon = np.radians([frame.latitude_deg, frame.longitude_deg])
    return np.array(
        [
            [-np.sin(lon), -np.sin(lat) * np.cos(lon), np.cos(lat) * np.cos(lon)],
            [np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat) * np.sin(lon)],
            [0.0, np.cos(lat), np.sin(lat)],
        ]
    )


def _origin(frame: WorldFrame) -> np.ndarray:
    origin = np.array([[frame.longitude_deg, frame.latitude_deg, frame.height_m]])
    found: np.ndarray = _ecef(frame, origin)[0]
    return found


def _ecef(frame: WorldFrame, geodetic: np.ndarray) -> np.ndarray:
    """(N, 3) Earth-centred metres on the frame's own datum, of longitude, latitude (deg) and ellipsoidal height."""
    a, e2 = _ellipsoid(frame)
    lon, lat = np.radians(geodetic[:, 0]), np.radians(geodetic[:, 1])
    n = a / np.sqrt(1 - e2 * np.sin(lat) ** 2)
    across = (n + geodetic[:, 2]) * np.cos(lat)
    return np.stack([across * np.cos(lon), across * np.sin(lon), (n * (1 - e2) + geodetic[:, 2]) * np.sin(lat)], axis=1)


def _geodetic(frame: WorldFrame, ecef: np.ndarray) -> np.ndarray:
    """The reverse of `_ecef`, by Bowring 1976 and Newton: to 1e-9 m within thousands of kilometres of the ellipsoid."""
    a, e2 = _ellipsoid(frame)
    across = np.hypot(ecef[:, 0], ecef[:, 1])
    lat = np.arctan2(ecef[:, 2], across * (1 - e2))
    for _ in range(6):
        n = a / np.sqrt(1 - e2 * np.sin(lat) ** 2)
        lat = np.arctan2(ecef[:, 2] + e2 * n * np.sin(lat), across)
    n = a / np.sqrt(1 - e2 * np.sin(lat) ** 2)
    height = across * np.cos(lat) + ecef[:, 2] * np.sin(lat) - a**2 / n
    return np.stack([np.degrees(np.arctan2(ecef[:, 1], ecef[:, 0])), np.degrees(lat), height], axis=1)
