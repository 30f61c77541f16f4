"""Refiners, covariance, significance and the scale vote against known answers."""

from dataclasses import replace

import numpy as np
import pytest
from register_worlds import node_world, splat_world
from scipy.stats import norm

from gsmap.evaluate.registration import pose_error, scene_centroid
from gsmap.geometry.rotations import exp_so3, retract
from gsmap.geometry.similarities import Similarities
from gsmap.geometry.umeyama import umeyama
from gsmap.register import Params, covariance, degeneracy, error_field, surface, unit_scale
from gsmap.register.a_contrario import BackgroundModel, _log10_binomial_tail, find_inliers
from gsmap.register.correspondences import Correspondences
from gsmap.register.covariance import (
    RADIUS_M,
    condition,
    find_colour_motion,
    in_scene_units,
    load_model,
    point_to_plane_jacobian,
    uncertainty_of_correspondences,
)
from gsmap.register.metric_scene import MetricPair
from gsmap.register.refiners import colored_icp, gicp, icp
from gsmap.register.scale_selection import refine_and_select_scale
from gsmap.register.scale_vote import vote_scales
from gsmap.register.surface import Surface
from gsmap.types import Gaussians, Proposal, Sim3

NO_UNOBSERVED = replace(
    load_model(coloured=True),
    residual_factor=1.0,
    colour_share=0.0,
    colour_scale_share=0.0,
    shift_m=0.0,
    scale_error_m=0.0,
    shift_per_scale=0.0,
    min_shift_m=0.0,
)


def believed(log_scale: float, sigma: float) -> unit_scale.ScaleDecision:
    """That the scale is 1 where another was measured."""
    return unit_scale.ScaleDecision(True, log_scale, 1e-3, sigma)


@pytest.fixture(scope="module")
def world():
    return splat_world(0, points=30_000)


@pytest.fixture(scope="module")
def surfaces(world):
    return Surface.of(world.target.gaussians), Surface.of(world.source.gaussians)


def _off(pose: Sim3, about: np.ndarray, degrees: float, metres: float, factor: float = 1.0) -> Sim3:
    turn = exp_so3(np.radians(degrees) * np.array([0.6, 0.0, 0.8]))
    return pose @ Sim3(turn, about - factor * turn @ about + metres * np.array([0.0, 0.6, 0.8]), factor)


def test_colored_icp_refiner_comes_back_from_four_degrees(world, surfaces):
    centre = scene_centroid(world.source.gaussians)
    # Colours of this world are off point by point, as by default they are not thought to be.
    params = colored_icp.Params(colour_weight=1.0)
    found = colored_icp.refine(*surfaces, _off(world.S_target_source, centre, 4, 0.15), params)
    error = pose_error(found, world.S_target_source, centre)
    assert (error.rre_deg < 0.05, error.centroid_m < 0.003, found.scale) == (True, True, 1.0)


def test_icp_aligns_cells_or_the_means_themselves():
    """Half the points of every cell of the source lie off: cells average that away only in part, means pair as they
    are."""
    rng = np.random.default_rng(3)
    points = rng.uniform(0, 4, (4000, 3))
    target, source = (
        Surface(points, np.zeros((len(points), 3), np.float32), resolution_m=size) for size in (0.05, 0.8)
    )
    start = Sim3(exp_so3(np.array([0.0, 0.0, 0.004])), np.array([0.01, 0.0, -0.01]))
    cells, means = (icp.refine(target, source, start, icp.Params((0.12,), means=m)) for m in (False, True))
    errors = [np.linalg.norm(pose.apply(points) - points, axis=1).max() for pose in (cells, means)]
    assert errors[1] < 1e-6
    assert errors[0] > 1e-3


def test_colored_icp_refiner_finds_the_scale(world, surfaces):
    centre = scene_centroid(world.source.gaussians)
    found = colored_icp.refine(*surfaces, _off(world.S_target_source, centre, 2, 0.08, 1.02), with_scale=True)
    assert pose_error(found, world.S_target_source, centre).rse < 0.002


def test_scale_is_the_same_both_ways_on_rough_surfaces():
    # Laying one scene's points on the other alone, either way shrinks what is laid: by 0.15 percent each here.
    for seed in (1, 2):
        rough = splat_world(seed, points=30_000, noise_m=0.04)
        target, source = Surface.of(rough.target.gaussians), Surface.of(rough.source.gaussians)
        there = colored_icp.refine(target, source, rough.S_target_source, with_scale=True)
        back = colored_icp.refine(source, target, rough.S_target_source.inverse(), with_scale=True)
        assert abs(np.log(there.scale * back.scale)) < 0.001
        assert abs(np.log(there.scale)) < 0.003


def test_gicp_refiner_agrees(world, surfaces):
    centre = scene_centroid(world.source.gaussians)
    found = gicp.refine(*surfaces, _off(world.S_target_source, centre, 4, 0.15))
    error = pose_error(found, world.S_target_source, centre)
    assert error.rre_deg < 0.1
    assert error.centroid_m < 0.01


def test_icp_refiner_comes_back_and_gicp_is_finer():
    # All overlaps: points beyond an overlap would be pulled to its edge.
    world = splat_world(0, points=20_000, cut_m=(6.0, 0.0), with_cameras=False)
    surfaces = Surface.of(world.target.gaussians), Surface.of(world.source.gaussians)
    centre = scene_centroid(world.source.gaussians)
    start = _off(world.S_target_source, centre, 2, 0.08)
    errors = [pose_error(r.refine(*surfaces, start), world.S_target_source, centre) for r in (icp, gicp)]
    assert errors[0].rre_deg < 0.1
    assert errors[0].centroid_m < 0.03
    assert errors[1].rre_deg < errors[0].rre_deg  # points of two samplings never coincide; their planes do


def test_refiners_give_back_the_start_where_nothing_overlaps(surfaces):
    target, source = surfaces
    away = Sim3(np.eye(3), [500.0, 0, 0])
    nothing = Surface.of(Gaussians.empty())
    for refine in (colored_icp.refine, gicp.refine, icp.refine):
        assert np.allclose(refine(target, source, away).matrix(), away.matrix())
        assert refine(target, nothing, away) is away
        assert refine(nothing, source, away) is away


def test_colour_fixes_what_a_bare_wall_leaves_free():
    def wall(seed):
        p = np.c_[np.random.default_rng(seed).uniform(0, 4, (12_000, 2)), np.zeros(12_000)]
        tone = 0.5 + 0.2 * np.sin(4 * p[:, 0]) + 0.2 * np.sin(5 * p[:, 1] + p[:, 0])
        sh = ((np.stack([tone] * 3, 1) - 0.5) / 0.28209479177387814)[:, None]
        return Gaussians(p, np.tile([1.0, 0, 0, 0], (len(p), 1)), np.full((len(p), 3), -4.0), np.full(len(p), 3.0), sh)

    target, source = Surface.of(wall(1)), Surface.of(wall(2))
    start = Sim3(exp_so3([0, 0, 0.01]), [0.05, -0.01, 0.0])
    with_colour = colored_icp.refine(target, source, start)
    without = colored_icp.refine(target, source, start, colored_icp.Params(colour_weight=0))
    assert np.linalg.norm(with_colour.apply([2.0, 2, 0]) - [2.0, 2, 0]) < 0.008
    assert np.linalg.norm(without.apply([2.0, 2, 0]) - [2.0, 2, 0]) > 0.02


def test_jacobian_equals_finite_differences():
    rng = np.random.default_rng(1)
    pose = Sim3(exp_so3(rng.normal(size=3)), rng.normal(size=3), 1.7)
    points, normals = rng.normal(size=(5, 3)), rng.normal(size=(5, 3))
    analytic = point_to_plane_jacobian(pose, points, normals)
    for k in range(7):
        step = np.zeros(7)
        step[k] = 1e-6
        up = (normals * retract(pose, step).apply(points)).sum(1)
        down = (normals * retract(pose, -step).apply(points)).sum(1)
        assert np.allclose((up - down) / 2e-6, analytic[:, k], atol=1e-6)


@pytest.mark.parametrize("cut_m", [(3.8, 2.2), (6.0, 0.0)], ids=["a strip overlaps", "all overlaps"])
def test_covariance_is_as_large_as_the_errors_are(cut_m):
    """Surfaces whose every cubic metre is a centimetre off, as trainers and sensors leave them: squared errors over
    what the residuals say follow a chi-square with 6 degrees of freedom (median 5.35, 22.5 at 0.999)."""
    errors = []
    for seed in range(6):
        world = splat_world(seed, place=(seed, seed), points=20_000, cut_m=cut_m, with_cameras=False)
        target = _warped(Surface.of(world.target.gaussians), 0.01, seed)
        source = _warped(Surface.of(world.source.gaussians), 0.01, 99 + seed)
        pose = colored_icp.refine(target, source, world.S_target_source)
        covariance = (
            condition(target, source, pose, unobserved=NO_UNOBSERVED).uncertainty(pose, believed(0.0, 0.0)).covariance
        )
        off = (Similarities.stack([pose]).inverse() @ Similarities.stack([world.S_target_source])).log()[0, :6]
        errors.append(off @ np.linalg.solve(covariance[:6, :6], off))
    # Of a narrow strip residuals tell little, and fields that are alike all over it are still found possible.
    assert 5.35 / (2 if cut_m[0] == 6.0 else 8) < np.median(errors) < 5.35 * 2
    assert max(errors) < 22.5


def test_noise_of_walls_does_not_hold_what_slides_along_them():
    """A corridor without ends: nothing but the noise of its normals would tell how far along it a pose is."""

    def corridor(seed: int) -> Surface:
        rng = np.random.default_rng(seed)
        along, across, up = rng.uniform(0, 8, 9000), rng.uniform(0, 2, 9000), rng.uniform(0, 2.5, 9000)
        zero = np.zeros(3000)
        points = np.concatenate(
            [np.c_[along[:3000], across[:3000], zero]]
            + [np.c_[along[i : i + 3000], zero + y, up[i : i + 3000]] for i, y in ((3000, 0.0), (6000, 2.0))]
        )
        return Surface(points + rng.normal(0, 0.006, points.shape), np.full(points.shape, 0.5), 0.05)

    found = condition(corridor(0), corridor(1), Sim3.identity(), unobserved=NO_UNOBSERVED)
    variances, axes = np.linalg.eigh(found.covariance_of_rigid(1.0, 0.0, 0.0, None)[3:6, 3:6])
    assert np.sqrt(variances[1]) < 0.003
    assert np.sqrt(variances[2]) > 0.5  # anywhere within the overlap: nothing holds it
    assert abs(axes[0, 2]) > 0.99


def _front(rng: np.random.Generator, along: tuple[float, float], *, textured: bool = False) -> Surface:
    """A flat front and the ground before it, x along the front: nothing of them holds x, nor the scale."""
    n = int(400 * (along[1] - along[0]))
    x, other = rng.uniform(*along, 2 * n), np.r_[rng.uniform(0, 2.5, n), rng.uniform(0, 2.5, n)]
    zero = np.zeros(n)
    points = np.c_[x, np.r_[zero, other[n:]], np.r_[other[:n], zero]] + rng.normal(0, 0.004, (2 * n, 3))
    tone = 0.5 + 0.2 * np.sin(3 * x) + 0.15 * np.sin(5.3 * x + 2 * other) if textured else np.full(2 * n, 0.5)
    return Surface(points, np.repeat(tone[:, None], 3, axis=1).astype(np.float32), 0.05)


def _same_points(rng: np.random.Generator, count: int = 60) -> tuple[np.ndarray, np.ndarray]:
    """Landmarks on the part of two fronts that both show, each 3 cm off in either."""
    points = np.c_[rng.uniform(2, 6, count), rng.uniform(0, 2, count), rng.uniform(0, 2, count)]
    return points + rng.normal(0, 0.03, points.shape), points + rng.normal(0, 0.03, points.shape)


def test_motions_that_planes_leave_free_are_told_from_those_that_they_hold():
    """A front and the ground leave one translation of six motions free, and with the scale one more; a room none."""
    rng = np.random.default_rng(0)
    points = np.c_[rng.uniform(-2, 2, 3000), rng.uniform(-1, 1, 3000), rng.uniform(-1, 1, 3000)]
    for normals, free in ((np.eye(3)[rng.integers(1, 3, 3000)], True), (np.eye(3)[rng.integers(0, 3, 3000)], False)):
        on = points * (1 - normals) + normals * (1 if free else rng.choice([-1, 1], (3000, 1)))
        noisy = normals + rng.normal(0, 0.01, normals.shape)
        slope = point_to_plane_jacobian(Sim3.identity(), on, noisy / np.linalg.norm(noisy, axis=1, keepdims=True))
        for dim in (6, 7):
            system = (slope.T @ slope)[:dim, :dim]
            held = degeneracy.constrained_motions(system, degeneracy.point_information(on), 0.004, 0.05, 20)
            assert (held is not None) == free
            if free:
                assert round(np.trace(held)) == 5
                gradient = np.zeros(dim)
                gradient[3] = 1.0  # a pull along the front
                assert abs((held @ gradient)[3]) < 0.01
                if dim == 6:  # one away from it stays
                    assert (held @ np.eye(6)[4])[4] == pytest.approx(1.0, abs=0.01)


def test_a_pose_does_not_slide_along_a_bare_front():
    """Overlap of four metres of eight: pairs at its ends would pull either front over the other, by metres."""
    rng = np.random.default_rng(1)
    target, source = _front(rng, (-2.0, 6.0)), _front(rng, (2.0, 10.0))
    start = Sim3(exp_so3([0.0, 0.004, 0.0]), [0.03, 0.02, -0.02])
    for with_scale in (False, True):
        found = colored_icp.refine(target, source, start, with_scale=with_scale)
        on_both = np.array([[4.0, 0.0, 0.0]])
        moved = found.apply(on_both)[0] - on_both[0]
        assert abs(moved[0]) < 0.1  # nothing says where; it started 3 cm off
        assert np.abs(moved[1:]).max() < 0.005


def test_correspondences_hold_what_planes_leave_free_and_planes_the_rest():
    rng = np.random.default_rng(2)
    target, source = _front(rng, (-2.0, 6.0)), _front(rng, (2.0, 10.0))
    start = Sim3(exp_so3([0.0, 0.004, 0.0]), [0.3, 0.02, -0.02])
    ties = _same_points(rng)
    found = colored_icp.refine(target, source, start, correspondences=ties)
    moved = found.apply(np.array([[4.0, 1.0, 1.0]]))[0] - [4.0, 1.0, 1.0]
    alone = (ties[0] - ties[1]).mean(0)
    assert abs(moved[0] - alone[0]) < 0.003  # as correspondences have it
    assert np.abs(moved[1:]).max() < 0.002  # as planes have it, better than they


def test_what_planes_leave_free_is_known_as_well_as_correspondences_know_it():
    """Errors along the front over what the covariance says, over many draws of the correspondences."""
    rng = np.random.default_rng(3)
    target, source = _front(rng, (-2.0, 6.0)), _front(rng, (2.0, 10.0))
    ratios = []
    for _ in range(8):
        ties = _same_points(rng)
        pose = colored_icp.refine(target, source, Sim3.identity(), correspondences=ties)
        found = condition(target, source, pose, ties, NO_UNOBSERVED)
        sigma = np.sqrt(found.covariance_of_rigid(1.0, 0.0, 0.0, None)[3, 3])
        ratios.append((pose.apply(found.centroid[None])[0] - found.centroid)[0] / sigma)
    assert 0.3 < np.sqrt(np.mean(np.square(ratios))) < 2.0
    without = condition(target, source, pose, unobserved=NO_UNOBSERVED)
    assert np.sqrt(without.covariance_of_rigid(1.0, 0.0, 0.0, None)[3, 3]) > 0.5 > 50 * sigma


def test_colours_hold_what_planes_leave_free():
    rng = np.random.default_rng(4)
    target, source = (_front(rng, along, textured=True) for along in ((-2.0, 6.0), (2.0, 10.0)))
    pose = colored_icp.refine(target, source, Sim3(np.eye(3), [0.03, 0.01, 0.0]))
    found = condition(target, source, pose, unobserved=NO_UNOBSERVED)
    off = abs((pose.apply(found.centroid[None])[0] - found.centroid)[0])
    sigma = np.sqrt(found.covariance_of_rigid(1.0, 0.0, 0.0, None)[3, 3])
    assert off < 0.01
    assert off / 3 < sigma < 0.05


def test_a_pose_of_correspondences_alone_is_known_as_well_as_they_fit():
    rng, values = np.random.default_rng(5), []
    for _ in range(60):
        ties = _same_points(rng, 40)
        pose = umeyama(*ties)
        covariance = uncertainty_of_correspondences(ties, pose, block_m=0.01).covariance
        off = Similarities.stack([pose]).inverse().log()[0, :6]
        values.append(off @ np.linalg.solve(covariance[:6, :6], off))
    assert 5.35 / 1.5 < np.median(values) < 5.35 * 1.5  # a chi-square with 6 degrees of freedom
    together = uncertainty_of_correspondences(ties, pose, block_m=100.0).covariance
    assert np.allclose(together, 40 * covariance, rtol=1e-6)  # one block: one measurement


def _warped(surface: Surface, sigma_m: float, seed: int, cell_m: float = 1.0) -> Surface:
    """The surface with each cell of space shifted on its own."""
    _, cell = np.unique(np.floor(surface.points / cell_m), axis=0, return_inverse=True)
    cell = cell.ravel()
    shifts = np.random.default_rng(seed).normal(0, sigma_m, (cell.max() + 1, 3))
    return Surface(surface.points + shifts[cell], surface.colours, surface.resolution_m)


def test_covariance_moves_with_the_source_frame(world, surfaces):
    target, source = surfaces
    covariance = condition(target, source, world.S_target_source).uncertainty(world.S_target_source).covariance
    assert np.linalg.eigvalsh(covariance).min() > 0
    # The same source with its origin 40 m away: the spread of any of its points in the target stays as it was.
    shift = np.array([40.0, 0, 0])
    moved = Surface(source.points + shift, source.colours, source.resolution_m)
    pose = world.S_target_source @ Sim3(np.eye(3), -shift)
    other = condition(target, moved, pose).uncertainty(pose).covariance
    point = source.points.mean(0)
    a = point_to_plane_jacobian(world.S_target_source, np.tile(point, (3, 1)), np.eye(3))
    b = point_to_plane_jacobian(pose, np.tile(point + shift, (3, 1)), np.eye(3))
    assert np.allclose(a @ covariance @ a.T, b @ other @ b.T, rtol=0.05)


def _walls(rng, blocks: int = 150) -> error_field.Blocks:
    """Blocks on the walls, the floor and the ceiling of a room of 6 x 4 x 2.5 m; how residuals follow a pose."""
    size = np.array([6.0, 4.0, 2.5])
    positions, axis = rng.uniform(0, 1, (blocks, 3)) * size, rng.integers(0, 3, blocks)
    positions[np.arange(blocks), axis] = size[axis] * rng.integers(0, 2, blocks)
    directions = np.eye(3)[axis]
    jacobian = point_to_plane_jacobian(Sim3.identity(), positions - positions.mean(0), directions)
    return error_field.Blocks(jacobian, np.zeros(blocks), positions, directions, np.full(blocks, 1e9))


def test_errors_are_judged_by_the_restricted_likelihood_of_one_field(monkeypatch):
    """With one length and one share there is nothing to average: the generalised least squares written out."""
    rng = np.random.default_rng(3)
    blocks = replace(_walls(rng), residual=rng.normal(size=150) * 0.01, counts=rng.uniform(3, 90, 150))
    monkeypatch.setattr(error_field, "LENGTHS_M", (1.5,))
    monkeypatch.setattr(error_field, "SHARES", (0.3,))
    influence = rng.normal(size=(4, 150))
    found = error_field.estimate_errors(blocks, influence)
    distance = np.linalg.norm(blocks.positions[:, None] - blocks.positions[None], axis=2)
    K = 0.3 * np.exp(-distance / 1.5) * (blocks.directions @ blocks.directions.T)
    K += np.diag(0.7 * (1 + error_field.SMALL_BLOCK / blocks.counts))
    X, y, W = blocks.jacobian, blocks.residual, np.linalg.inv(K)
    left = y - X @ np.linalg.solve(X.T @ W @ X, X.T @ W @ y)
    variance = left @ W @ left / (150 - 7 - 2)
    assert np.allclose(found.covariance, variance * influence @ K @ influence.T)
    assert found.field_m == pytest.approx(np.sqrt(0.3 * variance))


@pytest.mark.parametrize("length_m", [0.0, 1.0, 4.0], ids=["noise", "a metre", "four metres"])
def test_errors_of_a_field_are_found_whatever_its_length(length_m):
    """A thousandfold repeated room: squared errors of least squares over what its residuals say, on average 7."""
    rng = np.random.default_rng(7)
    blocks, values, fields = _walls(rng), [], []
    distance = np.linalg.norm(blocks.positions[:, None] - blocks.positions[None], axis=2)
    K = 1e-6 * np.eye(150)
    if length_m:
        K += 4e-6 * np.exp(-distance / length_m) * (blocks.directions @ blocks.directions.T)
    root, influence = np.linalg.cholesky(K), np.linalg.pinv(blocks.jacobian)
    for _ in range(40):
        noise = root @ rng.normal(size=150)
        off = influence @ noise
        found = error_field.estimate_errors(replace(blocks, residual=noise - blocks.jacobian @ off), influence)
        values.append(off @ np.linalg.solve(found.covariance, off))
        fields.append(found.field_m)
    assert 6.35 / 2 < np.median(values) < 6.35 * 1.5
    assert (np.median(fields) < 5e-4) == (length_m == 0.0)  # true: 0 or 2 mm


def test_too_few_blocks_say_nothing():
    blocks = _walls(np.random.default_rng(0), 9)
    assert error_field.estimate_errors(blocks, np.eye(9)) is None


def test_what_leaves_no_residual_is_added_where_residuals_are_large(world, surfaces):
    """Over the overlap's radius, as the square of the errors that residuals show, and in proportion to the swelling."""
    target, source = surfaces
    pose = world.S_target_source
    hidden = replace(
        NO_UNOBSERVED,
        residual_factor=1.0,
        colour_share=0.0,
        colour_scale_share=0.0,
        shift_m=0.02,
        scale_error_m=0.03,
        shift_per_scale=0.4,
        rotation_per_shift=0.5,
        field_m=0.004,
        field_power=2.0,
        min_shift_m=0.003,
    )
    bare, found = (condition(target, source, pose, unobserved=h) for h in (NO_UNOBSERVED, hidden))
    growth = (bare.field_m / 0.004) ** 2
    near = np.isfinite(target.nearest(pose.apply(source.coarse[0]), RADIUS_M)[0])
    inside = source.coarse[0][near]
    radius = np.sqrt(((inside - inside.mean(0)) ** 2).sum(1).mean())
    swell = growth * 0.03 / radius
    swell = 1 / np.sqrt(1 / swell**2 + 1 / 0.02**2)  # no sensor is off by much more than 2 percent
    for told, added in (
        (swell, found.covariance_with_scale(1.0) - bare.covariance_with_scale(1.0)),
        (0.01, found.covariance_of_rigid(1.0, -0.01, 0.0, None) - bare.covariance_of_rigid(1.0, -0.01, 0.0, None)),
    ):
        shift = np.sqrt((growth * 0.02) ** 2 + (0.4 * told * radius) ** 2 + 0.003**2)
        assert np.allclose(np.sqrt(np.diag(added)[:6]), np.r_[np.full(3, 0.5 * shift / radius), np.full(3, shift)])
    assert found.log_scale_sigma == pytest.approx(np.hypot(bare.log_scale_sigma, swell))
    assert np.sqrt(found.covariance_with_scale(1.0)[6, 6]) == pytest.approx(found.log_scale_sigma)


def _textured(surface: Surface, into: Sim3, shift_m: float = 0.0) -> Surface:
    """The surface with a smooth texture that lies fixed in the target's frame, but for a shift along its x axis."""
    at = into.apply(surface.points) - [shift_m, 0.0, 0.0]
    waves = np.stack([np.sin(at @ k) for k in ((9.0, 5.0, 3.0), (-4.0, 10.0, 6.0), (5.0, -6.0, 11.0))], axis=1)
    return Surface(surface.points, (0.5 + 0.2 * waves).astype(np.float32), surface.resolution_m)


def test_colours_that_lie_otherwise_than_planes_widen_the_pose(world, surfaces):
    """Textures that lie 2 cm off on their surfaces, as where colours and depths do not belong together: planes fit as
    before, and nothing of their residuals tells."""
    pose = world.S_target_source
    told = replace(NO_UNOBSERVED, colour_share=0.5, colour_scale_share=0.7)
    target = _textured(surfaces[0], Sim3.identity())
    right, off = (_textured(surfaces[1], pose, shift_m) for shift_m in (0.0, 0.02))
    bare, found = condition(target, off, pose, unobserved=NO_UNOBSERVED), condition(target, off, pose, unobserved=told)
    still = find_colour_motion(target, right, pose, bare.centroid, with_scale=False)
    colour_motion = find_colour_motion(target, off, pose, bare.centroid, with_scale=False)
    assert np.linalg.norm(still[3:6]) < 0.002 < 0.005 < np.linalg.norm(colour_motion[3:6]) < 0.025
    assert (pose.rotation @ colour_motion[3:6])[0] < -0.9 * np.linalg.norm(colour_motion[3:6])
    assert colour_motion[6] == 0.0
    # As much as they would move it, on average over axes, the pose is more uncertain about the overlap's middle.
    rigid = [c.covariance_of_rigid(1.0, 0.0, 0.0, colour_motion) for c in (found, bare)]
    added = np.diag(rigid[0] - rigid[1])
    assert np.allclose(added[:3], 0.25 * (colour_motion[:3] ** 2).mean())
    assert np.allclose(added[3:6], 0.25 * (colour_motion[3:6] ** 2).mean())
    added = np.diag(found.covariance_with_scale(1.0) - bare.covariance_with_scale(1.0))
    assert np.allclose(added[3:6], 0.25 * (found.colour_motion[3:6] ** 2).mean())
    told_swell = 0.7 * abs(found.colour_motion[6])
    assert added[6] == pytest.approx(1 / (1 / told_swell**2 + 1 / 0.02**2))
    # What the pair itself is said to know of the rigid pose rests on the motion of that pose.
    wide, narrow = (found.uncertainty(pose, believed(0.0, 0.0), s).sigmas for s in (colour_motion, still))
    assert wide[1] > 1.5 * narrow[1]


def test_where_a_surface_has_no_colours_the_model_for_grey_ones_holds(world, surfaces):
    grey = [Surface(s.points, np.full(s.points.shape, 0.5, np.float32), s.resolution_m) for s in surfaces]
    pose = world.S_target_source
    told = replace(NO_UNOBSERVED, shift_m=0.02, field_power=0.0)
    found = condition(*grey, pose, unobserved=told)
    bare = condition(*grey, pose, unobserved=NO_UNOBSERVED)
    assert found.colour_motion is None
    assert find_colour_motion(grey[0], surfaces[1], pose, found.centroid, with_scale=False) is None
    assert np.allclose(np.diag(found.covariance_with_scale(1.0) - bare.covariance_with_scale(1.0))[3:6], 0.02**2)


def test_what_a_known_scale_reveals_of_the_sensors_widens_the_pose(world, surfaces):
    """The same residuals: where surfaces in metres measure 1 % too large, their sensors hide more than where they fit;
    translations of a source in another unit are told in that."""
    target, source = surfaces
    pose = world.S_target_source
    found = condition(target, source, pose)
    fits, swells = (found.uncertainty(pose, believed(off, 0.0)).sigmas for off in (0.0, 0.01))
    assert swells[1] ** 2 - fits[1] ** 2 == pytest.approx(
        (found.unobserved.shift_per_scale * 0.01 * found.radius_m) ** 2
    )
    assert swells[0] > fits[0]
    hidden = [
        found.covariance_of_rigid(s, 0.01, 0.0, None) - found.covariance_of_rigid(s, 0.0, 0.0, None) for s in (1.0, 4.0)
    ]
    assert np.allclose(hidden[1][3:6, 3:6], hidden[0][3:6, 3:6] / 16)


@pytest.mark.guards("answers")
def test_a_rigid_pose_knows_what_its_scale_could_move(world, surfaces):
    """Refined under a scale that is 0.3 percent wrong, a pose moves as its covariance says of that much scale."""
    target, source = surfaces
    pose = world.S_target_source
    conditioned = condition(target, source, pose, unobserved=NO_UNOBSERVED)
    wrong = conditioned.rescaled(pose, 1.003)
    assert wrong.scale == pytest.approx(1.003)
    again = colored_icp.refine(target, source, wrong, schedule=colored_icp.Schedule((0.06,), (20_000,)))
    centre = np.median(source.points, axis=0)
    moved = [np.linalg.norm(again.apply(centre) - other.apply(centre)) for other in (wrong, pose)]
    assert moved[0] < 0.003
    assert moved[0] < 0.5 * moved[1]
    sure, unsure = (conditioned.uncertainty(pose, believed(0.0, sigma)).covariance for sigma in (0.0, 0.003))
    off = (Similarities.stack([pose]).inverse() @ Similarities.stack([again])).log()[0]
    assert off @ np.linalg.solve(sure, off) > 1e4
    assert off @ np.linalg.solve(unsure, off) < 7
    assert np.sqrt(unsure[6, 6]) == pytest.approx(0.003)
    # Near a corner, growing moves: with nothing else uncertain, what the scale moved is one standard deviation.
    near = np.linalg.norm(pose.apply(source.points) - [3.0, 0.0, 0.3], axis=1) < 1.0
    corner = condition(
        target, Surface(source.points[near], source.colours[near], source.resolution_m), pose, unobserved=NO_UNOBSERVED
    )
    alone = replace(corner, rigid=1e-9 * np.eye(6)).uncertainty(pose, believed(0.0, 0.003)).covariance
    moved = corner.rescaled(pose, np.exp(0.003))
    off = (Similarities.stack([pose]).inverse() @ Similarities.stack([moved])).log()[0]
    assert off @ np.linalg.solve(alone, off) == pytest.approx(1.0, rel=0.05)


@pytest.mark.parametrize(("factor", "voted"), [(0.96, 1.0), (1.04, 1.02)])
def test_a_scale_some_percent_off_is_reached_from_a_pose_that_it_put_off(factor, voted):
    world = splat_world(3, scale=factor)
    S, centre = world.S_target_source, np.median(world.source.gaussians.means, axis=0)
    start = Sim3(S.rotation, S.apply(centre) - voted * S.rotation @ centre + [0.0, 0.15, 0.15], voted)
    pair = MetricPair.of(world.target, world.source, Proposal("test", start, False, 50), Params())
    pose, known, decision = refine_and_select_scale(pair, pair.to_metres(start), Params(), with_scale=False)
    assert abs(pair.to_scene_units(pose).scale / factor - 1) < 0.002
    assert decision.log_scale == pytest.approx(np.log(factor), abs=0.002)
    assert not decision.rigid
    assert known.sigmas[2] == pytest.approx(decision.measured_sigma)
    assert decision.measured_sigma == decision.log_scale_sigma


def test_an_edge_is_as_wide_as_its_colours_say(monkeypatch):
    """The whole way of a pair: colours of this world are off point by point, so they would move the pose a little."""
    world = splat_world(3)
    pair = MetricPair.of(world.target, world.source, Proposal("test", world.S_target_source, False, 50), Params())
    sigmas = []
    for share in (0.0, 50.0):
        model = replace(NO_UNOBSERVED, colour_share=share)
        monkeypatch.setattr(covariance, "load_model", lambda *, coloured, model=model: model)
        pose, known, decision = refine_and_select_scale(pair, world.S_target_source, Params(), with_scale=False)
        assert decision.rigid
        sigmas.append(known.sigmas)
    surfaces = pair.target.surface(), pair.source.surface()
    centroid = condition(*surfaces, pose, unobserved=NO_UNOBSERVED).centroid
    colour_motion = find_colour_motion(*surfaces, pose, centroid, with_scale=False)
    told = 50 * np.sqrt((colour_motion[3:6] ** 2).mean())
    assert np.sqrt(sigmas[1][1] ** 2 - sigmas[0][1] ** 2) == pytest.approx(told, rel=0.1)


def test_covariance_in_scene_units_scales_translations_only():
    covariance = np.diag(np.arange(1.0, 8.0))
    moved = in_scene_units(covariance, 0.5)
    assert np.allclose(np.diag(moved), [1, 2, 3, 16, 20, 24, 7])


def test_a_small_overlap_knows_angles_and_scale_less_well(world, surfaces):
    target, source = surfaces
    pose = world.S_target_source
    inside = pose.apply(source.points)
    near = np.linalg.norm(inside - [3.0, 0.0, 0.5], axis=1) < 0.8
    part = Surface(source.points[near], source.colours[near], source.resolution_m)
    all_of_it, little = (condition(target, s, pose).uncertainty(pose).sigmas for s in (source, part))
    assert little[0] > 2 * all_of_it[0]
    assert little[2] > 2 * all_of_it[2]


def test_a_measured_scale_is_one_or_what_was_measured():
    """One where that is more probable than a drift; and then as sure as Bayes' rule, written out, makes it."""
    grid = np.linspace(-0.2, 0.2, 400_001)
    said = set()
    for log_scale, sigma in [(0.0, 0.001), (-0.0028, 0.001), (-0.0029, 0.001), (0.00034, 1e-4), (0.00037, 1e-4),
                             (0.0114, 0.005), (0.0118, 0.005), (0.02, 0.02), (0.0, 0.2), (-0.02, 0.0005)]:  # fmt: skip
        found = unit_scale.decide_scale(log_scale, sigma)
        drifts = norm.pdf(grid, 0, 0.02) * norm.pdf(log_scale, grid, sigma)
        share = 3 * norm.pdf(log_scale, 0, sigma) / (drifts.sum() * (grid[1] - grid[0]))
        said.add(found.rigid)
        assert found.rigid == (share > 1)
        if found.rigid:
            assert found.log_scale_sigma == pytest.approx(np.sqrt(drifts @ grid**2 / drifts.sum()), rel=1e-3)
        else:
            assert found == unit_scale.ScaleDecision(False, log_scale, sigma, sigma)
    assert said == {True, False}


def test_sources_that_were_told_to_be_metric_stay_so_and_disagreement_is_said():
    agrees, disagrees = (unit_scale.decide_scale(x, 0.001, specified=True) for x in (0.003, -0.02))
    assert agrees.rigid
    assert not agrees.note
    assert disagrees.rigid
    assert "-1.98% (20 sigma)" in disagrees.note
    assert disagrees.log_scale_sigma == pytest.approx(0.02, rel=0.01)  # 1 is taken, and is known to be that far off


def test_surfaces_that_measure_another_size_than_their_residuals_explain_are_said_to_bend():
    rigid = unit_scale.ScaleDecision(True, -0.008, 0.005, 0.008)
    said = unit_scale.bending_note(rigid, 0.0005, 6.0)
    assert "the source's lengths differ by +0.8% over 6.0 m, 16 times" in said
    assert unit_scale.bending_note(rigid, 0.003, 6.0) == ""  # residuals explain it
    assert unit_scale.bending_note(replace(rigid, log_scale=-0.0015), 0.0001, 6.0) == ""  # nobody needs to know
    assert unit_scale.bending_note(replace(rigid, rigid=False), 0.0005, 6.0) == ""  # the scale differs, and is measured
    assert unit_scale.bending_note(replace(rigid, note="disagrees"), 0.0005, 6.0) == ""  # was said


def test_surface_leaves_out_what_is_faint_or_huge(monkeypatch):
    g = Gaussians(np.arange(12.0).reshape(4, 3), np.tile([1.0, 0, 0, 0], (4, 1)),
                  np.log([[0.02] * 3, [0.02] * 3, [3.0] * 3, [0.02] * 3]), [3.0, -3.0, 3.0, 3.0],
                  np.zeros((4, 1, 3)))  # fmt: skip
    monkeypatch.setattr(surface, "MAX_SCALE_QUANTILE", 0.0)
    kept = Surface.of(g, unit_m=2.0)
    assert np.allclose(kept.points, 2.0 * g.means[[0, 3]])


def test_binomial_tail_far_out():
    from scipy.stats import binom

    for n, k, p in [(50, 10, 0.02), (200, 100, 0.01), (30, 1, 0.5)]:
        assert _log10_binomial_tail(n, k, p) == pytest.approx(binom.logsf(k - 1, n, p) / np.log(10), rel=1e-9)


def test_random_partners_are_never_significant_and_a_planted_pose_is():
    scores = []
    for seed in range(20):
        world = node_world(seed, shared=40, extra=60, wrong=300)
        rng = np.random.default_rng(seed)
        m = world.matches
        shuffled = rng.permutation(len(m))
        wrong = Correspondences(m.target, m.source[shuffled], m.target_ids, m.source_ids[shuffled], m.similarity)
        # The best of many three-point poses, as a clique would find it.
        from gsmap.register.clique import maximum_clique
        from gsmap.register.consistency import consistency_graph
        from gsmap.register.pose import fit_pose

        members = wrong[maximum_clique(consistency_graph(wrong)).members]
        pose = fit_pose(members.target, members.source).S_target_source
        scores.append(BackgroundModel(world.target, world.source, world.source.positions, wrong).log10_nfa(pose))
        background = BackgroundModel(world.target, world.source, world.source.positions, m)
        right = background.log10_nfa(world.S_target_source)
        assert right < -10
    assert min(scores) > -2


def test_agreeing_is_one_to_one():
    m = Correspondences(
        np.zeros((3, 3)), np.array([[0.01, 0, 0], [0.0, 0, 0], [9.0, 0, 0]]),
        np.array([0, 0, 1], np.int32), np.array([0, 1, 2], np.int32), np.ones(3, np.float32),
    )  # fmt: skip
    assert find_inliers(m, Sim3.identity(), 0.1).tolist() == [False, True, False]


@pytest.mark.parametrize("scale", [0.8, 1.0, 1.25])
def test_scale_vote(scale):
    world = node_world(3, shared=60, wrong=400, scale=scale)
    best, score = vote_scales(world.matches)[0]
    assert abs(np.log(best / scale)) < 0.015
    assert score > 5


@pytest.mark.parametrize("heights", [True, False])
def test_ratio_histogram_equals_its_definition(heights):
    from gsmap import _native

    rng = np.random.default_rng(5)
    n, limit, bins = 150, 0.6, 48
    target, source = rng.normal(size=(2, n, 3)) * 2 + 1e4
    ids = rng.integers(0, 100, (2, n)).astype(np.int32)
    rises = (target[:, 2].copy(), source[:, 2].copy()) if heights else (None, None)
    got = _native.ratio_histogram(target, source, *ids, *rises, 1.0, 0.3, limit, bins)
    i, j = np.triu_indices(n, 1)
    dt, ds = (np.linalg.norm(p[i] - p[j], axis=1) for p in (target, source))
    use = (dt > 1.0) & (ds > 1.0) & (ids[:, i] != ids[:, j]).all(0)
    if heights:
        use &= np.abs((rises[0][i] - rises[0][j]) / dt - (rises[1][i] - rises[1][j]) / ds) <= 0.3
    expected, _ = np.histogram(np.log(dt[use] / ds[use]), bins, (-limit, limit))
    assert expected.sum() > 500
    # float32 may differ exactly on a threshold
    assert abs(got.sum() - expected.sum()) <= 2
    assert np.abs(np.cumsum(got) - np.cumsum(expected)).max() <= 3


def test_photometric_refiner_lays_renders_over_each_other(monkeypatch):
    from gsmap.geometry.transforms import transform_gaussians
    from gsmap.register.refiners import photometric

    world = splat_world(4, points=30_000)
    scene, cameras, S = world.target.gaussians, world.target.cameras, world.S_target_source
    target = Surface.of(scene, cameras=cameras)
    source = Surface.of(transform_gaussians(scene, S.inverse()))
    centre = scene_centroid(source.gaussians)
    start = _off(S, centre, 0.3, 0.015)
    monkeypatch.setattr(photometric, "MAX_ITERATIONS", 6)
    found = photometric.refine(target, source, start)
    before, after = (pose_error(p, S, centre) for p in (start, found))
    assert after.rre_deg < 0.2 * before.rre_deg
    assert after.centroid_m < 0.2 * before.centroid_m
    away = Sim3(np.eye(3), [500.0, 0, 0])
    assert photometric.refine(target, source, away) is away
    assert photometric.refine(Surface.of(scene), source, start) is start  # without cameras there is nothing to see


def test_photometric_refiner_reads_each_scene_in_its_own_unit():
    from gsmap.geometry.transforms import transform_gaussians
    from gsmap.register.refiners import photometric

    world = splat_world(4, points=15_000)
    metric = world.target.gaussians
    quarter = Sim3(np.eye(3), np.zeros(3), 4.0)
    answers = []
    for unit_m, scene in ((1.0, metric), (0.25, transform_gaussians(metric, quarter))):
        target = Surface.of(metric, cameras=world.target.cameras)
        source = Surface.of(scene, unit_m)
        start = Sim3(exp_so3([0.0, 0.004, 0.0]), [0.01, 0.0, 0.0])
        answers.append(photometric.refine(target, source, start).matrix())
    assert not np.allclose(answers[0], start.matrix(), atol=1e-4)
    assert np.allclose(*answers, atol=1e-4)


def test_equations_of_corresponding_points_are_the_derivatives_of_their_distances():
    rng = np.random.default_rng(3)
    source, pose = rng.uniform(-3, 3, (20, 3)), Sim3(exp_so3([0.4, -0.2, 1.0]), np.array([1.0, 2.0, -1.0]), 1.3)
    target = pose.apply(source) + rng.normal(0, 0.1, source.shape)
    here, centre = retract(pose, np.array([0.02, -0.01, 0.03, 0.1, -0.05, 0.07, 0.02])), Sim3(np.eye(3), source.mean(0))
    points = colored_icp.PointConstraints((target, source))
    best = umeyama(target, source, with_scale=True)
    variance = ((best.apply(source) - target) ** 2).mean()

    def cost(step):
        moved = retract(here @ centre, step) @ centre.inverse()
        return 0.5 * ((moved.apply(source) - target) ** 2).sum() * 0.01**2 / variance

    information, gradient = points.equations(here, centre.translation, 0.01)
    steps = 1e-5 * np.eye(7)
    np.testing.assert_allclose(gradient, [(cost(s) - cost(-s)) / 2e-5 for s in steps], rtol=1e-5)
    there = points.equations(best, centre.translation, 0.01)
    np.testing.assert_allclose(there[1], 0, atol=1e-9)  # the closed form is the minimum
    levers = source - centre.translation
    np.testing.assert_allclose(information[6, 6], here.scale**2 * (levers**2).sum() * 0.01**2 / variance)
