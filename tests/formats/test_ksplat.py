"""Files put together as src/loaders/SplatBuffer.js of GaussianSplats3D lays them out."""

import struct

import numpy as np
import pytest
from formats_cases import angles_rad, random_gaussians
from raising import raises

from gsmap import formats
from gsmap.errors import InputError
from gsmap.geometry.sh import rgb_of_sh0
from gsmap.types import Gaussians

BLOCK, RANGE = 5.0, 32767


def ksplat(parts: list[Gaussians], level: int, bucket_size: int = 64, sh_range: tuple = (-1.5, 1.5)) -> bytes:
    """One section for each part; in levels 1 and 2 its Gaussians in buckets, full ones first."""
    half = "<f2" if level else "<f4"
    header = bytearray(4096)
    struct.pack_into("<BB2xIIIIHH", header, 0, 0, 1, len(parts), len(parts), 0, sum(map(len, parts)), level, 0)
    struct.pack_into("<2f", header, 36, *sh_range)
    headers, bodies = [], []
    for g in parts:
        means, meta = g.means.astype("<f4").tobytes(), b""
        rows = [g.means.astype("<f4").view(np.uint8)]
        full, partial, buckets = 0, 0, 0
        if level:
            full, rest = divmod(len(g), bucket_size)
            partial = int(rest > 0)
            buckets = full + partial
            of = np.minimum(np.arange(len(g)) // bucket_size, buckets - 1)
            centres = np.array([g.means[of == b].mean(0) for b in range(buckets)], "<f4")
            steps = np.round((g.means - centres[of]) / (BLOCK / 2 / RANGE) + RANGE)
            rows = [steps.astype("<u2").view(np.uint8)]
            meta = np.full(partial, rest, "<u4").tobytes() + centres.tobytes()
            del means
        rgba = np.concatenate([rgb_of_sh0(g.sh[:, 0]), g.opacities[:, None]], axis=1)
        rows += [g.scales.astype(half).view(np.uint8), g.quats.astype(half).view(np.uint8)]
        rows += [np.round(np.clip(rgba, 0, 1) * 255).astype(np.uint8)]
        for degree in range(1, g.sh_degree + 1):
            band = g.sh[:, degree**2 : (degree + 1) ** 2].transpose(0, 2, 1).reshape(len(g), -1)
            if level == 2:
                band = np.round((band - sh_range[0]) / (sh_range[1] - sh_range[0]) * 255).astype(np.uint8)
            else:
                band = np.ascontiguousarray(band.astype(half)).view(np.uint8)
            rows.append(band)
        section = bytearray(1024)
        struct.pack_into("<4If2H", section, 0, len(g), len(g), bucket_size, buckets, BLOCK, 12, 0)
        struct.pack_into("<4I", section, 24, 0, 0, full, partial)
        struct.pack_into("<H", section, 40, g.sh_degree)
        headers.append(bytes(section))
        bodies.append(meta + np.concatenate(rows, axis=1).tobytes())
    return bytes(header) + b"".join(headers) + b"".join(bodies)


def near(n: int, degree: int, seed: int = 0) -> Gaussians:
    """Within one block of the format, with colours and SH that it can hold."""
    g = random_gaussians(n, degree, seed, extent=1.0)
    sh = np.clip(g.sh, -1.4, 1.4)
    return Gaussians(
        g.means, g.quats / np.linalg.norm(g.quats, axis=1, keepdims=True), g.log_scales, g.logit_opacities, sh
    )


@pytest.mark.parametrize("level", [0, 1, 2])
@pytest.mark.parametrize("degree", [0, 1, 2])
def test_every_level_and_degree(tmp_path, level, degree):
    g = near(200, degree)
    (tmp_path / "a.ksplat").write_bytes(ksplat([g], level))
    back = formats.read(tmp_path / "a.ksplat")
    assert back.sh_degree == degree
    np.testing.assert_allclose(back.means, g.means, atol=1e-4 if level else 0)
    np.testing.assert_allclose(back.log_scales, g.log_scales, atol=1e-2 if level else 1e-5)
    assert angles_rad(g, back).max() < (2e-3 if level else 1e-6)
    np.testing.assert_allclose(back.opacities, g.opacities, atol=3e-3)
    np.testing.assert_allclose(back.sh[:, 1:], g.sh[:, 1:], atol=(0, 1e-3, 7e-3)[level])
    assert np.abs(back.sh[:, 0] - g.sh[:, 0]).max() < 0.008


def test_sections_of_several_degrees(tmp_path):
    parts = [near(70, 0), near(130, 2, 1)]
    (tmp_path / "a.ksplat").write_bytes(ksplat(parts, 1))
    back = formats.read(tmp_path / "a.ksplat")
    assert len(back) == 200
    assert back.sh_degree == 2
    np.testing.assert_allclose(back.means, np.concatenate([part.means for part in parts]), atol=1e-4)


def test_the_range_of_sh_is_the_files(tmp_path):
    g = near(50, 1)
    (tmp_path / "a.ksplat").write_bytes(ksplat([g], 2, sh_range=(-2.0, 3.0)))
    np.testing.assert_allclose(formats.read(tmp_path / "a.ksplat").sh[:, 1:], g.sh[:, 1:], atol=0.011)


def put(data: bytes, kind: str, at: int, *values: int) -> bytes:
    out = bytearray(data)
    struct.pack_into(kind, out, at, *values)
    return bytes(out)


@pytest.mark.parametrize(
    ("damage", "code", "match"),
    [
        (lambda d: b"", "wrong_file_type", "it has 0 bytes"),
        (lambda d: d[:4000], "wrong_file_type", "it has 4000 bytes"),
        (lambda d: d[:4200], "file_truncated", "1 sections .*4200 bytes"),
        (lambda d: d[:-1], "file_truncated", "byte 13572, .*13571"),
        (lambda d: put(d, "<B", 0, 1), "unsupported_version", "version 1.1"),
        (lambda d: put(d, "<H", 20, 3), "unsupported_version", "level 3"),
        (lambda d: put(d, "<I", 4, 0), "file_truncated", " 0 sections"),
        (lambda d: put(d, "<I", 4, 2**32 - 1), "file_truncated", "4294967295 sections"),
        (lambda d: put(d, "<I", 16, 7), "count_mismatch", " 7 Gaussians"),
        (lambda d: put(d, "<I", 4096, 2**31), "count_mismatch", "2147483648 Gaussians, but has room for 200"),
        (lambda d: put(d, "<2I", 4096, 2**31, 2**31), "file_truncated", "byte 90194318388, .*13572"),
        (lambda d: put(d, "<2I", 4096, 0, 200), "no_gaussians", "no Gaussians"),
        (lambda d: put(d, "<I", 4096 + 12, 2**32 - 1), "file_truncated", "byte 51539621064, .*13572"),
        (lambda d: put(d, "<I", 4096 + 12, 0), "invalid_buckets", " 0 buckets of 12 bytes"),
        (lambda d: put(d, "<I", 4096 + 32, 2**31), "invalid_buckets", "4 buckets of 12 bytes"),
        (lambda d: put(d, "<H", 4096 + 20, 8), "invalid_buckets", "4 buckets of 8 bytes"),
        (lambda d: put(d, "<H", 4096 + 40, 3), "unsupported_sh_degree", "SH degree 3"),
        (lambda d: put(d, "<I", 5120, 2**31), "invalid_buckets", "2147483840 Gaussians"),
    ],
)
def test_damage_is_named(tmp_path, damage, code, match):
    (tmp_path / "a.ksplat").write_bytes(damage(ksplat([near(200, 1)], 1)))
    with raises(InputError, code=code, match=match):
        formats.read(tmp_path / "a.ksplat")
