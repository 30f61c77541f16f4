import numpy as np
import pytest
from formats_cases import angles_rad, gaussians, random_gaussians
from hypothesis import given, settings
from raising import raises

from gsmap import formats
from gsmap.errors import InputError
from gsmap.formats import splat


@settings(max_examples=25, deadline=None)
@given(g=gaussians)
def test_round_trip_within_its_bytes(g, tmp_path_factory):
    path = tmp_path_factory.mktemp("splat") / "a.splat"
    formats.write(path, g)
    back = formats.read(path)
    np.testing.assert_array_equal(back.means, g.means)
    np.testing.assert_allclose(back.log_scales, g.log_scales, atol=1e-5)
    assert np.abs(back.opacities - g.opacities).max() <= 0.5 / 255 + 1e-6
    seen = np.clip(g.sh[:, 0] * 0.28209479 + 0.5, 0, 1)
    assert np.abs(back.sh[:, 0] * 0.28209479 + 0.5 - seen).max() <= 0.5 / 255 + 1e-6
    assert angles_rad(g, back).max() < 0.03
    assert back.sh_degree == 0


def test_one_row_by_hand(tmp_path):
    path = tmp_path / "a.splat"
    floats = np.array([1, 2, 3, 1, np.e, np.e**2], "<f4").tobytes()
    path.write_bytes(floats + bytes([255, 0, 51, 51]) + bytes([128, 192, 64, 128]))
    g = splat.read(path)
    np.testing.assert_allclose(g.means, [[1, 2, 3]])
    np.testing.assert_allclose(g.log_scales, [[0, 1, 2]], atol=1e-6)
    np.testing.assert_allclose(g.sh[0, 0] * 0.28209479 + 0.5, [1, 0, 0.2], atol=1e-6)
    np.testing.assert_allclose(g.opacities, 0.2, atol=1e-6)
    np.testing.assert_allclose(g.quats[0], [0, 0.5, -0.5, 0])


def test_degenerate_rows_stay_usable(tmp_path):
    path = tmp_path / "a.splat"
    path.write_bytes(bytes(24) + bytes([0, 0, 0, 255]) + bytes([128] * 4))
    g = splat.read(path)
    np.testing.assert_array_equal(g.quats, [[1, 0, 0, 0]])
    assert np.isfinite(g.log_scales).all()
    assert np.isfinite(g.logit_opacities).all()


@pytest.mark.parametrize("size", [0, 1, 31, 33])
def test_partial_rows_are_refused(tmp_path, size):
    path = tmp_path / "a.splat"
    path.write_bytes(bytes(size))
    with raises(InputError, code="wrong_file_type"):
        formats.read(path)


def test_nothing_or_nan_is_not_written(tmp_path):
    g = random_gaussians(5)
    with raises(InputError, code="no_gaussians"):
        formats.write(tmp_path / "a.splat", g[:0])
    g.means[3, 1] = np.nan
    with raises(InputError, code="not_finite"):
        formats.write(tmp_path / "a.splat", g)
    assert list(tmp_path.iterdir()) == []


def test_two_trainings_of_one_chair_lie_in_one_frame(shared_data):
    a = formats.read(shared_data / "formats" / "chair_gaussian.splat")
    b = formats.read(shared_data / "formats" / "chair_radegs.splat")
    box_a, box_b = (np.percentile(g.means, [1, 99], axis=0) for g in (a, b))
    np.testing.assert_allclose(box_a, box_b, atol=0.03)
