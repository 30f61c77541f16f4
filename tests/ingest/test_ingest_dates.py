"""When a capture was taken: sidecars, photographs and names, in this order, and nothing else."""

from __future__ import annotations

import json
import os
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from raising import raises

from gsmap.errors import ConfigError, InputError
from gsmap.formats import cameras_json, write
from gsmap.ingest import find_captures, find_date, read_captures
from gsmap.ingest.dates import MAX_FRAMES, date_in_name, given_date
from gsmap.types import Cameras, Gaussians

NOW = datetime(2026, 11, 21, 12, tzinfo=UTC)


def capture(path: Path, seed: int = 0) -> Path:
    """A file of a few Gaussians."""
    path.parent.mkdir(parents=True, exist_ok=True)
    points = np.random.default_rng(seed).uniform(-1, 1, (50, 3))
    n = len(points)
    write(
        path, Gaussians(points, np.tile([1.0, 0, 0, 0], (n, 1)), np.full((n, 3), -3.0), np.ones(n), np.zeros((n, 1, 3)))
    )
    return path


def photograph(path: Path, taken: str | None = None, offset: str | None = None) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    exif = Image.Exif()
    exif[306] = "2001:01:01 00:00:00"  # when it was last changed, which says nothing
    if taken is not None:
        exif.get_ifd(0x8769)[0x9003] = taken
    if offset is not None:
        exif.get_ifd(0x8769)[0x9011] = offset
    Image.new("RGB", (8, 8)).save(path, "JPEG", exif=exif)
    return path


def date_of(path: Path, **given):
    (found,) = find_captures([path])
    return find_date(found, now=NOW, **given)


@pytest.mark.parametrize(
    ("name", "when", "note"),
    [
        ("hall_2026-05-31", "2026-05-31T00:00:00+00:00", "no time of day"),
        ("20260531", "2026-05-31T00:00:00+00:00", "no time of day"),
        ("2026-05-31T14-00", "2026-05-31T14:00:00+00:00", "no zone"),
        ("2026_05_31_1400", "2026-05-31T14:00:00+00:00", "no zone"),
        ("hall-20260531_140059-b", "2026-05-31T14:00:59+00:00", "no zone"),
        ("20260531T140059Z", "2026-05-31T14:00:59+00:00", ""),
        ("run_2026-05-31-14-00-59", "2026-05-31T14:00:59+00:00", "no zone"),  # rosbag
        ("run_2026-05-31-14-00-59_0", "2026-05-31T14:00:59+00:00", "no zone"),  # its first part
        ("rosbag2_2026_05_31-14_00_59", "2026-05-31T14:00:59+00:00", "no zone"),
        ("Screenshot_20260531-140059", "2026-05-31T14:00:59+00:00", "no zone"),
        ("PXL_20260531_140059123", "2026-05-31T14:00:59.123000+00:00", "no zone"),  # Pixel
        ("PXL_20260531_140059123.MP", "2026-05-31T14:00:59.123000+00:00", "no zone"),
        ("DJI_20260531140059_0001_V", "2026-05-31T14:00:59+00:00", "no zone"),  # DJI since 2022
        ("2026-05-31-14", "2026-05-31T00:00:00+00:00", "no time of day"),  # the number of a take
        ("2026-05-31-1400", "2026-05-31T00:00:00+00:00", "no time of day"),
        ("20260531-1234567", "2026-05-31T00:00:00+00:00", "no time of day"),
        ("2026-05-31-25-00-00", "2026-05-31T00:00:00+00:00", "no time of day"),
        ("2026-05-31T14-00+0200", "2026-05-31T14:00:00+02:00", ""),
        ("scan_20260531T140000-0700", "2026-05-31T14:00:00-07:00", ""),
        ("2026-05-31T14:00:00-07:00", "2026-05-31T14:00:00-07:00", ""),
        ("2026-05-31T23:30:00-0800", "2026-05-31T23:30:00-08:00", ""),
        ("2026-05-31T14:00-07:00", "2026-05-31T14:00:00-07:00", ""),
        ("2026-05-31T14:00:00.250Z", "2026-05-31T14:00:00+00:00", ""),
        ("hall_2026-05-31_14-00-00+02", "2026-05-31T14:00:00+02:00", ""),
        ("2026-05-31T14-00-00-0700", "2026-05-31T14:00:00+00:00", "-0700 may be a number"),
        ("20260531T140000-0001", "2026-05-31T14:00:00+00:00", "no zone"),  # the number of a take
        ("2026-05-31_9900", "2026-05-31T00:00:00+00:00", "no time of day"),  # the number of a take
        ("2026_05_31_2", "2026-05-31T00:00:00+00:00", "no time of day"),
        ("2026-11-22", "2026-11-22T00:00:00+00:00", "no time of day"),  # it is tomorrow east of here
        ("2026-05-31_2026-05-31", "2026-05-31T00:00:00+00:00", "no time of day"),
    ],
)
def test_dates_in_names(name: str, when: str, note: str) -> None:
    found, said = date_in_name(name, now=NOW)
    assert found is not None
    assert found.isoformat() == when
    assert said.startswith(note)
    assert bool(said) == bool(note)


@pytest.mark.parametrize(
    "name",
    [
        "capture_20261399",
        "capture_20260230",
        "2026-13-01",
        "2026-02-30",
        "1989-12-31",
        "120260531",
        "202605311",
        "20260531140059",
        "0.20260531",
        "3f20260531ab",
        "v20260531",
        "2026-0531",
        "2026-05_31",
        "12026-05-31",
        "2026-05-311",
        "31-05-2026",
        "2026",
        "２０２６-05-31",
        "",
    ],
)
def test_numbers_that_are_no_dates(name: str) -> None:
    assert date_in_name(name, now=NOW) == (None, "")


@pytest.mark.parametrize("name", ["20261123", "2062-01-01", "DJI_20620101140000_0001", "2062-01-01_2063-01-01"])
def test_a_date_in_the_future_is_not_taken_and_named(name: str, tmp_path: Path) -> None:
    date, note = date_in_name(name, now=NOW)
    assert date is None
    assert "lies in the future" in note
    found = date_of(capture(tmp_path / "a" / f"{name}.ply"))
    assert found.when is None
    assert note in found.note
    found = date_of(capture(tmp_path / "2026-05-31" / f"{name}.ply", 1))  # the folder tells, and the note stays
    assert found.when == "2026-05-31T00:00:00+00:00"
    assert note in found.note
    assert date_in_name(f"{name}_2026-05-31", now=NOW)[0] == datetime(2026, 5, 31, tzinfo=UTC)


def test_photographs_of_the_future_are_named(tmp_path: Path) -> None:
    """The clock of this computer may be behind, after its battery was changed."""
    path = capture(tmp_path / "hall.ply")
    photograph(tmp_path / "images" / "a.jpg", "2062:01:01 00:00:00")
    found = date_of(path)
    assert found.when is None
    assert "2062-01-01" in found.note
    assert "a.jpg" in found.note
    photograph(tmp_path / "images" / "b.jpg", "2026:05:31 00:00:00")
    assert date_of(path).when == "2026-05-31T00:00:00+00:00"


def test_a_person_s_date_in_the_future_is_refused() -> None:
    for when in ("2262-01-01", "2262-01-01T00:00:00+02:00"):
        with raises(ConfigError, code="date_in_future"):
            given_date(when)


@pytest.mark.parametrize("name", ["2026-05-31_2026-06-02", "20260531_20260602", "2025-05-31_vs_2026-05-31"])
def test_several_dates_in_a_name_are_none(name: str, tmp_path: Path) -> None:
    assert date_in_name(name, now=NOW)[0] is None
    found = date_of(capture(tmp_path / "2024-01-01" / f"{name}.ply"))
    assert (found.when, found.source) == (None, "")
    assert "several dates" in found.note


def test_a_trainer_s_folder_and_the_folder_around_tell(tmp_path: Path) -> None:
    capture(tmp_path / "hall_2026-05-31" / "point_cloud" / "iteration_7000" / "point_cloud.ply")
    found = date_of(tmp_path / "hall_2026-05-31")
    assert (found.when, found.source) == ("2026-05-31T00:00:00+00:00", "the name hall_2026-05-31")
    assert "no time of day" in found.note
    found = date_of(capture(tmp_path / "visit 2026-06-01" / "hall.ply"))
    assert found.source == "the name visit 2026-06-01"
    found = date_of(capture(tmp_path / "2026-06-01" / "hall_2026-05-30.ply"))
    assert found.when == "2026-05-30T00:00:00+00:00"
    assert date_of(capture(tmp_path / "2026-06-01" / "deeper" / "hall.ply")).when is None


def test_the_beginning_of_a_training_is_no_date(tmp_path: Path) -> None:
    run = tmp_path / "hall" / "splatfacto" / "2026-05-31_140012"
    (run / "nerfstudio_models").mkdir(parents=True)
    assert date_of(capture(run / "exports" / "splat" / "splat.ply")).when is None
    assert date_of(capture(run / "hall.ply")).when is None


def test_modification_times_are_never_asked(tmp_path: Path) -> None:
    path = capture(tmp_path / "hall.ply")
    photograph(tmp_path / "images" / "a.jpg")
    for each in (path, tmp_path / "images" / "a.jpg"):
        os.utime(each, (1e9, 1e9))
    assert date_of(path) == find_date(find_captures([path])[0]) == date_of(path)
    assert (date_of(path).when, date_of(path).note) == (None, "")


# -- sidecars


@pytest.mark.parametrize("sidecar", ["hall_2026-05-31.json", "hall_2026-05-31.meta.json"])
def test_a_sidecar_comes_first(sidecar: str, tmp_path: Path) -> None:
    path = capture(tmp_path / "hall_2026-05-31.ply")
    photograph(tmp_path / "images" / "a.jpg", "2026:05:30 09:00:00")
    (tmp_path / sidecar).write_text('{"captured_at": "2026-05-29T08:00:00+02:00", "by": "ada"}')
    found = date_of(path)
    assert (found.when, found.source) == ("2026-05-29T08:00:00+02:00", sidecar)
    assert found.note == f"dated 2026-05-29T08:00:00+02:00 by {sidecar}"
    (tmp_path / sidecar).write_text('{"captured_at": "2026-05-29"}')
    assert "UTC was assumed" in date_of(path).note


def test_a_trainer_s_folder_has_its_sidecar_beside_it(tmp_path: Path) -> None:
    capture(tmp_path / "hall" / "point_cloud" / "iteration_7000" / "point_cloud.ply")
    (tmp_path / "hall.json").write_text('{"captured_at": "2026-05-29T08:00:00Z"}')
    assert date_of(tmp_path / "hall").when == "2026-05-29T08:00:00+00:00"


@pytest.mark.parametrize(
    "content", ['"2026-05-29"', "[1, 2]", "{}", '{"captured_at": null}', '["captured_at"]', "no JSON", "\0\xff"]
)
def test_other_files_of_the_name_are_let_be(content: str, tmp_path: Path) -> None:
    path = capture(tmp_path / "hall.ply")
    (tmp_path / "hall.json").write_text(content)
    assert date_of(path).when is None


@pytest.mark.parametrize(
    ("content", "code"),
    [
        ('{"captured_at": "yesterday"}', "invalid_date"),
        ('{"captured_at": 20260531}', "invalid_date"),
        ('{"captured_at": ""}', "invalid_date"),
        ('{"captured_at": "2206-05-31"}', "date_in_future"),
        ('{"captured_at": 2026-05-31}', "not_json"),
    ],
)
def test_a_wrong_sidecar_is_refused_by_name(content: str, code: str, tmp_path: Path) -> None:
    path = capture(tmp_path / "hall.ply")
    (tmp_path / "hall.meta.json").write_text(content)
    with raises(InputError, code=code, match=r"hall\.meta\.json"):
        read_captures(path)
    (told,) = read_captures(path, captured_at="2026-05-31")  # a person's word needs no sidecar
    assert told.captured_at == "2026-05-31T00:00:00+00:00"


# -- photographs


def test_the_first_photograph_beside_it_tells(tmp_path: Path) -> None:
    path = capture(tmp_path / "hall_2026-01-01.ply")
    photograph(tmp_path / "images" / "a.jpg", "2026:05:31 14:10:00", "+02:00")
    photograph(tmp_path / "images" / "b.jpg", "2026:05:31 12:05:00", "+00:00")
    photograph(tmp_path / "images" / "c.jpg")
    found = date_of(path)
    assert (found.when, found.source) == ("2026-05-31T12:05:00+00:00", "the EXIF of b.jpg")
    assert "the earliest of 2 dates in 3 frames read; the latest is 2026-05-31T14:10:00+02:00" in found.note
    assert "UTC" not in found.note
    photograph(tmp_path / "images" / "b.jpg", "2026:05:31 12:05:00")
    assert "no zone was given, so UTC was assumed" in date_of(path).note


@pytest.mark.parametrize(
    "taken",
    ["0000:00:00 00:00:00", "    :  :     :  :  ", "1980:01:01 00:00:00", "2062:01:01 00:00:00", "2026-05-31", ""],
)
def test_photographs_that_cannot_tell(taken: str, tmp_path: Path) -> None:
    path = capture(tmp_path / "hall.ply")
    photograph(tmp_path / "images" / "a.jpg", taken)
    (tmp_path / "images" / "b.jpg").write_bytes(b"\xff\xd8\xff\xe1\xff\xffExif\0\0")
    (tmp_path / "images" / "c.jpg").write_text("no picture")
    Image.new("RGB", (8, 8)).save(tmp_path / "images" / "d.png")
    assert date_of(path).when is None


def test_an_offset_that_is_none_is_not_believed(tmp_path: Path) -> None:
    path = capture(tmp_path / "hall.ply")
    photograph(tmp_path / "images" / "a.jpg", "2026:05:31 14:00:00", "+99:00")
    found = date_of(path)
    assert found.when == "2026-05-31T14:00:00+00:00"
    assert "UTC was assumed" in found.note


def test_images_of_several_captures_tell_of_none(tmp_path: Path) -> None:
    path = capture(tmp_path / "hall.ply")
    capture(tmp_path / "cellar.ply")
    photograph(tmp_path / "images" / "a.jpg", "2026:05:31 14:00:00")
    assert date_of(path).when is None


@pytest.mark.parametrize("suffix", ["", ".jpg"])
def test_frames_that_its_cameras_name_tell_whoever_else_lies_there(suffix: str, tmp_path: Path) -> None:
    for name, day in (("hall", 30), ("cellar", 29)):
        capture(tmp_path / f"{name}.ply")
        views = Cameras(
            np.tile(np.eye(4), (2, 1, 1)),
            np.tile([50.0, 50, 32, 24], (2, 1)),
            np.tile([64, 48], (2, 1)),
            (f"{name}_0{suffix}", f"{name}_1{suffix}"),
        )
        cameras_json.write(tmp_path / f"{name}.cameras.json", views)
        photograph(tmp_path / "images" / f"{name}_1.jpg", f"2026:05:{day} 14:00:00", "Z")
    dates = {one.name: one for one in read_captures(tmp_path)}
    assert dates["hall"].captured_at == "2026-05-30T14:00:00+00:00"
    assert dates["cellar"].captured_at == "2026-05-29T14:00:00+00:00"
    assert dates["hall"].dated_by == "the EXIF of hall_1.jpg"
    assert any("by the EXIF of hall_1.jpg" in note for note in dates["hall"].notes)


def test_transforms_and_colmap_models_name_frames(tmp_path: Path) -> None:
    path = capture(tmp_path / "a" / "hall.ply")
    frame = {"file_path": "./images/one.jpg", "transform_matrix": np.eye(4).tolist()}
    (tmp_path / "a" / "transforms.json").write_text(
        json.dumps({"w": 64, "h": 48, "fl_x": 50.0, "fl_y": 50.0, "frames": [frame]})
    )
    photograph(tmp_path / "a" / "images" / "one.jpg", "2026:05:31 14:00:00")
    photograph(tmp_path / "a" / "images" / "other.jpg", "2026:05:30 14:00:00")
    (one,) = read_captures(path)
    assert one.captured_at == "2026-05-31T14:00:00+00:00"
    model = tmp_path / "b" / "colmap" / "sparse" / "0"
    model.mkdir(parents=True)
    photograph(tmp_path / "b" / "images" / "deep" / "one.jpg", "2026:05:29 14:00:00")
    found = date_of(
        capture(tmp_path / "b" / "hall.ply"), cameras=model, frames=("deep/one.jpg", "", "x" * 5000, "a\0b")
    )
    assert found.when == "2026-05-29T14:00:00+00:00"


def test_of_many_frames_only_some_are_opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = capture(tmp_path / "hall.ply")
    for i in range(100):
        photograph(tmp_path / "images" / f"{i:03d}.jpg", f"2026:05:31 14:{i // 60:02d}:{i % 60:02d}")
    opened = []
    really = Image.open
    monkeypatch.setattr(Image, "open", lambda file, **more: opened.append(file) or really(file, **more))
    found = date_of(path)
    assert len(opened) == MAX_FRAMES
    assert found.when == "2026-05-31T14:00:00+00:00"  # the first is among them, and so is the last
    assert "14:01:39" in found.note


# -- what is given


def test_a_given_date_needs_no_finding(tmp_path: Path) -> None:
    path = capture(tmp_path / "hall_2026-05-31.ply")
    (told,) = read_captures(path, captured_at="2026-01-01T10:00")
    assert (told.captured_at, told.dated_by) == ("2026-01-01T10:00:00+00:00", "")
    assert any("as specified: no zone was given, so UTC was assumed" in note for note in told.notes)
    assert given_date("2026-01-01T10:00+01:00").note == ""
    assert given_date(None).when is None
    (found,) = read_captures(path)
    assert (found.captured_at, found.dated_by) == ("2026-05-31T00:00:00+00:00", "the name hall_2026-05-31")
    assert any(note.startswith("dated 2026-05-31") for note in found.notes)


def test_names_are_shown_without_control_characters(tmp_path: Path) -> None:
    found = date_of(capture(tmp_path / "a\x1b[31m_2026-05-31.ply"))
    assert found.source == "the name a?[31m_2026-05-31"
    assert "\x1b" not in found.note
