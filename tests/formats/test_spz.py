import struct
import tracemalloc
import zlib

import numpy as np
import pytest
from formats_cases import angles_rad, covariances, gaussians, random_gaussians
from hypothesis import given, settings
from hypothesis import strategies as st
from raising import raises

from gsmap import formats
from gsmap.errors import ConfigError, InputError
from gsmap.formats import spz
from gsmap.geometry.transforms import transform_gaussians
from gsmap.types import Gaussians, Sim3

FLIP = np.array([1, -1, -1], np.float32)  # right-up-back from right-down-front


@settings(max_examples=30, deadline=None)
@given(g=gaussians, version=st.sampled_from([3, 4]), bits=st.sampled_from([(5, 4), (8, 8), (1, 3)]))
def test_round_trip_within_its_bits(g, version, bits, tmp_path_factory):
    path = tmp_path_factory.mktemp("spz") / "a.spz"
    formats.write(path, g, version=version, sh_bits=bits)
    back = formats.read(path)
    extent = np.abs(g.means).max()
    # Half of 0.24 mm, or a part in 2^18 of a smaller scene (down to 2^-24), or what 24 bits leave of a larger one.
    assert np.abs(back.means - g.means).max() <= max(min(2**-13, extent * 2**-18), extent * 2**-22, 2**-24) * 1.01
    assert np.abs(back.log_scales - g.log_scales).max() <= 1 / 32 + 1e-5
    assert np.abs(back.opacities - g.opacities).max() <= 0.5 / 255 + 1e-6
    assert angles_rad(g, back).max() < 0.006
    inside = np.abs(g.sh[:, 0]) < 0.5 / 0.15
    assert np.abs(back.sh[:, 0] - g.sh[:, 0])[inside].max(initial=0) <= 0.5 / 255 / 0.15 + 1e-5
    for band, kept in ((slice(1, 4), bits[0]), (slice(4, None), bits[1])):
        a, b = g.sh[:, band], back.sh[:, band]
        step = 2 ** (8 - kept) / 128
        assert np.abs(a - b)[np.abs(a) < 1 - step].max(initial=0) <= step / 2 + 1e-6
    assert back.sh_degree == g.sh_degree


def test_versions_hold_the_same_and_zero_sh_stays_zero(tmp_path):
    g = random_gaussians(300)
    g.sh[::2, 1:] = 0
    for version in (3, 4):
        formats.write(tmp_path / f"{version}.spz", g, version=version)
    a, b = (formats.read(tmp_path / f"{v}.spz") for v in (3, 4))
    for name in ("means", "quats", "log_scales", "logit_opacities", "sh"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    assert (a.sh[::2, 1:] == 0).all()


def test_saturated_values_stay_finite(tmp_path):
    g = random_gaussians(4, degree=1)
    g.logit_opacities[:2] = 1e4, -1e4
    g.log_scales[0] = -np.inf
    g.quats[1] = 0
    g.sh[2] = 50
    formats.write(tmp_path / "a.spz", g)
    back = formats.read(tmp_path / "a.spz")
    for name in ("means", "quats", "log_scales", "logit_opacities", "sh"):
        assert np.isfinite(getattr(back, name)).all()
    assert back.opacities[0] > 0.998
    assert back.opacities[1] < 0.002


@pytest.mark.parametrize("version", [3, 4])
def test_independent_reader_agrees_once_its_axes_are_turned(tmp_path, version):
    """gsply reads the bytes as they are, right-up-back: half a turn about x, done by the geometry room, is ours."""
    gsply = pytest.importorskip("gsply")
    path = tmp_path / "a.spz"
    formats.write(path, random_gaussians(500), version=version)
    ours, theirs = formats.read(path), gsply.read_spz(str(path))
    raw = Gaussians(
        theirs.means,
        theirs.quats,
        theirs.scales,
        np.ravel(theirs.opacities),
        np.concatenate([theirs.sh0[:, None], theirs.shN], 1),
    )
    turned = transform_gaussians(raw, Sim3(np.diag(FLIP), np.zeros(3)))
    np.testing.assert_allclose(turned.means, ours.means, atol=1e-6)
    np.testing.assert_allclose(turned.log_scales, ours.log_scales, atol=1e-6)
    np.testing.assert_allclose(turned.opacities, ours.opacities, atol=0.3 / 255)
    np.testing.assert_allclose(turned.sh, ours.sh, atol=1e-5)
    np.testing.assert_allclose(covariances(turned), covariances(ours), rtol=1e-3, atol=1e-4)


def test_second_independent_reader_agrees(tmp_path):
    """Open3D, whose SH is rougher; in the bytes' own axes too."""
    o3d = pytest.importorskip("open3d")
    path = tmp_path / "a.spz"
    formats.write(path, random_gaussians(500))
    ours, cloud = formats.read(path), o3d.t.io.read_point_cloud(str(path)).point
    np.testing.assert_allclose(cloud["positions"].numpy() * FLIP, ours.means, atol=1e-6)
    np.testing.assert_allclose(np.log(cloud["scale"].numpy()), ours.log_scales, atol=1e-4)
    np.testing.assert_allclose(cloud["f_dc"].numpy().reshape(-1, 3), ours.sh[:, 0], atol=1e-4)


def test_we_read_what_independent_writers_write(tmp_path):
    gsply = pytest.importorskip("gsply")
    g = random_gaussians(400, degree=2)
    data = gsply.GSData.from_arrays(
        g.means, g.log_scales, g.quats, g.logit_opacities, g.sh[:, 0], g.sh[:, 1:], format="ply"
    )
    gsply.write_spz(str(tmp_path / "a.spz"), data)
    back = formats.read(tmp_path / "a.spz")
    np.testing.assert_allclose(back.means, g.means * FLIP, atol=2**-12)
    assert np.abs(back.log_scales - g.log_scales).max() < 1 / 16
    assert np.abs(back.opacities - g.opacities).max() < 1 / 255


def test_two_formats_of_one_object_agree_axes_included(shared_data):
    """biker.spz (version 4) and biker.compressed.ply come from one source: matched by position, all must agree."""
    from scipy.spatial import cKDTree

    a = formats.read(shared_data / "formats" / "biker.compressed.ply")
    b = formats.read(shared_data / "formats" / "biker.spz")
    distance, row = cKDTree(a.means).query(b.means)
    assert distance.max() < 3e-4
    alone = np.bincount(row, minlength=len(a))[row] == 1
    a, b = a[row[alone]], b[alone]
    assert len(b) > 0.99 * 152746
    assert np.percentile(angles_rad(a, b), 99) < 0.006
    assert np.percentile(np.abs(a.log_scales - b.log_scales), 99) < 0.033
    np.testing.assert_array_equal(a.logit_opacities, b.logit_opacities)
    assert np.abs(a.sh - b.sh).max() < 0.5 / 255 / 0.15 + 1e-3


def legacy(version: int, g: Gaussians) -> bytes:
    """An SPZ of version 1 or 2, written down from the format's description: half floats or fixed point, xyz bytes."""
    n = len(g)
    means = g.means * FLIP
    quats = g.quats / np.linalg.norm(g.quats, axis=1, keepdims=True)
    quats = quats[:, 1:] * np.where(quats[:, :1] < 0, -1, 1) * FLIP.prod() * FLIP
    if version == 1:
        position = means.astype("<f2").tobytes()
    else:
        position = b"".join(int(v).to_bytes(3, "little", signed=True) for v in np.round(means * 4096).ravel())
    body = [
        position,
        np.round(g.opacities * 255).astype(np.uint8).tobytes(),
        np.round((g.sh[:, 0] * 0.15 + 0.5) * 255).astype(np.uint8).tobytes(),
        np.round((g.log_scales + 10) * 16).astype(np.uint8).tobytes(),
        np.round(quats * 127.5 + 127.5).clip(0, 255).astype(np.uint8).tobytes(),
    ]
    header = struct.pack("<4sIIBBBB", b"NGSP", version, n, 0, 12 if version == 2 else 0, 0, 0)
    squeeze = zlib.compressobj(wbits=31)
    return squeeze.compress(header + b"".join(body)) + squeeze.flush()


@pytest.mark.parametrize(("version", "atol"), [(1, 4e-3), (2, 2e-4)])
def test_first_versions(tmp_path, version, atol):
    g = random_gaussians(200, degree=0)
    (tmp_path / "a.spz").write_bytes(legacy(version, g))
    back = formats.read(tmp_path / "a.spz")
    np.testing.assert_allclose(back.means, g.means, atol=atol)
    np.testing.assert_allclose(back.log_scales, g.log_scales, atol=0.04)
    assert np.median(angles_rad(g, back)) < 0.02


def with_axes(data: bytes, value: int) -> bytes:
    """The same version 4 file with the extension that names its axes."""
    toc_at = struct.unpack_from("<I", data, 16)[0]
    record = struct.pack("<III", 0xADBE0003, 4, value)
    head = data[:14] + bytes([data[14] | 2]) + data[15:16] + struct.pack("<I", toc_at + len(record))
    return head + data[20:toc_at] + record + data[toc_at:]


def test_axes_named_by_the_file_are_followed(tmp_path):
    path = tmp_path / "a.spz"
    formats.write(path, random_gaussians(50), version=4)
    plain, data = formats.read(path), path.read_bytes()
    path.write_bytes(with_axes(data, 6))  # right-down-front: nothing to turn
    as_stored = formats.read(path)
    np.testing.assert_array_equal(as_stored.means, plain.means * FLIP)
    path.write_bytes(with_axes(data, 4))  # right-up-back, named
    np.testing.assert_array_equal(formats.read(path).sh, plain.sh)
    path.write_bytes(with_axes(data, 99))
    with raises(InputError, code="unsupported_axes"):
        formats.read(path)


def test_antialiased_is_kept(tmp_path):
    for version in (3, 4):
        formats.write(tmp_path / "a.spz", random_gaussians(3), version=version, antialiased=True)
        assert formats.info(tmp_path / "a.spz").antialiased
    formats.write(tmp_path / "a.spz", random_gaussians(3))
    assert not formats.info(tmp_path / "a.spz").antialiased


def test_options_and_range_are_checked(tmp_path):
    g = random_gaussians(3)
    with raises(ConfigError, code="unsupported_output", match="version 2"):
        formats.write(tmp_path / "a.spz", g, version=2)
    with raises(ConfigError, code="out_of_range", match="sh_bits"):
        formats.write(tmp_path / "a.spz", g, sh_bits=(0, 4))
    g.means[0] = 1e8
    with raises(InputError, code="precision_loss"):
        formats.write(tmp_path / "a.spz", g)


def gzipped(header: bytes, body: bytes = b"") -> bytes:
    squeeze = zlib.compressobj(wbits=31)
    return squeeze.compress(header + body) + squeeze.flush()


HEADER = struct.Struct("<4sIIBBBB")


@pytest.mark.parametrize(
    ("data", "code", "match"),
    [
        (b"", "wrong_file_type", "it is empty"),
        (b"PK\x03\x04 no splat", "wrong_file_type", "begins with b'PK"),
        (gzipped(b"short"), "file_truncated", "16 bytes promised, 5 found"),
        (gzipped(HEADER.pack(b"PSGN", 3, 1, 0, 12, 0, 0)), "wrong_file_type", "no NGSP header"),
        (gzipped(HEADER.pack(b"NGSP", 9, 1, 0, 12, 0, 0)), "unsupported_version", "version 9"),
        (gzipped(HEADER.pack(b"NGSP", 4, 1, 0, 12, 0, 0)), "compression_mismatch", "version 4"),
        (gzipped(HEADER.pack(b"NGSP", 3, 0, 0, 12, 0, 0)), "no_gaussians", "no Gaussians"),
        (gzipped(HEADER.pack(b"NGSP", 3, 1, 5, 12, 0, 0)), "invalid_fractional_bits", "SH degree 5"),
        (gzipped(HEADER.pack(b"NGSP", 3, 1, 3, 31, 0, 0)), "invalid_fractional_bits", "31 fractional"),
        (
            gzipped(HEADER.pack(b"NGSP", 3, 100, 0, 12, 0, 0), bytes(100)),
            "file_truncated",
            "2,000 bytes promised, 100 found",
        ),
        (gzipped(HEADER.pack(b"NGSP", 3, 2**32 - 1, 3, 12, 0, 0)), "decompression_bomb", "266,240 MiB"),
        (b"NGSP" + struct.pack("<II", 4, 2**32 - 1) + bytes(20), "invalid_streams", "0 streams"),
        (
            b"NGSP" + struct.pack("<IIBBBBI", 4, 2**32 - 1, 0, 12, 0, 5, 32) + bytes(12 + 80),
            "count_mismatch",
            "4294967295 Gaussians",
        ),
        (b"NGSP" + struct.pack("<II", 3, 1) + bytes(20), "compression_mismatch", "version 3"),
        (b"\x1f\x8b\x08\x00 garbage that does not inflate", "decompression_failed", "cannot be decompressed"),
    ],
)
def test_damage_is_named(tmp_path, data, code, match):
    (tmp_path / "a.spz").write_bytes(data)
    with raises(InputError, code=code, match=match):
        formats.read(tmp_path / "a.spz")


@pytest.mark.parametrize("version", [3, 4])
def test_every_truncation_is_refused(tmp_path, version):
    path = tmp_path / "a.spz"
    formats.write(path, random_gaussians(50), version=version)
    data = path.read_bytes()
    for size in [*range(0, 140), *range(140, len(data) - 8, 97)]:
        path.write_bytes(data[:size])
        with pytest.raises(InputError):
            formats.read(path)


def test_a_bomb_costs_no_memory(tmp_path):
    """A header that promises 20 million Gaussians out of a few kilobytes, and a stream that goes on after its end."""
    path = tmp_path / "a.spz"
    path.write_bytes(gzipped(HEADER.pack(b"NGSP", 3, 20_000_000, 0, 12, 0, 0), bytes(4 << 20)))
    (tmp_path / "tail.spz").write_bytes(gzipped(HEADER.pack(b"NGSP", 3, 1, 0, 12, 2, 0), bytes(40 << 20)))
    tracemalloc.start()
    try:
        with raises(InputError, code="decompression_bomb"):
            formats.read(path)
        assert len(formats.read(tmp_path / "tail.spz")) == 1
        assert tracemalloc.get_traced_memory()[1] < 8 << 20
    finally:
        tracemalloc.stop()


def test_a_stream_shorter_than_promised_is_refused(tmp_path):
    """numcodecs fills only part of the buffer then, and says nothing."""
    from numcodecs import zstd

    path = tmp_path / "a.spz"
    formats.write(path, random_gaussians(10, degree=0), version=4)
    data = path.read_bytes()
    short = bytes(zstd.compress(bytes(40), 1))
    first = struct.unpack_from("<Q", data, 32)[0]
    toc = struct.pack("<Q", len(short)) + data[40 : 32 + 5 * 16]
    path.write_bytes(data[:32] + toc + short + data[32 + 5 * 16 + first :])
    with raises(InputError, code="count_mismatch"):
        spz.read(path)
