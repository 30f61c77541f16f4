"""Degenerate Gaussians are harmless; wrong arguments are named."""

import os
import subprocess
import sys

import numpy as np
import pytest
import torch
from raising import raises
from test_render_parity import random_scene

from gsmap.errors import ConfigError, InputError
from gsmap.render import ChunkIndex, GaussianTensors, native, render
from gsmap.types import Cameras, Gaussians


def spoil(gaussians: Gaussians) -> Gaussians:
    """Appends one Gaussian of every degenerate kind, each in front of the camera and opaque if it were sound."""
    nan, inf = np.nan, np.inf
    base = {"means": (0.0, 0, 4), "quats": (1.0, 0, 0, 0), "log_scales": (-2.0, -2, -2), "logit_opacities": 3.0}
    kinds = [
        {"means": (nan, 0, 4)},
        {"means": (inf, 0, 4)},
        {"means": (0, 0, inf)},
        {"means": (1e30, 1e30, 1e30)},
        {"quats": (nan, 0, 0, 0)},
        {"log_scales": (nan, 0, 0)},
        {"log_scales": (inf, 0, 0)},
        {"log_scales": (60, 60, 60)},
        {"logit_opacities": nan},
        {"logit_opacities": -inf},
        {"logit_opacities": -200.0},
        {"means": (0, 0, -4), "log_scales": (5, 5, 5)},
        {"means": (0.1, 0.05, -0.2)},  # at the camera's centre
    ]
    rows = [{**base, **k} for k in kinds]
    extra = Gaussians(
        *(np.array([r[name] for r in rows]) for name in base), np.full((len(rows), gaussians.sh.shape[1], 3), 0.1)
    )
    poisoned = Gaussians(*(np.array([base[name]]) for name in base), np.full((1, gaussians.sh.shape[1], 3), nan))
    return Gaussians.concatenate([gaussians, extra, poisoned])


@pytest.mark.usefixtures("instruction_set")
def test_degenerate_gaussians_are_not_drawn_and_get_no_gradient():
    gaussians, cameras = random_scene(4, n=200)
    spoiled = spoil(gaussians)
    clean, image = render(gaussians, cameras), render(spoiled, cameras)
    for name in ("colour", "depth", "alpha", "dominant_id"):
        assert np.array_equal(getattr(clean, name), getattr(image, name)), name
    tensors = GaussianTensors.of(spoiled, requires_grad=True)
    pose = torch.tensor(cameras.T_camera_frame, requires_grad=True)
    out = render(tensors, cameras, T_camera_frame=pose)
    (out.colour.sum() + out.depth.sum() + out.alpha.sum()).backward()
    for t in (*tensors.tensors(), pose):
        assert torch.isfinite(t.grad).all()
    assert not any(t.grad[200:].any() for t in tensors.tensors())


@pytest.mark.usefixtures("instruction_set")
@pytest.mark.parametrize(
    "change",
    [
        {"log_scales": (-np.inf, -np.inf, -np.inf)},  # a point: drawn as the dilation alone
        {"log_scales": (-np.inf, 0, -3)},
        {"log_scales": (-40, -40, -40)},
        {"log_scales": (9, 9, 9)},  # wraps around the camera
        {"log_scales": (4, -12, -12)},  # a needle
        {"quats": (0, 0, 0, 0)},  # the identity
        {"quats": (1e-20, 0, 0, 0)},
        {"quats": (1e15, 0, 0, 1e15)},
        {"logit_opacities": 100.0},
        {"logit_opacities": 200.0},
        {"logit_opacities": np.inf},
        {"means": (0, 0, 0.0101)},
        {"means": (300, 0, 0.5), "log_scales": (6, 6, 6)},  # far outside the view, reaching in
    ],
)
def test_extreme_but_sound_gaussians_stay_finite(change):
    row = {
        "means": (0.0, 0, 2),
        "quats": (1.0, 0, 0, 0),
        "log_scales": (-3.0, -2, -1),
        "logit_opacities": 3.0,
        **change,
    }
    names = ("means", "quats", "log_scales", "logit_opacities")
    one = Gaussians(*(np.array([row[n]]) for n in names), np.full((1, 16, 3), 0.2))
    gaussians = Gaussians.concatenate([one, random_scene(16, n=50)[0]])
    cameras = Cameras(np.eye(4)[None], [[90, 95, 48, 36]], [[100, 70]])
    tensors = GaussianTensors.of(gaussians, requires_grad=True)
    pose = torch.tensor(cameras.T_camera_frame, requires_grad=True)
    out = render(tensors, cameras, T_camera_frame=pose, max_weight=True)
    assert all(torch.isfinite(x).all() for x in (out.colour, out.depth, out.alpha, out.max_weight))
    (out.colour.square().sum() + out.depth.sum() + out.alpha.sum()).backward()
    for name, t in zip((*names, "sh", "pose"), (*tensors.tensors(), pose), strict=True):
        assert torch.isfinite(t.grad).all(), name
    if one.logit_opacities[0] >= 100:  # as opaque as can be: d ln(opacity) / d logit = 1 - opacity
        assert abs(tensors.logit_opacities.grad[0]) < 1e-20


def test_empty_scenes_and_no_cameras():
    cameras = Cameras(np.eye(4)[None], [[90, 95, 48, 36]], [[100, 70]])
    image = render(Gaussians.empty(1), cameras, background=(0.25, 0.5, 1), max_weight=True)
    assert (image.colour == np.float32([0.25, 0.5, 1])).all()
    assert not image.alpha.any()
    assert not image.depth.any()
    assert (image.dominant_id == -1).all()
    none = render(random_scene(1)[0], cameras[[]])
    assert none.colour.shape[0] == 0
    tensors = GaussianTensors.of(Gaussians.empty(1), requires_grad=True)
    render(tensors, cameras).colour.sum().backward()
    assert tensors.means.grad.shape == (0, 3)


def test_wrong_arguments_are_input_errors():
    gaussians, cameras = random_scene(1, n=50)
    two = Cameras(np.tile(np.eye(4), (2, 1, 1)), [[90, 95, 48, 36]] * 2, [[100, 70], [50, 70]])
    with raises(InputError, code="shape_mismatch", match="share one image size"):
        render(gaussians, two)
    with raises(InputError, code="wrong_type", match="Cameras, got ndarray"):
        render(gaussians, np.eye(4))
    with raises(InputError, code="invalid_vector", match="background"):
        render(gaussians, cameras, background=(0, 0))
    with raises(InputError, code="wrong_type", match="Gaussians or GaussianTensors, got ndarray"):
        render(np.zeros((3, 3)), cameras)
    with raises(InputError, code="invalid_pose", match="T_camera_frame needs"):
        render(gaussians, cameras, T_camera_frame=torch.eye(4)[None])
    with raises(InputError, code="shape_mismatch", match="10 Gaussians"):
        render(gaussians, cameras, index=ChunkIndex.build(gaussians[:10]))
    with raises(ConfigError, code="invalid_choice", match="backend .*'vulkan'"):
        render(gaussians, cameras, backend="vulkan")
    tensors = GaussianTensors.of(gaussians)
    with raises(InputError, code="not_finite", match="T_camera_frame holds NaN"):
        render(tensors, cameras, T_camera_frame=torch.full((1, 4, 4), torch.nan))
    with raises(InputError, code="invalid_pose", match="1, 4, 4"):
        render(tensors, cameras, T_camera_frame=torch.eye(4))
    with raises(InputError, code="wrong_type", match="means must be a float32"):
        GaussianTensors(tensors.means.double(), *tensors.tensors()[1:])
    with raises(InputError, code="shape_mismatch"):
        GaussianTensors(tensors.means, tensors.quats[:, :3], *tensors.tensors()[2:])
    with raises(InputError, code="picture_too_large"):
        render(gaussians, Cameras(np.eye(4)[None], [[90, 95, 48, 36]], [[2**20, 2**20]]))


def test_inputs_need_not_be_contiguous_or_leaves():
    gaussians, cameras = random_scene(4, n=200)
    tensors = GaussianTensors.of(gaussians)
    wide = torch.zeros(200, 6)
    wide[:, ::2] = tensors.means
    wide.requires_grad_()
    image = render(GaussianTensors(wide[:, ::2], *tensors.tensors()[1:]), cameras)
    assert np.array_equal(image.colour.detach().numpy(), render(gaussians, cameras).colour)
    image.colour.sum().backward()
    assert wide.grad[:, ::2].any()
    assert not wide.grad[:, 1::2].any()


def test_the_environment_chooses_the_kernels():
    ask = "from gsmap import _native; print(_native.use_instruction_set('best'))"

    def run(name: str) -> subprocess.CompletedProcess[str]:
        env = {**os.environ, "GSMAP_INSTRUCTION_SET": name}
        return subprocess.run([sys.executable, "-c", ask], env=env, capture_output=True, text=True, check=False)

    runnable = [name for name in ("baseline", "avx2", "avx512") if native.use_instruction_set(name) == name]
    native.use_instruction_set("best")
    assert [run(name).stdout.strip() for name in runnable] == runnable
    assert run("").stdout.split() == runnable[-1:]
    refused = run("sse9")
    assert refused.returncode != 0
    assert "GSMAP_INSTRUCTION_SET=sse9: this machine runs" in refused.stderr


def test_memory_that_was_used_before_changes_no_picture():
    few, many = (random_scene(1, n)[0] for n in (50, 3000))
    camera = Cameras(np.eye(4)[None], np.array([[60.0, 60, 32, 24]]), np.array([[64, 48]]))
    first = render(few, camera)
    render(many, camera)
    again = render(few, camera)
    for name in ("colour", "alpha", "depth", "dominant_id"):
        np.testing.assert_array_equal(getattr(first, name), getattr(again, name))
    with native.workspace() as one, native.workspace() as other:
        assert one is not other
    with native.workspace() as again_one:
        assert again_one in (one, other)
