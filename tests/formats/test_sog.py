import contextlib
import io
import json
import zipfile
from dataclasses import replace

import numpy as np
import pytest
from formats_cases import angles_rad, random_gaussians
from PIL import Image
from raising import raises

from gsmap import formats
from gsmap.errors import ConfigError, InputError
from gsmap.geometry.morton import morton_order
from gsmap.geometry.sh import SH_C0
from gsmap.types import Gaussians

N = 5


def webp(texels: np.ndarray) -> bytes:
    out = io.BytesIO()
    Image.fromarray(texels.astype(np.uint8), "RGBA").save(out, "WEBP", lossless=True, exact=True)
    return out.getvalue()


def texture(values: np.ndarray, width: int = 4) -> bytes:
    """(n, 4) bytes as an image, filled up with zeros."""
    height = -(-len(values) // width)
    texels = np.zeros((height * width, 4))
    texels[: len(values)] = values
    return webp(texels.reshape(height, width, 4))


def sog(with_sh: bool = True) -> tuple[dict, dict[str, bytes]]:
    """A small .sog made from the format's description."""
    rng = np.random.default_rng(0)
    level = rng.integers(0, 65536, (N, 3))
    opaque = np.full((N, 1), 255)
    codebook = np.linspace(-6, 0, 256).tolist()
    colours = np.linspace(-2, 2, 256).tolist()
    files = {
        "means_l.webp": texture(np.hstack([level & 255, opaque])),
        "means_u.webp": texture(np.hstack([level >> 8, opaque])),
        "quats.webp": texture(np.hstack([rng.integers(0, 256, (N, 3)) // 2 + 64, 252 + np.arange(N)[:, None] % 4])),
        "scales.webp": texture(np.hstack([rng.integers(0, 256, (N, 3)), opaque])),
        "sh0.webp": texture(np.hstack([rng.integers(0, 256, (N, 3)), [[0], [51], [128], [204], [255]]])),
    }
    meta = {
        "version": 2,
        "count": N,
        "means": {"mins": [-1, -2, -3], "maxs": [1, 2, 3], "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": codebook, "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": colours, "files": ["sh0.webp"]},
    }
    if with_sh:
        palette = np.zeros((2, 64 * 3, 4))  # 128 entries of one band: three coefficients each
        palette[1, 3:6] = [[0, 10, 20, 255], [30, 40, 50, 255], [60, 70, 255, 255]]  # entry 65
        labels = np.array([[65, 0, 0, 255]] * N)
        files |= {"shN_centroids.webp": webp(palette), "shN_labels.webp": texture(labels)}
        meta["shN"] = {"count": 128, "bands": 1, "codebook": colours}
        meta["shN"]["files"] = ["shN_centroids.webp", "shN_labels.webp"]
    return meta, files


def save(path, meta: dict, files: dict[str, bytes], *, compress: int = zipfile.ZIP_STORED) -> None:
    with zipfile.ZipFile(path, "w", compress) as archive:
        for name, data in files.items():
            archive.writestr(name, data)
        archive.writestr("meta.json", json.dumps(meta))


def test_a_file_made_by_hand(tmp_path):
    meta, files = sog()
    save(tmp_path / "a.sog", meta, files)
    g = formats.read(tmp_path / "a.sog")
    low = np.asarray(Image.open(io.BytesIO(files["means_l.webp"])).convert("RGBA")).reshape(-1, 4)[:N, :3].astype(int)
    high = np.asarray(Image.open(io.BytesIO(files["means_u.webp"])).convert("RGBA")).reshape(-1, 4)[:N, :3].astype(int)
    span = np.array([1, 2, 3])
    logarithm = -span + 2 * span * (low + 256 * high) / 65535
    np.testing.assert_allclose(g.means, np.sign(logarithm) * (np.exp(np.abs(logarithm)) - 1), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(g.opacities, [0, 0.2, 128 / 255, 0.8, 1], atol=1.1e-3)
    np.testing.assert_allclose(np.linalg.norm(g.quats, axis=1), 1, atol=1e-6)
    assert (np.abs(g.quats).argmax(1)[:4] == [0, 1, 2, 3]).all()
    book = np.linspace(-2, 2, 256)
    np.testing.assert_allclose(g.sh[0, 1:], book[[[0, 10, 20], [30, 40, 50], [60, 70, 255]]], atol=1e-6)
    assert g.sh_degree == 1


def test_real_files_read_as_an_independent_reader_does(shared_data):
    gsply = pytest.importorskip("gsply")
    for name in ("monkey_0001", "wave_0001"):
        path = shared_data / "formats" / f"{name}.sog"
        ours = formats.read(path)
        try:
            theirs = gsply.sogread(str(path))
        except ImportError:
            pytest.skip("gsply's SOG reader needs imagecodecs")
        np.testing.assert_allclose(ours.means, theirs.means, atol=1e-5)
        np.testing.assert_allclose(ours.log_scales, theirs.scales, atol=1e-5)
        np.testing.assert_allclose(np.abs((theirs.quats * ours.quats).sum(1)), 1, atol=1e-4)
        np.testing.assert_allclose(ours.sh[:, 0], theirs.sh0, atol=1e-5)


def test_real_files_hold_what_their_meta_says(shared_data):
    for name, count in (("monkey_0001", 31658), ("wave_0001", 4225)):
        path = shared_data / "formats" / f"{name}.sog"
        g = formats.read(path)
        meta = json.loads(zipfile.ZipFile(path).read("meta.json"))
        bounds = [np.array(meta["means"][end]) for end in ("mins", "maxs")]
        reached = [np.sign(b) * np.expm1(np.abs(b)) for b in bounds]
        assert len(g) == count
        np.testing.assert_allclose(g.means.min(0), reached[0], rtol=1e-4)
        np.testing.assert_allclose(g.means.max(0), reached[1], rtol=1e-4)
        assert (g.sh[:, 0] * SH_C0 + 0.5 > -0.1).all()


@pytest.mark.parametrize(
    ("damage", "code", "match"),
    [
        (lambda m, f: m.update(version=1), "unsupported_version", "version 1"),
        (lambda m, f: m.pop("version"), "unsupported_version", "version 1"),
        (lambda m, f: m.update(count=10**12), "count_mismatch", "1000000000000"),
        (lambda m, f: m.update(count=-1), "count_mismatch", "promises -1"),
        (lambda m, f: m.update(count=9), "count_mismatch", "8 texels for 9"),
        (
            lambda m, f: m["means"].update(files=["../../etc/passwd", "means_u.webp"]),
            "content_missing",
            "'../../etc/passwd'",
        ),
        (lambda m, f: m["means"].update(files=[]), "not_json", r"meta\.json .*IndexError"),
        (lambda m, f: m.update(means=3), "not_json", r"meta\.json .*TypeError"),
        (lambda m, f: m["scales"].update(codebook=[1, 2]), "invalid_codebook", r"codebook of shape \(2,\)"),
        (lambda m, f: m["scales"].update(codebook=["x"] * 256), "not_json", r"meta\.json .*ValueError"),
        (lambda m, f: m["shN"].update(bands=7), "unsupported_sh_degree", "7 bands"),
        (lambda m, f: m["shN"].update(bands=2), "invalid_palette", "192 .*512"),
        (lambda m, f: m["shN"].update(count=64), "invalid_palette", "65 .*64"),
        (lambda m, f: f.pop("quats.webp"), "content_missing", "'quats.webp'"),
        (lambda m, f: f.update({"quats.webp": b"not an image"}), "picture_unreadable", r"quats\.webp .*WebP"),
        (lambda m, f: f.update({"quats.webp": f["quats.webp"][:40]}), "picture_unreadable", r"quats\.webp .*WebP"),
        (
            lambda m, f: f.update({"quats.webp": texture(np.full((8, 4), 128))}),
            "not_a_rotation",
            "Gaussian 0 .*tag 128",
        ),
    ],
)
def test_damage_is_named(tmp_path, damage, code, match):
    meta, files = sog()
    damage(meta, files)
    save(tmp_path / "a.sog", meta, files)
    with raises(InputError, code=code, match=match):
        formats.read(tmp_path / "a.sog")


def test_bombs_are_refused_before_they_expand(tmp_path):
    meta, files = sog(with_sh=False)
    with zipfile.ZipFile(tmp_path / "a.sog", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("meta.json", b" " * (5 << 20) + json.dumps(meta).encode())
    with raises(InputError, code="file_too_large"):
        formats.read(tmp_path / "a.sog")
    # A WebP of a few hundred bytes whose header claims 9000 x 9000 pixels, within what Pillow itself would allow.
    image = bytearray(webp(np.zeros((1, 1, 4))))
    at = image.index(b"VP8L") + 9
    bits = int.from_bytes(image[at : at + 4], "little") | 8999 | 8999 << 14
    image[at : at + 4] = bits.to_bytes(4, "little")
    save(tmp_path / "b.sog", meta, files | {"quats.webp": bytes(image)})
    with raises(InputError, code="picture_too_large"):
        formats.read(tmp_path / "b.sog")


def test_an_image_much_larger_than_its_gaussians_is_not_decoded(tmp_path):
    """2.6 kB that would take 256 MiB; and a count that no file of this size holds."""
    meta, files = sog(with_sh=False)
    out = io.BytesIO()
    Image.new("RGBA", (8192, 8192)).save(out, "WEBP", lossless=True)
    save(tmp_path / "a.sog", meta, files | {"scales.webp": out.getvalue()})
    with raises(InputError, code="picture_too_large"):
        formats.read(tmp_path / "a.sog")
    save(tmp_path / "b.sog", meta | {"count": 1 << 20}, files)
    with raises(InputError, code="decompression_bomb"):
        formats.read(tmp_path / "b.sog")


@pytest.mark.parametrize("method", [zipfile.ZIP_DEFLATED, zipfile.ZIP_LZMA, zipfile.ZIP_BZIP2])
def test_damage_within_a_member_is_an_input_error(tmp_path, method):
    meta, files = sog(with_sh=False)
    with zipfile.ZipFile(tmp_path / "a.sog", "w", method) as archive:
        for name, data in {"meta.json": json.dumps(meta).encode(), **files}.items():
            archive.writestr(name, data)
    whole = (tmp_path / "a.sog").read_bytes()
    for at in range(40, 240, 3):
        (tmp_path / "a.sog").write_bytes(whole[:at] + bytes([whole[at] ^ 0xFF, 0x55]) + whole[at + 2 :])
        with contextlib.suppress(InputError):  # some bytes do not matter
            formats.read(tmp_path / "a.sog")
    locked = bytearray(whole)
    locked[6] |= 1
    locked[whole.index(b"PK\1\2") + 8] |= 1
    (tmp_path / "a.sog").write_bytes(locked)
    with raises(InputError, code="wrong_file_type"):
        formats.read(tmp_path / "a.sog")


def test_truncation_and_other_files(tmp_path):
    save(tmp_path / "a.sog", *sog())
    data = (tmp_path / "a.sog").read_bytes()
    for size in [*range(0, 64, 7), *range(64, len(data), 131)]:
        (tmp_path / "a.sog").write_bytes(data[:size])
        with pytest.raises(InputError):
            formats.read(tmp_path / "a.sog")


def colour_rms(a, b) -> float:
    return float(np.sqrt(((a.sh - b.sh) ** 2).mean()))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("name", ["a.sog", "new/folder/meta.json"])
def test_what_is_written_is_read_back(tmp_path, degree, name):
    g = random_gaussians(3000, degree, extent=20.0)
    formats.write(tmp_path / name, g)
    back = formats.read(tmp_path / name)
    g = g[morton_order(g.means)]
    assert back.sh_degree == degree
    assert (np.abs(back.means - g.means) <= 6e-5 * (1 + np.abs(g.means))).all()
    assert angles_rad(g, back).max() < 0.02
    assert np.abs(back.log_scales - g.log_scales).max() < 0.03
    assert np.abs(back.opacities - g.opacities).max() < 0.003
    assert np.abs(back.sh[:, 0] - g.sh[:, 0]).max() < 0.01
    if degree == 1:  # 1,500 entries for 3,000 colours of nine numbers that nothing ties together
        assert colour_rms(back, g) < 0.4 * float(g.sh[:, 1:].std())


def test_the_palette_holds_every_colour_when_there_are_few(tmp_path):
    g = random_gaussians(2000, 3)
    kinds = random_gaussians(50, 3, seed=1).sh
    g = replace(g, sh=np.concatenate([g.sh[:, :1], kinds[np.arange(2000) % 50][:, 1:]], axis=1))
    formats.write(tmp_path / "a.sog", g)
    assert np.abs(formats.read(tmp_path / "a.sog").sh - g[morton_order(g.means)].sh).max() < 0.01


def test_bundle_and_folder_hold_the_same(tmp_path):
    g = random_gaussians(700, 2)
    formats.write(tmp_path / "a.sog", g, antialiased=True)
    formats.write(tmp_path / "b" / "meta.json", g, antialiased=True)
    for name in ("means", "quats", "log_scales", "logit_opacities", "sh"):
        both = [getattr(formats.read(tmp_path / one), name) for one in ("a.sog", "b/meta.json")]
        np.testing.assert_array_equal(*both)
    assert formats.info(tmp_path / "a.sog").antialiased
    assert formats.info(tmp_path / "b" / "meta.json").antialiased
    first = (tmp_path / "a.sog").read_bytes()
    formats.write(tmp_path / "a.sog", g, antialiased=True)
    assert (tmp_path / "a.sog").read_bytes() == first


def test_positions_are_rounded_not_cut(tmp_path):
    g = random_gaussians(4000, 0)
    formats.write(tmp_path / "a.sog", g, ordered=True)
    off = formats.read(tmp_path / "a.sog").means.astype(np.float64) - g.means
    step = 2 * np.log1p(5) / 65535 * (1 + np.abs(g.means))
    assert (np.abs(off) < 0.52 * step).all()
    assert abs((off / step * np.sign(g.means)).mean()) < 0.02


def test_order_is_kept_when_asked(tmp_path):
    g = random_gaussians(300, 1)
    formats.write(tmp_path / "a.sog", g, ordered=True)
    np.testing.assert_allclose(formats.read(tmp_path / "a.sog").means, g.means, atol=1e-3)


@pytest.mark.parametrize("n", [1, 2, 255, 1025])
def test_few_gaussians_and_ones_that_are_all_alike(tmp_path, n):
    g = random_gaussians(1, 1)
    g = Gaussians.concatenate([g] * n)
    formats.write(tmp_path / "a.sog", g)
    back = formats.read(tmp_path / "a.sog")
    np.testing.assert_allclose(back.means, g.means, rtol=1e-5)
    np.testing.assert_allclose(back.log_scales, g.log_scales, rtol=1e-5)
    np.testing.assert_allclose(back.sh, g.sh, rtol=1e-5)


def test_writing_again_leaves_an_older_folder_whole_until_the_end(tmp_path):
    formats.write(tmp_path / "meta.json", random_gaussians(100, 1))
    older = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    formats.write(tmp_path / "meta.json", random_gaussians(100, 1, seed=1))
    for name, data in older.items():
        assert name == "meta.json" or (tmp_path / name).read_bytes() == data


def test_what_a_sog_cannot_hold_is_refused(tmp_path):
    with raises(InputError, code="no_gaussians"):
        formats.write(tmp_path / "a.sog", formats.Gaussians.empty())
    with raises(ConfigError, code="out_of_range", match="palette_size"):
        formats.write(tmp_path / "a.sog", random_gaussians(2), palette_size=1 << 17)
    with raises(ConfigError, code="out_of_range", match="turns"):
        formats.write(tmp_path / "a.sog", random_gaussians(2), turns=0)
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("file", "code", "match"),
    [
        ("../a.webp", "content_outside_folder", "'../a.webp'"),
        ("/etc/passwd", "content_outside_folder", "'/etc/passwd'"),
        ("none.webp", "content_missing", "'none.webp'"),
        ("a\0b", "content_invalid", r"'a\\x00b'"),
    ],
)
def test_a_folder_names_no_file_elsewhere(tmp_path, file, code, match):
    folder = tmp_path / "scene"
    formats.write(folder / "meta.json", random_gaussians(10, 0))
    (tmp_path / "a.webp").write_bytes(webp(np.zeros((4, 4, 4))))
    meta = json.loads((folder / "meta.json").read_text())
    meta["scales"]["files"] = [file]
    (folder / "meta.json").write_text(json.dumps(meta))
    with raises(InputError, code=code, match=match):
        formats.read(folder / "meta.json")


def test_another_reader_reads_what_is_written(tmp_path):
    gsply = pytest.importorskip("gsply")
    g = random_gaussians(2500, 3)
    formats.write(tmp_path / "a.sog", g)
    try:
        theirs = gsply.sogread(str(tmp_path / "a.sog"))
    except ImportError:
        pytest.skip("gsply's SOG reader needs imagecodecs")
    ours = formats.read(tmp_path / "a.sog")
    np.testing.assert_allclose(ours.means, theirs.means, atol=1e-4)
    np.testing.assert_allclose(ours.log_scales, theirs.scales, atol=1e-5)
    np.testing.assert_allclose(np.abs((theirs.quats * ours.quats).sum(1)), 1, atol=1e-4)
    np.testing.assert_allclose(ours.sh[:, 0], theirs.sh0, atol=1e-5)
    np.testing.assert_allclose(ours.sh[:, 1:], theirs.shN.reshape(2500, 15, 3), atol=1e-5)
