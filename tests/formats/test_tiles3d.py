import json
import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from formats_cases import colours_along, covariances, directions, random_gaussians
from raising import raises
from scipy.spatial import cKDTree

from gsmap import formats
from gsmap.errors import ConfigError, InputError
from gsmap.formats import glb, tiles3d
from gsmap.formats.tiles3d import TileNode

TOOL = Path(__file__).resolve().parents[2] / "tools" / "check" / "validate_3dtiles.sh"


def by_position(g):
    return g[np.lexsort(g.means.T)]


def corners(box):
    """Lowest and highest corner of a boundingVolume.box."""
    box = np.array(box["box"])
    half = np.abs(box[3:].reshape(3, 3)).sum(0)
    return box[:3] - half, box[:3] + half


def tiles_of(tile, above=None):
    yield tile, above
    for child in tile.get("children", []):
        yield from tiles_of(child, tile)


@pytest.mark.parametrize("degree", [0, 3])
def test_the_finest_level_is_the_originals_bit_by_bit(tmp_path, degree):
    g = random_gaussians(3000, degree=degree)
    formats.write(tmp_path / "tileset.json", g, max_per_tile=400, compressed=False)
    back = formats.read(tmp_path / "tileset.json")
    a, b = by_position(g), by_position(back)
    np.testing.assert_array_equal(a.means, b.means)
    np.testing.assert_array_equal(a.sh, b.sh)
    np.testing.assert_allclose(a.log_scales, b.log_scales, atol=2e-6)
    np.testing.assert_allclose(a.opacities, b.opacities, atol=1e-7)


def json_of(glb_file):
    data = glb_file.read_bytes()
    return json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])


def test_content_is_packed_where_viewers_look_for_it(tmp_path):
    """CesiumJS draws splats where the tileset requires both extensions, and takes the SPZ as the node's own numbers."""
    g = random_gaussians(3000, degree=2)
    g.means[:] += [300, 0, -200]
    formats.write(tmp_path / "packed" / "tileset.json", g, max_per_tile=400)
    tileset = json.loads((tmp_path / "packed" / "tileset.json").read_text())
    both = ["KHR_gaussian_splatting", "KHR_gaussian_splatting_compression_spz_2"]
    assert tileset["extensions"]["3DTILES_content_gltf"] == {"extensionsUsed": both, "extensionsRequired": both}
    for tile, _ in tiles_of(tileset["root"]):
        gltf = json_of(tmp_path / "packed" / tile["content"]["uri"])
        assert gltf["extensionsRequired"] == both
        assert all("bufferView" not in accessor for accessor in gltf["accessors"])
    back = formats.read(tmp_path / "packed" / "tileset.json")
    apart, same = cKDTree(back.means).query(g.means)
    assert len(back) == len(g) == len(set(same.tolist()))
    assert apart.max() < 8e-5  # 18 bits from the middle of tiles of 5 m, and float32 of 300 m
    np.testing.assert_allclose(back.log_scales[same], g.log_scales, atol=1 / 32 + 1e-5)
    np.testing.assert_allclose(back.opacities[same], g.opacities, atol=1 / 255)
    np.testing.assert_allclose(colours_along(back[same], directions()), colours_along(g, directions()), atol=0.3)
    formats.write(tmp_path / "plain" / "tileset.json", g, max_per_tile=400, compressed=False)
    packed, plain = (sum(f.stat().st_size for f in (tmp_path / n / "tiles").iterdir()) for n in ("packed", "plain"))
    assert packed < plain / 3


def test_packed_numbers_are_those_of_the_node(tmp_path):
    """As an independent reader of SPZ finds them, without turning axes: what CesiumJS and cesium-native do."""
    gsply = pytest.importorskip("gsply")
    g = random_gaussians(200, degree=1)
    tiles3d.write_content(tmp_path / "a.glb", g)
    data = (tmp_path / "a.glb").read_bytes()
    gltf = json_of(tmp_path / "a.glb")
    (tmp_path / "a.spz").write_bytes(data[-gltf["buffers"][0]["byteLength"] :].rstrip(b"\0") + b"\0" * 4)
    theirs = gsply.read_spz(str(tmp_path / "a.spz"))
    node = np.array(gltf["nodes"][0]["matrix"]).reshape(4, 4).T
    turn = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])  # of the 3D Tiles specification
    placed = np.c_[theirs.means, np.ones(len(g))] @ (turn @ node).T
    np.testing.assert_allclose(placed[:, :3], g.means, atol=5e-5)


def test_tree_is_well_formed_and_coarser_upwards(tmp_path):
    g = random_gaussians(6000, degree=1)
    formats.write(tmp_path / "tileset.json", g, max_per_tile=500)
    tileset = json.loads((tmp_path / "tileset.json").read_text())
    assert tileset["asset"]["version"] == "1.1"
    assert tileset["root"]["refine"] == "REPLACE"
    assert tileset["geometricError"] >= tileset["root"]["geometricError"]
    count = 0
    for tile, above in tiles_of(tileset["root"]):
        count += 1
        low, high = corners(tile["boundingVolume"])
        content = glb.read_world(tmp_path / tile["content"]["uri"])
        # Content is stored y up: (x, z, -y) of the root's frame.
        stored = content.means @ np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
        assert (stored >= low - 1e-4).all()
        assert (stored <= high + 1e-4).all()
        assert len(content) <= 500 * 1.5
        assert (tile["geometricError"] == 0) == ("children" not in tile)
        if above is not None:
            outer_low, outer_high = corners(above["boundingVolume"])
            assert (low >= outer_low - 1e-9).all()
            assert (high <= outer_high + 1e-9).all()
            assert tile["geometricError"] < above["geometricError"]
    assert count > 9


def test_coarse_levels_keep_the_moments(tmp_path):
    """Never by dropping: mass, mean and covariance of the whole stay what they are, from afar it is the same thing."""
    g = random_gaussians(4000, degree=0)
    level, voxel = tiles3d.coarser(g, 300)
    assert 150 < len(level) <= 300
    assert voxel > 0

    def moments(g):
        from gsmap.geometry.voxels import optical_depths, projected_areas

        mass = optical_depths(g) * projected_areas(g.scales)
        mean = np.average(g.means, axis=0, weights=mass)
        spread = g.means - mean
        return mass.sum(), mean, np.average(covariances(g) + spread[:, :, None] * spread[:, None], axis=0, weights=mass)

    (mass, mean, covariance), (mass_level, mean_level, covariance_level) = moments(g), moments(level)
    # A group of more than opaque Gaussians saturates, so some mass is hidden behind itself; none is invented.
    assert 0.5 * mass < mass_level <= mass * 1.001
    np.testing.assert_allclose(mean_level, mean, atol=0.3)
    np.testing.assert_allclose(covariance_level, covariance, rtol=0.2, atol=0.5)


def test_few_gaussians_are_one_tile_and_equal_points_do_not_recurse_for_ever(tmp_path):
    formats.write(tmp_path / "tileset.json", random_gaussians(7))
    assert len(list((tmp_path / "tiles").iterdir())) == 1
    g = random_gaussians(50)
    g.means[:] = 1
    formats.write(tmp_path / "tileset.json", g, max_per_tile=10)
    assert len(formats.read(tmp_path / "tileset.json")) == 50


def test_content_is_in_the_frame_of_the_root_tile_in_every_reading_of_sh(tmp_path):
    """3D Tiles turns y up to z up; node and turn cancel, so stored SH are right with or without turning them."""
    g = random_gaussians(20)
    tiles3d.write_content(tmp_path / "a.glb", g, compressed=False)
    data = (tmp_path / "a.glb").read_bytes()
    gltf = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
    node = np.array(gltf["nodes"][0]["matrix"]).reshape(4, 4).T
    turn = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])  # of the 3D Tiles specification
    np.testing.assert_array_equal(turn @ node, np.eye(4))
    y_up = glb.read_world(tmp_path / "a.glb")
    np.testing.assert_allclose(y_up.means, g.means[:, [0, 2, 1]] * [1, 1, -1], atol=1e-6)
    looked = directions()
    seen = colours_along(y_up, looked[:, [0, 2, 1]] * [1, 1, -1])
    np.testing.assert_allclose(seen, colours_along(g, looked), atol=1e-5)


def test_the_root_stands_upright_or_where_it_is_put(tmp_path):
    g = random_gaussians(5)
    formats.write(tmp_path / "tileset.json", g)
    transform = np.array(json.loads((tmp_path / "tileset.json").read_text())["root"]["transform"]).reshape(4, 4).T
    np.testing.assert_array_equal(transform @ [0, -1, 0, 0], [0, 0, 1, 0])  # up of a ply is up
    placed = np.eye(4)
    placed[:3, 3] = 4e6, 1e6, 4e6
    formats.write(tmp_path / "tileset.json", g, transform=placed, compressed=False)
    back = formats.read(tmp_path / "tileset.json")
    np.testing.assert_array_equal(back.means, g.means)


def test_tiles_written_one_by_one_with_transforms_and_both_refinements(tmp_path):
    """The way of a large map; and a foreign tileset with placed tiles, several contents and ADD."""
    near, far = random_gaussians(30, degree=1), random_gaussians(20, degree=0, seed=1)
    for name, g in (("near.glb", near), ("far.glb", far)):
        tiles3d.write_content(tmp_path / name, g, compressed=False)
    boxes = [tiles3d.box_of(g) for g in (near, far)]
    box = np.stack([np.minimum(*[b[0] for b in boxes]), np.maximum(*[b[1] for b in boxes])])
    leaves = (TileNode(boxes[0], 0.0, "near.glb"), TileNode(boxes[1], 0.0, "far.glb"))
    tiles3d.write_tileset(tmp_path / "tileset.json", TileNode(box, 1.0, None, leaves))
    assert len(formats.read(tmp_path / "tileset.json")) == 50

    tileset = json.loads((tmp_path / "tileset.json").read_text())
    child = tileset["root"]["children"][0]
    child["transform"] = [2, 0, 0, 0, 0, 2, 0, 0, 0, 0, 2, 0, 10, 0, 0, 1]
    tileset["root"]["refine"] = "ADD"
    tileset["root"]["contents"] = [{"uri": "far.glb"}, {"uri": "near.glb"}]
    (tmp_path / "tileset.json").write_text(json.dumps(tileset))
    back = formats.read(tmp_path / "tileset.json")
    assert len(back) == 100
    np.testing.assert_allclose(back.means[50:80], near.means * 2 + [10, 0, 0], atol=1e-5)


def change(tmp_path, **root):
    formats.write(tmp_path / "tileset.json", random_gaussians(5))
    tileset = json.loads((tmp_path / "tileset.json").read_text())
    tileset["root"].update(root)
    (tmp_path / "tileset.json").write_text(json.dumps(tileset))


@pytest.mark.parametrize(
    "uri",
    [
        "../secret.glb",
        "/etc/secret.glb",
        "%2e%2e/secret.glb",
        "http://x.y/a.glb",
        "file:///a.glb",
        "..\\a.glb",
        "link.glb",
    ],
)
def test_content_outside_the_folder_is_not_followed(tmp_path, uri):
    inside = tmp_path / "in"
    inside.mkdir()
    glb.write(tmp_path / "secret.glb", random_gaussians(5))
    os.symlink(tmp_path / "secret.glb", inside / "link.glb")
    change(inside, content={"uri": uri})
    with raises(InputError, code="content_outside_folder"):
        formats.read(inside / "tileset.json")


@pytest.mark.parametrize(
    ("root", "code", "match"),
    [
        ({"content": {"uri": "nowhere.glb"}}, "content_missing", "'nowhere.glb'"),
        ({"content": {"uri": "points.pnts"}}, "content_invalid", "'points.pnts'"),
        ({"content": {}}, "wrong_file_type", "no uri"),
        ({"content": None}, "wrong_file_type", "AttributeError"),
        ({"children": [{"transform": [1, 2, 3], "content": {"uri": "a.glb"}}]}, "wrong_file_type", "ValueError"),
        ({"children": [{}]}, "file_damaged", "no tiles with content"),
        ({"implicitTiling": {}}, "unsupported_feature", "implicit"),
    ],
)
def test_damage_is_named(tmp_path, root, code, match):
    change(tmp_path, **root)
    with raises(InputError, code=code, match=match):
        formats.read(tmp_path / "tileset.json")


@pytest.mark.parametrize("content", [{"url": "a.glb"}, {"uri": "a.glb?v=2#lod"}, {"url": "a%20b.glb?token=x%2Fy"}])
def test_content_of_older_versions_and_with_a_query_is_the_file(tmp_path, content):
    g = random_gaussians(5)
    for name in ("a.glb", "a b.glb"):
        tiles3d.write_content(tmp_path / name, g, compressed=False)
    (tmp_path / "tileset.json").write_text(json.dumps({"asset": {"version": "1.0"}, "root": {"content": content}}))
    np.testing.assert_allclose(formats.read(tmp_path / "tileset.json").means, g.means, atol=1e-6)


def test_not_a_tileset(tmp_path):
    for text in ("", "[]", "{}", '{"root": 3}', "[" * 100_000):
        (tmp_path / "tileset.json").write_text(text)
        with pytest.raises(InputError):
            formats.read(tmp_path / "tileset.json")


def test_deep_nesting_is_refused(tmp_path):
    tile = {"content": {"uri": "a.glb"}}
    for _ in range(100):
        tile = {"children": [tile]}
    (tmp_path / "tileset.json").write_text(json.dumps({"root": tile}))
    with raises(InputError, code="nested_too_deeply"):
        formats.read(tmp_path / "tileset.json")


def test_options_are_checked_and_an_older_export_stays_whole(tmp_path):
    with raises(ConfigError, code="out_of_range", match="max_per_tile"):
        formats.write(tmp_path / "tileset.json", random_gaussians(5), max_per_tile=0)
    formats.write(tmp_path / "tileset.json", random_gaussians(5))
    older = (tmp_path / "tileset.json").read_bytes()
    formats.write(tmp_path / "tileset.json", random_gaussians(6))
    (tmp_path / "tileset.json").write_bytes(older)
    assert len(formats.read(tmp_path / "tileset.json")) == 5


def test_published_validators_find_no_fault(tmp_path):
    if shutil.which("node") is None:
        pytest.skip("needs node and the npm package gltf-validator: see tools/check/validate_3dtiles.sh")
    formats.write(tmp_path / "tileset.json", random_gaussians(3000), max_per_tile=500)
    formats.write(tmp_path / "a.glb", random_gaussians(30, degree=1))
    formats.write(tmp_path / "packed.glb", random_gaussians(30, degree=1), compressed=True)
    done = subprocess.run(
        ["bash", TOOL, "--no-install", tmp_path / "tileset.json", tmp_path / "a.glb", tmp_path / "packed.glb"],
        capture_output=True,
        text=True,
        timeout=300,
    )
    if done.returncode == 3:
        pytest.skip(done.stderr.strip())
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize("uri", ["a\\u0000b.glb", "\\ud800.glb", "%00.glb", "a" * 300 + ".glb", 7, None, ["a.glb"]])
def test_content_that_is_no_name_of_a_file_is_refused(tmp_path, uri):
    text = json.dumps({"root": {"content": {"uri": uri}}}).replace("\\\\", "\\")
    (tmp_path / "tileset.json").write_text(text)
    with raises(InputError, code=("content_invalid", "file_unreadable", "wrong_file_type")):
        formats.read(tmp_path / "tileset.json")
