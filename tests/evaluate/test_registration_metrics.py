"""Registration metrics against values worked out by hand and invariances they must have."""

import numpy as np
import pytest
from raising import raises

from gsmap.errors import InputError
from gsmap.evaluate.registration import (
    PoseError,
    absolute_trajectory_error,
    pose_error,
    scene_centroid,
)
from gsmap.geometry.rotations import exp_so3
from gsmap.types import Gaussians, Sim3
from tools.bench.registration_summary import summarise


def test_pose_error_matches_the_published_definitions():
    true = Sim3(exp_so3([0.0, 0.0, 0.4]), [3.0, 4.0, 0.0], 2.0)
    estimated = Sim3(exp_so3([0.0, 0.0, 0.4 + np.radians(10)]), [3.0, 4.0, 1.0], 2.2)
    error = pose_error(estimated, true, np.zeros(3))
    assert error.rre_deg == pytest.approx(10.0, abs=1e-9)
    # GaussReg: t is divided by the scale first; |[1.5, 2, 0] - [3, 4, 1] / 2.2| / 2.5
    assert error.rte == pytest.approx(np.linalg.norm([1.5 - 3 / 2.2, 2 - 4 / 2.2, -1 / 2.2]) / 2.5)
    assert error.rse == pytest.approx(0.1)
    assert error.centroid_m == pytest.approx(1.0)


def test_centroid_error_does_not_depend_on_the_frames_origins():
    rng = np.random.default_rng(0)
    true, off = Sim3(exp_so3(rng.normal(size=3)), rng.normal(size=3)), Sim3(exp_so3([0.01, 0, 0]), [0.02, 0, 0])
    centroid = rng.normal(size=3)
    near = pose_error(true @ off, true, centroid)
    shift_t, shift_s = Sim3(np.eye(3), [50.0, -9.0, 3.0]), Sim3(np.eye(3), [-80.0, 30.0, 5.0])
    far = pose_error(
        shift_t @ true @ off @ shift_s.inverse(), shift_t @ true @ shift_s.inverse(), shift_s.apply(centroid)
    )
    assert far.centroid_m == pytest.approx(near.centroid_m, rel=1e-9)
    assert far.rre_deg == pytest.approx(near.rre_deg, rel=1e-6)
    assert far.rte != pytest.approx(near.rte, rel=0.1)


def test_small_angles_keep_their_digits():
    true = Sim3(exp_so3([0.3, -0.2, 0.9]), np.ones(3))
    error = pose_error(Sim3(true.rotation @ exp_so3([1e-9, 0, 0]), np.ones(3)), true, np.zeros(3))
    assert error.rre_deg == pytest.approx(np.degrees(1e-9), rel=1e-4)


def test_summary_counts_missing_pairs_as_missed():
    errors = [PoseError(0.1, 0.01, 0.01, 0.0), PoseError(90.0, 3.0, 1.0, 0.5), None, PoseError(3.0, 0.2, 0.05, 0.0)]
    summary = summarise(errors)
    assert (summary.num_pairs, summary.num_estimated) == (4, 3)
    assert summary.mean_rre_deg == pytest.approx(93.1 / 3)
    assert summary.median_centroid_m == pytest.approx(0.2)
    assert summary.recall["fine"] == 0.25
    assert summary.recall["coarse"] == 0.5
    assert summary.recall["rse_0.2"] == 0.5
    assert np.isnan(summarise([]).mean_rte)


def test_ate_is_zero_for_a_moved_trajectory_and_rms_otherwise():
    rng = np.random.default_rng(1)
    true = rng.normal(size=(50, 3)) * 5
    move = Sim3(exp_so3([0.3, 1.0, -2.0]), [9.0, 1.0, -4.0], 1.7)
    assert absolute_trajectory_error(move.apply(true), true, align="similarity") == pytest.approx(0, abs=1e-9)
    assert absolute_trajectory_error(move.apply(true), true) > 1.0
    assert absolute_trajectory_error(true + np.array([0.3, 0, 0.4]), true, align="none") == pytest.approx(0.5)


def test_centroid_ignores_transparent_gaussians():
    means = np.zeros((5, 3))
    means[3:] = 1000.0
    g = Gaussians(means, np.tile([1.0, 0, 0, 0], (5, 1)), np.zeros((5, 3)), [3, 3, 3, -9, -9], np.zeros((5, 1, 3)))
    assert np.allclose(scene_centroid(g), 0)
    with raises(InputError, code="no_opaque_gaussians"):
        scene_centroid(g[3:])
