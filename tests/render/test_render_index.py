"""Rendering through an index of chunk boxes leaves nothing out."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gsmap.geometry.projection import project
from gsmap.geometry.sh import sh0_of_rgb
from gsmap.geometry.voxels import reached_box
from gsmap.render import ChunkIndex, GaussianTensors, render
from gsmap.render.chunked import ChunkedGaussians
from gsmap.types import Cameras, Gaussians
from gsmap.types.source import ChunkSource


def site(n: int, seed: int, largest: float) -> Gaussians:
    """Gaussians over 40 x 40 x 4 m, sorted by cells of 2 m so that chunks are local."""
    rng = np.random.default_rng(seed)
    means = rng.uniform(-1, 1, size=(n, 3)) * [20, 2, 20]
    cell = np.floor(means / 2).astype(int)
    means = means[np.lexsort(cell.T)]
    log_scales = rng.uniform(-5, largest, size=(n, 3))
    return Gaussians(means, rng.normal(size=(n, 4)), log_scales, rng.normal(size=n) * 2, rng.normal(size=(n, 1, 3)))


def some_cameras(count: int) -> list[Cameras]:
    """Cameras inside and around the site, from fisheye-like to narrow."""
    rng = np.random.default_rng(1)
    found = []
    for _ in range(count):
        T = np.eye(4)
        T[:3, :3] = Rotation.from_euler("yxz", rng.uniform(-1, 1, 3) * [np.pi, 0.3, 0.2]).as_matrix()
        T[:3, 3] = rng.uniform(-1, 1, 3) * [22, 1.5, 22]
        focal = rng.uniform(30, 120)
        found.append(Cameras(T[None], [[focal, 1.1 * focal, 40, 21]], [[64, 48]]))
    return found


@pytest.mark.parametrize("largest", [-3.0, 0.5, 3.0])
def test_index_changes_no_bit(largest):
    gaussians = site(30_000, 0, largest)
    index = ChunkIndex.build(gaussians, chunk=100)
    skipped = 0
    for cameras in some_cameras(12):
        all_, some = render(gaussians, cameras), render(gaussians, cameras, index=index)
        for name in ("colour", "depth", "alpha", "dominant_id"):
            assert np.array_equal(getattr(all_, name), getattr(some, name)), name
        ranges = index.visible_ranges(cameras.T_camera_frame[0], cameras.intrinsics_px[0], 64, 48)
        skipped += 1 - (ranges[:, 1] - ranges[:, 0]).sum() / len(gaussians)
    if largest < 0:
        assert skipped / 12 > 0.4


def test_index_changes_no_bit_where_much_is_hidden_and_depths_are_equal():
    # More than one round of the kernel, with many chunks that lie behind opaque Gaussians.
    gaussians = site(200_000, 3, -1.5)
    rng = np.random.default_rng(4)
    depths = np.repeat(rng.uniform(-20, 20, 1000), 200) + rng.uniform(-1, 1, 200_000)
    gaussians.means[:, 2] = np.round(4 * depths) / 4
    gaussians.logit_opacities[:] += 4
    index = ChunkIndex.build(gaussians, chunk=200)
    T = np.eye(4)
    T[2, 3] = -15
    cameras = Cameras(T[None], [[60, 60, 51, 33]], [[100, 70]])
    all_, some = (render(gaussians, cameras, index=i, max_weight=True) for i in (None, index))
    for name in ("colour", "depth", "alpha", "dominant_id", "max_weight"):
        assert np.array_equal(getattr(all_, name), getattr(some, name)), name
    assert (all_.alpha > 0.999).mean() > 0.5


@pytest.mark.slow
def test_too_many_intersections_of_records_that_are_kept_are_refused():
    # All chunks begin before the camera, so that all records are kept to the last round; each touches 8,160 tiles.
    gaussians = Gaussians(
        np.tile(np.float32([0, 0, 5]), (540_000, 1)),
        np.tile(np.float32([1, 0, 0, 0]), (540_000, 1)),
        np.full((540_000, 3), 4, np.float32),
        np.full(540_000, -3, np.float32),
        np.zeros((540_000, 1, 3), np.float32),
    )
    gaussians.means[::1000, 2] = -5
    cameras = Cameras(np.eye(4)[None], [[2000, 2000, 1920, 1080]], [[3840, 2160]])
    with pytest.raises(RuntimeError, match="intersections"):
        render(gaussians, cameras, depth=False, dominant_id=False, index=ChunkIndex.build(gaussians, chunk=1000))


def test_gradients_go_through_the_index():
    gaussians = site(20_000, 2, -2.0)
    index = ChunkIndex.build(gaussians, chunk=64)
    cameras = Cameras(np.eye(4)[None], [[60, 60, 32, 24]], [[64, 48]])
    gradients = []
    for i in (None, index):
        tensors = GaussianTensors.of(gaussians, requires_grad=True)
        render(tensors, cameras, index=i).colour.square().sum().backward()
        gradients.append([t.grad.numpy() for t in tensors.tensors()])
    for a, b in zip(*gradients, strict=True):
        assert np.allclose(a, b, rtol=1e-5, atol=1e-7)
    assert gradients[0][0].any()


def test_index_ignores_rows_with_nan():
    gaussians = site(1000, 3, -2.0)
    means = gaussians.means.copy()
    means[::7] = np.nan
    broken = Gaussians(means, gaussians.quats, gaussians.log_scales, gaussians.logit_opacities, gaussians.sh)
    cameras = Cameras(np.eye(4)[None], [[60, 60, 32, 24]], [[64, 48]])
    a, b = render(broken, cameras), render(broken, cameras, index=ChunkIndex.build(broken, chunk=50))
    assert np.array_equal(a.colour, b.colour)
    assert a.alpha.any()


@pytest.mark.parametrize("largest", [-3.0, 0.5, 3.0])
def test_chunks_that_are_read_when_seen_change_no_bit(largest):
    gaussians, rows, reads = site(30_000, 4, largest), 4096, {"means": [], "sh": []}

    def read(fields, start, stop, out):
        for name in fields:
            getattr(out, name)[:] = getattr(gaussians, name)[start:stop]
            reads.get(name, []).extend(range(start, stop))

    boxes = np.array([reached_box(gaussians[a : a + rows], 3.0) for a in range(0, len(gaussians), rows)])
    chunked = ChunkedGaussians(ChunkSource(len(gaussians), 0, boxes, rows, read))
    read_after = []
    for cameras in some_cameras(6):
        some, index = chunked.seen_from(cameras)
        read_after.append((len(reads["sh"]), len(reads["means"])))
        a, b = render(gaussians, cameras), render(some, cameras, index=index)
        for name in ("colour", "depth", "alpha", "dominant_id"):
            assert np.array_equal(getattr(a, name), getattr(b, name)), name
    for read in reads.values():
        assert len(read) == len(set(read))  # no row is read twice
    if largest < 0:
        assert read_after[0][1] < len(gaussians)
        assert any(colours < shapes for colours, shapes in read_after)


def test_centres_are_those_of_the_gaussians_by_their_weights():
    gaussians = site(5000, 5, -2.0)
    camera = some_cameras(1)[0]
    rendered = ChunkedGaussians.of(gaussians).render(camera, with_centres=True)
    plain = render(gaussians, camera)
    for name in ("colour", "depth", "alpha"):
        assert np.array_equal(getattr(rendered, name), getattr(plain, name)), name
    # The same by colours: each Gaussian has its own position in the image.
    at, depth = project(gaussians.means.astype(np.float64), camera.T_camera_frame[0], camera.intrinsics_px[0])
    seen = depth > 0.01
    rgb = np.zeros((len(gaussians), 3))
    rgb[seen, :2] = at[seen] + 1000  # no colour is negative
    coloured = replace(gaussians, sh=sh0_of_rgb(rgb)[:, None].astype(np.float32))
    shown = render(coloured, camera)
    solid = shown.alpha[0] > 0.5
    expected = shown.colour[0][solid][:, :2] / shown.alpha[0][solid][:, None] - 1000
    assert np.abs(rendered.centre[0][solid] - expected).max() < 0.01
    assert solid.any()
