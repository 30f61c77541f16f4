"""Lists of control points as OpenDroneMap has them."""

from __future__ import annotations

from pathlib import Path

import pytest
from raising import raises

from gsmap.errors import InputError, NotFoundError
from gsmap.formats import gcp_list
from gsmap.formats.gcp_list import GcpLine

GOOD = """EPSG:25832
# x y z column row photo name
691234.1234 5334567.7654 519.321 812.5 410 IMG_1.JPG P1
691234.1234\t5334567.7654\t519.321\t12\t40.25\tIMG 2.JPG\tP1\tmore

691254.0 5334560.0 518 5 6 IMG_1.JPG
"""


def test_a_list_is_read() -> None:
    found = gcp_list.parse(GOOD)
    assert found.crs == "EPSG:25832"
    assert [(one.line, one.name, one.image, one.pixel) for one in found.lines] == [
        (3, "P1", "IMG_1.JPG", (812.5, 410.0)),
        (4, "P1", "IMG 2.JPG", (12.0, 40.25)),
        (6, "691254.0_5334560.0_518", "IMG_1.JPG", (5.0, 6.0)),
    ]
    assert found.lines[0].position == (691234.1234, 5334567.7654, 519.321)


@pytest.mark.parametrize(
    ("line", "crs"),
    [
        ("WGS84 UTM 32N", "EPSG:32632"),
        ("wgs84 utm 7s", "EPSG:32707"),
        ("+proj=utm +zone=32 +datum=WGS84 +units=m", "+proj=utm +zone=32 +datum=WGS84 +units=m"),
        ("EPSG:25832+7837", "EPSG:25832+7837"),
        ("WGS84 UTM33N", "EPSG:32633"),
        ("EPSG:32633 # site 4", "EPSG:32633"),
        ("+proj=utm +zone=32 +datum=WGS84 +units=m  # by hand", "+proj=utm +zone=32 +datum=WGS84 +units=m"),
    ],
)
def test_the_first_line_names_the_system(line: str, crs: str) -> None:
    assert gcp_list.parse(f"{line}\n1 2 3 4 5 a.jpg\n").crs == crs


@pytest.mark.parametrize(
    ("text", "code", "match"),
    [
        ("", "file_empty", "is empty"),
        ("EPSG:25832\n", "no_control_points", "no control point"),
        ("1 2 3 4 5 a.jpg\n", "gcp_crs_missing", "line 1: .*is a point"),
        ("UTM somewhere\n1 2 3 4 5 a.jpg", "gcp_crs_missing", "line 1: 'UTM somewhere'"),
        ("WGS84 UTM 61N\n1 2 3 4 5 a.jpg", "gcp_crs_missing", "line 1: UTM zone 61"),
        ("EPSG:1\n\n1 2 4 5 a.jpg", "invalid_line", "line 3 has 5 of .*height"),
        ("EPSG:1\n1 2 3 4 five a.jpg", "invalid_line", "line 2: im_y is 'five'"),
        ("EPSG:1\n1 nan 3 4 5 a.jpg", "invalid_line", "line 2: geo_y is 'nan'"),
        ("EPSG:1\n1 2 3 4 5 a.jpg P\n1 2 4 4 5 b.jpg P", "duplicate", "line 3: point P has other .*line 2"),
        ("EPSG:1\n1 2 3 4 5 a.jpg P\n1 2 3 6 7 a.jpg P", "duplicate", "line 3: point P in photo a.jpg .*line 2"),
        ("EPSG:1\nG1 1 2 3", "invalid_line", "line 2 has 4 fields and begins with 'G1'"),
        ("EPSG:1\n1 2 3 4 5 a.jpg b.jpg G1", "invalid_line", "line 2: .*'a.jpg b.jpg G1'"),
        ("EPSG:1\n1 2 3 4 5 DJI_0001 (2) G1", "invalid_line", "line 2: .*'DJI_0001 .2. G1'"),
        ("EPSG:1\n1 2 3 4 5 DJI_0001 (2)", "invalid_line", "line 2: .*'DJI_0001 .2.'"),
        ("EPSG:1\n1 2 3 4 5 a.jpg\n1.0 2 3e0 6 7 a.jpg", "duplicate", "line 3: point 1_2_3 in .*a.jpg .*line 2"),
    ],
)
def test_what_is_wrong_is_named_with_its_line(text: str, code: str, match: str) -> None:
    with raises(InputError, code=code, match=match):
        gcp_list.parse(text, "g.txt")


@pytest.mark.parametrize(
    ("rest", "image", "name"),
    [
        ("DJI_0001 (2).JPG G1", "DJI_0001 (2).JPG", "G1"),
        ("2022-09-26 15-24-47 DJI_0293.JPG G1", "2022-09-26 15-24-47 DJI_0293.JPG", "G1"),
        ("flight 2/DJI_0001.JPG G1 extra", "flight 2/DJI_0001.JPG", "G1"),
        ("my  photo.tiff", "my  photo.tiff", "1_2_3"),
        ("photo.jpg.png P.1", "photo.jpg.png", "P.1"),
        ("IMG_1 P1", "IMG_1", "P1"),
        ("DJI_0001 (2).JPG\tG1", "DJI_0001 (2).JPG", "G1"),
    ],
)
def test_a_photo_s_name_may_have_spaces(rest: str, image: str, name: str) -> None:
    (line,) = gcp_list.parse(f"EPSG:32633\n1 2 3 4 5 {rest}").lines
    assert (line.image, line.name, line.pixel) == (image, name, (4.0, 5.0))


def test_one_place_is_one_point_however_it_is_written() -> None:
    text = "EPSG:32633\n592836.5 6582077.25 62.4 1 2 a.JPG\n592836.50\t6582077.250\t6.24e1\t1\t1\tb.JPG"
    assert [line.name for line in gcp_list.parse(text).lines] == ["592836.5_6582077.25_62.4"] * 2
    assert [line.name for line in gcp_list.parse(f"{text}\n592836.5 6582077.25 62.40 5 5 c.JPG G1").lines] == ["G1"] * 3
    other = gcp_list.parse(f"{text}\n592836.5 6582077.25 62.41 5 5 c.JPG")
    assert other.lines[2].name == "592836.5_6582077.25_62.41"


def test_a_list_round_trips(tmp_path: Path) -> None:
    line = GcpLine(2, "P1", (691234.12345678, 5334567.765432109, 519.3), (0.1, 2.0), "a b.jpg")
    gcp_list.write(tmp_path / "g.txt", "EPSG:25832", [line])
    assert gcp_list.read(tmp_path / "g.txt").lines == (line,)
    with pytest.raises(NotFoundError):
        gcp_list.read(tmp_path / "none.txt")
    (tmp_path / "b.txt").write_bytes(b"EPSG:25832\n\xff\xfe")
    with raises(InputError, code="invalid_text"):
        gcp_list.read(tmp_path / "b.txt")
