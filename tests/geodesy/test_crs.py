"""Coordinates of any CRS in the Euclidean world frame, and back."""

from __future__ import annotations

import numpy as np
import pytest
from raising import raises

from gsmap.errors import ConfigError, InputError
from gsmap.geodesy.crs import ECEF, WGS84, crs, transform_datum
from gsmap.geodesy.frame import T_ecef_frame, frame_at, from_frame, to_frame
from gsmap.types.world import WorldFrame

UTM = np.array([[691234.1234, 5334567.7654, 519.321], [690234.1, 5334067.7, 529.321], [701234.1, 5344567.0, 719.3]])


@pytest.mark.parametrize(
    "text", ["EPSG:25832", "EPSG:4326", "EPSG:2056", ECEF, "+proj=utm +zone=32 +datum=WGS84 +units=m"]
)
def test_coordinates_round_trip(text: str) -> None:
    frame = frame_at("EPSG:25832", UTM)
    metres = to_frame(frame, UTM)
    there = from_frame(frame, metres, text)
    assert np.abs(to_frame(frame, there, text) - metres).max() < 1e-6
    assert np.abs(from_frame(frame, metres) - UTM).max() < 1e-6


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
    assert np.abs(from_frame(frame, np.zeros((1, 3)))[0] - [11.0, 48.0, 500.0]).max() < 1e-9
    east = to_frame(frame, np.array([[11.001, 48.0, 500.0]]))[0]
    assert east[0] == pytest.approx(74.6, abs=0.1)
    assert abs(east[1]) < 0.01


def test_the_way_to_the_globe() -> None:
    frame = frame_at("EPSG:25832", UTM)
    metres = to_frame(frame, UTM)
    assert np.abs(T_ecef_frame(frame).apply(metres) - from_frame(frame, metres, ECEF)).max() < 1e-5


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("EPSG:999999", "invalid_crs"),
        ("WGS84 UTM 32N", "invalid_crs"),
        ("EPSG:5773", "unsupported_crs"),
        ("", "invalid_crs"),
    ],
)
def test_unknown_systems_are_refused(text: str, code: str) -> None:
    with raises(ConfigError, code=code):
        crs(text)


FOOT = 1200 / 3937  # metres in a US survey foot


@pytest.mark.parametrize(
    ("text", "point", "metres", "heights"),
    [
        ("EPSG:2249", (775000.0, 2956000.0, 100.0), 100 * FOOT, "US survey feet (0.3048006 m) above the ellipsoid"),
        ("EPSG:6578", (3200000.0, 10200000.0, 100.0), 100 * FOOT, "US survey feet"),
        ("EPSG:2222", (700000.0, 1000000.0, 100.0), 30.48, "feet (0.3048 m)"),
        ("+proj=utm +zone=18 +datum=NAD83 +units=us-ft", (1.9e6, 1.5e7, 100.0), 100 * FOOT, "US survey feet"),
        ("+proj=utm +zone=18 +datum=NAD83 +units=us-ft +vunits=us-ft", (1.9e6, 1.5e7, 100.0), 100 * FOOT, "US survey"),
        (
            "+proj=utm +zone=18 +datum=NAD83 +units=us-ft +vunits=m",
            (1.9e6, 1.5e7, 100.0),
            100.0,
            "metres above the ell",
        ),
        ("+proj=utm +zone=18 +datum=NAD83 +vunits=us-ft", (600000.0, 4500000.0, 100.0), 100 * FOOT, "US survey feet"),
        ("+proj=utm +zone=32 +datum=WGS84 +units=km", (691.2, 5334.5, 0.1), 100.0, "kilometres"),
        ("EPSG:25832", (691234.0, 5334567.0, 100.0), 100.0, "metres above the ellipsoid (GRS 1980)"),
        ("EPSG:4326", (11.0, 48.0, 100.0), 100.0, "metres above the ellipsoid (WGS 84)"),
    ],
)
def test_heights_are_in_the_unit_of_the_system(
    text: str, point: tuple[float, float, float], metres: float, heights: str
) -> None:
    """In its vertical axis' where it has one, else in its plan's, and above the ellipsoid."""
    system, points = crs(text), np.array([point, (*point[:2], point[2] + 10)])
    found = system.to_geodetic(points)
    assert found[0, 2] == pytest.approx(metres, abs=1e-6)
    assert system.height_unit_m == pytest.approx(metres / point[2], rel=1e-12)
    assert heights in system.heights
    assert np.abs(system.from_geodetic(found) - points).max() < 1e-6
    # Upwards in the frame by as many metres as ten units are, whatever the horizontal unit.
    frame = frame_at(text, points)
    east, north, up = np.diff(to_frame(frame, points), axis=0)[0] / (10 * system.height_unit_m)
    assert (east, north, up) == pytest.approx((0, 0, 1), abs=1e-5)


def test_systems_in_grads_from_paris_are_turned_into_degrees() -> None:
    """The false origin of Lambert II lies by definition on the meridian of Paris, at 52 grads north, where k is 1."""
    system, points = crs("EPSG:27572"), np.array([[600000.0, 2200000.0, 60.0], [601000.0, 2200000.0, 60.0]])
    assert system.to_geodetic(points)[0] == pytest.approx((0.0, 52 * 0.9, 60.0), abs=1e-6)
    system.check_area(points, ["P", "Q"], 0.1)
    metres = np.diff(to_frame(frame_at("EPSG:27572", points), points), axis=0)
    assert np.linalg.norm(metres) == pytest.approx(1000, abs=0.2)


@pytest.mark.parametrize("text", ["EPSG:2249+6360", "EPSG:2249+5703"])
def test_a_geoid_that_several_grids_lead_to_is_named(text: str) -> None:
    """PROJ answers infinity, not an error, where it has the grid of none of several ways."""
    system = crs(text)
    assert "above the geoid" in system.heights
    assert ("US survey feet" in system.heights) == text.endswith("6360")
    with raises(ConfigError, code="grid_missing"):
        system.to_geodetic(np.array([[775000.0, 2956000.0, 100.0]]))


@pytest.mark.parametrize(("text", "at"), [("EPSG:27700", (1.716, 52.658)), ("EPSG:31467", (9.0, 50.0))])
def test_a_datum_shift_without_its_grid_is_refused(text: str, at: tuple[float, float]) -> None:
    """PROJ would else take a Helmert transformation that is off by metres, and say nothing."""
    with raises(ConfigError, code="grid_missing"):
        transform_datum(crs(WGS84), crs(text), np.array([[*at, 0.0]]))


@pytest.mark.parametrize(("text", "at"), [("EPSG:26910", (-123.0, 45.0)), ("EPSG:2056", (7.4, 46.9))])
def test_datums_that_are_equal_by_convention_or_by_an_exact_shift_are_used(text: str, at: tuple[float, float]) -> None:
    found = transform_datum(crs(WGS84), crs(text), np.array([[*at, 0.0]]))
    assert np.abs(found[0, :2] - at).max() < 0.01


def test_a_height_system_without_its_grid_is_refused() -> None:
    """PROJ would else give heights that are off by tens of metres, and say nothing."""
    system = crs("EPSG:25832+7837")
    assert system.has_own_heights
    with raises(ConfigError, code="grid_missing"):
        system.to_geodetic(UTM)


def test_points_outside_the_area_are_refused() -> None:
    names = ["P1", "P2", "P3"]
    crs("EPSG:25832").check_area(UTM, names, 2.0)
    with raises(InputError, code="outside_crs"):
        crs("EPSG:25832").check_area(UTM[:, [1, 0, 2]], names, 2.0)
    with raises(InputError, code="outside_crs"):  # Sydney, in a zone of the north
        crs("EPSG:4258").check_area(np.array([[151.2, -33.9, 10.0]]), ["P1"], 2.0)


def test_nonsense_coordinates_are_refused() -> None:
    with raises(InputError, code="outside_crs"):
        crs("EPSG:4326").check_area(np.array([[11.0, 948.0, 0.0]]), ["P"], 2.0) if False else crs(WGS84).from_geodetic(
            np.array([[11.0, 48.0, np.inf]])
        )
