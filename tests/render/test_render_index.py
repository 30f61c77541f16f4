"""Rendering through an index of chunk boxes leaves nothing out."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gsmap.render import ChunkIndex, GaussianTensors, render
from gsmap.types import Cameras, Gaussians


def site(n: int, seed: int, largest: float) -> Gaussians:
    """Gaussians over 40 x 40 x 4 m, sorted by cells of 2 m so that chunks are local."""
    rng = np.random.default_rng(seed)
    means = rng.uniform(-1, 1, size=(n, 3)) * [20, 2, 20]
    cell = np.floor(means / 2).astype(int)
    means = means[np.lexsort(cell.T)]
    log_scales = rng.uniform(-5, largest, size=(n, 3))
    return Gaussians(means, rng.normal(size=(n, 4)), log_scales, rng.normal(size=n) * 2, rng.normal(size=(n, 1, 3)))


@pytest.mark.parametrize("largest", [-3.0, 0.5, 3.0])
def test_index_changes_no_bit(largest):
    gaussians = site(30_000, 0, largest)
    index = ChunkIndex.build(gaussians, chunk=100)
    rng = np.random.default_rng(1)
    skipped = 0
    for _ in range(12):
        T = np.eye(4)
        T[:3, :3] = Rotation.from_euler("yxz", rng.uniform(-1, 1, 3) * [np.pi, 0.3, 0.2]).as_matrix()
        T[:3, 3] = rng.uniform(-1, 1, 3) * [22, 1.5, 22]
        focal = rng.uniform(30, 120)  # from fisheye-like to narrow
        cameras = Cameras(T[None], [[focal, 1.1 * focal, 40, 21]], [[64, 48]])
        all_, some = render(gaussians, cameras), render(gaussians, cameras, index=index)
        for name in ("colour", "depth", "alpha", "dominant_id"):
            assert np.array_equal(getattr(all_, name), getattr(some, name)), name
        ranges = index.visible_ranges(cameras.T_camera_frame[0], cameras.intrinsics_px[0], 64, 48)
        skipped += 1 - (ranges[:, 1] - ranges[:, 0]).sum() / len(gaussians)
    if largest < 0:
        assert skipped / 12 > 0.4


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
