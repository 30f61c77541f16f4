"""Covariances of poses, from definitions: Jacobians written out, changes of centre and unit, repeated fits."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from gsmap.geometry.rotations import exp_so3, retract, skew
from gsmap.geometry.similarities import Similarities
from gsmap.geometry.umeyama import umeyama
from gsmap.register.covariance import (
    Conditioning,
    PairBlocks,
    PoseUncertainty,
    UnobservedErrors,
    _measured_hessian,
    in_scene_units,
    load_model,
    uncertainty_of_correspondences,
    unobserved_log_scale,
    unobserved_motion,
)
from gsmap.register.degeneracy import point_information
from gsmap.register.surface import Surface
from gsmap.types import Sim3

MODEL = replace(load_model(coloured=False), colour_share=0.9, colour_scale_share=2.0)
NONE = UnobservedErrors(1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 1.0, 0.0)


def spd(seed: int, size: int = 7) -> np.ndarray:
    root = np.random.default_rng(seed).normal(size=(size, size))
    return root @ root.T


def test_information_of_points_is_that_of_their_motions() -> None:
    rng = np.random.default_rng(0)
    levers, weights = rng.normal(size=(6, 3)), rng.uniform(0.5, 2, 6)
    wanted = np.zeros((7, 7))
    for p, w in zip(levers, weights, strict=True):
        J = np.c_[-skew(p), np.eye(3), p]  # of a turn, a shift and a swelling about the centre
        wanted += w * J.T @ J
    np.testing.assert_allclose(point_information(levers, weights), wanted, atol=1e-12)
    np.testing.assert_allclose(point_information(levers), point_information(levers, np.ones(6)))


@pytest.mark.guards("answers")
def test_a_covariance_is_moved_from_the_overlap_to_the_origin() -> None:
    """``S T Exp(x) T^-1 = S Exp(Ad_T x)``, where T moves the origin to the overlap."""
    about, centre = spd(1), np.array([3.0, -2.0, 5.0])
    adjoint = Similarities.stack([Sim3(np.eye(3), centre)]).adjoint()[0]
    found = PoseUncertainty.about(about, centre, 2.0)
    np.testing.assert_allclose(found.covariance, adjoint @ about @ adjoint.T, rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(found.covariance, found.covariance.T)


@pytest.mark.guards("answers")
def test_sigmas_are_those_of_the_least_certain_directions_in_the_target() -> None:
    turn = exp_so3([0.3, -0.8, 0.5])
    covariance = np.zeros((7, 7))
    covariance[:3, :3] = turn @ np.diag([1e-6, 9e-6, 4e-6]) @ turn.T
    covariance[3:6, 3:6] = turn.T @ np.diag([16e-4, 1e-4, 4e-4]) @ turn
    covariance[6, 6] = 25e-6
    sigmas = PoseUncertainty.about(covariance, np.array([7.0, 0, 0]), 2.0).sigmas
    assert sigmas == pytest.approx((0.003, 0.08, 0.005))


def test_translations_are_converted_to_the_units_of_the_scene() -> None:
    """In a unit of half a metre a shift has twice the number."""
    covariance = spd(2)
    twice = np.diag([1.0, 1, 1, 2, 2, 2, 1])
    np.testing.assert_allclose(in_scene_units(covariance, 0.5), twice @ covariance @ twice)


@pytest.mark.guards("answers")
def test_fits_to_noisy_points_scatter_as_their_covariance_has_it() -> None:
    rng = np.random.default_rng(4)
    pose = Sim3(exp_so3([0.2, 0.5, -0.3]), np.array([1.0, 2, 3]), 1.5)
    source = rng.uniform(-4, 4, (60, 3)) + np.array([10.0, 0, 0])
    steps, found = [], []
    for _ in range(100):
        target = pose.apply(source) + rng.normal(0, 0.02, source.shape)
        fit = umeyama(target, source, with_scale=True)
        steps.append(Similarities.stack([pose.inverse() @ fit]).log()[0])
        found.append(uncertainty_of_correspondences((target, source), fit).covariance)
    wanted, mean = np.cov(np.array(steps).T), np.mean(found, axis=0)
    ratio = np.linalg.eigvals(np.linalg.solve(mean, wanted)).real
    assert ratio.min() > 0.4
    assert ratio.max() < 2.2


@pytest.mark.guards("answers")
def test_points_of_one_block_share_their_error() -> None:
    """The same points four times over are no more certain; far apart they would be twice as certain."""
    rng = np.random.default_rng(5)
    source = rng.uniform(-4, 4, (40, 3))
    target = source + rng.normal(0, 0.02, source.shape)
    once = uncertainty_of_correspondences((target, source), Sim3.identity(), block_m=0.01)
    often = (np.tile(target, (4, 1)), np.tile(source, (4, 1)))
    shared = uncertainty_of_correspondences(often, Sim3.identity(), block_m=0.01)
    np.testing.assert_allclose(shared.covariance, once.covariance, rtol=1e-9, atol=1e-15)


def conditioned(**changed: object) -> Conditioning:
    made = Conditioning(
        scaled=spd(6) * 1e-6,
        rigid=spd(7, 6) * 1e-6,
        scale_coupling=np.array([0.1, 0, 0, 0.5, 0, -0.2, 1.0]),
        centroid=np.array([2.0, 1.0, 0.0]),
        field_m=0.0,
        radius_m=2.0,
        colour_motion=None,
        unobserved=NONE,
        free_covariance=(np.zeros((7, 7)), np.zeros((6, 6))),
    )
    return replace(made, **changed)  # type: ignore[arg-type]


@pytest.mark.guards("answers")
def test_the_error_of_a_given_scale_moves_the_pose_along() -> None:
    made = conditioned()
    found = made.covariance_of_rigid(1.0, 0.0, 0.01, None)
    wanted = np.zeros((7, 7))
    wanted[:6, :6] = made.rigid
    wanted += 1e-4 * np.outer(made.scale_coupling, made.scale_coupling)
    np.testing.assert_allclose(found, wanted, rtol=1e-12)
    assert np.linalg.eigvalsh(made.covariance_of_rigid(1.0, 0.0, 0.0, None))[0] > 0, "regular all the same"


@pytest.mark.guards("answers")
def test_directions_that_nothing_determines_are_as_uncertain_as_they_are() -> None:
    free = np.diag([0, 0, 0, 9.0, 0, 0, 0])
    made = conditioned(free_covariance=(free, free[:6, :6]))
    scaled = made.covariance_with_scale(1.0) - conditioned().covariance_with_scale(1.0)
    np.testing.assert_allclose(scaled, free, atol=1e-9)
    rigid = made.covariance_of_rigid(1.0, 0.0, 0.01, None) - conditioned().covariance_of_rigid(1.0, 0.0, 0.01, None)
    np.testing.assert_allclose(rigid, free, atol=1e-9)


@pytest.mark.guards("answers")
def test_a_pose_under_another_scale_moves_as_its_refinement_would() -> None:
    pose = Sim3(exp_so3([0.1, 0.2, 0.3]), np.array([4.0, 5, 6]), 1.1)
    held = conditioned(scale_coupling=np.r_[np.zeros(6), 1.0])
    found = held.rescaled(pose, 1.3)
    assert found.scale == pytest.approx(1.3)
    np.testing.assert_allclose(found.apply(held.centroid), pose.apply(held.centroid), atol=1e-9)
    np.testing.assert_allclose(found.rotation, pose.rotation, atol=1e-9)
    step = 1e-5
    moved = conditioned().rescaled(pose, pose.scale * np.exp(step))
    centre = Sim3(np.eye(3), held.centroid)
    twist = Similarities.stack([(pose @ centre).inverse() @ (moved @ centre)]).log()[0] / step
    np.testing.assert_allclose(twist, conditioned().scale_coupling, atol=1e-4)


@pytest.mark.guards("answers")
def test_unobserved_errors_only_add_to_the_residuals() -> None:
    """With a field, a swelling and moving colours: each makes the pose less certain, none more."""
    colours = np.array([0.01, 0.0, 0.02, 0.03, 0.01, 0.0, 0.004])
    plain = conditioned(unobserved=MODEL, field_m=MODEL.field_m)
    steps = [
        plain.covariance_of_rigid(1.0, 0.0, 0.001, None),
        plain.covariance_of_rigid(1.0, 0.01, 0.001, None),
        plain.covariance_of_rigid(1.0, -0.02, 0.001, None),
        plain.covariance_of_rigid(1.0, -0.02, 0.001, colours),
    ]
    for less, more in pairwise(steps):
        assert (np.diag(more)[:6] > np.diag(less)[:6]).all()
    same = plain.covariance_of_rigid(1.0, 0.02, 0.001, -colours)
    np.testing.assert_allclose(same, steps[-1])
    # In a source whose unit is half a metre the same shift has twice the number.
    larger = plain.covariance_of_rigid(0.5, 0.0, 0.001, None) - steps[0]
    shift = unobserved_motion(plain.field_m, plain.radius_m, 0.0, MODEL)[1]
    np.testing.assert_allclose(np.diag(larger), [0, 0, 0, *(3 * shift**2,) * 3, 0], atol=1e-15)


def test_unobserved_errors_grow_with_the_field_and_have_limits() -> None:
    m = MODEL
    turn, shift = unobserved_motion(m.field_m, 2.0, 0.0, m)
    assert shift == pytest.approx(np.hypot(m.shift_m, m.min_shift_m))
    assert turn == pytest.approx(m.rotation_per_shift * shift / 2.0)
    _, twice = unobserved_motion(2 * m.field_m, 2.0, 0.0, m)
    assert np.sqrt(twice**2 - m.min_shift_m**2) == pytest.approx(2**m.field_power * m.shift_m)
    assert unobserved_motion(0.0, 2.0, 0.0, m)[1] == pytest.approx(m.min_shift_m)
    _, swollen = unobserved_motion(0.0, 2.0, 0.01, m)
    assert np.sqrt(swollen**2 - m.min_shift_m**2) == pytest.approx(m.shift_per_scale * 0.01 * 2.0)
    small = unobserved_log_scale(m.field_m, 1e3 * m.scale_error_m / m.max_scale_sigma, None, m)
    assert small == pytest.approx(1e-3 * m.max_scale_sigma, rel=1e-4)
    assert unobserved_log_scale(1e9, 2.0, None, m) == pytest.approx(m.max_scale_sigma, rel=1e-3)
    colours = np.array([0, 0, 0, 0, 0, 0, 0.01])
    by_colour = m.colour_scale_share * 0.01 * 2.0
    wanted = by_colour / np.hypot(2.0, by_colour / m.max_scale_sigma)
    assert unobserved_log_scale(0.0, 2.0, colours, m) == pytest.approx(wanted)
    assert unobserved_log_scale(0.0, 2.0, -colours, m) == pytest.approx(wanted)


def test_pairs_of_exact_planes_keep_about_their_curvature_when_they_are_found_again() -> None:
    """Six walls: nothing but their planes constrains the pose, whichever cells are paired."""
    rng = np.random.default_rng(6)

    def walls(seed: int) -> Surface:
        flat = np.random.default_rng(seed).uniform(0.1, 2.9, (6, 4000, 2))
        points = np.concatenate([np.insert(one, k % 3, 3.0 * (k // 3), axis=1) for k, one in enumerate(flat)])
        return Surface(points * [1.0, 0.6, 0.8], np.zeros((len(points), 3)), 0.05)

    target, source = walls(1), walls(2)
    pose = retract(Sim3.identity(), rng.normal(size=7) * 1e-3)
    blocks = PairBlocks.of(target, source, pose)
    assert blocks is not None
    measured = _measured_hessian(target, source, pose, blocks)
    root = np.linalg.inv(np.linalg.cholesky(blocks.hessian))
    np.testing.assert_allclose(measured, measured.T, rtol=1e-9, atol=1e-6)
    constrained = np.linalg.eigvalsh(root @ measured @ root.T)  # beside the curvature with fixed pairs
    assert 0.65 < constrained[0] < constrained[-1] < 1.15, "rims and corners pair otherwise"
