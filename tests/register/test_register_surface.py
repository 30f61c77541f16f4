"""The kernels of surfaces against their definitions in numpy's float64."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from gsmap import _native
from gsmap.geometry.rotations import exp_so3
from gsmap.register.covariance import point_to_plane_jacobian
from gsmap.register.surface import Surface, surface_rows
from gsmap.types import Gaussians, Sim3


@pytest.fixture(scope="module")
def cells():
    """A wavy sheet and a wall, 40 m from the origin, and a value on them."""
    rng = np.random.default_rng(0)
    sheet = np.c_[rng.uniform(0, 3, (3000, 2)), np.zeros(3000)]
    sheet[:, 2] = 0.2 * np.sin(sheet[:, 0]) + rng.normal(size=3000) * 0.003
    wall = np.c_[rng.uniform(0, 3, 1500), np.full(1500, 3.0), rng.uniform(0, 2, 1500)]
    points = np.concatenate([sheet, wall]) + np.array([40.0, 0.0, -25.0])
    return points, 0.5 + 0.3 * np.sin(3 * points[:, 0]) * np.cos(2 * points[:, 1])


@pytest.fixture(params=[1, 3], ids=["one thread", "three threads"])
def threads(request):
    before = _native.num_threads()
    _native.set_num_threads(request.param)
    yield request.param
    _native.set_num_threads(before)


def test_nearest_points_are_those_of_brute_force(cells, threads):
    points, _ = cells
    asked = points[::7] + np.random.default_rng(1).normal(size=points[::7].shape) * 0.1
    distance, row = _native.PointTree(points).nearest(asked, 0.12)
    every = np.linalg.norm(asked[:, None] - points[None], axis=2)
    near = every.min(1) < 0.12
    assert 0.2 < near.mean() < 0.95
    assert np.array_equal(np.isfinite(distance), near)
    assert np.array_equal(row[near], every.argmin(1)[near])
    assert np.allclose(distance[near], every.min(1)[near], rtol=0, atol=1e-12)
    assert not row[~near].any()


def test_of_equally_near_points_the_first_is_taken():
    points = np.repeat(np.random.default_rng(0).uniform(size=(50, 3)), 6, axis=0)
    distance, row = _native.PointTree(points).nearest(points, 0.01)
    assert not distance.any()
    assert np.array_equal(row, np.repeat(np.arange(0, 300, 6), 6))


def test_a_tree_may_be_empty_and_takes_no_nan():
    distance, row = _native.PointTree(np.zeros((0, 3))).nearest(np.zeros((2, 3)), 1.0)
    assert np.isinf(distance).all()
    assert not row.any()
    with pytest.raises(ValueError, match="finite"):
        _native.PointTree(np.array([[0.0, np.nan, 0.0]]))


def test_normals_are_those_of_the_neighbours_planes(cells, threads):
    points, _ = cells
    found = _native.PointTree(points).normals(20)
    _, near = cKDTree(points).query(points, k=20)
    offset = points[near] - points[near].mean(1, keepdims=True)
    values, vectors = np.linalg.eigh(offset.transpose(0, 2, 1) @ offset)
    clear = values[:, 0] < 0.5 * values[:, 1]
    assert clear.mean() > 0.9
    assert np.allclose(np.linalg.norm(found, axis=1), 1.0)
    assert np.allclose(np.abs((found * vectors[:, :, 0]).sum(1))[clear], 1.0, atol=1e-7)


def test_gradients_are_least_squares_within_the_tangent_plane(cells, threads):
    points, value = cells
    tree = _native.PointTree(points)
    normals = tree.normals(20)
    found = tree.tangent_gradients(normals, value, 10, 0.05)
    _, near = cKDTree(points).query(points, k=10)
    offset = points[near] - points[:, None]
    offset -= (offset * normals[:, None]).sum(2, keepdims=True) * normals[:, None]
    system = offset.transpose(0, 2, 1) @ offset + 0.05**2 * normals[:, :, None] * normals[:, None]
    system += 0.1 * 0.05**2 * np.eye(3)
    right = (offset * (value[near] - value[:, None])[..., None]).sum(1)
    assert np.allclose(found, np.linalg.solve(system, right[..., None])[..., 0], atol=1e-7)


def _reference(onto, moving, rows, pose, centre, backward, radius, width, weight):
    """The same equations, written out."""
    points, own = moving.coarse[0][rows], moving.lightness[rows]
    moved = pose.apply(points)
    every = np.linalg.norm(moved[:, None] - onto.coarse[0][None], axis=2)
    hit = np.flatnonzero(every.min(1) < radius)
    row = every.argmin(1)[hit]
    points, moved, own = points[hit], moved[hit], own[hit]
    lever = (moved if backward else points) - centre

    def slope(along):
        if backward:
            return point_to_plane_jacobian(Sim3.identity(), lever, -along)
        return point_to_plane_jacobian(Sim3(pose.rotation, np.zeros(3), pose.scale), lever, along)

    offset, normals, gradients = moved - onto.coarse[0][row], onto.normals[row], onto.lightness_gradients[row]
    plane = (normals * offset).sum(1)
    weights = 1.0 / (1.0 + (plane / width) ** 2) ** 2
    expected = onto.lightness[row] + (gradients * offset).sum(1)
    gain = np.median(np.abs(expected - np.median(expected))) / np.median(np.abs(own - np.median(own)))
    gain = np.clip(gain, 0.5, 2.0)
    colour = expected - gain * own - (np.median(expected) - gain * np.median(own))
    spread = 1.4826 * np.median(np.abs(colour)) + 1e-6
    tint = weights / (1.0 + (colour / (2 * spread)) ** 2) ** 2 if weight else np.zeros(len(hit))
    noise = 1.4826 * np.median(np.abs(plane))
    weight = weight * max(noise, 0.03 * radius) / spread
    a, b = slope(normals), slope(gradients) * weight
    system = (a * weights[:, None]).T @ a + (b * tint[:, None]).T @ b
    gradient = (a * weights[:, None]).T @ plane + (b * tint[:, None]).T @ (colour * weight)
    extent = np.sqrt((lever**2).sum(1).mean())
    return system, gradient, len(hit), noise, lever.mean(0), extent


@pytest.mark.parametrize("backward", [False, True], ids=["forward", "backward"])
@pytest.mark.parametrize("weight", [0.0, 0.7], ids=["planes", "planes and colour"])
def test_equations_equal_their_definition(cells, threads, backward, weight):
    points, value = cells
    colours = np.repeat(value[:, None], 3, axis=1).astype(np.float32)
    S = Sim3(exp_so3([0.1, -0.2, 0.3]), [1.0, -2.0, 3.0], 1.1)
    onto = Surface(points, colours, 0.05)
    moving = Surface(S.inverse().apply(points + 0.01), 0.8 * colours + 0.05, 0.05)
    pose, rows = S @ Sim3(exp_so3([0.002, 0.0, -0.003]), [0.01, 0.0, 0.005]), moving.sample(900)
    centre = (onto if backward else moving).coarse[0].mean(0)
    expected = _reference(onto, moving, rows, pose, centre, backward, 0.1, 0.03, weight)
    assert expected[2] > 500
    partners = np.full((len(rows), 5), -1.0)

    def equations(pose):
        return _native.icp_equations(
            tree=onto.tree,
            normals=onto.normals,
            lightness=onto.lightness,
            gradients=onto.lightness_gradients if weight else None,
            points=moving.coarse[0],
            own_lightness=moving.lightness,
            rows=rows,
            partners=partners,
            pose=np.ascontiguousarray(pose.matrix()[:3]),
            centre=centre,
            backward=backward,
            radius_m=0.1,
            width_m=0.03,
            colour_weight=weight,
        )

    found = equations(pose)
    for one, other in zip(found, expected, strict=True):
        assert np.allclose(one, other, rtol=1e-9, atol=1e-9 * np.abs(other).max())
    # What is kept of earlier poses saves searching, and changes no bit.
    rng = np.random.default_rng(3)
    for step_m in (5e-4, 5e-4, 0.02, 5e-4, 5e-4, 0.03, 5e-4, 5e-4, 0.0):
        other = pose @ Sim3(exp_so3(2e-3 * step_m * rng.normal(size=3)), step_m * rng.normal(size=3))
        once = equations(other)
        kept, partners[:] = partners.copy(), -1.0
        assert all(np.array_equal(one, anew) for one, anew in zip(once, equations(other), strict=True))
        partners[:] = kept
    assert (partners[:, 3] > 0.002).mean() > 0.5


def test_equations_are_the_same_bits_whatever_the_threads(cells):
    points, value = cells
    surface = Surface(points, np.repeat(value[:, None], 3, axis=1).astype(np.float32), 0.03)
    pose = np.ascontiguousarray(Sim3(exp_so3([0.0, 0.0, 0.001]), [0.0, 0.0, 0.01]).matrix()[:3])
    before, found = _native.num_threads(), []
    for count in (1, 4):
        _native.set_num_threads(count)
        rows = surface.sample(10_000)
        found.append(
            _native.icp_equations(
                surface.tree,
                surface.normals,
                surface.lightness,
                surface.lightness_gradients,
                surface.coarse[0],
                surface.lightness,
                rows,
                np.full((len(rows), 5), -1.0),
                pose,
                points.mean(0),
                False,
                0.1,
                0.03,
                0.01,
            )
        )
    _native.set_num_threads(before)
    assert len(rows) > 2000
    assert all(np.array_equal(one, other) for one, other in zip(*found, strict=True))


def test_equations_take_nothing_that_does_not_fit(cells):
    points, value = cells
    tree, rows, pose = _native.PointTree(points), np.arange(5), np.eye(4)[:3].copy()
    partners = np.full((5, 5), -1.0)

    def ask(rows=rows, partners=partners, own=value):
        _native.icp_equations(
            tree, tree.normals(10), value, None, points, own, rows, partners, pose, np.zeros(3), False, 0.1, 0.03, 0.0
        )

    ask()
    with pytest.raises(ValueError, match="no point"):
        ask(rows=np.array([0, 1, 2, 3, len(points)]))
    with pytest.raises(ValueError, match="no cell"):
        ask(partners=np.full((5, 5), float(len(points))))
    with pytest.raises(ValueError, match="lightness each"):
        ask(own=value[1:])


@pytest.mark.parametrize(
    ("opacities", "share"),
    [
        (np.linspace(0.4, 1.0, 400), 5 / 6),  # those of at least 0.5
        (np.linspace(0.0, 0.5, 400), 0.4),  # a faint capture: its most opaque 40 %
        (np.linspace(0.0, 0.12, 400), 1 / 6),  # but none below 0.1
    ],
)
def test_surface_gaussians_are_opaque_or_the_most_opaque(opacities, share):
    x, y = np.meshgrid(np.arange(20.0), np.arange(20.0))
    order = np.random.default_rng(0).permutation(400)
    with np.errstate(divide="ignore"):
        logits = np.log(opacities / (1 - opacities))[order]
    points = 0.03 * np.c_[x.ravel(), y.ravel(), np.zeros(400)]
    quats, sh = np.tile([1.0, 0, 0, 0], (400, 1)), np.zeros((400, 1, 3))
    sheet = Gaussians(points, quats, np.full((400, 3), np.log(0.02)), np.clip(logits, -20, 20), sh)
    rows = surface_rows(sheet, 1.0)
    assert len(rows) == pytest.approx(400 * share, abs=2)
    assert opacities[order][rows].min() >= np.delete(opacities[order], rows).max()
    # The same scene in another unit, and one Gaussian as large as a floater.
    sizes = np.full((400, 3), np.log(0.08))
    sizes[rows[0]] = np.log(4.0)
    other = Gaussians(4.0 * points, quats, sizes, np.clip(logits, -20, 20), sh)
    assert surface_rows(other, 0.25).tolist() == rows[1:].tolist()
