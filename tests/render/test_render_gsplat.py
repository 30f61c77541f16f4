"""The CUDA backend against the native one, where there is a GPU and gsplat."""

import numpy as np
import pytest
import torch
from test_render_parity import random_scene

from gsmap.errors import MissingDependencyError
from gsmap.render import GaussianTensors, render
from gsmap.render.backends import gsplat_available

needs_gpu = pytest.mark.skipif(not gsplat_available(), reason="needs gsplat and a CUDA GPU")


@needs_gpu
@pytest.mark.parametrize("k", [1, 4, 9, 16])
def test_images_match_the_native_backend(k):
    gaussians, cameras = random_scene(k)
    options = {"background": (0.1, 0.2, 0.3), "max_weight": True}
    ours = render(gaussians, cameras, backend="native", **options)
    theirs = render(gaussians, cameras, backend="gsplat", **options)
    for name, scale in (("colour", 1.0), ("alpha", 1.0), ("depth", 4.0)):
        error = np.abs(getattr(ours, name) - getattr(theirs, name)) / scale
        assert np.quantile(error, 0.999) < 1e-4, name
    assert (ours.dominant_id != theirs.dominant_id).mean() < 0.01
    assert np.quantile(np.abs(ours.max_weight - theirs.max_weight), 0.99) < 1e-3


@needs_gpu
@pytest.mark.parametrize("device", ["cpu", "cuda"])
def test_gradients_match_the_native_backend(device):
    gaussians, cameras = random_scene(4)
    gradients = []
    for backend, where in (("native", "cpu"), ("gsplat", device)):
        tensors = GaussianTensors.of(gaussians, device=where, requires_grad=True)
        pose = torch.tensor(cameras.T_camera_frame, dtype=torch.float32, device=where, requires_grad=True)
        image = render(tensors, cameras, T_camera_frame=pose, backend=backend)
        assert image.colour.device.type == where
        (image.colour.square().sum() + image.alpha.sum() + 0.1 * image.depth.sum()).backward()
        # A pose moves on SE(3) only: compare the gradient along rotations and translations.
        R = torch.tensor(cameras.T_camera_frame[0, :3, :3], dtype=torch.float32)
        g = pose.grad[0, :3].cpu()
        turn = g[:, :3] @ R.T + torch.outer(g[:, 3], torch.tensor(cameras.T_camera_frame[0, :3, 3]).float())
        pose_gradient = torch.cat([(turn - turn.T).flatten(), g[:, 3]])
        gradients.append([t.grad.cpu() for t in tensors.tensors()] + [pose_gradient])
    for a, b in zip(*gradients, strict=True):
        assert (a - b).norm() / a.norm() < 1e-2


@pytest.mark.skipif(gsplat_available(), reason="gsplat is there")
def test_without_gsplat_the_error_names_the_extra():
    gaussians, cameras = random_scene(1)
    with pytest.raises(MissingDependencyError, match="cuda"):
        render(GaussianTensors.of(gaussians), cameras, backend="gsplat")
