import numpy as np
import pytest
from scipy.linalg import expm

from gsmap.geometry import similarities
from gsmap.geometry.similarities import Similarities, without_scale


def generator(xi):
    out = np.zeros((4, 4))
    w = xi[:3]
    out[:3, :3] = [[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]]
    out[:3, :3] += xi[6] * np.eye(3)
    out[:3, 3] = xi[3:6]
    return out


@pytest.fixture
def tangents():
    rng = np.random.default_rng(0)
    xi = rng.normal(0, 1, (40, 7)) * [1, 1, 1, 3, 3, 3, 0.5]
    xi[0] = 0
    xi[1] = 1e-9
    xi[2, :3], xi[3, 6] = 0, 0
    xi[4, :3] *= 3.14 / np.linalg.norm(xi[4, :3])
    return xi


def test_exp_is_the_matrix_exponential(tangents):
    got = similarities.exp(tangents)
    for k, xi in enumerate(tangents):
        np.testing.assert_allclose(got.item(k).matrix(), expm(generator(xi)), atol=1e-10)


def test_log_undoes_exp(tangents):
    small = tangents * np.minimum(1, 3 / np.maximum(1e-9, np.linalg.norm(tangents[:, :3], axis=1)))[:, None]
    np.testing.assert_allclose(similarities.exp(small).log(), small, atol=1e-9)


def test_exp_and_adjoint_agree_with_gtsam(tangents):
    gtsam = pytest.importorskip("gtsam")
    ours = similarities.exp(tangents)
    for k, xi in enumerate(tangents):
        theirs = gtsam.Similarity3.Expmap(xi)
        assert np.isclose(theirs.scale(), np.exp(ours.log_scales[k]))
        np.testing.assert_allclose(theirs.rotation().matrix(), ours.rotations[k], atol=1e-9)
        np.testing.assert_allclose(theirs.scale() * theirs.translation(), ours.translations[k], atol=1e-9)
    rigid = tangents.copy()
    rigid[:, 6] = 0
    for k, xi in enumerate(rigid):
        pose = gtsam.Pose3.Expmap(xi[:6])
        np.testing.assert_allclose(pose.matrix(), similarities.exp(rigid[k : k + 1]).item(0).matrix(), atol=1e-9)
        np.testing.assert_allclose(
            pose.AdjointMap(), similarities.exp(rigid[k : k + 1]).adjoint()[0, :6, :6], atol=1e-9
        )


def test_adjoint_moves_a_tangent_through_a_similarity(tangents):
    outer, inner = similarities.exp(tangents), tangents[::-1] * 0.1
    left = outer @ similarities.exp(inner) @ outer.inverse()
    right = similarities.exp(np.einsum("nij,nj->ni", outer.adjoint(), inner))
    np.testing.assert_allclose(left.translations, right.translations, atol=1e-9)
    np.testing.assert_allclose(left.rotations, right.rotations, atol=1e-9)
    np.testing.assert_allclose(left.log_scales, right.log_scales, atol=1e-12)


def test_commutator_is_the_derivative_of_the_adjoint(tangents):
    step = 1e-6
    ahead = similarities.exp(tangents * step).adjoint()
    np.testing.assert_allclose((ahead - np.eye(7)) / step, similarities.commutator(tangents), atol=1e-4)


def test_rows_compose_like_single_similarities(tangents):
    a, b = similarities.exp(tangents), similarities.exp(tangents[::-1])
    both, back = a @ b, a.inverse()
    points = tangents[:, 3:6]
    for k in range(len(tangents)):
        np.testing.assert_allclose(both.item(k).matrix(), (a.item(k) @ b.item(k)).matrix(), atol=1e-9)
        np.testing.assert_allclose(back.item(k).matrix(), a.item(k).inverse().matrix(), atol=1e-9)
        np.testing.assert_allclose(a.apply(points)[k], a.item(k).apply(points[k]), atol=1e-9)
    assert len(Similarities.stack([])) == 0


def test_information_whatever_the_scale_is_that_of_the_marginal():
    rng = np.random.default_rng(3)
    roots = rng.normal(size=(5, 7, 7))
    information = roots @ roots.transpose(0, 2, 1) + 0.1 * np.eye(7)
    marginal = np.linalg.inv(np.linalg.inv(information)[:, :6, :6])
    np.testing.assert_allclose(without_scale(information), marginal, rtol=1e-8, atol=1e-10)
