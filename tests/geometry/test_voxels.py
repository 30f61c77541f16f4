import numpy as np
from raising import raises

from gsmap._native import principal_axes
from gsmap.errors import ConfigError, InputError
from gsmap.geometry.rotations import quats_to_matrices
from gsmap.geometry.voxels import (
    axis_deviations,
    covariances,
    merge_groups,
    optical_depths,
    projected_areas,
    voxel_labels,
)
from gsmap.types import Gaussians


def random_gaussians(rng, n, degree=1):
    return Gaussians(
        rng.uniform(-1, 1, size=(n, 3)),
        rng.normal(size=(n, 4)),
        rng.normal(-3, 0.5, size=(n, 3)),
        rng.normal(size=n),
        rng.normal(0, 0.3, size=(n, (degree + 1) ** 2, 3)),
    )


def mass(g):
    return optical_depths(g) * projected_areas(g.scales)


def test_points_share_a_label_exactly_where_they_share_a_cell():
    points = np.array([[0.01, 0, 0], [0.09, 0.09, 0.09], [-0.01, 0, 0], [0.11, 0, 0], [0.01, 0, 0.2]])
    labels = voxel_labels(points, 0.1)
    assert labels[0] == labels[1]
    assert len(set(labels.tolist())) == 4
    shuffled = np.array([3, 1, 4, 0, 2])
    np.testing.assert_array_equal(voxel_labels(points[shuffled], 0.1), labels[shuffled])


def test_groups_keep_mean_covariance_colour_and_stopped_light():
    rng = np.random.default_rng(0)
    g = random_gaussians(rng, 60)
    labels = np.sort(rng.permutation(np.arange(60) % 7))
    merged, heaviest = merge_groups(g, labels)
    assert len(merged) == 7
    for k in range(7):
        members = np.flatnonzero(labels == k)
        w = mass(g)[members] / mass(g)[members].sum()
        mean = w @ g.means[members]
        spread = g.means[members] - mean
        covariance = np.einsum("n,nij->ij", w, covariances(g)[members] + spread[:, :, None] * spread[:, None])
        np.testing.assert_allclose(merged.means[k], mean, atol=1e-6)
        np.testing.assert_allclose(covariances(merged)[k], covariance, rtol=1e-4, atol=1e-7)
        np.testing.assert_allclose(merged.sh[k], np.einsum("n,nkc->kc", w, g.sh[members]), atol=1e-6)
        np.testing.assert_allclose(mass(merged)[k], mass(g)[members].sum(), rtol=1e-3)
        assert heaviest[k] == members[np.argmax(w)]


def test_coinciding_gaussians_keep_their_joint_transmittance():
    g = random_gaussians(np.random.default_rng(1), 1)
    pair = Gaussians(
        np.repeat(g.means, 2, 0),
        np.repeat(g.quats, 2, 0),
        np.repeat(g.log_scales, 2, 0),
        np.array([0.3, -1.0]),
        np.repeat(g.sh, 2, 0),
    )
    merged, _ = merge_groups(pair, np.zeros(2, dtype=int))
    np.testing.assert_allclose(1 - merged.opacities[0], np.prod(1 - pair.opacities), rtol=1e-4)
    np.testing.assert_allclose(covariances(merged)[0], covariances(g)[0], rtol=1e-4, atol=1e-9)


def test_lonely_gaussians_pass_bit_for_bit():
    g = random_gaussians(np.random.default_rng(2), 20)
    merged, heaviest = merge_groups(g, np.arange(20)[::-1].copy())
    np.testing.assert_array_equal(heaviest, np.arange(20)[::-1])
    np.testing.assert_array_equal(merged.quats, g.quats[::-1])


def test_mean_shadow_of_a_sphere_and_of_a_disc():
    np.testing.assert_allclose(projected_areas(np.array([[2.0, 2, 2]])), np.pi * 4)
    # A flat disc of radius 1 throws a mean shadow of half its area.
    np.testing.assert_allclose(projected_areas(np.array([[1.0, 1, 1e-6]])), np.pi / 2, rtol=0.012)


def test_bad_input_is_refused():
    with raises(ConfigError, code="out_of_range", match="voxel size"):
        voxel_labels(np.zeros((1, 3)), 0)
    with raises(InputError, code="extent_too_large"):
        voxel_labels(np.array([[0, 0, 0], [1e30, 1e30, 1e30]]), 0.01)
    with raises(InputError, code="shape_mismatch", match="2 labels for 0"):
        merge_groups(Gaussians.empty(), np.zeros(2, dtype=int))
    assert len(merge_groups(Gaussians.empty(), np.zeros(0, dtype=int))[0]) == 0


def test_deviations_along_the_axes_are_those_of_the_covariances():
    rng = np.random.default_rng(3)
    n = 500
    quats = rng.normal(size=(n, 4)) * rng.uniform(0.1, 5, (n, 1))
    quats[7] = 0
    g = Gaussians(np.zeros((n, 3)), quats, rng.normal(-3, 1, (n, 3)), np.zeros(n), np.zeros((n, 1, 3)))
    expected = np.sqrt(np.diagonal(covariances(g), axis1=1, axis2=2))
    np.testing.assert_allclose(axis_deviations(g), expected, rtol=1e-12)


def test_principal_axes_are_those_of_numpy_and_turn_without_a_mirror():
    rng = np.random.default_rng(5)
    axes = quats_to_matrices(rng.normal(size=(400, 4)))
    axes[:30] = np.eye(3)[rng.permuted(np.tile([0, 1, 2], (30, 1)), axis=1)]  # already diagonal
    deviations = np.exp(rng.uniform(-9, 1, (400, 3)))
    deviations[100:200, 1] = deviations[100:200, 0]  # two axes alike, then three, then a disc without thickness
    deviations[200:250] = deviations[200:250, :1]
    deviations[250:300, 2] = 0.0
    covariance = (axes * deviations[:, None] ** 2) @ axes.transpose(0, 2, 1)
    covariance = (covariance + covariance.transpose(0, 2, 1)) / 2

    quats, variances = principal_axes(covariance)

    size = covariance.max((1, 2))
    turned = quats_to_matrices(quats)
    assert (
        np.abs((turned * variances[:, None]) @ turned.transpose(0, 2, 1) - covariance).max((1, 2)) < 1e-13 * size
    ).all()
    assert (np.abs(np.sort(variances, axis=1) - np.linalg.eigh(covariance)[0]).max(1) < 1e-13 * size).all()
    assert (quats[:, 0] >= 0).all()
    np.testing.assert_allclose(np.linalg.norm(quats, axis=1), 1.0, rtol=0, atol=1e-14)
