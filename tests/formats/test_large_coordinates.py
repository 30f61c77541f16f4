"""Files of Gaussians in map coordinates: every format holds them to a millimetre, or refuses them with the offset."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest
from formats_cases import random_gaussians
from raising import raises
from scipy.spatial import cKDTree

from gsmap import formats
from gsmap.cli.app import run
from gsmap.errors import InputError
from gsmap.formats.axes import GLTF, PLY, axes_matrix
from gsmap.types import Gaussians

PLACES = {
    "LV95": (2683000.37, 1247900.61, 408.2),
    "UTM": (500123.4, 5412345.6, 320.0),
    "ECEF": (4271234.5, 672345.6, 4672345.7),
}
HOLDING = ["x.ply", "x.glb", "tiles/tileset.json", "x.usdc", "x.usda", "x.usdz"]
SINGLE = ["x.spz", "x.sog", "x.splat", "x.compressed.ply", "meta.json", "lod-meta.json"]


def at(place: str, n: int = 3000, extent: float = 4.0) -> tuple[Gaussians, np.ndarray]:
    """Gaussians there, and their positions."""
    g = random_gaussians(n, degree=1, extent=extent)
    return g, g.means + np.array(PLACES[place])


def write_ply(path: Path, g: Gaussians, positions: np.ndarray, kind: str = "<f8", text: bool = False) -> None:
    """A .ply as another program writes it."""
    columns = {"x": positions[:, 0], "y": positions[:, 1], "z": positions[:, 2], "opacity": g.logit_opacities}
    columns |= {f"f_dc_{i}": g.sh[:, 0, i] for i in range(3)} | {f"scale_{i}": g.log_scales[:, i] for i in range(3)}
    columns |= {f"rot_{i}": g.quats[:, i] for i in range(4)}
    rows = np.zeros(len(g), [(name, kind if name in "xyz" else "<f4") for name in columns])
    for name, values in columns.items():
        rows[name] = values
    kinds = [f"property {'double' if rows.dtype[name].itemsize == 8 else 'float'} {name}" for name in columns]
    form = "ascii" if text else "binary_little_endian"
    head = "\n".join(["ply", f"format {form} 1.0", f"element vertex {len(g)}", *kinds, "end_header", ""])
    body = "".join(" ".join(map(repr, row.tolist())) + "\n" for row in rows).encode() if text else rows.tobytes()
    path.write_bytes(head.encode() + body)


def far_off(back: np.ndarray, truth: np.ndarray) -> float:
    assert len(np.unique(back, axis=0)) == len(truth)
    return float(cKDTree(back).query(truth)[0].max())


def needs(name: str) -> None:
    if ".usd" in name:
        pytest.importorskip("pxr")


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("text", [False, True])
def test_doubles_are_read_as_they_are(place: str, text: bool, tmp_path: Path) -> None:
    g, truth = at(place)
    write_ply(tmp_path / "a.ply", g, truth, text=text)
    back = formats.read(tmp_path / "a.ply")
    assert np.abs(back.positions - truth).max() < 5e-6
    streamed = formats.stream(tmp_path / "a.ply")
    np.testing.assert_array_equal(np.concatenate([chunk.positions for chunk in streamed.chunks()]), back.positions)
    np.testing.assert_array_equal(np.concatenate(list(streamed.columns("means"))), back.means)


def test_a_checkpoint_of_doubles(tmp_path: Path) -> None:
    torch = pytest.importorskip("torch")
    g, truth = at("ECEF")
    own = {"quats": g.quats, "scales": g.log_scales, "opacities": g.logit_opacities, "sh0": g.sh[:, :1]}
    tensors = {name: torch.from_numpy(np.array(values)) for name, values in own.items()}
    torch.save({"splats": tensors | {"means": torch.from_numpy(truth)}}, tmp_path / "a.pt")
    assert np.abs(formats.read(tmp_path / "a.pt").positions - truth).max() < 5e-6


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("name", HOLDING)
def test_formats_that_hold_them(place: str, name: str, tmp_path: Path) -> None:
    needs(name)
    g, truth = at(place)
    write_ply(tmp_path / "a.ply", g, truth)
    formats.write(tmp_path / name, formats.read(tmp_path / "a.ply"))
    back = formats.read(tmp_path / name)
    assert far_off(back.positions, truth) < 1e-3
    again = formats.read(tmp_path / "a.ply")
    assert np.abs(np.sort(back.log_scales[:, 0]) - np.sort(again.log_scales[:, 0])).max() < 0.05


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("name", SINGLE)
def test_formats_that_do_not_refuse_them_and_name_the_offset(place: str, name: str, tmp_path: Path) -> None:
    g, truth = at(place)
    write_ply(tmp_path / "a.ply", g, truth)
    content = formats.read(tmp_path / "a.ply")
    (tmp_path / "out").mkdir()
    with pytest.raises(InputError) as refused:
        formats.write(tmp_path / "out" / name, content)
    assert ", ".join(f"{value:.15g}" for value in content.origin) in str(refused.value)
    assert not list((tmp_path / "out").iterdir())


def test_a_ply_is_read_by_others(tmp_path: Path) -> None:
    o3d = pytest.importorskip("open3d")
    g, truth = at("LV95")
    write_ply(tmp_path / "a.ply", g, truth)
    formats.write(tmp_path / "b.ply", formats.read(tmp_path / "a.ply"))
    theirs = np.asarray(o3d.io.read_point_cloud(str(tmp_path / "b.ply")).points)
    assert np.abs(theirs - truth).max() < 1e-6


@pytest.mark.parametrize("compressed", [False, True])
def test_a_glb_has_them_on_its_node(compressed: bool, tmp_path: Path) -> None:
    g, truth = at("ECEF")
    write_ply(tmp_path / "a.ply", g, truth)
    formats.write(tmp_path / "b.glb", formats.read(tmp_path / "a.ply"), compressed=compressed)
    data = (tmp_path / "b.glb").read_bytes()
    length = struct.unpack_from("<I", data, 12)[0]
    gltf = json.loads(data[20 : 20 + length])
    matrix = np.array(gltf["nodes"][0]["matrix"]).reshape(4, 4).T
    position = gltf["accessors"][gltf["meshes"][0]["primitives"][0]["attributes"]["POSITION"]]
    corners = np.array([position["min"], position["max"]]) @ matrix[:3, :3].T + matrix[:3, 3]
    turned = truth @ axes_matrix(GLTF, PLY).T
    np.testing.assert_allclose(np.sort(corners, axis=0), [turned.min(0), turned.max(0)], atol=1e-3)
    if not compressed:
        view = gltf["bufferViews"][position["bufferView"]]
        start = 20 + length + 8 + view["byteOffset"]
        stored = np.frombuffer(data, "<f4", 3 * len(g), start).reshape(-1, 3).astype(float)
        assert np.abs(stored @ matrix[:3, :3].T + matrix[:3, 3] - turned).max() < 1e-5


def test_a_tileset_has_them_in_double_precision_above_its_tiles(tmp_path: Path) -> None:
    g, truth = at("ECEF")
    write_ply(tmp_path / "a.ply", g, truth)
    formats.write(tmp_path / "t" / "tileset.json", formats.read(tmp_path / "a.ply"), max_per_tile=500)
    root = json.loads((tmp_path / "t" / "tileset.json").read_text())["root"]
    (inner,) = root["children"]
    origin = np.array(inner["transform"]).reshape(4, 4)[3, :3]
    box = np.array(root["boundingVolume"]["box"])
    assert np.abs(box[:3] - truth.mean(0)).max() < 3
    assert np.abs(np.array(inner["boundingVolume"]["box"])[:3] + origin - box[:3]).max() < 1e-6
    assert root["geometricError"] > inner["geometricError"] > 0  # it is refined at any distance


def test_usd_has_them_as_a_translation(tmp_path: Path) -> None:
    needs(".usd")
    from pxr import Usd, UsdGeom

    g, truth = at("LV95")
    write_ply(tmp_path / "a.ply", g, truth)
    formats.write(tmp_path / "b.usdc", formats.read(tmp_path / "a.ply"))
    stage = Usd.Stage.Open(str(tmp_path / "b.usdc"))
    prim = stage.GetDefaultPrim()
    matrix = np.array(UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(Usd.TimeCode.Default()))
    stored = np.array(prim.GetAttribute("positions").Get(), dtype=float)
    placed = stored @ matrix[:3, :3] + matrix[3, :3]
    assert np.abs(placed - truth @ axes_matrix("RUB", PLY).T).max() < 1e-5


def test_child_tiles_at_globe_coordinates(tmp_path: Path) -> None:
    """Content near zero, placed by a tile's transform: distances between neighbours are kept."""
    g, truth = at("ECEF")
    local = Gaussians(g.means, g.quats, g.log_scales, g.logit_opacities, g.sh)
    formats.write(tmp_path / "tileset.json", local, compressed=False)
    tileset = json.loads((tmp_path / "tileset.json").read_text())
    shift = np.eye(4)
    shift[:3, 3] = PLACES["ECEF"]
    inner = tileset["root"] | {"transform": shift.T.ravel().tolist()}
    tileset["root"] = {name: inner[name] for name in ("boundingVolume", "geometricError")} | {"children": [inner]}
    (tmp_path / "tileset.json").write_text(json.dumps(tileset))
    assert far_off(formats.read(tmp_path / "tileset.json").positions, truth) < 1e-5


@pytest.mark.parametrize("place", PLACES)
def test_single_precision_that_neighbours_are_lost_in_is_refused(place: str, tmp_path: Path) -> None:
    g, truth = at(place)
    for kind in ("<f4", "<f8"):  # rounded before, and perhaps written in full since
        write_ply(tmp_path / "a.ply", g, truth.astype(np.float32), kind)
        with raises(InputError, code="precision_loss"):
            formats.read(tmp_path / "a.ply")
        with raises(InputError, code="precision_loss"):
            formats.stream(tmp_path / "a.ply")


def test_single_precision_of_what_lies_far_apart_is_kept_to_the_bit(tmp_path: Path) -> None:
    g, truth = at("LV95", n=200, extent=200.0)
    single = truth.astype(np.float32)
    write_ply(tmp_path / "a.ply", g, single, "<f4")
    back = formats.read(tmp_path / "a.ply")
    np.testing.assert_array_equal(back.positions, single)
    formats.write(tmp_path / "b.splat", back)  # single precision is all that there was
    np.testing.assert_array_equal(formats.read(tmp_path / "b.splat").positions, single)


def test_an_spz_whose_neighbours_fall_together_is_refused(tmp_path: Path) -> None:
    g = random_gaussians(400, degree=0, extent=0.05)
    formats.write(tmp_path / "a.spz", g)
    g.means[0] = 3e5  # what lies far out takes the bits of all the others
    with raises(InputError, code="precision_loss"):
        formats.write(tmp_path / "a.spz", g)
    assert len(formats.read(tmp_path / "a.spz")) == 400


def test_convert(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def convert(target: str, *options: str) -> int:
        with pytest.raises(SystemExit) as end:
            run(["convert", str(tmp_path / "a.ply"), str(tmp_path / target), *options])
        return int(end.value.code or 0)

    g, truth = at("LV95")
    write_ply(tmp_path / "a.ply", g, truth)
    assert convert("a.spz") == 1
    assert "(2683000, 1247900, 400)" in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "a.spz").exists()
    assert convert("a.spz", "--local", "--json") == 0
    report = json.loads(capsys.readouterr().out)
    assert report["offset"] == [2683000, 1247900, 400]
    back = formats.read(tmp_path / "a.spz")
    assert far_off(back.positions + report["offset"], truth) < 1e-3
    assert convert("b.ply", "--json") == 0
    assert json.loads(capsys.readouterr().out)["offset"] == [0, 0, 0]
    assert far_off(formats.read(tmp_path / "b.ply").positions, truth) < 1e-6
