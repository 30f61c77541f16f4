"""Positions of photos."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from PIL import Image
from raising import raises

from gsmap.errors import ConfigError, InputError, MissingDependencyError
from gsmap.world import Params, exif


def photo(path: Path, **gps: object) -> Path:
    """A small picture with GPS tags (by number, ``t1=...``)."""
    picture = Image.new("RGB", (8, 8))
    tags = picture.getexif()
    ifd = tags.get_ifd(0x8825)
    for tag, value in gps.items():
        ifd[int(tag[1:])] = value
    picture.save(path, exif=tags)
    return path


def test_a_position_is_read(tmp_path: Path) -> None:
    one = photo(tmp_path / "a.jpg", t1="S", t2=(48.0, 8.0, 13.2), t3="E", t4=(11.0, 34.0, 30.0), t6=520.5, t31=4.0)
    found = exif.read(one)
    assert found is not None
    assert (found.latitude_deg, found.longitude_deg) == pytest.approx((-48.137, 11.575))
    assert found.height_m == pytest.approx(520.5)
    assert found.sigma_m == pytest.approx(4.0)
    own, common, sea_level = found.sigmas(Params())
    assert own == pytest.approx((4.0, 8.0))
    assert common == pytest.approx((4.0, 8.0))
    assert sea_level == 40, "sea level is not the ellipsoid"


def test_a_position_without_an_error_has_the_default_one(tmp_path: Path) -> None:
    found = exif.read(photo(tmp_path / "a.jpg", t1="N", t2=(48.0, 8.0, 13.2), t3="E", t4=(11.0, 34.0, 30.0), t6=520.5))
    assert found is not None
    own, common, _ = found.sigmas(Params(gnss_sigma_m=2.0, gnss_common_sigma_m=5.0))
    assert (own[0], common[0]) == (2.0, 5.0)


def rtk(**values: str) -> str:
    return f"<d {' '.join(f'drone-dji:Rtk{name}={value!r}' for name, value in values.items())}/>"


def with_xmp(path: Path, body: str) -> Path:
    """A photo at a position, with an XMP packet."""
    picture = Image.new("RGB", (8, 8))
    tags = picture.getexif()
    tags.get_ifd(0x8825).update({1: "N", 2: (48.0, 8.0, 13.2), 3: "E", 4: (11.0, 34.0, 30.0), 6: 520.5, 31: 4.0})
    picture.save(path, exif=tags, xmp=f"<x:xmpmeta>{body}</x:xmpmeta>".encode())
    return path


@pytest.mark.parametrize(
    "body",
    [
        rtk(Flag="50", StdLon="0.011", StdLat="0.013", StdHgt="0.024"),
        "<drone-dji:RtkFlag>50</drone-dji:RtkFlag><drone-dji:RtkStdLon>0.011</drone-dji:RtkStdLon>"
        "<drone-dji:RtkStdLat>0.013</drone-dji:RtkStdLat><drone-dji:RtkStdHgt>0.024</drone-dji:RtkStdHgt>",
    ],
)
def test_the_errors_of_a_position_with_corrections_come_from_xmp(tmp_path: Path, body: str) -> None:
    found = exif.read(with_xmp(tmp_path / "a.jpg", body))
    assert found is not None
    own, common, _ = found.sigmas(Params())
    assert own == pytest.approx((0.013, 0.024))
    assert common == pytest.approx((0.013, 0.024))


@pytest.mark.parametrize(
    "body",
    [
        rtk(Flag="0", StdLon="0.011", StdLat="0.013", StdHgt="0.024"),
        rtk(Flag="50", StdLon="0.0", StdLat="0.013", StdHgt="0.024"),
        rtk(Flag="50", StdLat="0.013"),
        rtk(Flag="x", StdLon="1e", StdLat="-", StdHgt="nan"),
    ],
)
def test_xmp_without_corrections_or_with_other_values_counts_for_nothing(tmp_path: Path, body: str) -> None:
    found = exif.read(with_xmp(tmp_path / "a.jpg", body))
    assert found is not None
    assert found.sigmas(Params())[0] == pytest.approx((4.0, 8.0))


@pytest.mark.parametrize("name", ["area_margin_deg", "gcp_sigma_m", "gnss_sigma_m", "survey_sigma_m"])
def test_sigmas_are_positive(name: str) -> None:
    with pytest.raises(ConfigError):
        Params(**{name: 0.0})


@pytest.mark.parametrize(
    "gps",
    [
        {},
        {"t1": "N", "t2": (48.0, 8.0, 13.2)},
        {"t1": "N", "t2": (0.0, 0.0, 0.0), "t3": "E", "t4": (0.0, 0.0, 0.0)},
        {"t1": "N", "t2": (98.0, 0.0, 0.0), "t3": "E", "t4": (11.0, 0.0, 0.0)},
        {"t1": "?", "t2": (48.0, 0.0, 0.0), "t3": "E", "t4": (11.0, 0.0, 0.0)},
        {"t1": "N", "t2": (48.0, 0.0, 0.0), "t3": "E", "t4": (11.0, 0.0, 0.0), "t18": "TOKYO"},
    ],
)
def test_what_is_no_position_is_none(tmp_path: Path, gps: dict[str, object]) -> None:
    assert exif.read(photo(tmp_path / "a.jpg", **gps)) is None


def test_heic_photos_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The suffix counts only for the search; the content is read whatever it is."""
    tags = {"t1": "N", "t2": (48.0, 0.0, 0.0), "t3": "E", "t4": (11.0, 0.0, 0.0)}
    for suffix in (".HEIC", ".heif"):
        photo(tmp_path / "a.jpg", **tags).rename(tmp_path / f"a{suffix}")
    assert all(found is not None for found in exif.read_folder(tmp_path).values())
    assert len(exif.read_folder(tmp_path)) == 2
    (tmp_path / "a.heif").write_bytes(b"\0\0\0\x18ftypheic\0\0\0\0mif1heic" + bytes(64))
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    with pytest.raises(MissingDependencyError):
        exif.read_folder(tmp_path)


def test_a_folder_without_positions_is_refused(tmp_path: Path) -> None:
    photo(tmp_path / "a.jpg")
    (tmp_path / "b.jpg").write_bytes(b"no picture")
    with raises(InputError, code="no_gnss"):
        exif.read_folder(tmp_path)
    with raises(InputError, code="folder_not_found"):
        exif.read_folder(tmp_path / "a.jpg")


@pytest.mark.parametrize(("reference", "height"), [(b"\0", 100.0), (b"\1", -100.0), (b"\2", 100.0), (b"\3", -100.0)])
def test_heights_are_above_sea_level_whatever_exif_calls_them(tmp_path: Path, reference: bytes, height: float) -> None:
    """EXIF 3: 2 and 3 are sea level; 0 and 1 became the ellipsoid, and are written for sea level still."""
    found = exif.read(
        photo(tmp_path / "a.jpg", t1="N", t2=(48.0, 8.0, 0), t3="E", t4=(11.0, 34.0, 0), t5=reference, t6=100.0)
    )
    assert found is not None
    assert found.height_m == height
    assert found.sigmas(Params())[2] == 40
