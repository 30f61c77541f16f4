"""Photos of one name: matched to cameras by folders, or refused; and observations that have no solution."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import gsmap
from gsmap.errors import InputError, NotFoundError
from gsmap.formats import gcp_list
from gsmap.geodesy.frame import from_frame
from gsmap.map import Map
from gsmap.map.world.georeference import Request
from gsmap.map.world.photo_names import match_photos, rows_of_photo
from gsmap.optimize.survey_system import System
from gsmap.types import Cameras
from gsmap_synthetic.surveyed import Site, SiteParams, ground, surveyed_site

sys.path.insert(0, str(Path(__file__).parents[1] / "world"))
from made_sites import made_map
from raising import raises

DRONE = tuple(f"DJI_{k + 1:04d}.JPG" for k in range(8))
RIG = tuple(f"cam{k % 2}/{k // 2:06d}.JPG" for k in range(8))


def matched(photos: list[str], **names: tuple[str, ...]) -> dict[str, str]:
    """Each photo's camera as SCENE:CAMERA."""
    found = match_photos(photos, names, dict.fromkeys(photos, "photos"))
    return {photo: f"{scene}:{names[scene][row]}" for photo, (scene, row) in found.cameras.items()}


@pytest.mark.parametrize(
    ("photos", "names", "cameras"),
    [
        # A file name that only one scene has, with other folders or another suffix.
        (["/p/DJI_0001.JPG"], {"a": DRONE}, ["a:DJI_0001.JPG"]),
        (["/p/DJI_0001.png"], {"a": ("images/DJI_0001.JPG",)}, ["a:images/DJI_0001.JPG"]),
        (["C:\\p\\DJI_0001.JPG"], {"a": DRONE}, ["a:DJI_0001.JPG"]),
        # Flights in folders called as the scenes, directly or further up.
        (["/p/a/DJI_0001.JPG", "/p/b/DJI_0001.JPG"], {"a": DRONE, "b": DRONE}, ["a:DJI_0001.JPG", "b:DJI_0001.JPG"]),
        (["/p/b/100MEDIA/DJI_0001.JPG"], {"a": DRONE, "b": DRONE}, ["b:DJI_0001.JPG"]),
        (["/a/b/DJI_0001.JPG"], {"a": DRONE, "b": DRONE}, ["b:DJI_0001.JPG"]),
        (["/p/site/east/DJI_0001.JPG"], {"site/east": DRONE, "site/west": DRONE}, ["site/east:DJI_0001.JPG"]),
        # The folder's scene does not have it: no other scene's camera is taken for it.
        (["/p/a/DJI_0009.JPG"], {"a": DRONE, "b": ("DJI_0009.JPG",)}, [""]),
        # A flight that is not in the map, beside one that is; contested cameras and others.
        (["/p/a/DJI_0001.JPG", "/p/c/DJI_0001.JPG", "/p/c/DJI_0002.JPG"], {"a": DRONE}, ["a:DJI_0001.JPG", "", ""]),
        # The same under names that only another scene has, whose own photos are not there.
        (["/p/a/DJI_0001.JPG", "/p/c/DJI_0009.JPG"], {"a": DRONE, "b": ("DJI_0009.JPG",)}, ["a:DJI_0001.JPG", ""]),
        (["/p/a/DJI_0001.JPG", "/p/c/b_9.JPG"], {"a": DRONE, "b": ("b_9.JPG",)}, ["a:DJI_0001.JPG", "b:b_9.JPG"]),
        (
            ["a/DJI_0001.JPG", "DJI_0009.JPG"],
            {"a": DRONE, "b": ("DJI_0009.JPG",)},
            ["a:DJI_0001.JPG", "b:DJI_0009.JPG"],
        ),
        # A rig, and the same of two scenes.
        (["/p/cam0/000000.JPG", "/p/cam1/000000.JPG"], {"a": RIG}, ["a:cam0/000000.JPG", "a:cam1/000000.JPG"]),
        (["/p/b/cam1/000000.JPG"], {"a": RIG, "b": RIG}, ["b:cam1/000000.JPG"]),
        # A third camera of the rig, which the capture was not made of.
        (["/p/cam0/000000.JPG", "/p/cam2/000001.JPG"], {"a": RIG}, ["a:cam0/000000.JPG", ""]),
        (["/p/a/cam0/000000.JPG", "/p/a/cam2/000001.JPG"], {"a": RIG}, ["a:cam0/000000.JPG", ""]),
        # Two files of one shot: the one that the capture names.
        (["/p/DJI_0001.JPG", "/p/DJI_0001.TIF"], {"a": DRONE}, ["a:DJI_0001.JPG", ""]),
        # Two ways to write one photo.
        (["DJI_0001", "a/DJI_0001.JPG"], {"a": DRONE}, ["a:DJI_0001.JPG"] * 2),
        # Cameras named with and without folders in one scene.
        (["/p/x.jpg", "/p/cam0/y.jpg"], {"a": ("x.jpg", "cam0/y.jpg")}, ["a:x.jpg", "a:cam0/y.jpg"]),
    ],
)
def test_a_photo_is_known_by_its_path(photos: list[str], names: dict[str, tuple[str, ...]], cameras: list[str]) -> None:
    for order in (photos, photos[::-1]):
        found = matched(order, **names)
        assert [found.get(photo, "") for photo in photos] == cameras


@pytest.mark.parametrize(
    ("photos", "names", "told"),
    [
        (["/p/DJI_0001.JPG"], {"a": DRONE, "b": DRONE}, ["a/DJI_0001.JPG", "b/DJI_0001.JPG"]),
        (["000000.JPG"], {"a": RIG}, ["a/cam0/000000.JPG", "a/cam1/000000.JPG"]),
        (["/p/cam0/000000.JPG"], {"a": RIG, "b": RIG}, ["a/cam0/000000.JPG", "b/cam0/000000.JPG"]),
        (["/p/c/DJI_0001.JPG", "/p/d/DJI_0001.JPG"], {"a": DRONE}, ["/p/c/DJI_0001.JPG", "/p/d/DJI_0001.JPG"]),
        (["/p/DJI_0001.TIF", "/p/DJI_0001.png"], {"a": DRONE}, ["/p/DJI_0001.TIF", "/p/DJI_0001.png"]),
    ],
)
def test_what_is_ambiguous_is_refused_with_both_names(
    photos: list[str], names: dict[str, tuple[str, ...]], told: list[str]
) -> None:
    with pytest.raises(InputError) as refused:
        matched(photos, **names)
    assert all(name in str(refused.value) for name in ["photos: ", *told])


def test_a_pick_names_a_camera_of_a_rig_by_its_tail() -> None:
    assert rows_of_photo(RIG, "cam1/000000") == [1]
    assert rows_of_photo(RIG, "/p/cam1/000003.png") == [7]
    assert rows_of_photo(RIG, "000000") == [0, 1]
    assert rows_of_photo(RIG, "000009") == []
    assert rows_of_photo(("a.jpg", "b/a.jpg"), "a.jpg") == [0]


def test_file_names_alone_are_told_of() -> None:
    """But for those that hold the scene's name, or lie in a folder that tells it."""
    names = {"monday": ("DJI_0001.JPG", "monday_2.jpg", "cam0/3.jpg", "4.jpg")}
    photos = ["/p/DJI_0001.JPG", "/p/monday_2.jpg", "/p/cam0/3.jpg"]
    found = match_photos(photos, names, dict.fromkeys(photos, ""))
    assert found.by_file_name == ("/p/DJI_0001.JPG",)
    assert match_photos(["/monday/4.jpg"], names, {"/monday/4.jpg": ""}).by_file_name == ()


# --- in a map ---------------------------------------------------------------------------------------------------------


def photo(
    path: Path, place: np.ndarray | None, sigma_m: float = 0.03, reference: bytes = b"\2", taken: str = ""
) -> None:
    """A small picture taken at longitude, latitude and height, by default above the ellipsoid."""
    path.parent.mkdir(parents=True, exist_ok=True)
    picture = Image.new("RGB", (16, 12))
    exif = picture.getexif()
    if place is not None:
        gps = exif.get_ifd(0x8825)
        for letter, value, tag in (("N", place[1], 1), ("E", place[0], 3)):
            minutes = value % 1 * 60
            gps[tag], gps[tag + 1] = letter, (float(int(value)), float(int(minutes)), round(minutes % 1 * 60, 6))
        gps[5], gps[6], gps[31] = reference, round(float(place[2]), 3), sigma_m
    if taken:
        exif.get_ifd(0x8769)[0x9003] = taken
    picture.save(path, exif=exif)


def flights(path: Path, site: Site, names: list[tuple[str, ...]], scenes: list[str]) -> Map:
    """A solved map of a site whose cameras have other names."""
    m = gsmap.map.create(path)
    for k, (scene, cameras, own) in enumerate(zip(scenes, site.cameras, names, strict=False)):
        named = Cameras(cameras.T_frame_camera, cameras.intrinsics_px, cameras.sizes_px, own)
        base = ground(0.5)
        m.store.scenes.add(replace(base, sh=base.sh + np.float32(1e-3 * k)), named, name=scene)
    for edge in site.edges if len(scenes) > 1 else ():
        a, b = (scenes[site.names.index(end)] for end in (edge.target, edge.source))
        m.add_edge(f"{a}:{b}", edge.S_target_source, np.diag(edge.information) ** -0.5)
    m.optimize()
    return m


def places(site: Site, k: int) -> np.ndarray:
    """(8, 3) longitude, latitude and height of a capture's cameras."""
    return from_frame(site.frame, site.truth[k].apply(site.cameras[k].centers), "EPSG:4979")


@pytest.fixture(scope="module")
def site() -> Site:
    return surveyed_site(0, SiteParams(rows=1, columns=2, spacing_m=80.0, num_control=2, num_check=0))


@pytest.mark.parametrize("names", [DRONE, RIG], ids=["drone", "rig"])
def test_photos_of_flights_numbered_alike_go_to_their_own_cameras(
    site: Site, tmp_path: Path, names: tuple[str, ...]
) -> None:
    for k in range(2):
        for name, place in zip(names, places(site, k), strict=True):
            photo(tmp_path / "photos" / f"flight{k}" / name, place)
    with flights(tmp_path / "m.gsmap", site, [names, names], ["flight0", "flight1"]) as m:
        report = m.georeference(Request(exif=tmp_path / "photos"))
        fixes = m.store.world.survey().fixes
        ids = {scene.id: scene.name for scene in m.scenes()}
        assert len(fixes) == 16
        for fix in fixes:
            k = int(ids[fix.scene][-1])
            assert np.abs(fix.position - places(site, k)[names.index(fix.name)]).max() < 1e-3
        (tie,) = report.components
        assert (tie.problem, tie.num_outliers) == ("", 0)
        assert tie.rms_m < 0.1
        assert not any("file name alone" in note for note in report.notes)


def test_a_flight_that_is_not_in_the_map_does_not_tie_it_elsewhere(site: Site, tmp_path: Path) -> None:
    """80 m further on, under the same names; also where the flight's own photos have no position."""
    for k, folder in enumerate(["flight0", "stranger"]):
        for name, place in zip(DRONE, places(site, k), strict=True):
            photo(tmp_path / "both" / folder / name, place)
            photo(tmp_path / "bare" / folder / name, None if k == 0 else place)
            photo(tmp_path / "unclear" / f"card{k}" / name, place)
    with flights(tmp_path / "m.gsmap", site, [DRONE], ["flight0"]) as m:
        with raises(
            InputError, code="photo_ambiguous", match=r"card0/DJI_0001\.JPG and .*card1/DJI_0001\.JPG may both be"
        ):
            m.georeference(Request(exif=tmp_path / "unclear"))
        with raises(NotFoundError, code="photos_not_matched"):
            m.georeference(Request(exif=tmp_path / "bare"))
        assert not m.store.world.survey()
        report = m.georeference(Request(exif=tmp_path / "both"))
        assert any("8 photos" in note and "stranger" in note for note in report.notes)
        assert report.components[0].problem == ""
        (row,) = m.pose_rows("EPSG:4979")
        want = from_frame(site.frame, site.truth[0].translation[None], "EPSG:4979")[0]
        assert np.abs((row.world - want) * [7e4, 1.1e5, 1]).max() < 0.1
        with raises(
            InputError,
            code="photo_ambiguous",
            match=r"DJI_\d+\.JPG has the file name of camera DJI_\d+\.JPG, .* [789]\d(\.\d)? m away",
        ):
            m.georeference(Request(exif=tmp_path / "unclear" / "card1"))
        # Alone, nothing tells them from the flight's own photos: that is said.
        told = m.georeference(Request(exif=tmp_path / "unclear" / "card0")).notes
        assert any("flight0 by file name alone" in note for note in told)


def test_photos_of_another_day_are_refused_where_only_file_names_tell(site: Site, tmp_path: Path) -> None:
    for name, place in zip(DRONE, places(site, 1), strict=True):
        photo(tmp_path / "card" / name, place, taken="2026:05:31 14:00:00")
        photo(tmp_path / "flight0" / name, place, taken="2026:05:31 14:00:00")
    with flights(tmp_path / "m.gsmap", site, [DRONE], ["flight0"]) as m:
        m.edit("flight0", captured_at="2026-06-02T20:00:00Z")
        with raises(
            InputError,
            code="photo_ambiguous",
            match=r"DJI_0001\.JPG .* of flight0 and was taken 2 days from it, as were all 8",
        ):
            m.georeference(Request(exif=tmp_path / "card"))
        assert not m.store.world.survey()
        # Of a capture that began on their day, or in a folder of its name, they are its photos.
        m.georeference(Request(exif=tmp_path / "flight0"))
        m.edit("flight0", captured_at="2026-06-01T20:00:00Z")
        m.georeference(Request(exif=tmp_path / "card"))


def test_photos_of_a_list_are_told_apart_too(site: Site, tmp_path: Path) -> None:
    lines = [
        gcp_list.GcpLine(0, line.name, line.position, line.pixel, f"{scene}/{DRONE[int(line.image[-5])]}")
        for line, scene in ((line, line.image.split("_")[0].replace("site-00", "flight")) for line in site.gcp_lines())
    ]
    with flights(tmp_path / "m.gsmap", site, [DRONE, DRONE], ["flight0", "flight1"]) as m:
        gcp_list.write(tmp_path / "bare.txt", site.frame.crs, [replace(one, image=one.image[8:]) for one in lines])
        with raises(
            InputError, code="photo_ambiguous", match=r"line 2: DJI_\d+\.JPG may be the camera flight0/DJI_\d+\.JPG or "
        ):
            m.georeference(Request(gcp=tmp_path / "bare.txt"))
        twice = [lines[0], replace(lines[0], image=lines[0].image.replace(".JPG", ""))]
        gcp_list.write(tmp_path / "twice.txt", site.frame.crs, twice)
        with raises(InputError, code="duplicate", match="line 3: point .*line 2"):
            m.georeference(Request(gcp=tmp_path / "twice.txt"))
        gcp_list.write(tmp_path / "g.txt", site.frame.crs, lines)
        m.georeference(Request(gcp=tmp_path / "g.txt"))
        ids = {scene.name: scene.id for scene in m.scenes()}
        seen = {(one.point, ids_name, one.image) for one in m.store.world.survey().images for ids_name in [one.scene]}
        assert seen == {(one.name, ids[one.image.split("/")[0]], one.image.split("/")[1]) for one in lines}


def test_a_place_without_a_name_is_one_point_in_every_list(site: Site, tmp_path: Path) -> None:
    """Written with four digits and then with seven, of which three are zeros."""
    with made_map(tmp_path / "m.gsmap", site) as m:
        for digits in (4, 7):
            rows = [
                " ".join([*(f"{round(v, 4):.{digits}f}" for v in (*one.position, *one.pixel)), one.image])
                for one in site.gcp_lines()
            ]
            (tmp_path / "g.txt").write_text("\n".join(["EPSG:25832", *rows]))
            m.georeference(Request(gcp=tmp_path / "g.txt"))
            survey = m.store.world.survey()
            assert len(survey.points) == len(site.marks)
            assert len(survey.images) == len(rows)


# --- observations without a solution ----------------------------------------------------------------------------------


@pytest.mark.parametrize("error", [np.linalg.LinAlgError("no convergence"), RuntimeError("Factor is exactly singular")])
def test_observations_that_have_no_solution_are_refused_and_the_map_stays_usable(
    site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    for k, folder in enumerate(["flight0", "flight1"]):
        for name, place in zip(DRONE, places(site, k), strict=True):
            photo(tmp_path / "photos" / folder / name, place)

    def fails(*_: object, **__: object) -> None:
        raise error

    with flights(tmp_path / "m.gsmap", site, [DRONE, DRONE], ["flight0", "flight1"]) as m:
        before = {row.scene: row.S_map_scene.matrix() for row in m.pose_rows()}
        revision = m.store.revisions.newest_number()
        with monkeypatch.context() as patched:
            patched.setattr(System, "factor", fails)
            with raises(InputError, code="unsolvable_observations"):
                m.georeference(Request(exif=tmp_path / "photos"))
        assert not m.store.world.survey()
        assert m.store.revisions.newest_number() == revision
        assert not m.georeference().stale
        # What was solved is kept as it was solved, once.
        (tie,) = m.georeference(Request(exif=tmp_path / "photos")).components
        assert tie.problem == ""
        assert m.store.revisions.newest_number() == revision + 1
        m.georeference(Request(exif=tmp_path / "photos"))
        assert m.store.revisions.newest_number() == revision + 1
        # A map that has observations which cannot be solved any more has the poses of its edges, and says so.
        with monkeypatch.context() as patched:
            patched.setattr(System, "factor", fails)
            m.optimize()
            (tie,) = m.georeference().components
            assert "no solution" in tie.problem
            m.georeference(remove=[])
        assert all(np.abs(row.S_map_scene.matrix() - before[row.scene]).max() < 1e-6 for row in m.pose_rows())
