import json
import struct

import numpy as np
import pytest
from formats_cases import angles_rad, colours_along, covariances, directions, gaussians, random_gaussians
from hypothesis import given, settings
from raising import raises

from gsmap import formats
from gsmap.errors import InputError
from gsmap.formats import glb
from gsmap.geometry.transforms import transform_gaussians
from gsmap.types import Sim3


@settings(max_examples=25, deadline=None)
@given(g=gaussians)
def test_round_trip_is_float32(g, tmp_path_factory):
    path = tmp_path_factory.mktemp("glb") / "a.glb"
    formats.write(path, g)
    back = formats.read(path)
    np.testing.assert_array_equal(back.means, g.means)
    np.testing.assert_array_equal(back.sh, g.sh)
    np.testing.assert_allclose(back.log_scales, g.log_scales, atol=2e-6)
    np.testing.assert_allclose(back.opacities, g.opacities, atol=1e-7)
    assert angles_rad(g, back).max() < 1e-6


def container(path) -> tuple[dict, bytes]:
    data = path.read_bytes()
    size = struct.unpack_from("<I", data, 12)[0]
    return json.loads(data[20 : 20 + size]), data[28 + size :]


def put(path, gltf: dict, binary: bytes) -> None:
    text = json.dumps(gltf).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sIIII", b"glTF", 2, 28 + len(text) + len(binary), len(text), 0x4E4F534A)
    path.write_bytes(head + text + struct.pack("<II", len(binary), 0x004E4942) + binary)


def attribute(path, name: str) -> np.ndarray:
    """One attribute, read by the letter of the glTF specification."""
    gltf, binary = container(path)
    accessor = gltf["accessors"][gltf["meshes"][0]["primitives"][0]["attributes"][name]]
    view = gltf["bufferViews"][accessor["bufferView"]]
    width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
    dtype = {5126: "<f4", 5121: "u1"}[accessor["componentType"]]
    return np.frombuffer(binary, dtype, accessor["count"] * width, view["byteOffset"]).reshape(-1, width)


def test_what_is_written_is_the_ratified_extension(tmp_path):
    """Names, types and meanings as the specification's attribute table has them."""
    path = tmp_path / "a.glb"
    g = random_gaussians(50, degree=2)
    formats.write(path, g)
    gltf, _ = container(path)
    primitive = gltf["meshes"][0]["primitives"][0]
    assert primitive["mode"] == 0
    assert gltf["extensionsUsed"] == ["KHR_gaussian_splatting"]
    extension = primitive["extensions"]["KHR_gaussian_splatting"]
    assert (extension["kernel"], extension["colorSpace"]) == ("ellipse", "srgb_rec709_display")
    prefix = "KHR_gaussian_splatting:"
    expected = {"POSITION", "COLOR_0", prefix + "ROTATION", prefix + "SCALE", prefix + "OPACITY"}
    expected |= {f"{prefix}SH_DEGREE_{degree}_COEF_{n}" for degree in range(3) for n in range(2 * degree + 1)}
    assert set(primitive["attributes"]) == expected
    # glTF's world is left-up-front: half a turn about the z of a ply.
    flip = np.array([-1, -1, 1])
    np.testing.assert_array_equal(attribute(path, "POSITION"), g.means * flip)
    np.testing.assert_allclose(attribute(path, prefix + "SCALE"), np.exp(g.log_scales), rtol=1e-6)
    np.testing.assert_allclose(attribute(path, prefix + "OPACITY")[:, 0], g.opacities, rtol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(attribute(path, prefix + "ROTATION"), axis=1), 1, atol=1e-6)
    w = g.quats[:, 0] / np.linalg.norm(g.quats, axis=1)
    np.testing.assert_allclose(attribute(path, prefix + "ROTATION")[:, 3], w, atol=1e-6)
    # SH_1,-1 goes with y and SH_1,1 with x, both of which are turned.
    np.testing.assert_array_equal(attribute(path, prefix + "SH_DEGREE_1_COEF_0"), -g.sh[:, 1])
    np.testing.assert_array_equal(attribute(path, prefix + "SH_DEGREE_1_COEF_1"), g.sh[:, 2])
    np.testing.assert_array_equal(attribute(path, prefix + "SH_DEGREE_1_COEF_2"), -g.sh[:, 3])
    assert attribute(path, "COLOR_0").shape == (50, 4)


def test_point_colours_are_linear(tmp_path):
    g = random_gaussians(1, degree=0)
    g.sh[0, 0] = np.array([-0.5, 0, 0.5]) / 0.28209479  # sRGB 0, 0.5, 1
    formats.write(tmp_path / "a.glb", g)
    assert attribute(tmp_path / "a.glb", "COLOR_0")[0, :3].tolist() == [0, 55, 255]


def test_node_transforms_are_applied_sh_included(tmp_path):
    """A turned, scaled and shifted parent and child, against the geometry room's transform."""
    path = tmp_path / "a.glb"
    g = random_gaussians(40)
    glb.write_world(path, g)
    gltf, binary = container(path)
    half = np.sqrt(0.5)
    gltf["scenes"][0]["nodes"] = [1]
    gltf["nodes"].append(
        {"rotation": [0, 0, half, half], "scale": [2, 2, 2], "translation": [1, 2, 3], "children": [0]}
    )
    gltf["nodes"][0]["translation"] = [0, 0, 5]
    put(path, gltf, binary)
    moved = glb.read_world(path)
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # about z
    np.testing.assert_allclose(moved.means, 2 * (g.means + np.array([0, 0, 5])) @ quarter.T + [1, 2, 3], atol=1e-5)
    np.testing.assert_allclose(covariances(moved), 4 * quarter @ covariances(g) @ quarter.T, rtol=1e-3, atol=1e-6)
    looked = directions()
    np.testing.assert_allclose(colours_along(moved, looked @ quarter.T), colours_along(g, looked), atol=1e-5)
    again = transform_gaussians(g, Sim3(quarter, np.array([1, 2, 13.0]), 2.0))
    np.testing.assert_allclose(moved.sh, again.sh, atol=1e-6)


def test_two_meshes_become_one_set(tmp_path):
    path = tmp_path / "a.glb"
    formats.write(path, random_gaussians(10))
    gltf, binary = container(path)
    gltf["nodes"].append({"mesh": 0, "translation": [1, 0, 0]})
    gltf["scenes"][0]["nodes"] = [0, 1]
    put(path, gltf, binary)
    assert len(formats.read(path)) == 20


def test_interleaved_and_normalised_attributes(tmp_path):
    """Rotations as normalised shorts, interleaved with byte opacities at a stride of 12."""
    path = tmp_path / "a.glb"
    g = random_gaussians(30, degree=0)
    formats.write(path, g)
    gltf, binary = container(path)
    attributes = gltf["meshes"][0]["primitives"][0]["attributes"]
    rows = np.zeros(30, np.dtype([("q", "<i2", 4), ("o", "u1"), ("pad", "u1", 3)]))
    rows["q"] = np.round(attribute(path, "KHR_gaussian_splatting:ROTATION") * 32767)
    rows["o"] = np.round(g.opacities * 255)
    view = {"buffer": 0, "byteOffset": len(binary), "byteLength": rows.nbytes, "byteStride": 12}
    gltf["bufferViews"].append(view)
    common = {"bufferView": len(gltf["bufferViews"]) - 1, "count": 30, "normalized": True}
    gltf["accessors"] += [
        common | {"componentType": 5122, "type": "VEC4"},
        common | {"componentType": 5121, "type": "SCALAR", "byteOffset": 8},
    ]
    attributes["KHR_gaussian_splatting:ROTATION"] = len(gltf["accessors"]) - 2
    attributes["KHR_gaussian_splatting:OPACITY"] = len(gltf["accessors"]) - 1
    gltf["buffers"][0]["byteLength"] += rows.nbytes
    put(path, gltf, binary + rows.tobytes())
    back = formats.read(path)
    assert angles_rad(g, back).max() < 1e-3
    np.testing.assert_allclose(back.opacities, g.opacities, atol=0.5 / 255 + 1e-6)


def prim(gltf):
    return gltf["meshes"][0]["primitives"][0]


def attr(gltf, name="KHR_gaussian_splatting:SCALE"):
    return gltf["accessors"][prim(gltf)["attributes"][name]]


@pytest.mark.parametrize(
    ("damage", "code", "match"),
    [
        (lambda d: d["buffers"][0].update(uri="../../etc/passwd"), "content_outside_folder", "outside the file"),
        (lambda d: d["buffers"][0].update(uri="data:;base64,AAAA"), "content_outside_folder", "outside the file"),
        (lambda d: d["bufferViews"][2].update(byteOffset=2**40), "data_outside_buffer", "accessor 2 needs"),
        (lambda d: d["bufferViews"][2].update(byteOffset=-8), "invalid_accessor", "accessor 2 .*stride"),
        (lambda d: d["bufferViews"][2].update(byteStride=2**40), "invalid_accessor", "accessor 2 .*stride"),
        (lambda d: d["bufferViews"][2].update(byteStride=0), "invalid_accessor", "accessor 2 .*stride"),
        (lambda d: attr(d).update(byteOffset=4), "data_outside_buffer", "accessor 3 needs 124 bytes of 120"),
        (lambda d: attr(d).update(count=11), "count_mismatch", "accessor 3 has 11 values for 10"),
        (lambda d: [a.update(count=2**60) for a in d["accessors"]], "decompression_bomb", "61,572,651,155,456 MiB"),
        (
            lambda d: [a.update(count=1000) for a in d["accessors"]],
            "data_outside_buffer",
            "accessor 3 needs 12,000 bytes of 120",
        ),
        (
            lambda d: d["scenes"][0].update(nodes=[0] * 9000) or [a.update(count=10**6) for a in d["accessors"]],
            "decompression_bomb",
            "480,652 MiB",
        ),
        (lambda d: [a.update(count=0) for a in d["accessors"]], "invalid_accessor", "accessor 3 has impossible count"),
        (lambda d: attr(d).update(componentType=5125), "invalid_accessor", "accessor 3 is .*type"),
        (lambda d: attr(d).update(type="MAT4"), "invalid_accessor", "accessor 3 is .*type"),
        (lambda d: attr(d).update(sparse={}), "invalid_accessor", "accessor 3 is sparse"),
        (
            lambda d: prim(d)["attributes"].pop("KHR_gaussian_splatting:OPACITY"),
            "missing_attribute",
            "KHR_gaussian_splatting:OPACITY",
        ),
        (
            lambda d: prim(d)["attributes"].pop("KHR_gaussian_splatting:SH_DEGREE_1_COEF_1"),
            "missing_attribute",
            "KHR_gaussian_splatting:SH_DEGREE_1_COEF_1",
        ),
        (lambda d: prim(d)["extensions"].clear(), "not_gaussians", "no Gaussian splats"),
        (lambda d: prim(d)["extensions"]["KHR_gaussian_splatting"].pop("kernel"), "unsupported_version", "kernel None"),
        (
            lambda d: prim(d)["extensions"]["KHR_gaussian_splatting"].update(colorSpace="lin_rec709_display"),
            "unsupported_version",
            "lin_rec709_display",
        ),
        (
            lambda d: prim(d)["extensions"]["KHR_gaussian_splatting"].update(extensions={"KHR_x_compression": {}}),
            "unsupported_feature",
            "KHR_x_compression",
        ),
        (lambda d: d["nodes"][0].update(children=[0]), "nested_too_deeply", "circle"),
        (lambda d: d["nodes"][0].update(scale=[1, 1, -1]), "unsupported_transform", "3x3 part"),
        (lambda d: d["nodes"][0].update(scale=[1, 1, 2]), "unsupported_transform", "3x3 part"),
        (lambda d: d["nodes"][0].update(matrix=[1, 2]), "not_json", "glTF: ValueError"),
        (lambda d: d["nodes"][0].update(matrix=[1e308] * 16), "unsupported_transform", "last row"),
        (lambda d: d["nodes"][0].update(mesh=7), "not_json", "glTF: IndexError"),
        (lambda d: d.update(nodes="x"), "not_json", "glTF: AttributeError"),
        (lambda d: d.pop("accessors"), "not_json", "glTF: KeyError 'accessors'"),
    ],
)
def test_damage_is_named(tmp_path, damage, code, match):
    path = tmp_path / "a.glb"
    formats.write(path, random_gaussians(10, degree=1))
    gltf, binary = container(path)
    damage(gltf)
    put(path, gltf, binary)
    with raises(InputError, code=code, match=match):
        formats.read(path)


def packing(d):
    return prim(d)["extensions"]["KHR_gaussian_splatting"]["extensions"]["KHR_gaussian_splatting_compression_spz_2"]


@pytest.mark.parametrize(
    ("damage", "code", "match"),
    [
        (lambda d: packing(d).update(bufferView=3), "not_json", "glTF: IndexError"),
        (lambda d: packing(d).pop("bufferView"), "not_json", "glTF: KeyError 'bufferView'"),
        (
            lambda d: d["bufferViews"][0].update(byteLength=10**9),
            "data_outside_buffer",
            "view 0 needs bytes up to 1,000,000,000 of 332",
        ),
        (
            lambda d: d["bufferViews"][0].update(byteOffset=-4),
            "data_outside_buffer",
            "view 0 needs bytes up to 328 of 332",
        ),
        (lambda d: d["bufferViews"][0].update(byteOffset=4, byteLength=40), "wrong_file_type", "not an SPZ file"),
        (lambda d: d["bufferViews"][0].update(buffer=1), "content_outside_folder", "outside the file"),
        (lambda d: d["buffers"][0].update(uri="other.bin"), "content_outside_folder", "outside the file"),
        (lambda d: [a.update(count=11) for a in d["accessors"]], "count_mismatch", "SPZ holds 10 Gaussians"),
        (lambda d: [a.update(count=2**60) for a in d["accessors"]], "decompression_bomb", "61,572,651,155,456 MiB"),
    ],
)
def test_damage_of_what_is_packed_is_named(tmp_path, damage, code, match):
    path = tmp_path / "a.glb"
    formats.write(path, random_gaussians(10, degree=1), compressed=True)
    gltf, binary = container(path)
    damage(gltf)
    put(path, gltf, binary)
    with raises(InputError, code=code, match=match):
        formats.read(path)


def test_a_draft_with_logarithmic_scales_is_recognised(tmp_path):
    path = tmp_path / "a.glb"
    g = random_gaussians(10)
    formats.write(path, g)
    gltf, binary = container(path)
    at = gltf["bufferViews"][attr(gltf)["bufferView"]]["byteOffset"]
    put(path, gltf, binary[:at] + g.log_scales.tobytes() + binary[at + g.log_scales.nbytes :])
    with raises(InputError, code="unsupported_version"):
        formats.read(path)


def test_every_truncation_is_refused(tmp_path):
    path = tmp_path / "a.glb"
    formats.write(path, random_gaussians(20, degree=0))
    data = path.read_bytes()
    for size in [*range(30), *range(30, len(data), 61)]:
        path.write_bytes(data[:size])
        with pytest.raises(InputError):
            formats.read(path)


@pytest.mark.parametrize(
    ("data", "code", "match"),
    [
        (b"", "wrong_file_type", "it is empty"),
        (b"glTF" + struct.pack("<IIII", 1, 20, 0, 0), "unsupported_version", "GLB version 1"),
        (
            b"glTF" + struct.pack("<IIII", 2, 2**32 - 1, 2**31, 0x4E4F534A),
            "file_truncated",
            "4,294,967,295 bytes .*has 20",
        ),
        (b"glTF" + struct.pack("<IIII", 2, 22, 2, 0x4E4F534A) + b"[]", "not_json", "not an object"),
        (b"glTF" + struct.pack("<IIII", 2, 22, 2, 0x4E4F534A) + b"{]", "not_json", "line 1 column 2"),
        (
            b"glTF" + struct.pack("<IIII", 2, 20020, 20000, 0x4E4F534A) + b"[" * 20000,
            "not_json",
            "its JSON cannot be read",
        ),
        (b"glTF" + struct.pack("<IIII", 2, 22, 2, 0x4E4F534A) + b"{}", "not_gaussians", "no Gaussian splats"),
    ],
)
def test_bad_containers(tmp_path, data, code, match):
    (tmp_path / "a.glb").write_bytes(data)
    with raises(InputError, code=code, match=match):
        formats.read(tmp_path / "a.glb")
