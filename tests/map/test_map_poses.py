"""Files of poses for other programs: which pose is whose, times that are real or said to be made up, and metres."""

from __future__ import annotations

import itertools
import logging
import shutil
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from raising import raises

import gsmap.map
from gsmap.errors import NotFoundError
from gsmap.formats import read_cameras
from gsmap.geometry.camera_models import camera_model, pinhole_views
from gsmap.geometry.transforms import transform_gaussians
from gsmap.map import Map
from gsmap.types import Cameras, Gaussians, Sim3
from tools.pose_graph_files import read_g2o, read_tum

NAMES = ["walk", "attic", "cellar", "den", "barn"]  # not in the order of names
SIGMAS = np.array([0.001] * 6 + [1e-9])
AT = {name: np.array([2.0 * i, 0.5 * i, 0.0]) for i, name in enumerate(NAMES)}
DAY = datetime(2026, 5, 31, tzinfo=UTC).timestamp()


def photos() -> Cameras:
    """A photo with distortion and a panorama, at -4 m along the view of the Gaussians."""
    pose = np.eye(4)
    pose[:3, 3] = (0, 0, -4)
    bent = camera_model("OPENCV", 200, 150, (180.0, 180, 100, 75, -0.2, 0.05, 0.001, 0))
    panorama = camera_model("EQUIRECTANGULAR", 200, 100, (200.0, 100.0))
    return Cameras.concatenate([pinhole_views(bent, pose, "a.jpg"), pinhole_views(panorama, pose, "pano.jpg")])


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five scenes in a row, none of which has a date, in a unit that nobody told; one has photos."""
    rng = np.random.default_rng(0)
    n = 400
    quats, log_scales = np.tile([1.0, 0, 0, 0], (n, 1)), np.full((n, 3), -4.0)
    one = Gaussians(rng.normal(size=(n, 3)), quats, log_scales, np.zeros(n), np.zeros((n, 1, 3)))
    path = tmp_path_factory.mktemp("poses") / "site.gsmap"
    with gsmap.map.create(path) as m:
        for name in NAMES:
            moved = transform_gaussians(one, Sim3(np.eye(3), -AT[name]))
            m.ingest(moved, cameras=photos() if name == "den" else None, name=name, scale="unknown")
        for a, b in itertools.pairwise(NAMES):
            m.add_edge(f"{a}:{b}", Sim3(np.eye(3), AT[b] - AT[a]), SIGMAS)
        m.optimize()
    return path


@pytest.fixture
def m(site: Path, tmp_path: Path) -> Iterator[Map]:
    shutil.copytree(site, tmp_path / "site.gsmap")
    with gsmap.map.open(tmp_path / "site.gsmap") as m:
        yield m


def written(m: Map, out: Path) -> dict[str, tuple[float, np.ndarray]]:
    """The time and position of each name of a TUM file, by the comment before each pose."""
    m.write_poses(out, "tum")
    lines = [line for line in out.read_text().splitlines() if line]
    poses = dict(zip([i for i, line in enumerate(lines) if line[0] != "#"], read_tum(out), strict=True))
    return {lines[i - 1].removeprefix("# "): (time_s, S.translation) for i, (time_s, S) in poses.items()}


def apart(found: dict[str, tuple[float, np.ndarray]], a: str, b: str) -> float:
    return float(np.linalg.norm(found[b][1] - found[a][1]))


def date(m: Map, dates: dict[str, str]) -> None:
    for name, when in dates.items():
        m.edit(name, captured_at=when)


def test_scenes_without_dates_go_by_name_at_times_that_are_said_to_be_made_up(m, tmp_path, caplog):
    date(m, {name: "2026-05-31" for name in NAMES if name != "cellar"})
    with caplog.at_level(logging.WARNING, "gsmap.map"):
        found = written(m, tmp_path / "a.tum")
    assert {name: time_s for name, (time_s, _) in found.items()} == {name: i for i, name in enumerate(sorted(NAMES))}
    for a in NAMES:
        for b in NAMES:
            assert apart(found, a, b) == pytest.approx(np.linalg.norm(AT[b] - AT[a]), abs=1e-6)
    assert any("cellar" in text and "placeholders" in text for text in caplog.messages)
    assert any("cellar" in line and "placeholders" in line for line in (tmp_path / "a.tum").read_text().splitlines())


def test_scenes_of_one_date_have_times_of_their_own_and_other_dates_stay(m, tmp_path, caplog):
    later = {"attic": "2026-05-31T00:00:00.5Z", "den": "2026-06-01", "barn": "2026-06-02"}
    date(m, {"walk": "2026-05-31", "cellar": "2026-05-31", **later})
    with caplog.at_level(logging.WARNING, "gsmap.map"):
        found = written(m, tmp_path / "a.tum")
    times = {name: time_s - DAY for name, (time_s, _) in found.items()}
    assert times == pytest.approx(
        {"cellar": 0.0, "walk": 0.25, "attic": 0.5, "den": 86400.0, "barn": 172800.0}, abs=1e-5
    )
    assert any("walk" in text and "same date" in text for text in caplog.messages)


def test_real_times_have_no_remark(m, tmp_path, caplog):
    early = {"attic": "2026-05-29", "den": "2026-05-28", "barn": "2026-05-27"}
    date(m, {"walk": "2026-05-31T02:00:00+02:00", "cellar": "2026-06-01", **early})
    m.edit("walk", metres_per_unit=1.0)
    with caplog.at_level(logging.WARNING, "gsmap.map"):
        found = written(m, tmp_path / "a.tum")
    assert list(found) == ["barn", "den", "attic", "walk", "cellar"]
    assert found["walk"][0] == DAY
    assert not caplog.messages


def test_lengths_are_metres_where_the_metre_is_known(m, tmp_path, caplog):
    with caplog.at_level(logging.WARNING, "gsmap.map"):
        written(m, tmp_path / "a.tum")
    assert any("unit of the map" in text for text in caplog.messages)
    m.edit("attic", metres_per_unit=0.5)
    caplog.clear()
    with caplog.at_level(logging.WARNING, "gsmap.map"):
        found = written(m, tmp_path / "a.tum")
    assert apart(found, "walk", "cellar") == pytest.approx(0.5 * np.linalg.norm(AT["cellar"]), abs=1e-6)
    assert not any("unit of the map" in text for text in caplog.messages)
    assert "metres" in (tmp_path / "a.tum").read_text()


def test_a_g2o_in_metres_has_the_same_error_at_every_pose(m, tmp_path):
    def read(name: str):
        m.write_poses(tmp_path / name, "g2o")
        return read_g2o(tmp_path / name)

    units = read("units.g2o")
    m.edit("attic", metres_per_unit=0.5)
    metres = read("metres.g2o")
    for one, two in zip(units.edges, metres.edges, strict=True):
        np.testing.assert_allclose(two.S_target_source.translation, 0.5 * one.S_target_source.translation, atol=1e-9)
        step = np.array([0.01, -0.02, 0.03, 0.1, 0.2, -0.3, 0.0])
        halved = step * [1, 1, 1, 0.5, 0.5, 0.5, 1]
        assert halved @ two.information @ halved == pytest.approx(step @ one.information @ step, rel=1e-9)
    lines = (tmp_path / "metres.g2o").read_text().splitlines()
    names = [lines[i - 1] for i, line in enumerate(lines) if line.startswith("VERTEX")]
    assert names == [f"# {name}" for name in sorted(NAMES)]


def test_photos_are_written_with_their_lenses_in_the_unit_of_exports_which_is_said(m, tmp_path, caplog):
    m.edit("attic", metres_per_unit=0.5)
    with caplog.at_level(logging.WARNING, "gsmap.map"):
        m.write_poses(tmp_path / "model", "colmap")
    assert any("0.5 m" in text for text in caplog.messages)
    assert any("barn" in text and "den" not in text for text in caplog.messages), "it has no photos"
    found = read_cameras(tmp_path / "model")
    assert {name: found.lenses[rows[0]].model.name for name, rows in found.photo_rows.items()} == {
        "den/a.jpg": "OPENCV",
        "den/pano.jpg": "EQUIRECTANGULAR",
    }
    den = m.poses()["den"].S_map_scene
    np.testing.assert_allclose(found.centers, np.tile(den.apply(np.array([[0, 0, -4.0]])), (7, 1)), atol=1e-6)


def test_a_map_without_photos_has_no_cameras_to_write(m, tmp_path):
    m.remove("den")
    with raises(NotFoundError, code="no_cameras"):
        m.write_poses(tmp_path / "transforms.json", "nerfstudio")
