"""Captures of a synthetic place: true to the place, overlapping, and written so that gsmap reads them back."""

import json

import numpy as np
import pytest
from scipy.spatial import cKDTree

from gsmap.types import Sim3
from gsmap_synthetic import make_captures, write_captures


@pytest.fixture(scope="module")
def captures(place):
    return make_captures(
        3,
        3,
        steps=0,
        place=place,
        num_frames=24,
        num_gaussians=6000,
        size_px=(96, 72),
        scales=[1.0, 1.0, 2.5],
        vary_exposure=True,
    )


def _in_place(capture):
    return Sim3.from_matrix(capture.T_scene_world).inverse().apply(capture.gaussians.means)


def test_untrained_gaussians_lie_on_the_surfaces(place, captures):
    o3d = pytest.importorskip("open3d")
    scene = o3d.t.geometry.RaycastingScene()
    vertices, triangles = place.skin.with_shut(range(len(place.doors))).mesh()
    scene.add_triangles(o3d.core.Tensor(vertices), o3d.core.Tensor(triangles))
    for capture in captures:
        distance = scene.compute_distance(o3d.core.Tensor(_in_place(capture).astype(np.float32))).numpy()
        assert np.median(distance) < 0.005
        assert np.quantile(distance, 0.99) < 0.06


def test_own_frames_and_units(captures):
    poses = [Sim3.from_matrix(c.T_scene_world) for c in captures]
    assert [round(p.scale, 6) for p in poses] == [1.0, 1.0, 2.5]
    assert np.abs(poses[0].rotation - poses[1].rotation).max() > 0.1
    for capture, pose in zip(captures, poses, strict=True):
        heights = pose.inverse().apply(capture.cameras.centers)[:, 2]
        assert np.abs(heights - 1.5).max() < 0.2


def test_captures_overlap_pairwise(captures):
    points = [_in_place(c) for c in captures]
    for a, b in [(0, 1), (0, 2), (1, 2)]:
        shared = [(cKDTree(points[i]).query(points[j])[0] < 0.15).mean() for i, j in [(a, b), (b, a)]]
        assert 0.3 < min(shared) < 0.75


def test_same_seed_same_captures(place, captures):
    again = make_captures(
        3,
        3,
        steps=0,
        place=place,
        num_frames=24,
        num_gaussians=6000,
        size_px=(96, 72),
        scales=[1.0, 1.0, 2.5],
        vary_exposure=True,
    )
    for one, two in zip(captures, again, strict=True):
        np.testing.assert_array_equal(one.images, two.images)
        np.testing.assert_array_equal(one.gaussians.means, two.gaussians.means)
        np.testing.assert_array_equal(one.T_scene_world, two.T_scene_world)


def test_written_captures_are_found_and_read_back(tmp_path, captures):
    from gsmap.ingest import read_captures

    write_captures(tmp_path, captures, images=True)
    read = {c.name: c for c in read_captures([tmp_path / f"{c.name}.ply" for c in captures])}
    for capture in captures:
        back = read[capture.name]
        assert not back.cameras.synthesised
        np.testing.assert_allclose(back.cameras.T_frame_camera, capture.cameras.T_frame_camera, atol=1e-9)
        np.testing.assert_array_equal(back.gaussians.means, capture.gaussians.means)
        truth = json.loads((tmp_path / "truth" / f"{capture.name}.json").read_text())
        np.testing.assert_allclose(truth["T_scene_world"], capture.T_scene_world)
    assert len(list((tmp_path / "frames").glob("*.jpg"))) == 72
