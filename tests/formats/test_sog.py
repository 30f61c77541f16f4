import contextlib
import io
import json
import zipfile

import numpy as np
import pytest
from PIL import Image

from gsmap import formats
from gsmap.errors import InputError
from gsmap.geometry.sh import SH_C0

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
    ("damage", "says"),
    [
        (lambda m, f: m.update(version=1), "version 1"),
        (lambda m, f: m.pop("version"), "version 1"),
        (lambda m, f: m.update(count=10**12), "count"),
        (lambda m, f: m.update(count=-1), "count"),
        (lambda m, f: m.update(count=9), "8 texels for 9"),
        (lambda m, f: m["means"].update(files=["../../etc/passwd", "means_u.webp"]), "lacks"),
        (lambda m, f: m["means"].update(files=[]), "meta.json"),
        (lambda m, f: m.update(means=3), "meta.json"),
        (lambda m, f: m["scales"].update(codebook=[1, 2]), "codebook"),
        (lambda m, f: m["scales"].update(codebook=["x"] * 256), "meta.json"),
        (lambda m, f: m["shN"].update(bands=7), "7 bands"),
        (lambda m, f: m["shN"].update(bands=2), "palette"),
        (lambda m, f: m["shN"].update(count=64), "label"),
        (lambda m, f: f.pop("quats.webp"), "lacks"),
        (lambda m, f: f.update({"quats.webp": b"not an image"}), "WebP"),
        (lambda m, f: f.update({"quats.webp": f["quats.webp"][:40]}), "WebP"),
        (lambda m, f: f.update({"quats.webp": texture(np.full((8, 4), 128))}), "unknown tag"),
    ],
)
def test_damage_is_named(tmp_path, damage, says):
    meta, files = sog()
    damage(meta, files)
    save(tmp_path / "a.sog", meta, files)
    with pytest.raises(InputError, match=says):
        formats.read(tmp_path / "a.sog")


def test_bombs_are_refused_before_they_expand(tmp_path):
    meta, files = sog(with_sh=False)
    with zipfile.ZipFile(tmp_path / "a.sog", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("meta.json", b" " * (5 << 20) + json.dumps(meta).encode())
    with pytest.raises(InputError, match="more than"):
        formats.read(tmp_path / "a.sog")
    # A WebP of a few hundred bytes whose header claims 9000 x 9000 pixels, within what Pillow itself would allow.
    image = bytearray(webp(np.zeros((1, 1, 4))))
    at = image.index(b"VP8L") + 9
    bits = int.from_bytes(image[at : at + 4], "little") | 8999 | 8999 << 14
    image[at : at + 4] = bits.to_bytes(4, "little")
    save(tmp_path / "b.sog", meta, files | {"quats.webp": bytes(image)})
    with pytest.raises(InputError, match="9000 x 9000 pixels"):
        formats.read(tmp_path / "b.sog")


def test_an_image_much_larger_than_its_gaussians_is_not_decoded(tmp_path):
    """2.6 kB that would take 256 MiB; and a count that no file of this size holds."""
    meta, files = sog(with_sh=False)
    out = io.BytesIO()
    Image.new("RGBA", (8192, 8192)).save(out, "WEBP", lossless=True)
    save(tmp_path / "a.sog", meta, files | {"scales.webp": out.getvalue()})
    with pytest.raises(InputError, match=r"8192 x 8192 pixels, more than 65,546"):
        formats.read(tmp_path / "a.sog")
    save(tmp_path / "b.sog", meta | {"count": 1 << 20}, files)
    with pytest.raises(InputError, match="hostile"):
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
    with pytest.raises(InputError, match="encrypted"):
        formats.read(tmp_path / "a.sog")


def test_truncation_and_other_files(tmp_path):
    save(tmp_path / "a.sog", *sog())
    data = (tmp_path / "a.sog").read_bytes()
    for size in [*range(0, 64, 7), *range(64, len(data), 131)]:
        (tmp_path / "a.sog").write_bytes(data[:size])
        with pytest.raises(InputError):
            formats.read(tmp_path / "a.sog")


def test_it_is_only_read(tmp_path):
    with pytest.raises(InputError, match=r"cannot write \.sog"):
        formats.write(tmp_path / "a.sog", formats.Gaussians.empty())
