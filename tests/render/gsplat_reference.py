"""The CUDA backend on the CPU: gsplat's torch functions in place of its CUDA functions, and gsmap's kernels emulated.

Where gsplat's torch functions themselves need a GPU (to list what a pixel is blended from) the list is made here. What
runs is everything but gsplat's CUDA kernels.
"""

from __future__ import annotations

import ctypes
import functools
import importlib.util
import shutil
import subprocess
import tempfile
import threading
from pathlib import Path

import pytest
import torch

from gsmap.render import backends, blending_weights, cuda_fit, cuda_kernels, gsplat

_LAUNCHING = threading.Lock()  # the emulation keeps the state of one launch
MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE = 0.999, 1 / 255, 1e-4  # as its kernels have them


@pytest.fixture
def gsplat_on_cpu(monkeypatch):
    """`gsmap.render` with ``backend="gsplat"``, and ``auto``, on the CPU."""
    if importlib.util.find_spec("gsplat") is None:
        pytest.skip("needs the package gsplat (its Python part): pip install gsplat")
    import gsplat as package

    functions = {
        "fully_fused_projection": _projection,
        "spherical_harmonics": _spherical_harmonics,
        "isect_tiles": _isect_tiles,
        "isect_offset_encode": _isect_offset_encode,
        "rasterize_to_pixels": _rasterize_to_pixels,
    }
    for name, function in functions.items():
        monkeypatch.setattr(package, name, function)
        monkeypatch.setattr(package.rendering, name, function)  # of its own `rasterization`
    monkeypatch.setattr(gsplat, "load", lambda: package)
    monkeypatch.setattr(gsplat, "device", lambda: torch.device("cpu"))
    monkeypatch.setattr(gsplat, "_device_cache", gsplat._DeviceCache())
    monkeypatch.setattr(backends, "gsplat_available", lambda: True)
    monkeypatch.setattr(cuda_fit, "launch", _launch)
    monkeypatch.setattr(blending_weights, "launch", _launch)
    return package


@functools.cache
def _emulated_kernels():
    """gsmap's CUDA kernels, compiled for the CPU; every thread is a fiber."""
    here = Path(__file__).parent
    with tempfile.TemporaryDirectory() as folder:
        built = Path(folder) / "kernels.so"
        includes = [f"-I{here}", f"-I{Path(cuda_kernels.__file__).parent}"]
        flags = ["-O2", "-std=c++17", "-shared", "-fPIC", "-U_FORTIFY_SOURCE", *includes]
        compiler = shutil.which("c++") or "g++"
        subprocess.run([compiler, *flags, "-o", built, here / "emulated_kernels.cpp"], check=True)
        return ctypes.CDLL(str(built))


def _launch(file, kernel, blocks, threads, *arguments, shared=0, num_sh=None):
    values = [ctypes.c_void_p(a.data_ptr()) if isinstance(a, torch.Tensor) else ctypes.c_int32(a) for a in arguments]
    pointers = (ctypes.c_void_p * len(values))(*(ctypes.cast(ctypes.byref(v), ctypes.c_void_p) for v in values))
    with _LAUNCHING:
        assert not _emulated_kernels().launch(kernel.encode(), blocks, threads, shared, pointers)


def _projection(means, covars, quats, scales, viewmats, Ks, width, height, opacities=None, packed=False, **options):
    from gsplat.cuda._torch_impl import _fully_fused_projection, _quat_scale_to_covar_preci

    assert covars is None
    options.pop("sparse_grad", None), options.pop("radius_clip", None)
    covars, _ = _quat_scale_to_covar_preci(quats, scales, compute_preci=False)
    radii, means2d, depths, conics, compensations = _fully_fused_projection(
        means, covars, viewmats, Ks, width, height, **options
    )
    if not packed:
        return radii, means2d, depths, conics, compensations
    camera_ids, gaussian_ids = torch.nonzero((radii > 0).all(-1), as_tuple=True)
    at = camera_ids, gaussian_ids
    packed_ids = (torch.zeros_like(camera_ids), camera_ids, gaussian_ids)
    return *packed_ids, radii[at], means2d[at], depths[at], conics[at], None


def _spherical_harmonics(degree, dirs, coeffs, masks=None):
    from gsplat.cuda._torch_impl import _spherical_harmonics as reference

    return reference(degree, dirs, coeffs)


@torch.no_grad()
def _isect_tiles(
    means2d,
    radii,
    depths,
    tile_size,
    tile_width,
    tile_height,
    sort=True,
    segmented=False,
    packed=False,
    n_images=None,
    image_ids=None,
    gaussian_ids=None,
):
    """What `gsplat.cuda._torch_impl._isect_tiles` computes in nested loops, for packed rows as well."""
    if not packed:
        n_images = len(means2d)
        image_ids = torch.arange(n_images)[:, None].expand(means2d.shape[:2]).reshape(-1)
        means2d, radii, depths = means2d.reshape(-1, 2), radii.reshape(-1, 2), depths.reshape(-1)
    border = torch.tensor([tile_width, tile_height])
    low = torch.floor((means2d - radii) / tile_size).long().clamp_min(0).minimum(border)
    high = torch.ceil((means2d + radii) / tile_size).long().clamp_min(0).minimum(border)
    rows = torch.nonzero((radii > 0).all(-1))[:, 0]
    found = []
    for row in rows.tolist():
        for y in range(low[row, 1], high[row, 1]):
            for x in range(low[row, 0], high[row, 0]):
                found.append((int(image_ids[row]), y * tile_width + x, float(depths[row]), row))
    found.sort(key=lambda one: one[:3])
    per_image = tile_width * tile_height
    tiles = torch.tensor([image * per_image + tile for image, tile, _, _ in found], dtype=torch.int64)
    return None, tiles, torch.tensor([row for *_, row in found], dtype=torch.int32)


def _isect_offset_encode(tiles, n_images, tile_width, tile_height):
    count = torch.bincount(tiles, minlength=n_images * tile_width * tile_height)
    return (count.cumsum(0) - count).to(torch.int32).reshape(n_images, tile_height, tile_width)


def _rasterize_to_pixels(
    means2d,
    conics,
    colors,
    opacities,
    width,
    height,
    tile_size,
    isect_offsets,
    flatten_ids,
    backgrounds=None,
    masks=None,
    packed=False,
    absgrad=False,
):
    """Blend every pixel of every tile, Gaussian by Gaussian; differentiable by autograd."""
    assert backgrounds is None
    assert not absgrad
    flat = [t.reshape(-1, *t.shape[len(opacities.shape) :]) for t in (means2d, conics, colors, opacities)]
    means2d, conics, colors, opacities = flat
    views, down, across = isect_offsets.shape
    ends = torch.cat([isect_offsets.reshape(-1)[1:], torch.tensor([len(flatten_ids)])])
    images, alphas = [], []
    for tile, (start, end) in enumerate(zip(isect_offsets.reshape(-1).tolist(), ends.tolist(), strict=True)):
        row, column = divmod(tile % (down * across), across)
        y, x = torch.meshgrid(
            torch.arange(tile_size) + row * tile_size, torch.arange(tile_size) + column * tile_size, indexing="ij"
        )
        ids = flatten_ids[start:end].long()
        if masks is not None and not masks.reshape(-1)[tile]:
            ids = ids[:0]
        d = torch.stack([x, y], -1).reshape(-1, 1, 2) + 0.5 - means2d[ids]  # (P, G, 2)
        a, b, c = conics[ids].unbind(1)
        sigma = 0.5 * (a * d[..., 0] ** 2 + c * d[..., 1] ** 2) + b * d[..., 0] * d[..., 1]
        alpha = (opacities[ids] * torch.exp(-sigma)).clamp_max(MAX_ALPHA)
        alpha = torch.where((sigma >= 0) & (alpha >= MIN_ALPHA), alpha, 0)
        left = torch.cumprod(1 - alpha, 1)
        before = torch.cat([torch.ones(len(left), 1), left[:, :-1]], 1)
        going = torch.cumprod((left > MIN_TRANSMITTANCE).float(), 1)
        weight = alpha * before * going
        images.append(weight @ colors[ids])
        alphas.append(weight.sum(1, keepdim=True))
    image, alpha = (
        torch.stack(parts)
        .reshape(views, down, across, tile_size, tile_size, -1)
        .permute(0, 1, 3, 2, 4, 5)
        .reshape(views, down * tile_size, across * tile_size, -1)[:, :height, :width]
        for parts in (images, alphas)
    )
    return image, alpha
