import numpy as np
import pytest
from formats_cases import angles_rad, gaussians, random_gaussians
from hypothesis import given, settings
from raising import raises

from gsmap import formats
from gsmap.errors import InputError
from gsmap.formats import compressed_ply, ply
from gsmap.geometry.morton import morton_order
from gsmap.geometry.sh import SH_C0


@settings(max_examples=25, deadline=None)
@given(g=gaussians)
def test_round_trip_within_its_bits(g, tmp_path_factory):
    path = tmp_path_factory.mktemp("compressed") / "a.compressed.ply"
    formats.write(path, g)
    back = formats.read(path)
    g = g[morton_order(g.means)]
    for start in range(0, len(g), 256):  # half a step of what the chunk spans
        a, b = g[start : start + 256], back[start : start + 256]
        bits = np.array([2047, 1023, 2047])
        assert (np.abs(a.means - b.means) <= np.ptp(a.means, axis=0) / bits * 0.51 + 1e-6 * np.abs(a.means)).all()
        assert (np.abs(a.log_scales - b.log_scales) <= np.ptp(a.log_scales, axis=0) / bits * 0.51 + 1e-6).all()
        assert (np.abs(a.sh[:, 0] - b.sh[:, 0]) <= np.ptp(a.sh[:, 0], axis=0) / 255 * 0.51 + 1e-5).all()
    assert np.abs(back.opacities - g.opacities).max() <= 0.5 / 255 + 1e-6
    assert angles_rad(g, back).max() < 0.005
    if g.sh_degree:
        assert np.abs(back.sh[:, 1:] - g.sh[:, 1:]).max() <= 1 / 64 + 1e-6
    assert back.sh_degree == g.sh_degree


def test_writing_what_was_read_changes_nothing_more(tmp_path):
    """A second round trip stays on the levels of the first."""
    formats.write(tmp_path / "a.compressed.ply", random_gaussians(1000))
    once = formats.read(tmp_path / "a.compressed.ply")
    formats.write(tmp_path / "b.compressed.ply", once)
    twice = formats.read(tmp_path / "b.compressed.ply")
    order = morton_order(once.means)
    np.testing.assert_array_equal(twice.sh[:, 1:], once.sh[order, 1:])
    np.testing.assert_array_equal(twice.logit_opacities, once.logit_opacities[order])


def test_independent_reader_reads_what_we_write(tmp_path):
    gsply = pytest.importorskip("gsply")
    path = tmp_path / "a.compressed.ply"
    formats.write(path, random_gaussians(1000))
    ours, theirs = formats.read(path), gsply.plyread(str(path))
    np.testing.assert_allclose(theirs.means, ours.means, atol=1e-5)
    np.testing.assert_allclose(theirs.scales, ours.log_scales, atol=1e-5)
    np.testing.assert_allclose(theirs.sh0, ours.sh[:, 0], atol=1e-5)
    # Of SH it leaves out the half step of the reference's reader.
    np.testing.assert_allclose(theirs.shN, ours.sh[:, 1:], atol=0.02)
    dots = np.abs((theirs.quats * ours.quats).sum(1))
    np.testing.assert_allclose(dots, 1, atol=1e-5)


@pytest.mark.parametrize("name", ["biker", "guitar"])
def test_files_of_supersplat_read_as_an_independent_reader_does(shared_data, name):
    gsply = pytest.importorskip("gsply")
    path = shared_data / "formats" / f"{name}.compressed.ply"
    ours, theirs = formats.read(path), gsply.plyread(str(path))
    np.testing.assert_allclose(ours.means, theirs.means, atol=1e-5)
    np.testing.assert_allclose(ours.log_scales, theirs.scales, atol=1e-5)
    np.testing.assert_allclose(ours.sh[:, 0], theirs.sh0, atol=1e-5)
    np.testing.assert_allclose(np.abs((theirs.quats * ours.quats).sum(1)), 1, atol=1e-5)
    theirs_opacity = 1 / (1 + np.exp(-np.asarray(theirs.opacities, float).ravel()))
    np.testing.assert_allclose(ours.opacities, theirs_opacity, atol=0.3 / 255)


def test_older_files_without_bounds_of_colours(tmp_path):
    path, old = tmp_path / "a.compressed.ply", tmp_path / "old.compressed.ply"
    formats.write(path, random_gaussians(10, degree=0))
    header = ply.read_header(path)
    data = path.read_bytes()
    lines = data[: header.data_offset].decode().splitlines()
    lines = [line for line in lines if not line.endswith(("_r", "_g", "_b"))]
    bounds = np.frombuffer(data, "<f4", 18, header.data_offset)
    old.write_bytes("\n".join([*lines, ""]).encode() + bounds[:12].tobytes() + data[header.data_offset + 72 :])
    rgb = formats.read(old).sh[:, 0] * SH_C0 + 0.5
    np.testing.assert_array_equal(np.round(rgb.max(0) * 255), 255)  # the level itself, not stretched to the bounds
    np.testing.assert_array_equal(formats.read(old).means, formats.read(path).means)


def test_it_is_known_by_its_columns_not_by_its_name(tmp_path):
    g = random_gaussians(300)
    formats.write(tmp_path / "a.compressed.ply", g)
    (tmp_path / "a.compressed.ply").rename(tmp_path / "a.ply")
    assert len(formats.read(tmp_path / "a.ply")) == 300
    formats.write(tmp_path / "b.ply", g)
    (tmp_path / "b.ply").rename(tmp_path / "b.compressed.ply")
    np.testing.assert_array_equal(formats.read(tmp_path / "b.compressed.ply").means, g.means)


def test_damage_is_named(tmp_path):
    path = tmp_path / "a.compressed.ply"
    formats.write(path, random_gaussians(300, degree=1))
    data = path.read_bytes()
    for old, new, code in (
        (b"element chunk 2", b"element chunk 1", "file_damaged"),
        (b"element vertex 300", b"element vertex 999999999999", "file_truncated"),
        (b"element chunk 2", b"element chunk 99999999999", "file_truncated"),
        (b"element sh 300", b"element sh 299", "file_damaged"),
        (b"property uint packed_scale", b"property int packed_scale", "wrong_file_type"),
        (b"property float max_z", b"property double max_z", "wrong_file_type"),
        (b"property uchar f_rest_0\n", b"", "file_damaged"),
        (b"property uchar f_rest_0\n", b"property uchar f_rest_9\n", "wrong_file_type"),
    ):
        path.write_bytes(data.replace(old, new, 1))
        with raises(InputError, code=code):
            compressed_ply.read(path)
    for cut in (len(data) - 1, len(data) // 2, 900):
        path.write_bytes(data[:cut])
        with raises(InputError, code="file_truncated"):
            compressed_ply.read(path)
