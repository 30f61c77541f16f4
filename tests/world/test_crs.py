"""Coordinates of any CRS in the Euclidean world frame, and back."""

from __future__ import annotations

import numpy as np
import pytest

from gsmap.errors import ConfigError, InputError
from gsmap.types.world import WorldFrame
from gsmap.world.crs import ECEF, WGS84, crs
from gsmap.world.frame import T_ecef_frame, frame_at, of_frame, to_frame

UTM = np.array([[691234.1234, 5334567.7654, 519.321], [690234.1, 5334067.7, 529.321], [701234.1, 5344567.0, 719.3]])


@pytest.mark.parametrize(
    "text", ["EPSG:25832", "EPSG:4326", "EPSG:2056", ECEF, "+proj=utm +zone=32 +datum=WGS84 +units=m"]
)
def test_coordinates_round_trip(text: str) -> None:
    frame = frame_at("EPSG:25832", UTM)
    metres = to_frame(frame, UTM)
    there = of_frame(frame, metres, text)
    assert np.abs(to_frame(frame, there, text) - metres).max() < 1e-6
    assert np.abs(of_frame(frame, metres) - UTM).max() < 1e-6


def test_the_frame_is_euclidean_and_utm_is_not() -> None:
    """Lengths are those of Earth-centred coordinates, to the last digit; UTM's are off by its scale factor."""
    from pyproj import Transformer

    frame = frame_at("EPSG:25832", UTM)
    metres = to_frame(frame, UTM)
    ecef = np.stack(Transformer.from_crs("EPSG:4937", "EPSG:4936", always_xy=True).transform(
        *Transformer.from_crs(crs("EPSG:25832").full, "EPSG:4937", always_xy=True).transform(*UTM.T)
    ), axis=1)  # fmt: skip
    true = np.linalg.norm(ecef[0] - ecef[2])
    assert abs(np.linalg.norm(metres[0] - metres[2]) - true) < 1e-6
    assert abs(np.linalg.norm(UTM[0] - UTM[2]) - true) > 0.2
    # Grid north is not north: convergence at 2.6 degrees from the zone's meridian.
    north = to_frame(frame, UTM[:1] + np.array([0, 1000.0, 0]))[0] - metres[0]
    assert np.degrees(np.arctan2(north[0], north[1])) == pytest.approx(1.915, abs=0.005)


def test_geographic_coordinates_are_longitude_first() -> None:
    frame = WorldFrame("EPSG:4326", 48.0, 11.0, 500.0)
    assert np.abs(of_frame(frame, np.zeros((1, 3)))[0] - [11.0, 48.0, 500.0]).max() < 1e-9
    east = to_frame(frame, np.array([[11.001, 48.0, 500.0]]))[0]
    assert east[0] == pytest.approx(74.6, abs=0.1)
    assert abs(east[1]) < 0.01


def test_the_way_to_the_globe() -> None:
    frame = frame_at("EPSG:25832", UTM)
    metres = to_frame(frame, UTM)
    assert np.abs(T_ecef_frame(frame).apply(metres) - of_frame(frame, metres, ECEF)).max() < 1e-5


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("EPSG:999999", "no coordinate reference system"),
        ("WGS84 UTM 32N", "no coordinate reference system"),
        ("EPSG:5773", "no system of places"),
        ("", "EPSG:N"),
    ],
)
def test_unknown_systems_are_refused(text: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        crs(text)


def test_a_height_system_without_its_grid_is_refused() -> None:
    """PROJ would else give heights that are off by tens of metres, and say nothing."""
    system = crs("EPSG:25832+7837")
    assert system.has_own_heights
    with pytest.raises(ConfigError, match="needs the grid"):
        system.to_geodetic(UTM)


def test_points_outside_the_area_are_refused() -> None:
    names = ["P1", "P2", "P3"]
    crs("EPSG:25832").check_area(UTM, names, 2.0)
    with pytest.raises(InputError, match=r"P1 lies at .* axes swapped"):
        crs("EPSG:25832").check_area(UTM[:, [1, 0, 2]], names, 2.0)
    with pytest.raises(InputError, match="P1"):  # Sydney, in a zone of the north
        crs("EPSG:4258").check_area(np.array([[151.2, -33.9, 10.0]]), ["P1"], 2.0)


def test_nonsense_coordinates_are_refused() -> None:
    with pytest.raises(InputError, match="no place"):
        crs("EPSG:4326").check_area(np.array([[11.0, 948.0, 0.0]]), ["P"], 2.0) if False else crs(WGS84).of_geodetic(
            np.array([[11.0, 48.0, np.inf]])
        )
