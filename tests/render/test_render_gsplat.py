"""The CUDA backend against the native one: on a GPU where there is one, and everywhere by `gsplat_reference`."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from gsplat_reference import gsplat_on_cpu
from raising import raises
from test_render_parity import random_scene

from gsmap.errors import MissingDependencyError
from gsmap.render import (
    FitOptions,
    GaussianTensors,
    LearningRates,
    backend,
    gsplat,
    make_fitter,
    render,
)
from gsmap.render.backends import gsplat_available
from gsmap.render.cuda_fit import CudaFitter
from gsmap.render.fit import with_enough_memory
from gsmap.types import Cameras, Gaussians

__all__ = ["gsplat_on_cpu"]

needs_gpu = pytest.mark.skipif(not gsplat_available(), reason="needs gsplat and a CUDA GPU")


@pytest.fixture(params=["reference", pytest.param("cuda", marks=needs_gpu)])
def device(request):
    """Where gsplat renders: ``cpu`` by its reference functions, ``cuda`` by its kernels."""
    if request.param == "reference":
        request.getfixturevalue("gsplat_on_cpu")
    return "cpu" if request.param == "reference" else "cuda"


def scene(k=4, n=250, views=1, size=(100, 70), opaque=3.5):
    """Gaussians none of which is so opaque that the two backends' clamps of alpha (0.99 and 0.999) differ."""
    gaussians, cameras = random_scene(k, n=n)
    gaussians.logit_opacities[:] = np.minimum(gaussians.logit_opacities, opaque)
    pose = np.repeat(cameras.T_frame_camera, views, 0)
    pose[1:, :3, 3] += np.random.default_rng(0).normal(size=(views - 1, 3)) * 0.3

    return gaussians, Cameras(pose, np.repeat(cameras.intrinsics_px, views, 0), np.repeat([size], views, 0))


def run_out_of_memory(monkeypatch, method):
    """Let the second call of a method of the fitter fail."""
    real, calls = getattr(CudaFitter, method), []

    def second_fails(*args):
        calls.append(args)
        if len(calls) == 2:
            raise torch.cuda.OutOfMemoryError("no memory")
        real(*args)

    monkeypatch.setattr(CudaFitter, method, second_fails)


def elsewhere(cameras):
    """The cameras, moved to where they see nothing."""
    pose = cameras.T_frame_camera.copy()
    pose[:, 2, 3] += 100
    return Cameras(pose, cameras.intrinsics_px, cameras.sizes_px)


def alike(ours, theirs, most=1e-4):
    for name, scale in (("colour", 1.0), ("alpha", 1.0), ("depth", 4.0)):
        error = np.abs(getattr(ours, name) - getattr(theirs, name)) / scale
        assert np.quantile(error, 0.999) < most, name
    assert (ours.dominant_id != theirs.dominant_id).mean() < 2e-3
    assert np.quantile(np.abs(ours.max_weight - theirs.max_weight), 0.99) < 1e-3


# Non-square images whose principal point lies off the centre, one and several cameras, every SH degree.
@pytest.mark.parametrize(
    ("k", "views", "size"), [(1, 1, (100, 70)), (4, 3, (64, 48)), (9, 1, (33, 90)), (16, 2, (70, 40))]
)
def test_images_match_the_native_backend(device, k, views, size):
    gaussians, cameras = scene(k, views=views, size=size)
    options = {"background": (0.1, 0.2, 0.3), "max_weight": True}
    ours = render(gaussians, cameras, backend="native", **options)
    alike(ours, render(gaussians, cameras, backend="gsplat", **options))
    assert backend("auto") == "gsplat"


def test_gaussians_more_opaque_than_the_native_clamp_differ_by_less_than_a_hundredth(device):
    gaussians, cameras = scene(n=100, opaque=np.inf)
    gaussians.logit_opacities[:] = 9.0
    ours, theirs = (render(gaussians, cameras, backend=name) for name in ("native", "gsplat"))
    error = np.abs(ours.colour - theirs.colour)
    assert 1e-4 < error.max() < 0.03


def test_views_of_nothing_and_gaussians_that_cannot_be_drawn(device):
    gaussians, cameras = scene(views=2)
    away = elsewhere(cameras)
    for g, c in ((gaussians, away), (gaussians, away[0]), (gaussians[:0], cameras), (gaussians, cameras[:0])):
        shown = render(g, c, background=(0.1, 0.2, 0.3), max_weight=True, backend="gsplat")
        assert np.allclose(shown.colour, [0.1, 0.2, 0.3])
        assert not shown.alpha.any()
        assert not shown.depth.any()
        assert (shown.dominant_id == -1).all()
        assert not shown.max_weight.any()
    broken = Gaussians(*(a.copy() for a in vars(gaussians).values()))
    broken.means[30], broken.log_scales[31, 1], broken.logit_opacities[32], broken.sh[33, 1, 2] = (
        np.nan,
        90,
        np.nan,
        np.inf,
    )
    broken.quats[34] = np.nan
    ours, theirs = (render(broken, cameras, max_weight=True, backend=name) for name in ("native", "gsplat"))
    alike(ours, theirs)
    assert not theirs.max_weight[30:35].any()


@pytest.mark.parametrize("views", [1, 2])
def test_gradients_match_the_native_backend(device, views):
    gaussians, cameras = scene(views=views, size=(60, 44))
    gradients = []
    for name, where in (("native", "cpu"), ("gsplat", device)):
        tensors = GaussianTensors.of(gaussians, device=where, requires_grad=True)
        pose = torch.tensor(cameras.T_camera_frame, dtype=torch.float32, device=where, requires_grad=True)
        image = render(tensors, cameras, T_camera_frame=pose, backend=name)
        assert image.colour.device.type == where
        (image.colour.square().sum() + image.alpha.sum() + 0.1 * image.depth.sum()).backward()
        # A pose moves on SE(3) only: compare the gradient along rotations and translations.
        R = torch.tensor(cameras.T_camera_frame[:, :3, :3], dtype=torch.float32)
        g, t = pose.grad[:, :3].cpu(), torch.tensor(cameras.T_camera_frame[:, :3, 3]).float()
        turn = g[:, :, :3] @ R.transpose(1, 2) + g[:, :, 3:] * t[:, None]
        pose_gradient = torch.cat([(turn - turn.transpose(1, 2)).flatten(), g[:, :, 3].flatten()])
        gradients.append([t.grad.cpu() for t in tensors.tensors()] + [pose_gradient])
    for a, b in zip(*gradients, strict=True):
        assert (a - b).norm() / a.norm() < 1e-3


@pytest.mark.parametrize(
    ("k", "n", "size", "ssim_weight", "delta", "masked"),
    [
        (1, 2000, (130, 70), 0.0, 0.0, False),
        (4, 3000, (101, 90), 0.2, 0.05, True),
        (9, 300, (33, 40), 1.0, 0.0, False),
        (16, 1000, (70, 40), 0.2, 0.0, True),
    ],
)
def test_a_step_has_the_gradients_of_the_native_fitter(device, k, n, size, ssim_weight, delta, masked):
    gaussians, cameras = scene(k, n=n, size=size, opaque=9.0)
    gaussians.log_scales[:] += 0.3  # long lists of tiles
    target = np.clip(render(gaussians, cameras, backend="native").colour + 0.05, 0, 1)
    mask = None
    if masked:  # the left half and a part of the rest are not looked at
        mask = np.random.default_rng(2).uniform(size=target.shape[:3]).astype(np.float32)
        mask[:, :, : size[0] // 2] = 0
    # Without momentum and with a large epsilon, a step of Adam is the gradient.
    options = FitOptions(ssim_weight, delta, (0.2, 0.1, 0.4), betas=(0.0, 0.0), epsilon=1e3)
    fitters = [
        make_fitter(gaussians, LearningRates(*[1e3] * 6), options=options, backend=name)
        for name in ("native", "gsplat")
    ]
    ours, theirs = (float(fitter.step(cameras, target, mask)) for fitter in fitters)
    assert ours == pytest.approx(theirs, rel=1e-5)
    for name in ("means", "quats", "log_scales", "logit_opacities", "sh"):
        ours, theirs, start = (getattr(g, name) for g in (*(f.gaussians() for f in fitters), gaussians))
        assert np.linalg.norm(ours - theirs) < 2e-4 * np.linalg.norm(ours - start), name


def test_a_step_whose_entries_do_not_fit_is_taken_again(device, monkeypatch):
    monkeypatch.setattr("gsmap.render.cuda_fit._FEWEST_ENTRIES", 64)
    gaussians, cameras = scene(n=300, size=(48, 33))
    image = np.zeros((1, 33, 48, 3), np.float32)
    after = []
    for too_small in (False, True):
        fitter = make_fitter(gaussians, backend="gsplat")
        losses = []
        for _ in range(3):
            losses.append(fitter.step(cameras, image))
            fitter._settle()
            [(camera, entries)] = fitter._entries_before.items()
            assert entries > 80
            if too_small:
                fitter._entries_before[camera] = 20
        losses = [float(loss) for loss in losses]
        after.append((losses, fitter.gaussians().means))
    assert after[0][0] == pytest.approx(after[1][0], rel=1e-5)
    assert np.allclose(after[0][1], after[1][1], atol=1e-6)


def test_a_step_that_fails_halfway_leaves_nothing_for_the_next(device, monkeypatch):
    gaussians, cameras = scene(n=60, views=2, size=(24, 16))
    image = np.zeros((2, 16, 24, 3), np.float32)
    # As above, a step is the gradient: one of Adam would hide that it is twice as large.
    options, rates = FitOptions(betas=(0.0, 0.0), epsilon=1e3), LearningRates(*[1e3] * 6)
    fitters = [make_fitter(gaussians, rates, options=options, backend="gsplat") for _ in range(2)]
    run_out_of_memory(monkeypatch, "_blend")
    with pytest.raises(torch.cuda.OutOfMemoryError):
        fitters[0].step(cameras, image)
    for fitter in fitters:
        fitter.step(cameras, image)
    ours, theirs = (fitter.gaussians().sh for fitter in fitters)
    assert np.abs(ours - theirs).max() < 1e-3 * np.abs(ours - gaussians.sh).max()


@pytest.mark.parametrize("wide", [1 << 15, 0])
def test_no_gaussians_and_what_the_mask_leaves_out(device, monkeypatch, wide):
    monkeypatch.setattr("gsmap.render.cuda_fit._WIDE", wide)
    gaussians, cameras = scene(n=60, views=2, size=(24, 16))
    image = np.full((2, 16, 24, 3), 0.5, np.float32)
    mask = np.ones((2, 16, 24), np.float32)
    mask[:, :, 12:] = 0
    unknown = image.copy()
    unknown[:, :, 20:] = np.nan  # farther than the window of SSIM reaches
    options, rates = FitOptions(ssim_weight=0.2, betas=(0.0, 0.0), epsilon=1e3), LearningRates(*[1e3] * 6)
    for some in (gaussians, gaussians[:0]):
        for pictures, weights in ((image, None), (unknown, mask), (unknown, 0 * mask)):
            fitters = [make_fitter(some, rates, options=options, backend=name) for name in ("native", "gsplat")]
            known = np.nan_to_num(pictures)  # the native loss is not a number there
            wanted = float(fitters[0].step(cameras, known, weights))
            found = float(fitters[1].step(cameras, pictures, weights))
            assert found == pytest.approx(wanted, rel=1e-4)
            assert np.allclose(*(fitter.gaussians().means for fitter in fitters), atol=1e-5)


@pytest.mark.skipif(not gsplat_available(), reason="needs gsplat and a CUDA GPU")
def test_recorded_steps_on_cuda_are_the_steps(monkeypatch):
    gaussians, cameras = scene(4, n=4000, views=6, size=(320, 200))
    targets = render(gaussians, cameras, backend="native").colour + 0.05
    after = []
    for recorded in (True, False):
        fitter = make_fitter(gaussians, LearningRates(means=1e-3), backend="gsplat")
        images = [fitter.load(target[None]) for target in targets]
        for step in range(30):
            fitter.step(cameras[step % 6], images[step % 6])
            fitter._recorder._possible = recorded
        assert len(fitter._recorder._graphs) >= 2 if recorded else not fitter._recorder._graphs
        after.append(fitter.gaussians())
    for name in ("means", "quats", "log_scales", "logit_opacities", "sh"):
        ours, theirs, start = (getattr(g, name) for g in (*after, gaussians))
        assert np.linalg.norm(ours - theirs) < 0.02 * np.linalg.norm(ours - start), name


@pytest.mark.parametrize(
    ("k", "views", "masked", "frozen", "statistics"),
    [
        (1, 1, False, False, False),
        (4, 1, True, True, False),
        (4, 1, False, False, True),
        (9, 2, False, True, True),
        (16, 1, True, False, False),
    ],
)
def test_ten_steps_match_the_native_fitter(device, k, views, masked, frozen, statistics):
    gaussians, cameras = scene(k, n=120, views=views, size=(48, 33))
    rng = np.random.default_rng(1)
    # What is rendered, moved a little: an image of noise has gradients that cancel, and Adam makes their signs count.
    target = np.clip(render(gaussians, cameras, backend="native").colour + 0.1, 0, 1)
    masks = (rng.uniform(size=target.shape[:3]) < 0.7).astype(np.uint8) * 255 if masked else None
    held = np.arange(120) % 3 == 0 if frozen else None
    options = FitOptions(ssim_weight=0.2, huber_delta=0.05, statistics=statistics, betas=(0.5, 0.999), epsilon=1e-6)
    rates = LearningRates(means=1e-3)
    native, other = (
        make_fitter(gaussians, rates, frozen=held, options=options, backend=name) for name in ("native", "gsplat")
    )
    assert isinstance(other, CudaFitter)
    images, weights = other.load(target), None if masks is None else other.load(masks)
    for step in range(10):
        for fitter in (native, other):
            fitter.learning_rates = replace(rates, means=rates.means / (1 + step))
        a, b = native.step(cameras, target, masks), float(other.step(cameras, images, weights))
        assert a == pytest.approx(b, rel=1e-3)
    for name in ("means", "quats", "log_scales", "logit_opacities", "sh"):
        ours, theirs, start = (getattr(g, name) for g in (native.gaussians(), other.gaussians(), gaussians))
        moved = np.linalg.norm(ours - start)
        assert moved > 0
        assert np.linalg.norm(ours - theirs) < 0.02 * moved, name
        assert np.median(np.abs(ours - theirs)) < 1e-3 * np.abs(ours - start).max(), name
        if held is not None:
            assert np.array_equal(theirs[held], start[held])
    if not statistics:
        return
    ours, theirs = native.statistics(), other.statistics()
    assert (ours.seen != theirs.seen).mean() < 0.02
    assert np.allclose(ours.max_weight, theirs.max_weight, atol=0.02)
    assert np.linalg.norm(ours.gradient_norm - theirs.gradient_norm) < 0.02 * np.linalg.norm(ours.gradient_norm)


def test_what_no_camera_sees_stays_where_it_is(device):
    gaussians, cameras = scene(n=120, size=(48, 33))
    away = elsewhere(cameras)
    fitter = make_fitter(gaussians, options=FitOptions(statistics=True), backend="gsplat")
    image = np.zeros((1, 33, 48, 3), np.float32)
    behind = (gaussians.means[:, 2] < 0).nonzero()[0]
    assert float(fitter.step(cameras, image)) > 0
    assert np.array_equal(fitter.gaussians().means[behind], gaussians.means[behind])
    assert (fitter.gaussians().means != gaussians.means).any()
    before = fitter.gaussians()
    fitter.step(away[0], image, np.zeros((1, 33, 48), np.uint8))
    fitter.step(cameras, image, np.zeros((1, 33, 48), np.uint8))
    for name, value in vars(before).items():
        assert np.array_equal(value, getattr(fitter.gaussians(), name))


def test_keep_and_append_carry_the_state(device):
    gaussians, cameras = scene(n=120, size=(48, 33))
    image = np.zeros((1, 33, 48, 3), np.float32)
    options = FitOptions(statistics=True)
    fitters = [
        make_fitter(gaussians, frozen=np.arange(120) < 30, options=options, backend=name)
        for name in ("native", "gsplat")
    ]
    rows = np.arange(120) % 2 == 0
    for fitter in fitters:
        for _ in range(3):  # recorded from the second on
            fitter.step(cameras, image)
        fitter.keep(rows)
        fitter.append(gaussians[~rows], np.arange(60) < 10)
        assert len(fitter) == 120
        for _ in range(3):
            fitter.step(cameras, image)
        fitter.reset_statistics()
        fitter.step(cameras, image)
    ours, theirs = (fitter.gaussians() for fitter in fitters)
    start = np.r_[gaussians.means[rows], gaussians.means[~rows]]
    assert np.linalg.norm(ours.means - theirs.means) < 1e-2 * np.linalg.norm(ours.means - start)
    held = np.r_[np.arange(15), np.arange(60, 70)]
    assert np.array_equal(theirs.means[held], start[held])
    assert np.array_equal(*(fitter.statistics().seen for fitter in fitters))
    assert fitters[1].statistics().seen.max() == 1


def test_batches_shrink_where_memory_runs_out_and_the_answer_stays(device, monkeypatch, caplog):
    gaussians, cameras = scene(views=5, size=(48, 33))
    whole = render(gaussians, cameras, max_weight=True, backend="gsplat")
    drawn, most = [], 2
    draw = gsplat._draw

    def short_of_memory(scene, views, *rest, **options):
        if len(views.K) > most:
            raise torch.cuda.OutOfMemoryError("no memory")
        drawn.append(len(views.K))
        return draw(scene, views, *rest, **options)

    monkeypatch.setattr(gsplat, "_draw", short_of_memory)
    pieces = render(gaussians, cameras, max_weight=True, backend="gsplat")
    assert drawn == [2, 2, 1]
    alike(whole, pieces, 1e-5)
    most = 0
    on_cpu = render(gaussians, cameras, max_weight=True, backend="gsplat")
    native = render(gaussians, cameras, max_weight=True, backend="native")
    assert np.array_equal(on_cpu.colour, native.colour)
    assert np.array_equal(on_cpu.max_weight, native.max_weight)
    assert "rendering on the CPU" in caplog.text


def test_a_fit_that_the_gpu_cannot_hold_runs_on_the_cpu(device, monkeypatch, caplog):
    gaussians, cameras = scene(n=60, size=(24, 16))
    image = np.zeros((1, 16, 24, 3), np.float32)

    def fit(backend):
        fitter = make_fitter(gaussians, backend=backend)
        return backend, [float(fitter.step(cameras, image)) for _ in range(3)]

    assert with_enough_memory(fit)[0] == "gsplat"
    run_out_of_memory(monkeypatch, "_project")
    assert with_enough_memory(fit) == fit("native")
    assert "runs on the CPU" in caplog.text


def test_a_scene_is_moved_once_and_forgotten_with_the_object(device):
    gaussians, cameras = scene(views=2, size=(48, 33))
    gsplat._device_cache.clear()
    render(gaussians, cameras[0], backend="gsplat")
    moved = gsplat._device_cache.get(gaussians)
    render(gaussians, cameras[1], backend="gsplat")
    assert gsplat._device_cache.get(gaussians) is moved
    del gaussians
    assert not gsplat._device_cache._entries


@pytest.mark.skipif(gsplat_available(), reason="gsplat is there")
def test_without_gsplat_the_error_names_the_extra(monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "gsplat", None)
    gaussians, cameras = random_scene(1)
    with raises(MissingDependencyError, code="missing_dependency"):
        render(GaussianTensors.of(gaussians), cameras, backend="gsplat")


@pytest.mark.slow
def test_the_bench_for_a_gpu_runs_dry_here(shared_data, tmp_path):
    pytest.importorskip("gsplat")
    command = [sys.executable, "-m", "tools.bench.gpu", shared_data, "--dry-run", "--json", tmp_path / "gpu.json"]
    subprocess.run(command, check=True, cwd=Path(__file__).parents[2])
    parts = json.loads((tmp_path / "gpu.json").read_text())
    assert len(parts) == 7
    assert all(parts.values())
