"""A map tied to the world, through every verb that carries it."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import gsmap
from gsmap.errors import ConfigError, InputError, NotFoundError
from gsmap.map.localization.photo_poses import PhotoPose
from gsmap.map.world.georeference import Request
from gsmap.types.world import PositionFix
from gsmap_synthetic.surveyed import Site, SiteParams, surveyed_site

sys.path.insert(0, str(Path(__file__).parents[1] / "world"))
from made_sites import made_map, write_gcps
from raising import raises

SITE = SiteParams(rows=3, columns=3, num_check=2, survey_m=0.005)


@pytest.fixture(scope="module")
def site() -> Site:
    return surveyed_site(1, SITE)


@pytest.fixture(scope="module")
def tied(site: Site, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map that is tied; copy or branch it before it is changed."""
    folder = tmp_path_factory.mktemp("world")
    with made_map(folder / "site.gsmap", site) as m:
        report = m.georeference(Request(gcp=write_gcps(folder / "gcp_list.txt", site), check=site.checks()))
        assert report.components[0].problem == ""
        assert not report.stale
    return folder / "site.gsmap"


def world_of(path: Path) -> dict[str, np.ndarray]:
    with gsmap.map.open(path) as m:
        return {row.scene_name: row.world for row in m.pose_rows() if row.world is not None}


def test_world_coordinates_are_right_and_last(tied: Path, site: Site, tmp_path: Path) -> None:
    """Eight digits before the point, to a centimetre by the survey and to a thousandth through store and export."""
    from gsmap.geodesy.frame import from_frame

    found = world_of(tied)
    truth = dict(zip(site.names, from_frame(site.frame, np.array([S.translation for S in site.truth])), strict=True))
    off = np.array([found[name] - truth[name] for name in site.names])
    assert np.sqrt((off**2).sum(1).mean()) < 0.02
    with gsmap.map.open(tied) as m:
        m.write_poses(tmp_path / "poses.json", "json")
        rows = json.loads((tmp_path / "poses.json").read_text())["poses"]
        here = m.pose_rows("EPSG:4326")
    assert max(np.abs(np.array(row["world"]) - found[row["scene_name"]]).max() for row in rows) < 1e-9
    back = np.array([row.world for row in here])
    from gsmap.geodesy.frame import to_frame

    again = from_frame(site.frame, to_frame(site.frame, back, "EPSG:4326"))
    assert np.abs(again - np.array([found[row.scene_name] for row in here])).max() < 1e-3


def test_the_metre_is_the_survey_s(tied: Path) -> None:
    with gsmap.map.open(tied) as m:
        (metre,) = m.metres().values()
        assert metre.known_by == "surveyed"
        assert metre.metres_per_unit == pytest.approx(0.5, rel=1e-3)


def test_a_surveyed_map_is_reported(tied: Path, tmp_path: Path) -> None:
    with gsmap.map.open(tied) as m:
        m.report(tmp_path / "report.html", pictures=False)
    assert "surveyed" in (tmp_path / "report.html").read_text()


def test_measuring(tied: Path, site: Site) -> None:
    from gsmap.geodesy.frame import from_frame

    true = float(np.linalg.norm(site.truth[0].translation - site.truth[8].translation))
    with gsmap.map.open(tied) as m:
        found = m.measure("site-000:0,0,0", "site-008:0,0,0")
        assert found.known_by == "world"
        assert abs(found.distance_m - true) < 4 * found.sigma_m
        assert 1e-4 < found.sigma_m < 0.02
        # A pixel shows the ground: opposite cameras see one point.
        a, b = "site-000:site-000_0.jpg@700,600", "site-000:site-000_0@700.5,600"
        near = m.measure(a, b)
        assert near.distance_m < 0.01
        pixel = m.measure("site-000:site-000_0.jpg@800,600", "site-000:site-000_4.jpg@800,600")
        assert pixel.distance_m < 0.005
        world = m.measure("site-000:0,0,0", f"world:{','.join(map(repr, found.a.world.tolist()))}")
        assert world.distance_m < 1e-6
        # Of a point that was told exactly, only the other end's error is left: that of where its scene lies.
        lone = m.measure("site-008:0,0,0", f"world:{','.join(map(repr, found.a.world.tolist()))}")
        assert lone.distance_m == pytest.approx(found.distance_m, abs=1e-6)
        assert 1e-4 < lone.sigma_m < 0.05
        assert lone.sigma_m <= 1.01 * np.linalg.norm(lone.a.sigma_m)
        assert lone.b.sigma_m.tolist() == [0, 0, 0]
        truth = from_frame(site.frame, site.truth[8].translation[None])[0]
        assert np.linalg.norm(found.b.world - truth) < 3 * np.linalg.norm(found.b.sigma_m)
        assert (found.b.sigma_m < 0.05).all()
        in_map = m.measure("site-008:0,0,0", ",".join(map(repr, found.a.map.tolist())))
        assert 1e-4 < in_map.sigma_m < 0.05
        for text in ("nonsense", "a:1,2"):
            with raises(ConfigError, code="invalid_point", match=text):
                m.measure(text, "0,0,0")
        for text in ("nobody:1,2,3", "site-000:none.jpg@1,2"):
            with pytest.raises(NotFoundError):
                m.measure(text, "0,0,0")
        with raises(InputError, code="pixel_outside"):
            m.measure("site-000:site-000_0.jpg@5000,2", "0,0,0")


def test_a_rough_scale_bar_does_not_outweigh_a_length_that_was_specified(site: Site, tmp_path: Path) -> None:
    with made_map(tmp_path / "site.gsmap", site) as m:
        m.edit("site-000", metres_per_unit=1.0)
        bar = ("site-000:0,0,0", "site-000:1,0,0", 1.3)
        m.georeference(Request(bars=[bar], bar_sigma_m=0.2))
        assert m.metres()[0].known_by == "told"
        found = m.measure("site-000:0,0,0", "site-000:2,0,0")
        assert (found.distance_m, found.known_by) == (pytest.approx(2.0, rel=0.01), "told")


def test_points_that_coincide_are_no_better_known_than_their_scenes(tied: Path, site: Site) -> None:
    """The origin of a scene, picked in a neighbour, too: the distance is 0, and its error that of the two poses."""
    with gsmap.map.open(tied) as m:
        poses = m.poses()
        S = poses["site-008"].S_map_scene.inverse() @ poses["site-000"].S_map_scene
        same = m.measure("site-000:0,0,0", "site-008:" + ",".join(map(repr, S.translation.tolist())))
        far = m.measure("site-000:0,0,0", "site-008:0,0,0")
        world = m.measure("site-000:0,0,0", f"world:{','.join(map(repr, same.a.world.tolist()))}")
    assert max(same.distance_m, world.distance_m) < 1e-6
    assert same.sigma_m > 0.3 * far.sigma_m
    assert np.max(same.a.sigma_m) <= world.sigma_m <= np.linalg.norm(same.a.sigma_m)


def test_one_tag_is_a_text_and_a_scene_is_in_its_map(site: Site, tmp_path: Path) -> None:
    with made_map(tmp_path / "site.gsmap", site) as m:
        assert m.edit("site-000", tags="hall").tags == ("hall",)
        assert m.edit("site-000", untag="hall").tags == ()
        assert all(scene in m for scene in m)
        removed = m["site-001"]
        m.remove("site-001")
        assert removed not in m
        assert m.thin(keep_days=np.int64(3650), dry_run=True, now="2026-01-01").scenes == ()


def test_a_bar_is_measured_again_where_scenes_were_renamed(site: Site, tmp_path: Path) -> None:
    with made_map(tmp_path / "site.gsmap", site) as m:
        m.georeference(Request(bars=[("site-000:0,0,0", "site-001:0,0,0", 10.0)]))
        m.edit("site-001", name="yard")
        m.georeference(Request(bars=[("site-000:0,0,0", "yard:0,0,0", 11.0)]))
        assert [bar.length_m for bar in m.store.world.survey().bars] == [11.0]
        m.edit("site-002", name="site-001")  # the bar of another pair of scenes, in the words of the first
        m.georeference(Request(bars=[("site-000:0,0,0", "site-001:0,0,0", 12.0)]))
        assert sorted(bar.length_m for bar in m.store.world.survey().bars) == [11.0, 12.0]


def test_observations_live_through_branch_backup_clone_and_merge(tied: Path, site: Site, tmp_path: Path) -> None:
    before = world_of(tied)
    with gsmap.map.open(tied) as m:
        m.branch("other")
        m.backup(tmp_path / "saved")
        m.clone(tmp_path / "clone.gsmap")
    gsmap.map.restore(tmp_path / "saved", tmp_path / "back.gsmap")
    with gsmap.map.create(tmp_path / "merged.gsmap") as m:
        m.merge(tied)
    for path in (f"{tied}@other", tmp_path / "back.gsmap", tmp_path / "clone.gsmap", tmp_path / "merged.gsmap"):
        with gsmap.map.open(path) as m:
            assert len(m.store.world.survey().points) == len(site.marks), path
            assert m.check().ok, path
            m.optimize()
        after = world_of(Path(path))
        assert max(np.abs(after[name] - before[name]).max() for name in site.names) < 1e-3, path
    with gsmap.map.open(tmp_path / "merged.gsmap") as m:
        assert m.merge(tied).num_observations == 0, "again it adds nothing"


def test_a_part_takes_what_was_seen_in_it(tied: Path, site: Site, tmp_path: Path) -> None:
    chosen = [mark.scene for mark in site.marks if mark.name in ("G0", "G1", "G2")]
    with gsmap.map.open(tied) as m:
        m.split(tmp_path / "part.gsmap", scenes=chosen)
    with gsmap.map.open(tmp_path / "part.gsmap") as m:
        names = {point.name for point in m.store.world.survey().points}
        assert {"G0", "G1", "G2"} <= names
        shown = {mark.name for mark in site.marks if mark.scene in chosen}
        assert names == shown
        assert m.store.revisions.world()[0].S_world_map is not None


def test_a_purged_scene_takes_its_photos_with_it(tied: Path, site: Site, tmp_path: Path) -> None:
    gone = next(mark.scene for mark in site.marks if mark.name == "G0")
    with gsmap.map.open(tied) as m:
        scene = m.store.scenes.get(gone).id
        m.clone(tmp_path / "c.gsmap")
    with gsmap.map.open(tmp_path / "c.gsmap") as m:
        m.remove(gone)
        m.purge(scene)
        assert all(image.scene != scene for image in m.store.world.survey().images)
        assert scene not in json.dumps([row.to_json() for row in m.georeference().components])


def test_taking_back(tied: Path, tmp_path: Path) -> None:
    with gsmap.map.open(tied) as m:
        m.clone(tmp_path / "c.gsmap")
    with gsmap.map.open(tmp_path / "c.gsmap") as m:
        report = m.georeference(remove=["G0"])
        assert "G0" not in {row.name for row in report.components[0].residuals}
        with raises(NotFoundError, code="observation_not_found"):
            m.georeference(remove=["G0"])
        report = m.georeference(remove=[])
        assert report.crs is None
        assert report.components == ()
        assert all(row.world is None for row in m.pose_rows())


def test_bad_input_changes_nothing(site: Site, tmp_path: Path) -> None:
    lines = write_gcps(tmp_path / "g.txt", site).read_text().splitlines()

    def file(*rows: str) -> Request:
        path = tmp_path / f"{abs(hash(rows))}.txt"
        path.write_text("\n".join(rows))
        return Request(gcp=path)

    first = lines[1].split("\t")
    swapped = "\t".join([first[1], first[0], *first[2:]])
    outside = "\t".join([*first[:3], "4000", "20", *first[5:]])
    unknown = "\t".join([*first[:5], "nobody.jpg", first[6]])
    with made_map(tmp_path / "m.gsmap", replace(site)) as m:
        for request, error, code, match in (
            (file("EPSG:25832", swapped), InputError, "outside_crs", "control point G0 .* axes swapped"),
            (file("EPSG:25832", outside), InputError, "pixel_outside", "line 2: .*4000 20"),
            (file("EPSG:25832", unknown), NotFoundError, "photos_not_matched", "1 photo"),
            (file("EPSG:999999", lines[1]), ConfigError, "invalid_crs", "EPSG:999999"),
            (file("EPSG:25832+7837", lines[1]), ConfigError, "grid_missing", "needs the grid"),
            (Request(crs="EPSG:25832"), InputError, "not_georeferenced", "EPSG:25832"),
            (Request(), ConfigError, "nothing_requested", "gcp="),
            (Request(check=["P9"]), NotFoundError, "observation_not_found", "'P9'"),
            (Request(bars=[("0,0,0", "site-000:0,0,0", 2.0)]), ConfigError, "moving_frame", "'0,0,0'"),
            (Request(bars=[("site-000:0,0,0", "site-000:1,0,0", -2.0)]), ConfigError, "invalid_observation", "-2"),
        ):
            with raises(error, code=code, match=match):
                m.georeference(request)
            assert not m.store.world.survey()
            assert m.store.world.survey().frame is None


def test_a_photo_that_was_localised_counts_with_its_covariance(site: Site, tmp_path: Path) -> None:
    """Marks of one scene's photos under other names, as a localiser places them."""
    lines, photos = site.gcp_lines(), {}
    for k, name in enumerate(site.names):
        for j, photo in enumerate(site.cameras[k].names):
            photos[f"walk_{photo}"] = (name, site.cameras[k][[j]])
    lines = [replace(line, image=f"walk_{line.image}") for line in lines]
    from gsmap.formats import gcp_list

    gcp_list.write(tmp_path / "g.txt", site.frame.crs, lines)
    with made_map(tmp_path / "m.gsmap", site) as m:
        ids = {scene.name: scene.id for scene in m.scenes()}

        def localise(names: list[str]) -> dict[str, PhotoPose]:
            sigma = np.diag([1e-3**2] * 3 + [0.02**2] * 3)
            return {
                name: PhotoPose(
                    ids[photos[name][0]],
                    photos[name][1].T_frame_camera[0],
                    photos[name][1].intrinsics_px[0],
                    tuple(photos[name][1].sizes_px[0].tolist()),
                    sigma,
                )
                for name in names
            }

        report = m.georeference(Request(gcp=tmp_path / "g.txt", check=site.checks()), localise=localise)
        (tie,) = report.components
        assert tie.problem == ""
        assert tie.rms_check_m is not None
        assert tie.rms_check_m < 0.03
        exact = m.georeference(Request(gcp=write_gcps(tmp_path / "e.txt", site), check=site.checks()))
        assert exact.components[0].scale_sigma < tie.scale_sigma


def test_a_point_in_one_photo_lies_on_the_surface(tmp_path: Path) -> None:
    one = surveyed_site(2, replace(SITE, num_views=1))
    with made_map(tmp_path / "m.gsmap", one) as m:
        report = m.georeference(Request(gcp=write_gcps(tmp_path / "g.txt", one), check=one.checks()))
        images = m.store.world.survey().images
    assert all(image.depth is not None for image in images)
    (tie,) = report.components
    assert tie.problem == ""
    assert tie.rms_check_m is not None
    assert tie.rms_check_m < 0.06
    kinds = {row.kind: row for row in tie.by_kind}
    assert list(kinds) == ["point", "check"]
    errors = np.array([row.error_m for row in tie.residuals if (row.kind, row.use) == ("point", "used")])
    assert (kinds["point"].count, kinds["point"].num_outliers) == (len(errors), tie.num_outliers)
    np.testing.assert_allclose(kinds["point"].rms_m, np.sqrt(np.mean(errors**2, axis=0)), rtol=1e-12)
    assert kinds["point"].max_m == tuple(np.abs(errors).max(0))
    assert np.linalg.norm(kinds["check"].rms_m) == pytest.approx(tie.rms_check_m)
    sigmas = [row.sigma_m for row in tie.residuals if row.kind == "point"]
    assert min(min(sigma) for sigma in sigmas) > 0.003


def test_heights_of_a_state_plane_are_in_feet(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A list in US survey feet, its heights divided by hand; they come out in feet, and the output names the unit."""
    from pyproj import Transformer

    from gsmap.cli import app
    from gsmap.formats import gcp_list
    from gsmap.geodesy.frame import from_frame
    from gsmap.types.world import WorldFrame

    foot = 1200 / 3937
    boston = surveyed_site(3, replace(SITE, rows=2, num_control=4), WorldFrame("EPSG:6319", 42.36, -71.06, 30.0))
    plan = Transformer.from_crs("EPSG:6318", "EPSG:6492", always_xy=True)

    def in_feet(geodetic: np.ndarray) -> tuple[float, float, float]:
        return (*plan.transform(*geodetic[:2]), geodetic[2] / foot)

    lines = [replace(line, position=in_feet(np.array(line.position))) for line in boston.gcp_lines()]
    gcp_list.write(tmp_path / "g.txt", "EPSG:6492", lines)
    with made_map(tmp_path / "m.gsmap", boston) as m:
        report = m.georeference(Request(gcp=tmp_path / "g.txt", check=boston.checks()))
        (tie,) = report.components
        assert (tie.problem, tie.num_outliers) == ("", 0)
        assert report.height_unit_m == pytest.approx(foot)
        rows = {row.scene_name: row for row in m.pose_rows()}
    for name, S in zip(boston.names, boston.truth, strict=True):
        want = in_feet(from_frame(boston.frame, S.translation[None])[0])
        assert np.abs(rows[name].world - want).max() * foot < 0.05
        assert "US survey feet" in rows[name].heights
    for verb in (["georeference"], ["list"], ["poses"], ["measure"]):
        rest = {"list": ["scenes"], "measure": ["site-000:0,0,0", "site-001:0,0,0"]}.get(verb[0], [])
        with pytest.raises(SystemExit) as ended:
            app.run([*verb, str(tmp_path / "m.gsmap"), *rest])
        assert not ended.value.code
        told = capsys.readouterr()
        assert "US survey feet (0.3048006 m) above the ellipsoid (GRS 1980)" in " ".join((told.out + told.err).split())


def test_surveyed_positions_of_scenes(site: Site, tmp_path: Path) -> None:
    from gsmap.geodesy.frame import from_frame

    with made_map(tmp_path / "m.gsmap", site) as m:
        for k in (0, 2, 6, 8):
            at = from_frame(site.frame, site.truth[k].translation[None], "EPSG:4326")[0]
            m.set_world_position(site.names[k], at, (0.01, 0.01))
        assert m.georeference().stale
        m.optimize()
        (tie,) = m.georeference().components
        assert tie.problem == ""
        assert [row.kind for row in tie.residuals] == ["fix"] * 4
        m.remove_prior(site.names[0])
        assert len(m.store.world.survey().fixes) == 3


def test_what_is_exported_says_where_it_lies(tied: Path, site: Site, tmp_path: Path) -> None:
    """3D Tiles lie on the globe; other formats, whose numbers are too short for it, have it beside them."""
    from gsmap.formats import tiles3d
    from gsmap.geodesy.crs import ECEF
    from gsmap.geodesy.frame import from_frame

    with gsmap.map.open(tied) as m:
        m.export(tmp_path / "globe", tile_size_m=20, format="3dtiles", merge="union")
        report = m.export(tmp_path / "plain", tile_size_m=0, format="ply", merge="union")
        tie = m.store.revisions.world()[0]
    assert any("tiles.json has S_world_map" in note for note in report.notes)
    (tileset,) = (tmp_path / "globe").glob("component_0/tileset.json")
    root = json.loads(tileset.read_text())["root"]
    transform = np.reshape(root["transform"], (4, 4)).T
    points = tiles3d.read(tileset).means[::97].astype(np.float64)
    there = points @ transform[:3, :3].T + transform[:3, 3]
    want = from_frame(tie.frame, tie.S_world_map.apply(points), ECEF)
    assert np.abs(there - want).max() < 1e-3
    sidecar = json.loads((tmp_path / "plain" / "tiles.json").read_text())["components"][0]["world"]
    assert sidecar["crs"] == "EPSG:25832"
    assert np.abs(np.array(sidecar["S_world_map"]) - tie.S_world_map.matrix()).max() == 0
    assert np.abs(np.array(sidecar["S_ecef_map"]) - transform).max() == 0


def test_a_map_in_a_system_without_a_way_to_the_globe_is_exported(tied: Path, tmp_path: Path, monkeypatch) -> None:
    """CGCS2000 has no transformation to WGS 84 in PROJ: only 3D Tiles need one."""
    import gsmap.geodesy.frame

    def nowhere(frame: object) -> None:
        raise ConfigError("PROJ knows no exact transformation", code="no_exact_transform")

    monkeypatch.setattr(gsmap.geodesy.frame, "T_ecef_frame", nowhere)
    with gsmap.map.open(tied) as m:
        m.export(tmp_path / "plain", tile_size_m=0, format="ply", merge="union")
        m.export(tmp_path / "stream", tile_size_m=20, format="streamed-sog", merge="union")
        with raises(ConfigError, code="no_exact_transform"):
            m.export(tmp_path / "globe", tile_size_m=20, format="3dtiles", merge="union")
    world = json.loads((tmp_path / "plain" / "tiles.json").read_text())["components"][0]["world"]
    assert "S_world_map" in world
    assert "S_ecef_map" not in world
    assert not (tmp_path / "globe").exists()


def test_tiles_move_on_the_globe_when_the_tie_does(tied: Path, tmp_path: Path) -> None:
    with gsmap.map.open(tied) as m:
        m.clone(tmp_path / "c.gsmap")
    with gsmap.map.open(tmp_path / "c.gsmap") as m:

        def root() -> list[float]:
            m.export(tmp_path / "globe", tile_size_m=20, format="3dtiles", merge="union")
            found: list[float] = json.loads((tmp_path / "globe/component_0/tileset.json").read_text())["root"][
                "transform"
            ]
            return found

        before = root()
        m.georeference(Request(check=["G3"]))
        assert root() != before
        with raises(InputError, code="outside_crs", match="the map lies at 48"):
            m.georeference(Request(crs="EPSG:2583"))  # a digit short of EPSG:25832
        m.georeference(Request(crs="EPSG:4326"))
        root()  # no tile changes, and what is said of them does
        told = json.loads((tmp_path / "globe" / "tiles.json").read_text())["components"][0]["world"]
        assert told["crs"] == "EPSG:4326"
        m.georeference(remove=[])
        assert abs(root()[12]) < 100, "in the map's own frame again"


def test_a_localised_photo_is_put_into_its_scene_s_frame(site: Site, tied: Path, tmp_path: Path) -> None:
    """By rows as ``gsmap localize`` gives them: map frame and unit in, scene frame and unit out."""
    from types import SimpleNamespace

    from PIL import Image

    from gsmap.geometry.rotations import exp_so3
    from gsmap.map.localization.photo_poses import photo_localizer, photo_pose_of
    from gsmap.types import ScenePose, Sim3

    S = Sim3(exp_so3(np.array([0.1, 0.2, 0.3])), np.array([1.0, 2, 3]), 4.0)
    T = np.eye(4)
    T[:3, 3] = S.apply(np.array([0.5, 0.6, 0.7]))
    sigma = np.diag([1.0] * 3 + [16.0] * 3)
    row = SimpleNamespace(
        file="a.jpg", T_map_camera=T, covariance=sigma, component=1, scenes=("gone", "far", "near"),
        intrinsics_px=np.array([100.0, 100, 32, 24]),
    )  # fmt: skip
    poses = {"1": ScenePose("1", S, 0, "placed"), "2": ScenePose("2", S, 1, "placed")}
    found = photo_pose_of(row, (64, 48), poses, {"far": "1", "near": "2"})
    assert found is not None
    assert found.scene == "2", "of its own component"
    assert found.T_scene_camera[:3, 3] == pytest.approx([0.5, 0.6, 0.7])
    assert np.diag(found.covariance) == pytest.approx([1.0] * 6)
    row.T_map_camera = None
    assert photo_pose_of(row, (64, 48), poses, {"near": "2"}) is None

    Image.new("RGB", (64, 48)).save(tmp_path / "in.jpg")
    (tmp_path / "below").mkdir()
    asked = []

    def localize(*files: Path) -> SimpleNamespace:
        asked.extend(files)
        return SimpleNamespace(results=[row for _ in files])

    with gsmap.map.open(tied) as m:
        localise = photo_localizer(m.store, localize, tmp_path / "below")
        assert localise(["../in.jpg", "none.jpg"]) == {}, "a list of points leads to no file elsewhere"
        assert photo_localizer(m.store, localize, tmp_path)(["in.jpg"]) == {}
    assert asked == [tmp_path / "in.jpg"]


def test_positions_in_exif_tie_a_map(tmp_path: Path) -> None:
    """A drone's photos: heights above sea level, and what a whole flight is off by, are in the sigma."""
    from PIL import Image

    from gsmap.geodesy.frame import from_frame

    site = surveyed_site(4, replace(SITE, spacing_m=40.0, edge_translation_m=5e-3))
    rng, folder = np.random.default_rng(0), tmp_path / "photos"
    folder.mkdir()
    for S, cameras in zip(site.truth, site.cameras, strict=True):
        flight = rng.normal(size=3) * [2, 2, 4]
        at = S.apply(cameras.centers[::3]) + flight + rng.normal(size=(3, 3)) * 0.5
        for name, (lon, lat, height) in zip(cameras.names[::3], from_frame(site.frame, at, "EPSG:4979"), strict=True):
            picture = Image.new("RGB", (8, 8))
            tags = picture.getexif()
            gps = tags.get_ifd(0x8825)
            for letter, value, tag in (("N", lat, 1), ("E", lon, 3)):
                minutes = (value % 1) * 60
                gps[tag], gps[tag + 1] = letter, (int(value), int(minutes), (minutes % 1) * 60)
            gps[6] = float(height)
            picture.save(folder / name, exif=tags)
    with made_map(tmp_path / "m.gsmap", site) as m:
        report = m.georeference(Request(crs="EPSG:25832", exif=folder))
        (tie,) = report.components
        assert tie.problem == ""
        assert tie.num_outliers == 0
        sigma = np.sqrt(np.diag(tie.covariance))[3:6] * tie.metres_per_unit
        assert sigma.max() > 5, "forty metres of geoid, of which nine flights know no better"
        assert any("above sea level" in note for note in report.notes)
        assert any("above sea level" in note for note in m.georeference().notes), "as long as it is so"
        found = {row.scene_name: row.world for row in m.pose_rows()}
        want = from_frame(site.frame, site.truth[4].translation[None])[0]
        assert np.linalg.norm(found[site.names[4]][:2] - want[:2]) < 4


def test_a_photo_that_cannot_be_placed_is_left_out(tied: Path, site: Site, tmp_path: Path) -> None:
    """Through `Map.localize` itself: noise is refused, and its points with it."""
    from PIL import Image

    from gsmap.map.localization.photo_poses import photo_localizer

    noise = np.random.default_rng(0).integers(0, 255, (120, 160, 3), dtype=np.uint8)
    Image.fromarray(noise).save(tmp_path / "noise.jpg")
    known = site.gcp_lines()[0]
    lines = [known, replace(known, image="noise.jpg", pixel=(10.0, 20.0))]
    from gsmap.formats import gcp_list

    gcp_list.write(tmp_path / "g.txt", site.frame.crs, lines)
    with gsmap.map.open(tied) as m:
        m.clone(tmp_path / "c.gsmap")
    with gsmap.map.open(tmp_path / "c.gsmap") as m:
        localise = photo_localizer(m.store, m.localize, tmp_path)
        report = m.georeference(Request(gcp=tmp_path / "g.txt"), localise=localise)
        assert any("noise.jpg" in note for note in report.notes)
        assert all(image.image != "noise.jpg" for image in m.store.world.survey().images)


def test_photos_above_take_off_are_named_and_tie_nothing_anew(tied: Path, site: Site, tmp_path: Path) -> None:
    """Their heights are 520 m too low, and 72 of them contradict five control points."""
    before = world_of(tied)
    with gsmap.map.open(tied) as m:
        m.clone(tmp_path / "c.gsmap")
    with gsmap.map.open(tmp_path / "c.gsmap") as m:
        ids = {scene.name: scene.id for scene in m.store.scenes.list()}
        from gsmap.geodesy.frame import from_frame

        fixes = []
        for name, S, cameras in zip(site.names, site.truth, site.cameras, strict=True):
            low = from_frame(site.frame, S.apply(cameras.centers) - [0, 0, 520])
            fixes += [
                PositionFix(photo, ids[name], point, site.frame.crs, position, (1.5, 3.0), (3.0, 6.0), 40.0)
                for photo, point, position in zip(cameras.names, cameras.centers, low, strict=True)
            ]
        m.store.world.add(fixes)
        m.optimize()
        (row,) = m.georeference(None).components
    (one,) = row.contradictions
    assert (one.group, one.against, one.cause, one.kept) == ("photos", "points", "above_takeoff", "against")
    assert one.offset_m[2] == pytest.approx(-520, abs=1)
    assert (one.count, set(one.scene_names)) == (len(fixes), set(site.names))
    assert (row.problem, row.problem_code) == ("", "")
    after = world_of(tmp_path / "c.gsmap")
    assert max(np.linalg.norm(after[name] - before[name]) for name in site.names) < 0.01
