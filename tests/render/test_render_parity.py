"""The renderer against a float64 reference: images, gradients, every instruction set, any number of threads."""

import numpy as np
import pytest
import torch
from render_reference import render_reference
from scipy.spatial.transform import Rotation

from gsmap.render import GaussianTensors, native, render, set_num_threads
from gsmap.types import Cameras, Gaussians

BACKGROUND = (0.1, 0.2, 0.3)
SIZE = (100, 70)  # no multiple of the tile


def random_scene(k: int, n: int = 600, seed: int = 0) -> tuple[Gaussians, Cameras]:
    rng = np.random.default_rng(seed + k)
    means = rng.normal(size=(n, 3)) * [1.5, 1.2, 1] + [0, 0, 4]
    means[:20, 2] = -1  # behind the camera
    gaussians = Gaussians(
        means,
        rng.normal(size=(n, 4)),
        rng.uniform(-5, -1, size=(n, 3)),
        rng.normal(size=n) * 2,
        rng.normal(size=(n, k, 3)) * 0.4,
    )
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec([0.05, -0.08, 0.1]).as_matrix()
    T[:3, 3] = [0.1, 0.05, -0.2]
    return gaussians, Cameras(T[None], [[90, 95, 48, 36]], [SIZE])


def reference(gaussians: Gaussians, cameras: Cameras):
    leaves = [torch.tensor(a.astype(np.float64), requires_grad=True) for a in native.arrays_of(gaussians)]
    pose = torch.tensor(cameras.T_camera_frame[0], requires_grad=True)
    width, height = cameras.sizes_px[0].tolist()
    return render_reference(*leaves, pose, cameras.intrinsics_px[0], width, height, BACKGROUND), [*leaves, pose]


@pytest.mark.parametrize("k", [1, 4, 9, 16])
def test_images_match_float64(k, instruction_set):
    gaussians, cameras = random_scene(k)
    ours = render(gaussians, cameras, background=BACKGROUND, max_weight=True)
    truth, _ = reference(gaussians, cameras)
    away = (truth["cut"] > 1e-5).numpy()  # a pixel on the 1/255 or 1e-4 cut may fall either way
    assert away.mean() > 0.95
    for name, scale in (("colour", 1.0), ("alpha", 1.0), ("depth", 4.0)):
        error = np.abs(getattr(ours, name)[0] - truth[name].detach().numpy())[away] / scale
        assert np.quantile(error, 0.9999) < 1e-5, name
    assert (ours.dominant_id[0] != truth["dominant_id"].numpy())[away].mean() < 1e-3
    assert np.abs(ours.max_weight - truth["max_weight"].numpy()).max() < 1e-4


@pytest.mark.parametrize("k", [1, 4, 9, 16])
def test_gradients_match_float64(k, instruction_set):
    gaussians, cameras = random_scene(k)
    truth, leaves = reference(gaussians, cameras)
    rng = np.random.default_rng(7)
    away = truth["cut"] > 1e-4
    weights = {
        name: torch.tensor(rng.normal(size=truth[name].shape), dtype=torch.float32)
        * (away[..., None] if name == "colour" else away)
        for name in ("colour", "depth", "alpha")
    }
    sum((truth[name] * w).sum() for name, w in weights.items()).backward()

    tensors = GaussianTensors.of(gaussians, requires_grad=True)
    pose = torch.tensor(cameras.T_camera_frame, requires_grad=True)
    ours = render(tensors, cameras, background=BACKGROUND, T_camera_frame=pose)
    sum((getattr(ours, name)[0] * w).sum() for name, w in weights.items()).backward()
    for name, a, b in zip(
        ("means", "quats", "log_scales", "logits", "sh", "pose"), (*tensors.tensors(), pose), leaves, strict=True
    ):
        error = (a.grad.double().reshape(b.shape) - b.grad).norm() / b.grad.norm()
        assert error < 1e-4, f"{name}: {error}"


def test_same_bits_for_any_number_of_threads():
    gaussians, cameras = random_scene(4, n=20_000)
    results = []
    for threads in (1, 2, 5):
        set_num_threads(threads)
        tensors = GaussianTensors.of(gaussians, requires_grad=True)
        pose = torch.tensor(cameras.T_camera_frame, requires_grad=True)
        image = render(tensors, cameras, T_camera_frame=pose, max_weight=True)
        (image.colour.square().sum() + image.depth.sum() + image.alpha.sum()).backward()
        arrays = [t.grad.numpy() for t in (*tensors.tensors(), pose)]
        arrays += [
            image.colour.detach(),
            image.depth.detach(),
            image.alpha.detach(),
            image.dominant_id,
            image.max_weight,
        ]
        results.append([np.asarray(a) for a in arrays])
    set_num_threads()
    for other in results[1:]:
        for a, b in zip(results[0], other, strict=True):
            assert np.array_equal(a, b)


def test_pose_only_gradient_is_the_same():
    gaussians, cameras = random_scene(4)
    poses = []
    for requires_grad in (True, False):
        tensors = GaussianTensors.of(gaussians, requires_grad=requires_grad)
        pose = torch.tensor(cameras.T_camera_frame, requires_grad=True)
        render(tensors, cameras, T_camera_frame=pose, depth=False).colour.square().sum().backward()
        assert (tensors.means.grad is not None) == requires_grad
        poses.append(pose.grad)
    assert torch.equal(*poses)
