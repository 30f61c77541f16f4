"""Point clouds, meshes and depth pictures, read as they are, and refused where they lie."""

from __future__ import annotations

import io
import json
import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from raising import raises

from gsmap import formats
from gsmap.errors import ConfigError, InputError, NotFoundError
from gsmap.formats import scans
from gsmap.formats.scans import Params, limits
from gsmap.types import Gaussians

FAR = np.array([500_000.25, 5_400_000.5, 300.125])


def cloud(count: int = 400, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.uniform(-2, 2, (count, 3)), rng.integers(2, 256, (count, 3)).astype(np.uint8)


def write_ply(path: Path, points: np.ndarray, colours: np.ndarray | None, kind: str = "f8") -> Path:
    names = [(axis, "<" + kind) for axis in "xyz"]
    names += [(c, "u1") for c in ("red", "green", "blue")] if colours is not None else []
    rows = np.empty(len(points), names)
    for k, axis in enumerate("xyz"):
        rows[axis] = points[:, k]
    for k, c in enumerate(("red", "green", "blue")):
        if colours is not None:
            rows[c] = colours[:, k]
    types = {"f8": "double", "f4": "float"}
    head = [f"property {types[kind]} {axis}" for axis in "xyz"]
    head += [f"property uchar {c}" for c in ("red", "green", "blue")] if colours is not None else []
    text = "\n".join(["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}", *head, "end_header\n"])
    path.write_bytes(text.encode() + rows.tobytes())
    return path


def test_ply_keeps_float64_and_tells_its_origin(tmp_path: Path) -> None:
    points, colours = cloud()
    found = scans.read(write_ply(tmp_path / "far.ply", points + FAR, colours))
    assert np.abs(found.points).max() < 200
    assert np.abs(found.points + found.origin - points - FAR).max() < 1e-8
    np.testing.assert_allclose(found.colours, colours / 255, atol=1e-6)


def test_near_points_keep_their_frame(tmp_path: Path) -> None:
    points, _ = cloud()
    found = scans.read(write_ply(tmp_path / "near.ply", points, None))
    assert not found.origin.any()
    assert found.colours is None
    np.testing.assert_array_equal(found.points, points)


def test_points_that_are_not_finite_are_left_out_and_told(tmp_path: Path) -> None:
    points, _ = cloud()
    points[7, 1] = np.nan
    found = scans.read(write_ply(tmp_path / "a.ply", points, None))
    assert len(found) == len(points) - 1
    assert "1 points with NaN or infinite" in found.notes[0]
    with raises(InputError, code="empty_scan"):
        scans.read(write_ply(tmp_path / "b.ply", np.full((5, 3), np.inf), None))


def test_of_many_points_an_even_share_is_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    points, _ = cloud(1000)
    monkeypatch.setattr(limits, "MAX_POINTS", 300)
    found = scans.read(write_ply(tmp_path / "a.ply", points, None))
    np.testing.assert_array_equal(found.points, points[::4])
    assert "250 of its 1,000" in found.notes[0]


@pytest.mark.parametrize("columns", [[0, 1, 2, 3, 4, 5, 6], [0, 1, 2, 6, 3, 4, 5]])
def test_of_four_columns_of_bytes_the_three_that_are_alike_are_the_colour(tmp_path: Path, columns: list[int]) -> None:
    """Colour and a class, as CloudCompare writes them; an intensity and the colour, as scanners do."""
    rng = np.random.default_rng(0)
    grey = rng.integers(20, 230, (200, 1))
    colour = grey + rng.integers(-20, 20, (200, 3))
    rows = np.c_[rng.normal(size=(200, 3)), colour, rng.integers(0, 9, 200)][:, columns]
    np.savetxt(tmp_path / "a.xyz", rows, fmt="%.9g")
    found = scans.read(tmp_path / "a.xyz")
    np.testing.assert_allclose(found.colours, colour / 255, atol=1e-6)


def test_a_ply_that_promises_more_than_it_holds(tmp_path: Path) -> None:
    path = write_ply(tmp_path / "a.ply", *cloud())
    path.write_bytes(path.read_bytes()[:-40])
    with raises(InputError, code="file_truncated"):
        scans.read(path)


@pytest.mark.parametrize(
    ("text", "colours"),
    [
        ("1 2 3\n4 5 6\n", None),
        ("# x y z r g b\n1 2 3 255 0 51\n4 5 6 0 0 0\n", [[1, 0, 0.2], [0, 0, 0]]),
        ("//X,Y,Z,R,G,B\n1,2,3,255,0,51\n4,5,6,0,0,0\n", [[1, 0, 0.2], [0, 0, 0]]),
        ("2\n1 2 3 0.5 255 0 51\n4 5 6 0.25 0 0 0\n", [[1, 0, 0.2], [0, 0, 0]]),
        ("1 2 3 7 255 0 51\n4 5 6 9 0 0 0\n", [[1, 0, 0.2], [0, 0, 0]]),  # an intensity of whole numbers
        ("1 2 3 255 0 51 0.5\n4 5 6 0 0 0 1\n", [[1, 0, 0.2], [0, 0, 0]]),  # an intensity after the colour
        ("1 2 3 0 0.6 0.8 255 0 51\n4 5 6 0 0 1 0 0 0\n", [[1, 0, 0.2], [0, 0, 0]]),  # normals, then the colour
        ("1 2 3 0 0 1 255 0 51\n4 5 6 0 0 1 0 0 0\n", [[1, 0, 0.2], [0, 0, 0]]),
        ("1 2 3 0 0 1\n4 5 6 0 1 0\n", None),  # normals
    ],
)
def test_text(tmp_path: Path, text: str, colours: list[list[float]] | None) -> None:
    path = tmp_path / "a.xyz"
    path.write_text(text)
    found = scans.read(path)
    np.testing.assert_array_equal(found.points, [[1, 2, 3], [4, 5, 6]])
    if colours is None:
        assert found.colours is None
    else:
        np.testing.assert_allclose(found.colours, colours, atol=1e-6)
    assert len(found.notes) == text.startswith(("1 2 3 0 0 1\n", "1 2 3 7 255"))  # no colours; two orders possible


@pytest.mark.parametrize("text", ["", "hello\nworld\n", "1 2\n3 4\n", "1 2 3\n4 5\n"])
def test_text_that_is_no_cloud(tmp_path: Path, text: str) -> None:
    path = tmp_path / "a.xyz"
    path.write_text(text)
    with raises(InputError, code=("wrong_file_type", "invalid_line", "invalid_row")):
        scans.read(path)


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize("bits", [8, 16])
def test_las_keeps_scale_and_offset_in_float64(tmp_path: Path, suffix: str, bits: int) -> None:
    laspy = pytest.importorskip("laspy")
    points, colours = cloud()
    header = laspy.LasHeader(point_format=7, version="1.4")
    header.scales, header.offsets = np.full(3, 1e-3), FAR
    las = laspy.LasData(header)
    las.x, las.y, las.z = (points + FAR).T
    for name, values in zip(("red", "green", "blue"), colours.T, strict=True):
        setattr(las, name, values.astype(np.uint16) * (257 if bits == 16 else 1))
    las.write(tmp_path / f"a{suffix}")
    found = scans.read(tmp_path / f"a{suffix}")
    assert np.abs(found.points).max() < 5
    assert np.abs(found.points + found.origin - points - FAR).max() < 0.5001e-3
    np.testing.assert_allclose(found.colours, colours / 255, atol=1e-4)


def test_las_without_colours_has_none_and_a_damaged_one_is_refused(tmp_path: Path) -> None:
    laspy = pytest.importorskip("laspy")
    points, _ = cloud()
    las = laspy.LasData(laspy.LasHeader(point_format=7, version="1.4"))
    las.x, las.y, las.z = points.T
    las.write(tmp_path / "a.las")
    assert scans.read(tmp_path / "a.las").colours is None
    whole = (tmp_path / "a.las").read_bytes()
    (tmp_path / "b.las").write_bytes(whole[:-1000])
    with raises(InputError, code="file_truncated"):
        scans.read(tmp_path / "b.las")
    (tmp_path / "c.las").write_bytes(whole[:100])
    with raises(InputError, code="wrong_file_type"):
        scans.read(tmp_path / "c.las")
    for at, count in ((100, 1 << 31), (96, 1 << 31), (243, 1 << 31), (105, 0)):  # records, where points begin, ...
        lying = bytearray(whole)
        lying[at : at + 4] = count.to_bytes(4, "little") if count else b"\0\0" + bytes(lying[at + 2 : at + 4])
        (tmp_path / "e.las").write_bytes(lying)
        with raises(InputError, code="file_truncated"):
            scans.read(tmp_path / "e.las")
    las.write(tmp_path / "d.laz")
    packed = bytearray((tmp_path / "d.laz").read_bytes())
    packed[247:255] = (1 << 13).to_bytes(8, "little")  # the number of points, LAS 1.4: 400 are there
    (tmp_path / "d.laz").write_bytes(packed)
    with raises(InputError, code="reader_failed"):
        scans.read(tmp_path / "d.laz")


def square(path: Path) -> Path:
    """A textured square of 1 x 1 whose node moves it by 10: red and green above, blue and yellow below."""
    pixels = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 0]]], np.uint8)
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "png")
    picture = file.getvalue()
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], "<f4")
    at = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], "<f4")
    rows = np.array([0, 1, 2, 0, 2, 3], "<u2")
    binary = corners.tobytes() + at.tobytes() + rows.tobytes() + picture
    binary += b"\0" * (-len(binary) % 4)
    views = [(0, 48), (48, 32), (80, 12), (92, len(picture))]
    gltf = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "translation": [10, 0, 0]}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        "textures": [{"source": 0}],
        "images": [{"bufferView": 3, "mimeType": "image/png"}],
        "buffers": [{"byteLength": len(binary)}],
        "bufferViews": [{"buffer": 0, "byteOffset": start, "byteLength": size} for start, size in views],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3", "min": [0, 0, 0], "max": [1, 1, 0]},
            {"bufferView": 1, "componentType": 5126, "count": 4, "type": "VEC2"},
            {"bufferView": 2, "componentType": 5123, "count": 6, "type": "SCALAR"},
        ],
    }
    text = json.dumps(gltf).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + len(binary))
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(binary), 0x004E4942) + binary
    path.write_bytes(head + chunks)
    return path


def test_a_textured_mesh_is_sampled_evenly_and_coloured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = square(tmp_path / "a.glb")
    assert not scans.holds_splat(path)
    monkeypatch.setattr(limits, "MAX_POINTS", 4000)
    found = scans.read(path)
    assert found.kind == "mesh"
    assert len(found) == 4000
    np.testing.assert_allclose(found.points[:, 2], 0, atol=1e-6)
    right, above = found.points[:, 0] > 10.5, found.points[:, 1] > 0.5
    assert found.colours is not None
    for where, colour in [
        (above & ~right, [1, 0, 0]),
        (above & right, [0, 1, 0]),
        (~above & ~right, [0, 0, 1]),
        (~above & right, [1, 1, 0]),
    ]:
        assert 900 < where.sum() < 1100  # a quarter each: by area
        np.testing.assert_allclose(found.colours[where], np.tile(colour, (where.sum(), 1)), atol=1e-6)
    again = scans.read(path)
    np.testing.assert_array_equal(found.points, again.points)


def test_meshes_and_clouds_that_open3d_reads(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 2 0 0\nv 0 2 0\nf 1 2 3\n")
    monkeypatch.setattr(limits, "MAX_POINTS", 500)
    found = scans.read(tmp_path / "a.obj")
    assert found.colours is None
    assert (found.points[:, :2].sum(1) <= 2 + 1e-9).all()
    stl = ["solid a", "facet normal 0 0 1", "outer loop", "vertex 0 0 0", "vertex 2 0 0", "vertex 0 2 0"]
    (tmp_path / "a.stl").write_text("\n".join([*stl, "endloop", "endfacet", "endsolid a", ""]))
    assert len(scans.read(tmp_path / "a.stl")) == 500
    head = ["VERSION .7", "FIELDS x y z", "SIZE 4 4 4", "TYPE F F F", "COUNT 1 1 1", "WIDTH 3", "HEIGHT 1"]
    (tmp_path / "a.pcd").write_text("\n".join([*head, "POINTS 3", "DATA ascii", "0 0 0", "1 2 3", "4 5 6", ""]))
    np.testing.assert_allclose(scans.read(tmp_path / "a.pcd").points, [[0, 0, 0], [1, 2, 3], [4, 5, 6]])


@pytest.mark.parametrize("name", ["a.obj", "a.stl", "a.pcd", "a.glb"])
def test_what_no_library_reads_is_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(b"nothing of the kind" * 10)
    with raises(InputError, code="wrong_file_type"):
        scans.read(tmp_path / name)


def test_a_mesh_that_takes_too_long_is_given_up(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 2 0 0\nv 0 2 0\nf 1 2 3\n")
    with raises(InputError, code="file_too_large"):
        scans.read(tmp_path / "a.obj", Params(max_seconds=0.01))


def test_splats_are_told_from_scans(tmp_path: Path) -> None:
    points, _ = cloud(10)
    splat = Gaussians(points, np.tile([1.0, 0, 0, 0], (10, 1)), np.full((10, 3), -3.0), np.zeros(10), points[:, None])
    for name in ("a.ply", "a.glb"):
        formats.write(tmp_path / name, splat)
        assert scans.holds_splat(tmp_path / name)
    assert not scans.holds_splat(write_ply(tmp_path / "b.ply", points, None))
    with raises(NotFoundError, code="file_not_found"):
        scans.holds_splat(tmp_path / "c.ply")
    other = write_ply(tmp_path / "a.dat", points, None)
    for read in (scans.read, scans.holds_splat):
        with raises(InputError, code="unsupported_format"):
            read(other)
    assert [scans.is_scan(name) for name in ("a.LAS", "a.compressed.ply", "a.sog", "a.jpg", "a")] == [True] * 3 + [
        False,
        False,
    ]


def depth_picture(path: Path, depth_m: np.ndarray) -> Path:
    Image.fromarray(np.round(depth_m * 1000).astype(np.uint16)).save(path)
    return path


def test_a_depth_picture_is_points_in_the_camera_s_frame(tmp_path: Path) -> None:
    depth = np.full((48, 64), 2.0)
    depth[:10] = 0
    depth[:, 40:] = 3.0
    colours = np.zeros((96, 128, 3), np.uint8)
    colours[:, 80:] = 255
    Image.fromarray(colours).save(tmp_path / "a.png")
    found = scans.read_depth(depth_picture(tmp_path / "d.png", depth), (50, 50, 32, 24), colour=tmp_path / "a.png")
    assert found.camera is not None
    assert found.kind == "depth"
    near = found.points[:, 2] < 2.5
    assert near.sum() == 38 * 39  # but for the column before the jump
    assert (~near).sum() == 38 * 23 + 10 * 24  # and the one behind it
    np.testing.assert_allclose(found.points[near][0], [(0.5 - 32) / 50 * 2, (10.5 - 24) / 50 * 2, 2.0])
    assert found.colours is not None
    np.testing.assert_array_equal(found.colours[:, 0], np.where(near, 0, 1))


def test_depth_pictures_that_make_no_sense(tmp_path: Path) -> None:
    path = depth_picture(tmp_path / "d.png", np.full((48, 64), 2.0))
    with raises(InputError, code="invalid_intrinsics"):
        scans.read_depth(path, (50, 0, 32, 24))
    with raises(InputError, code="invalid_depth_scale"):
        scans.read_depth(path, (50, 50, 32, 24), units_per_m=1.0)
    Image.new("RGB", (64, 64)).save(tmp_path / "c.png")
    with raises(InputError, code="not_a_depth_picture"):
        scans.read_depth(tmp_path / "c.png", (50, 50, 32, 24))
    with raises(InputError, code="size_mismatch"):
        scans.read_depth(path, (50, 50, 32, 24), colour=tmp_path / "c.png")
    (tmp_path / "e.png").write_bytes(b"no picture")
    with raises(InputError, code="picture_unreadable"):
        scans.read_depth(tmp_path / "e.png", (50, 50, 32, 24))
    with raises(ConfigError, code="out_of_range", match="max_memory_mb"):
        Params(max_memory_mb=0)
