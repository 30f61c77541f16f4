"""Points, orthophotos and floor plans of a georeferenced map lie where the survey says."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from pyproj import Transformer

import gsmap
from gsmap.errors import ConfigError, NotFoundError
from gsmap.geodesy.frame import from_frame, to_frame
from gsmap.map.world.georeference import Request
from gsmap.types import Gaussians
from gsmap_synthetic.surveyed import Site, SiteParams, surveyed_site

sys.path.insert(0, str(Path(__file__).parents[1] / "world"))
import made_sites
from made_sites import made_map, write_gcps
from raising import raises

CRS = "EPSG:25832"


@pytest.fixture(scope="module")
def site() -> Site:
    return surveyed_site(1, SiteParams(rows=3, columns=3, num_check=2, survey_m=0.002))


@pytest.fixture(scope="module")
def tied(site: Site, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("survey")
    with made_map(folder / "site.gsmap", site) as m:
        assert m.georeference(Request(gcp=write_gcps(folder / "gcp.txt", site))).components[0].problem == ""
        m.optimize()
    return folder / "site.gsmap"


def ground_points(path: Path, site: Site) -> np.ndarray:
    """Where the Gaussians of the captures truly lie, in the CRS."""
    with gsmap.map.open(path) as m:
        parts = [
            S.apply(m.store.scenes.gaussians(name).means.astype(np.float64))
            for name, S in zip(site.names, site.truth, strict=True)
        ]
    return from_frame(site.frame, np.concatenate(parts), CRS)


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_points_lie_where_they_truly_are(tied: Path, site: Site, tmp_path: Path, suffix: str) -> None:
    laspy = pytest.importorskip("laspy")
    from scipy.spatial import cKDTree

    with gsmap.map.open(tied) as m:
        report = m.export_survey(tmp_path / f"site{suffix}", merge="union")
    assert any(CRS in note and "above the ellipsoid" in note for note in report.notes)
    with laspy.open(tmp_path / f"site{suffix}") as file:
        assert (file.header.version.major, file.header.version.minor) == (1, 4)
        assert file.header.parse_crs().to_epsg() == 25832
        assert file.header.are_points_compressed == (suffix == ".laz")
        points = file.read()
    truth = ground_points(tied, site)
    found = np.stack([points.x, points.y, points.z], axis=1)
    assert len(found) == len(truth)
    off, _ = cKDTree(truth - truth[0]).query(found - truth[0])
    assert np.quantile(off, 0.99) < 0.03
    assert points.red.max() > 255
    assert set(points.return_number) == set(points.number_of_returns) == {1}  # LAS 1.4: numbers of returns begin at 1


def test_points_in_another_crs(tied: Path, site: Site, tmp_path: Path) -> None:
    laspy = pytest.importorskip("laspy")
    with gsmap.map.open(tied) as m:
        for crs, code in (("EPSG:4979", 4979), ("EPSG:2056", 2056)):
            m.export_survey(tmp_path / f"{code}.las", merge="union", crs=crs)
        m.export_survey(tmp_path / "own.las", merge="union")
    own = laspy.read(tmp_path / "own.las")
    for crs in ("EPSG:4979", "EPSG:2056"):
        read = laspy.read(tmp_path / f"{crs[5:]}.las")
        back = to_frame(site.frame, np.stack([read.x, read.y, read.z], axis=1), crs)
        there = to_frame(site.frame, np.stack([own.x, own.y, own.z], axis=1), CRS)
        assert np.abs(back - there).max() < 0.002


def test_an_orthophoto_shows_the_ground_in_its_place(tied: Path, site: Site, tmp_path: Path) -> None:
    with gsmap.map.open(tied) as m:
        m.export_survey(tmp_path / "site.tif", merge="union", pixel_size=0.1)
        with raises(ConfigError, code="unsupported_crs"):
            m.export_survey(tmp_path / "no.tif", merge="union", crs="EPSG:4979")
        with raises(ConfigError, code="picture_too_large"):
            m.export_survey(tmp_path / "no.tif", merge="union", pixel_size=1e-5)
    with Image.open(tmp_path / "site.tif") as picture:
        tags, rgba = picture.tag_v2, np.asarray(picture).astype(float)
    keys = np.reshape(tags[34735], (-1, 4)).tolist()
    assert keys[0] == [1, 1, 1, 4]
    assert [1024, 0, 1, 1] in keys
    assert [3072, 0, 1, 25832] in keys
    pixel, corner = np.array(tags[33550][:2]), np.array(tags[33922][3:5])
    assert pixel.tolist() == [0.1, 0.1]
    truth = ground_points(tied, site)
    with gsmap.map.open(tied) as m:
        sh = np.concatenate([m.store.scenes.gaussians(name).sh[:, 0] for name in site.names])
    colours = np.clip(sh * 0.28209479 + 0.5, 0, 1) * 255
    at = ((truth[:, :2] - corner) * [1, -1] / pixel).astype(int)
    inside = ((at >= 2) & (at < np.array(rgba.shape[1::-1]) - 2)).all(1)
    assert inside.mean() > 0.9
    seen = rgba[at[inside, 1], at[inside, 0]]
    assert (seen[:, 3] > 200).mean() > 0.9
    # Colours agree in place, and no longer a metre away.
    right = np.corrcoef(seen[:, :3].mean(1), colours[inside].mean(1))[0, 1]
    shifted = np.clip(at[inside] + [10, 10], 0, np.array(rgba.shape[1::-1]) - 1)
    wrong = np.corrcoef(rgba[shifted[:, 1], shifted[:, 0], :3].mean(1), colours[inside].mean(1))[0, 1]
    assert right > wrong + 0.2


def test_a_floor_plan_has_footprints_in_longitude_and_latitude(tied: Path, site: Site, tmp_path: Path) -> None:
    with gsmap.map.open(tied) as m:
        m.export_survey(tmp_path / "plan.geojson", merge="union")
        with raises(ConfigError, code="option_not_applicable"):
            m.export_survey(tmp_path / "plan.geojson", crs="EPSG:25832")
        with raises(ConfigError, code="option_not_applicable"):
            m.export_survey(tmp_path / "plan.las", pixel_size=0.1)
    content = json.loads((tmp_path / "plan.geojson").read_text())
    footprints = {f["properties"]["scene"]: f for f in content["features"] if f["properties"]["kind"] == "footprint"}
    assert set(footprints) == set(site.names)
    for name, S in zip(site.names, site.truth, strict=True):
        ring = np.array(footprints[name]["geometry"]["coordinates"][0][0])
        assert ring[0].tolist() == ring[-1].tolist()
        local = to_frame(site.frame, np.c_[ring, np.full(len(ring), site.frame.height_m)], "EPSG:4979")[:, :2]
        area = 0.5 * (local[:-1, 0] * local[1:, 1] - local[1:, 0] * local[:-1, 1]).sum()
        assert area > 1  # anticlockwise
        middle = S.apply(np.zeros((1, 3)))[0, :2]
        assert (local.min(0) < middle + 3).all()
        assert (local.max(0) > middle - 3).all()


def test_a_footprint_holds_sparse_ground_between_dense_posts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """10 m by 10 m of ground with few Gaussians, and posts with many at its corners, as plants have."""
    bare = made_sites.ground

    def with_posts(unit_m: float) -> Gaussians:
        base, rng = bare(unit_m), np.random.default_rng(0)
        corners = np.array([[x, y, 0.5] for x in (-4.7, 4.7) for y in (-4.7, 4.7)])
        points = np.repeat(corners, 5000, axis=0) + rng.uniform(-0.3, 0.3, (20_000, 3))
        rows = np.zeros(len(points), np.int64)
        posts = replace(base[rows], means=(points / unit_m).astype(np.float32))
        return Gaussians.concatenate([base, posts])

    monkeypatch.setattr(made_sites, "ground", with_posts)
    site = surveyed_site(1, SiteParams(rows=2, columns=2, num_check=0, survey_m=0.002))
    with made_map(tmp_path / "site.gsmap", site) as m:
        m.georeference(Request(gcp=write_gcps(tmp_path / "gcp.txt", site)))
        m.export_survey(tmp_path / "plan.geojson", merge="union")
    content = json.loads((tmp_path / "plan.geojson").read_text())
    footprints = [f for f in content["features"] if f["properties"]["kind"] == "footprint"]
    assert len(footprints) == 4
    for one in footprints:
        area = 0.0
        for (ring,) in one["geometry"]["coordinates"]:
            local = to_frame(site.frame, np.c_[ring, np.full(len(ring), site.frame.height_m)], "EPSG:4979")[:, :2]
            area += 0.5 * (local[:-1, 0] * local[1:, 1] - local[1:, 0] * local[:-1, 1]).sum()
        assert area > 85


def test_a_drawing_has_the_floor_plan_in_the_crs(tied: Path, site: Site, tmp_path: Path) -> None:
    import ezdxf

    with gsmap.map.open(tied) as m:
        m.export_survey(tmp_path / "plan.geojson", merge="union")
        m.export_survey(tmp_path / "plan.dxf", merge="union")
        for crs in ("EPSG:4326", "EPSG:4979"):
            with raises(ConfigError, code="unsupported_crs"):
                m.export_survey(tmp_path / "plan.dxf", crs=crs)
    plan = json.loads((tmp_path / "plan.geojson").read_text())
    drawing = ezdxf.readfile(tmp_path / "plan.dxf")
    assert drawing.units == 6
    assert not drawing.audit().errors
    lines = list(drawing.modelspace().query("LWPOLYLINE"))
    assert all(line.closed for line in lines)
    to_utm = Transformer.from_crs("EPSG:4326", "EPSG:25832", always_xy=True)
    for name in site.names:
        (feature,) = (f for f in plan["features"] if f["properties"].get("scene") == name)
        ring = np.array(feature["geometry"]["coordinates"][0][0])[:-1]
        expected = np.stack(to_utm.transform(*ring.T), axis=1)
        drawn = [np.array(line.get_points("xy")) for line in lines if line.dxf.layer == f"footprint {name}"]
        assert min(np.abs(one - expected).max() for one in drawn if one.shape == expected.shape) < 1e-3
    about = [feature["properties"] for feature in plan["features"]]
    named = {" ".join(one[key] for key in ("kind", "scene") if key in one) for one in about}
    assert {line.dxf.layer for line in lines} == named


def test_a_map_without_a_place_is_refused(site: Site, tmp_path: Path) -> None:
    with made_map(tmp_path / "lost.gsmap", site) as m, raises(NotFoundError, code="not_georeferenced"):
        m.export_survey(tmp_path / "site.tif")
    assert not (tmp_path / "site.tif").exists()
