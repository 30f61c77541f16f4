"""The optimiser against torch's Adam and against what it is for."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from raising import raises
from test_render_parity import random_scene

from gsmap._native import image_loss
from gsmap.errors import InputError
from gsmap.render import FitOptions, GaussianTensors, LearningRates, render, set_num_threads
from gsmap.render.native_fit import NativeFitter
from gsmap.types import Gaussians


def structural_similarity(a, b):
    """Wang et al. 2004 with zero padding, mean over pixels and channels."""
    tap = torch.exp(-((torch.arange(11) - 5.0) ** 2) / (2 * 1.5**2))
    window = (tap[:, None] * tap / tap.sum() ** 2).to(a.dtype).expand(3, 1, 11, 11)
    a, b = a.permute(2, 0, 1)[None], b.permute(2, 0, 1)[None]
    blur = lambda x: F.conv2d(x, window, padding=5, groups=3)  # noqa: E731
    ma, mb = blur(a), blur(b)
    va, vb, cov = blur(a * a) - ma * ma, blur(b * b) - mb * mb, blur(a * b) - ma * mb
    return ((2 * ma * mb + 1e-4) * (2 * cov + 9e-4) / ((ma * ma + mb * mb + 1e-4) * (va + vb + 9e-4))).mean()


@pytest.mark.parametrize(("ssim_weight", "delta", "momentum"), [(0.0, 0.0, 0.9), (0.2, 0.0, 0.9), (0.2, 0.2, 0.5)])
def test_steps_equal_torch_adam(ssim_weight, delta, momentum):
    gaussians, cameras = random_scene(4, n=400)
    target = np.random.default_rng(0).uniform(size=(1, 70, 100, 3)).astype(np.float32)
    rates = LearningRates(means=1e-3)
    betas = momentum, 0.999
    options = FitOptions(ssim_weight=ssim_weight, huber_delta=delta, betas=betas, epsilon=1e-8)
    fitter = NativeFitter(gaussians, rates, options=options)
    tensors = GaussianTensors.of(gaussians, requires_grad=True)
    base = tensors.sh.detach()[:, :1].clone().requires_grad_()
    rest = tensors.sh.detach()[:, 1:].clone().requires_grad_()
    pairs = [
        (tensors.means, rates.means),
        (tensors.quats, rates.quats),
        (tensors.log_scales, rates.log_scales),
        (tensors.logit_opacities, rates.logit_opacities),
        (base, rates.sh_base),
        (rest, rates.sh_rest),
    ]
    adam = torch.optim.Adam([{"params": [p], "lr": r} for p, r in pairs], betas=betas, eps=1e-8)
    for _ in range(5):
        loss = fitter.step(cameras, target)
        adam.zero_grad()
        leaves = GaussianTensors(*tensors.tensors()[:4], torch.cat([base, rest], 1))
        image = render(leaves, cameras, depth=False, dominant_id=False).colour[0]
        truth = torch.from_numpy(target[0])
        colours = F.huber_loss(image, truth, delta=delta) / delta if delta else (image - truth).abs().mean()
        theirs = (1 - ssim_weight) * colours
        theirs = theirs + ssim_weight * (1 - structural_similarity(image, truth))
        theirs.backward()
        adam.step()
        assert loss == pytest.approx(theirs.item(), abs=1e-6)
    moved = fitter.gaussians()
    seen = fitter._updates == 5  # what no pixel shows in some step stands still there; torch moves it on
    assert 200 < seen.sum() < 400
    for name in ("means", "quats", "log_scales", "logit_opacities"):
        assert np.abs(getattr(moved, name) - getattr(tensors, name).detach().numpy())[seen].max() < 1e-5, name
    assert np.abs(moved.sh - torch.cat([base, rest], 1).detach().numpy())[seen].max() < 1e-5
    # Gaussians behind the camera stay exactly where they were
    assert np.array_equal(moved.means[:20], gaussians.means[:20])


@pytest.mark.usefixtures("instruction_set")
@pytest.mark.parametrize(("height", "width"), [(1, 1), (7, 3), (200, 37)])
def test_the_loss_of_an_image_and_its_gradient_are_torch_s_whatever_cuts_it_into_bands(height, width):
    try:
        rng = np.random.default_rng(width)
        ours, wanted = rng.uniform(size=(2, height, width, 3)).astype(np.float32)
        found = []
        for threads in (1, 3):
            set_num_threads(threads)
            gradient = np.empty_like(ours)
            found.append((image_loss(ours, wanted, None, 1.0, 0.0, gradient), gradient))
    finally:
        set_num_threads()
    image = torch.from_numpy(ours).double().requires_grad_()
    loss = 1 - structural_similarity(image, torch.from_numpy(wanted).double())
    loss.backward()
    assert found[0][0] == found[1][0] == pytest.approx(loss.item(), abs=1e-5)
    assert np.array_equal(found[0][1], found[1][1])
    assert np.abs(found[0][1] - image.grad.numpy()).max() < 1e-4 * image.grad.abs().max().item()


def test_fit_brings_back_the_image_and_leaves_frozen_ones_alone():
    gaussians, cameras = random_scene(4, n=400)
    target = render(gaussians, cameras).colour
    rng = np.random.default_rng(1)
    off = Gaussians(
        gaussians.means + rng.normal(size=(400, 3)) * 0.02,
        gaussians.quats,
        gaussians.log_scales + 0.1,
        gaussians.logit_opacities,
        gaussians.sh + 0.1,
    )
    frozen = np.arange(400) % 4 == 0
    results = []
    for threads in (1, 3):
        set_num_threads(threads)
        fitter = NativeFitter(off, LearningRates(means=1e-3, sh_base=1e-2), frozen=frozen)
        losses = [fitter.step(cameras, target) for _ in range(60)]
        assert losses[-1] < 0.5 * losses[0]
        results.append(fitter.gaussians())
    set_num_threads()
    for name in ("means", "quats", "log_scales", "logit_opacities", "sh"):
        assert np.array_equal(getattr(results[0], name), getattr(results[1], name))
        assert np.array_equal(getattr(results[0], name)[frozen], getattr(off, name)[frozen])


def test_masked_pixels_do_not_matter():
    gaussians, cameras = random_scene(1, n=300)
    rng = np.random.default_rng(0)
    target = rng.uniform(size=(1, 70, 100, 3)).astype(np.float32)
    mask = np.zeros((1, 70, 100), bool)
    mask[:, :, :50] = True
    spoiled = target.copy()
    spoiled[:, :, 50:] = 7.0
    a, b = NativeFitter(gaussians), NativeFitter(gaussians)
    assert a.step(cameras, target, mask) == b.step(cameras, spoiled, mask)
    assert np.array_equal(a.means, b.means)
    before = a.gaussians()
    assert a.step(cameras, target, np.zeros_like(mask)) == 0.0
    assert np.array_equal(a.means, before.means)


@pytest.mark.usefixtures("instruction_set")
def test_what_no_window_of_the_loss_reaches_is_not_drawn_and_nothing_else_differs():
    gaussians, cameras = random_scene(4, n=300)
    target = np.random.default_rng(0).uniform(size=(1, 70, 100, 3)).astype(np.float32)
    mask = np.zeros((1, 70, 100), np.float32)
    mask[0, 21:24, 50:53] = 1.0  # their windows reach over the borders of blocks of 8 pixels, on all sides
    mask[0, 69, 99] = 0.5
    some, all_drawn = (
        NativeFitter(gaussians, options=FitOptions(ssim_weight=0.5, statistics=whole)) for whole in (False, True)
    )
    for _ in range(3):
        assert some.step(cameras, target, mask) == all_drawn.step(cameras, target, mask)
    for ours, theirs in zip(some._values, all_drawn._values, strict=True):
        assert np.array_equal(ours, theirs)
    assert some._updates.any()
    assert 0 < some._views[0].pairs < 0.4 * all_drawn._views[0].pairs


@pytest.mark.usefixtures("instruction_set")
def test_what_is_frozen_changes_no_step_of_the_others():
    gaussians, cameras = random_scene(4, n=400)
    target = np.random.default_rng(0).uniform(size=(1, 70, 100, 3)).astype(np.float32)
    frozen = np.arange(400) % 3 == 0
    held, free = NativeFitter(gaussians, frozen=frozen), NativeFitter(gaussians)
    assert held.step(cameras, target) == free.step(cameras, target)
    moved = (free.means != gaussians.means).any(1)
    assert (moved & frozen).sum() > 50
    assert (moved & ~frozen).sum() > 100
    for ours, theirs in zip(held._values, free._values, strict=True):
        assert np.array_equal(ours[~frozen], theirs[~frozen])


def test_several_views_and_statistics():
    gaussians, cameras = random_scene(4, n=300)
    two = cameras[[0, 0]]
    target = np.random.default_rng(0).integers(0, 255, size=(2, 70, 100, 3)).astype(np.uint8)
    target[1] = target[0]
    one, both = (NativeFitter(gaussians, options=FitOptions(statistics=True)) for _ in range(2))
    assert one.step(cameras, target[:1]) == pytest.approx(both.step(two, target), rel=1e-6)
    assert np.abs(one.means - both.means).max() < 1e-6
    once, twice = one.statistics(), both.statistics()
    assert np.array_equal(twice.seen, 2 * once.seen)
    assert once.seen.max() == 1
    assert np.allclose(once.gradient_norm, twice.gradient_norm, rtol=1e-4)
    assert np.array_equal(once.max_weight, render(gaussians, cameras, max_weight=True).max_weight)


def test_keep_and_append_carry_the_state():
    gaussians, cameras = random_scene(4, n=300)
    target = np.zeros((1, 70, 100, 3), np.float32)
    fitter = NativeFitter(gaussians, frozen=np.arange(300) < 10)
    fitter.step(cameras, target)
    rows = np.arange(300) % 2 == 0
    m = fitter._moments[0][4].copy()
    fitter.keep(rows)
    assert len(fitter) == 150
    assert fitter.frozen.sum() == 5
    assert np.array_equal(fitter._moments[0][4], m[rows])
    fitter.append(gaussians[~rows])
    assert len(fitter) == 300
    assert fitter.frozen.sum() == 5
    assert not fitter._moments[0][4][150:].any()
    fitter.step(cameras, target)
    with raises(InputError, code="shape_mismatch", match="SH"):
        fitter.append(random_scene(1)[0])
    with raises(InputError, code="shape_mismatch", match="images"):
        fitter.step(cameras, target[:, 1:])
