"""Gradients by finite differences, and on a crop of a trained capture."""

import json

import numpy as np
import pytest
import torch
from render_reference import render_reference
from test_render_parity import random_scene

from gsmap import formats
from gsmap.geometry.rotations import exp_so3
from gsmap.render import GaussianTensors, native, render
from gsmap.types import Cameras, Gaussians


def test_finite_differences_agree():
    """Central differences of the native forward pass along random directions, every input and the pose."""
    _, cameras = random_scene(9, n=1)
    rng = np.random.default_rng(3)
    n = 20
    soft = Gaussians(  # wider than the image and faint: nothing crosses the cuts at 1/255 and 1e-4, where it jumps
        rng.uniform([-0.5, -0.5, 3.5], [0.5, 0.5, 4.5], size=(n, 3)),
        rng.normal(size=(n, 4)),
        rng.uniform(0.5, 0.9, size=(n, 3)),
        rng.uniform(-2.5, -1.5, size=n),
        rng.normal(size=(n, 9, 3)) * 0.2,
    )
    weight = rng.normal(size=(70, 100, 3))

    def loss(arrays, cameras) -> float:
        return float((render(Gaussians(*arrays), cameras).colour[0].astype(np.float64) * weight).sum())

    tensors = GaussianTensors.of(soft, requires_grad=True)
    pose = torch.tensor(cameras.T_camera_frame, requires_grad=True)
    image = render(tensors, cameras, T_camera_frame=pose).colour[0]
    (image * torch.tensor(weight, dtype=torch.float32)).sum().backward()
    arrays = native.arrays_of(soft)
    for i, t in enumerate(tensors.tensors()):
        direction = t.grad.numpy() / np.linalg.norm(t.grad.numpy())
        direction = direction.astype(np.float64)
        h = 2e-3
        shifted = [[a + s * h * direction if j == i else a for j, a in enumerate(arrays)] for s in (1, -1)]
        slope = (loss(shifted[0], cameras) - loss(shifted[1], cameras)) / (2 * h)
        assert slope == pytest.approx(float(t.grad.norm()), rel=2e-3), i
    view = cameras.T_camera_frame[0]
    g = pose.grad[0].numpy()
    for axis in range(6):
        xi = np.zeros(6)
        xi[axis] = 1.0
        h = 1e-4

        def moved(s, xi=xi):
            T = view.copy()
            T[:3, :3] = exp_so3(s * xi[:3]) @ view[:3, :3]
            T[:3, 3] = view[:3, 3] + s * xi[3:]
            return T

        poses = [Cameras(np.linalg.inv(moved(s * h))[None], cameras.intrinsics_px, cameras.sizes_px) for s in (1, -1)]
        slope = (loss(arrays, poses[0]) - loss(arrays, poses[1])) / (2 * h)
        along = ((moved(1e-6) - moved(-1e-6)) / 2e-6 * g).sum()
        assert slope == pytest.approx(float(along), rel=2e-3, abs=2e-3 * np.abs(g).max()), axis


def test_crop_of_a_trained_capture(shared_data):
    gaussians = formats.read(shared_data / "house" / "c0.ply")
    listed = json.loads((shared_data / "house" / "c0.cameras.json").read_text())
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = listed[20]["rotation"], listed[20]["position"]
    # A window of 64 x 48 pixels in the middle of the frame, and the Gaussians that it shows.
    cameras = Cameras(T[None], [[280, 280, 32, 24]], [[64, 48]])
    visible = render(gaussians, cameras, max_weight=True).max_weight > 0
    crop = gaussians[visible]
    assert 300 < len(crop) < 30_000
    leaves = [torch.tensor(a.astype(np.float64), requires_grad=True) for a in native.arrays_of(crop)]
    pose = torch.tensor(cameras.T_camera_frame[0], requires_grad=True)
    truth = render_reference(*leaves, pose, cameras.intrinsics_px[0], 64, 48)
    tensors = GaussianTensors.of(crop, requires_grad=True)
    our_pose = torch.tensor(cameras.T_camera_frame, requires_grad=True)
    ours = render(tensors, cameras, T_camera_frame=our_pose)
    away = truth["cut"] > 1e-4
    assert away.float().mean() > 0.7
    for name in ("colour", "alpha"):
        error = (getattr(ours, name)[0].double() - truth[name]).abs()[away]
        assert torch.quantile(error, 0.9999) < 1e-5, name
    weight = torch.tensor(np.random.default_rng(0).normal(size=(48, 64, 3))) * away[..., None]
    (truth["colour"] * weight).sum().backward()
    (ours.colour[0] * weight.float()).sum().backward()
    for a, b in zip((*tensors.tensors(), our_pose), (*leaves, pose), strict=True):
        assert (a.grad.reshape(b.shape).double() - b.grad).norm() / b.grad.norm() < 1e-4
