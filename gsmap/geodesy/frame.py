"""Convert coordinates of a CRS to the world frame (east, north, up in metres at an origin) and back.

The world frame is Euclidean. A point is converted exactly from a CRS to geodetic coordinates, then to Earth-centred
coordinates on the same ellipsoid, and then by a rigid transform to the frame. So grid convergence, scale factor and the
Earth's curvature do not distort the map; over 10 km of UTM they amount to metres.
"""

from __future__ import annotations

import numpy as np

from gsmap.geodesy.crs import ECEF, crs, transform_datum
from gsmap.types import Sim3
from gsmap.types.world import WorldFrame


def frame_at(crs_text: str, points: np.ndarray) -> WorldFrame:
    """Return a frame whose origin is the rounded median of coordinates (N, 3) of a CRS."""
    system = crs(crs_text)
    lon, lat, height = np.median(system.to_geodetic(points), axis=0)
    return WorldFrame(system.text, float(np.round(lat, 4)), float(np.round(lon, 4)), float(np.round(height)))


def to_frame(frame: WorldFrame, points: np.ndarray, crs_text: str | None = None) -> np.ndarray:
    """Convert coordinates (N, 3) of a CRS (by default that of the frame) to east, north, up in metres."""
    system, own = crs(crs_text or frame.crs), crs(frame.crs)
    geodetic = transform_datum(system, own, system.to_geodetic(points))
    out: np.ndarray = (_ecef(frame, geodetic) - _origin(frame)) @ _axes(frame)
    return out


def from_frame(frame: WorldFrame, points: np.ndarray, crs_text: str | None = None) -> np.ndarray:
    """Invert `to_frame`."""
    system, own = crs(crs_text or frame.crs), crs(frame.crs)
    ecef = np.asarray(points, dtype=np.float64).reshape(-1, 3) @ _axes(frame).T + _origin(frame)
    return system.from_geodetic(transform_datum(own, system, _geodetic(frame, ecef)))


def T_ecef_frame(frame: WorldFrame) -> Sim3:
    """Return the transform from the frame to Earth-centred, Earth-fixed metres on WGS 84 (EPSG:4978), as 3D Tiles need
    it.

    It is exact for datums that are rigid transforms of WGS 84 (all modern datums nearly are); otherwise it is valid
    near the origin.
    """
    corners = np.array([[0.0, 0, 0], [1000, 0, 0], [0, 1000, 0], [0, 0, 1000]])
    return _rigid(from_frame(frame, corners, ECEF), corners)


def _rigid(target: np.ndarray, corners: np.ndarray) -> Sim3:
    """Fit a rigid transform to axes of a kilometre, which other datums shear and stretch slightly."""
    u, _, vt = np.linalg.svd((target[1:] - target[0]).T @ (corners[1:] - corners[0]))
    return Sim3(u @ vt, target[0])


def _ellipsoid(frame: WorldFrame) -> tuple[float, float]:
    """Return the semi-major axis of the ellipsoid in metres, and its squared eccentricity."""
    ellipsoid = crs(frame.crs).geodetic.ellipsoid
    a, b = ellipsoid.semi_major_metre, ellipsoid.semi_minor_metre
    return float(a), float(1 - (b / a) ** 2)


def _axes(frame: WorldFrame) -> np.ndarray:
    """Return the (3, 3) columns east, north and up in Earth-centred axes."""
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
    """Convert longitude, latitude (deg) and ellipsoidal height to (N, 3) Earth-centred metres on the frame's datum."""
    a, e2 = _ellipsoid(frame)
    lon, lat = np.radians(geodetic[:, 0]), np.radians(geodetic[:, 1])
    n = a / np.sqrt(1 - e2 * np.sin(lat) ** 2)
    across = (n + geodetic[:, 2]) * np.cos(lat)
    return np.stack([across * np.cos(lon), across * np.sin(lon), (n * (1 - e2) + geodetic[:, 2]) * np.sin(lat)], axis=1)


def _geodetic(frame: WorldFrame, ecef: np.ndarray) -> np.ndarray:
    """Invert `_ecef` (Bowring 1976, then Newton), to 1e-9 m up to thousands of kilometres from the ellipsoid."""
    a, e2 = _ellipsoid(frame)
    across = np.hypot(ecef[:, 0], ecef[:, 1])
    lat = np.arctan2(ecef[:, 2], across * (1 - e2))
    for _ in range(6):
        n = a / np.sqrt(1 - e2 * np.sin(lat) ** 2)
        lat = np.arctan2(ecef[:, 2] + e2 * n * np.sin(lat), across)
    n = a / np.sqrt(1 - e2 * np.sin(lat) ** 2)
    height = across * np.cos(lat) + ecef[:, 2] * np.sin(lat) - a**2 / n
    return np.stack([np.degrees(np.arctan2(ecef[:, 1], ecef[:, 0])), np.degrees(lat), height], axis=1)
