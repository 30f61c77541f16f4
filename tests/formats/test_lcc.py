"""Scenes put together as XGRIDS' white paper describes them."""

import json
from pathlib import Path

import numpy as np
import pytest
from formats_cases import angles_rad, colours_along, covariances, directions, random_gaussians
from raising import raises

from gsmap import formats
from gsmap.errors import InputError
from gsmap.formats.axes import axes_matrix, change_axes
from gsmap.formats.quantise import smallest_three
from gsmap.geometry.sh import rgb_of_sh0
from gsmap.types import Gaussians


def lcc(folder: Path, units: list[list[Gaussians]], *, with_sh: bool) -> Path:
    """A scene whose units have a run of each level; the Gaussians are given in the format's own axes."""
    folder.mkdir(exist_ok=True)
    every = Gaussians.concatenate([g for unit in units for g in unit])
    bounds = {"scale": (every.scales.min(0), every.scales.max(0)), "shcoef": (np.full(3, -1.0), np.full(3, 1.0))}
    index, data, more = b"", b"", b""
    for number, unit in enumerate(units):
        index += np.array([number, 2 * number], "<u2").tobytes()
        for g in unit:
            rows = np.zeros(
                len(g), [("m", "<f4", 3), ("c", "u1", 4), ("s", "<u2", 3), ("q", "<u2", 2), ("n", "<u2", 3)]
            )
            rows["m"] = g.means
            rgba = np.concatenate([rgb_of_sh0(g.sh[:, 0]), g.opacities[:, None]], axis=1)
            rows["c"] = np.round(np.clip(rgba, 0, 1) * 255)
            low, high = bounds["scale"]
            rows["s"] = np.round((g.scales - low) / (high - low) * 65535)
            rows["q"] = packed(g.quats).astype("<u4").view("<u2").reshape(-1, 2)
            index += np.array([len(g)], "<u4").tobytes() + np.array([len(data)], "<u8").tobytes()
            index += np.array([32 * len(g)], "<u4").tobytes()
            data += rows.tobytes()
            if with_sh:
                levels = np.round((g.sh[:, 1:] + 1) / 2 * [2047, 1023, 2047]).astype("<u4")
                words = np.zeros((len(g), 16), "<u4")
                words[:, :15] = levels[:, :, 0] | levels[:, :, 1] << 11 | levels[:, :, 2] << 21
                more += words.tobytes()
    (folder / "Index.bin").write_bytes(index)
    (folder / "data.bin").write_bytes(data)
    if with_sh:
        (folder / "Shcoef.bin").write_bytes(more)
    attributes = [{"name": name, "min": a.tolist(), "max": b.tolist()} for name, (a, b) in bounds.items()]
    meta = {"version": "5.0", "totalLevel": len(units[0]), "fileType": "Quality" if with_sh else "Portable"}
    meta |= {"splats": [sum(len(unit[k]) for unit in units) for k in range(len(units[0]))], "attributes": attributes}
    (folder / "scene.lcc").write_text(json.dumps(meta))
    return folder / "scene.lcc"


def packed(quats: np.ndarray) -> np.ndarray:
    """x, y, z, w without the largest, ten bits each, and which it is."""
    xyzw = quats[:, [1, 2, 3, 0]] / np.linalg.norm(quats, axis=1, keepdims=True)
    largest = np.abs(xyzw).argmax(1)
    xyzw *= np.sign(xyzw[np.arange(len(xyzw)), largest])[:, None]
    three = np.stack([np.delete(row, k) for row, k in zip(xyzw, largest, strict=True)])
    level = np.round((three + 0.5**0.5) / 2**0.5 * 1023).astype(np.uint32)
    return level[:, 0] | level[:, 1] << 10 | level[:, 2] << 20 | largest.astype(np.uint32) << 30


def some(n: int, degree: int, seed: int = 0) -> Gaussians:
    g = random_gaussians(n, degree, seed)
    return Gaussians(g.means, g.quats, g.log_scales, g.logit_opacities, np.clip(g.sh, -0.95, 0.95))


@pytest.mark.parametrize("with_sh", [False, True])
def test_the_finest_level_of_every_unit(tmp_path, with_sh):
    degree = 3 if with_sh else 0
    units = [[some(300, degree, seed), some(40, degree, seed + 9)] for seed in range(3)]
    path = lcc(tmp_path / "s", units, with_sh=with_sh)
    back = formats.read(path)
    truth = change_axes(Gaussians.concatenate([unit[0] for unit in units]), "RDF", "RFU")
    assert back.sh_degree == degree
    np.testing.assert_allclose(back.means, truth.means, atol=1e-6)
    assert angles_rad(truth, back).max() < 0.005
    np.testing.assert_allclose(back.scales, truth.scales, rtol=0.02, atol=1e-5)
    np.testing.assert_allclose(back.opacities, truth.opacities, atol=3e-3)
    np.testing.assert_allclose(back.sh, truth.sh, atol=0.008)
    streamed = formats.stream(path)
    assert streamed.num_gaussians == 900
    np.testing.assert_array_equal(np.concatenate(list(streamed.columns("sh"))), back.sh)


def test_z_is_up_and_colours_turn_with_it(tmp_path):
    """By covariances and colours along directions, not by the function that turns them."""
    g = some(60, 3)
    back = formats.read(lcc(tmp_path / "s", [[g]], with_sh=True))
    M = axes_matrix("RDF", "RFU")
    np.testing.assert_array_equal(M @ [0, 0, 1], [0, -1, 0])  # up is against y, which points down
    np.testing.assert_array_equal(M @ [0, 1, 0], [0, 0, 1])
    np.testing.assert_allclose(back.means, g.means @ M.T, atol=1e-6)
    np.testing.assert_allclose(covariances(back), M @ covariances(g) @ M.T, rtol=0.05, atol=2e-3)
    d = directions()
    np.testing.assert_allclose(colours_along(back, d @ M.T), colours_along(g, d), atol=0.01)


def test_what_is_left_out_and_whose_format_it_is_is_said(tmp_path):
    path = lcc(tmp_path / "s", [[some(5, 0)]], with_sh=False)
    assert formats.info(path).notes == ("Data Organization Format originated from XGRIDS",)
    (path.parent / "environment.bin").write_bytes(b"")
    assert "environment" in formats.info(path).notes[1]


def rewritten(change):
    def damage(folder: Path) -> None:
        meta = json.loads((folder / "scene.lcc").read_text())
        change(meta)
        (folder / "scene.lcc").write_text(json.dumps(meta))

    return damage


def patched(name: str, kind: str, at: int, value: int):
    def damage(folder: Path) -> None:
        data = bytearray((folder / name).read_bytes())
        data[at : at + np.dtype(kind).itemsize] = np.array(value, kind).tobytes()
        (folder / name).write_bytes(data)

    return damage


@pytest.mark.parametrize(
    ("damage", "code", "match"),
    [
        (rewritten(lambda m: m.update(totalLevel=0)), "unsupported_version", " 0 levels"),
        (rewritten(lambda m: m.update(totalLevel=10**9)), "unsupported_version", "1000000000 levels"),
        (rewritten(lambda m: m.update(totalLevel=3)), "file_damaged", r"Index\.bin: 20 bytes .*3 levels"),
        (rewritten(lambda m: m.update(attributes=[])), "unsupported_version", r"bounds of \[\]"),
        (rewritten(lambda m: m.update(attributes=5)), "not_json", r"scene\.lcc is not the JSON"),
        (rewritten(lambda m: m["attributes"][0].update(min=["x"])), "not_json", r"scene\.lcc is not the JSON"),
        (lambda f: (f / "scene.lcc").write_text("[]"), "not_json", "KeyError 'totalLevel'"),
        (lambda f: (f / "scene.lcc").write_text("{"), "not_json", "line 1 column 2"),
        (lambda f: (f / "Index.bin").unlink(), "content_missing", "'index.bin'"),
        (lambda f: (f / "data.bin").unlink(), "content_missing", "'data.bin'"),
        (lambda f: (f / "Shcoef.bin").unlink(), "content_missing", "'shcoef.bin'"),
        (lambda f: (f / "data.bin").write_bytes(b""), "rows_outside_file", "twice"),
        (lambda f: (f / "Shcoef.bin").write_bytes(b"1" * 640), "rows_outside_file", "twice"),
        (patched("Index.bin", "<u4", 4, 2**31), "rows_outside_file", "twice"),
        (patched("Index.bin", "<u8", 8, 2**63), "rows_outside_file", "refers to no rows"),
        (patched("Index.bin", "<u8", 8, 7), "rows_outside_file", "refers to no rows"),
        (patched("Index.bin", "<u4", 4, 0), "rows_outside_file", "no rows"),
    ],
)
def test_damage_is_named(tmp_path, damage, code, match):
    lcc(tmp_path / "s", [[some(30, 3)]], with_sh=True)
    damage(tmp_path / "s")
    with raises(InputError, code=code, match=match):
        formats.read(tmp_path / "s" / "scene.lcc")


def test_units_may_not_share_rows(tmp_path):
    path = lcc(tmp_path / "s", [[some(30, 0)], [some(30, 0, 1)]], with_sh=False)
    patched("Index.bin", "<u8", 20 + 8, 320)(path.parent)
    with raises(InputError, code="rows_outside_file"):
        formats.read(path)


def test_our_packing_is_smallest_three():
    """The fixture against the packer of other formats: the same three numbers in another order."""
    g = some(50, 0)
    largest, three = smallest_three(g.quats)
    words = packed(g.quats)
    np.testing.assert_array_equal(words >> 30, np.array([3, 0, 1, 2])[largest])
    assert (
        np.abs(
            np.sort(three, axis=1)
            - np.sort(
                np.stack([words & 1023, words >> 10 & 1023, words >> 20 & 1023], 1) / 1023 * 2**0.5 - 0.5**0.5, axis=1
            )
        ).max()
        < 1e-3
    )
