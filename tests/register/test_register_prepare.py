"""What is prepared of a scene is what registration would compute from its Gaussians."""

from dataclasses import replace

import numpy as np
import pytest

from gsmap.describe import Params, describe, find_basis
from gsmap.geometry.transforms import transform_cameras, transform_gaussians
from gsmap.register import SceneView
from gsmap.register.prepare import MAX_OWN_VIEWS, prepare, working_m_of
from gsmap.register.surface import Surface
from gsmap.register.view_cache import PreparedViews, ViewCache
from gsmap.types import Cameras, Gaussians, SceneGraph, Sim3


def _room(count: int = 4000) -> Gaussians:
    """A textured floor of 4 m."""
    rng = np.random.default_rng(0)
    means = np.c_[rng.uniform(-2, 2, (count, 2)), rng.normal(0, 0.002, count)]
    return Gaussians(
        means,
        np.tile([1.0, 0, 0, 0], (count, 1)),
        np.full((count, 3), np.log(0.04)),
        np.full(count, 4.0),
        np.concatenate([rng.uniform(-1, 1, (count, 1, 3)), rng.normal(0, 0.3, (count, 3, 3))], axis=1),
    )


def _cameras(count: int) -> Cameras:
    """Cameras 1.5 m above the floor that look down."""
    poses = np.tile(np.diag([1.0, -1, -1, 1]), (count, 1, 1))
    poses[:, :3, 3] = np.c_[np.linspace(-1, 1, count), np.zeros(count), np.full(count, 1.5)]
    return Cameras(poses, np.tile([160.0, 160, 160, 120], (count, 1)), np.tile([320, 240], (count, 1)))


@pytest.fixture(scope="module")
def prepared():
    return prepare("room", _room(), _cameras(6), 1.0)


def test_views_are_renders_within_a_grey_level_and_a_half_float(prepared):
    stored, rendered = PreparedViews(prepared), ViewCache(_room(), _cameras(6))
    assert stored.num_own == rendered.num_own == 6
    for row in range(len(stored.cameras)):
        kept, seen = stored.image(row), rendered.image(row)
        assert np.abs(kept.colour - np.clip(seen.colour, 0, 1)).max() <= 0.5 / 255 + 1e-6
        assert np.array_equal(np.isfinite(kept.depth), np.isfinite(seen.depth))
        near = np.isfinite(seen.depth)
        assert near.mean() > 0.3
        assert (np.abs(kept.depth[near] - seen.depth[near]) <= seen.depth[near] * 2.0**-11).all()


def test_cells_are_those_of_the_surface_and_face_the_cameras(prepared):
    surface = Surface.of(_room())
    assert np.allclose(prepared.points, surface.coarse[0], atol=1e-6)
    assert np.allclose(prepared.colours, surface.coarse[1], atol=1e-3)
    up = prepared.normals[:, 2] * prepared.sides
    seen = prepared.sides != 0
    assert seen.mean() > 0.6
    assert (up[seen] > 0.9).mean() > 0.95


def test_depths_are_in_working_metres_and_images_in_the_unit_of_the_scene():
    S = Sim3(np.eye(3), np.zeros(3), 10.0)
    room, cameras = transform_gaussians(_room(), S), transform_cameras(_cameras(3), S)
    found = prepare("room", room, cameras, 0.1)
    first = found.image_depths[: found.cameras.sizes_px[0].prod()].astype(float)
    assert 1.3 < np.median(first[np.isfinite(first)]) < 1.7
    depth = PreparedViews(found).image(0).depth
    assert 13 < np.median(depth[np.isfinite(depth)]) < 17
    assert np.ptp(found.points, axis=0).max() < 4.1


@pytest.mark.parametrize("policy", ["known", "auto", "unknown"])
@pytest.mark.parametrize("landmarks", [True, False])
def test_unit_is_known_before_the_graph(policy, landmarks):
    room, cameras = _room(), _cameras(3)
    params = Params(landmarks=landmarks, objects=False, things=False)
    basis = find_basis(room, cameras, params, scale_policy=policy)
    graph = describe("room", room, cameras, params, scale_policy=policy)
    assert basis.registration_m == working_m_of(graph, policy)


def test_many_cameras_give_a_bounded_number_of_views():
    found = prepare("room", _room(500), _cameras(MAX_OWN_VIEWS + 30), 1.0)
    assert found.num_own == MAX_OWN_VIEWS


def test_without_cameras_or_gaussians_there_are_no_views():
    assert len(prepare("room", _room(500), None, 1.0).cameras) == 0
    nothing = prepare("room", Gaussians.empty(), _cameras(2), 1.0)
    assert not len(nothing.points)
    assert not len(nothing.image_depths)


def test_a_view_of_a_prepared_scene_reads_its_cells(prepared):
    cells = replace(prepared, colours=np.zeros_like(prepared.colours))
    view = SceneView("room", _room(), _cameras(6), SceneGraph("room"), "known", cells)
    assert not view.surface(1.0).coarse[1].any()
    assert view.surface(2.0).coarse[1].any()  # in other metres, cells are computed from the Gaussians
    assert view.num_bytes > view.splats.num_bytes + cells.num_bytes
