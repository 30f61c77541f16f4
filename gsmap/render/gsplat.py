"""The CUDA backend: nerfstudio's gsplat, an optional dependency (the extra ``cuda``)."""

from __future__ import annotations

import functools
import logging
import math
import threading
import weakref
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from gsmap.errors import MissingDependencyError
from gsmap.render.blending_weights import TILE_PX, TileLists, blending_weights
from gsmap.render.outputs import Rendering, image_size
from gsmap.render.tensors import GaussianTensors
from gsmap.types import Cameras, Gaussians

logger = logging.getLogger(__name__)

NEAR_PLANE = 0.01
DILATION_PX2 = 0.3

# Largest memory of a batch of cameras; a larger batch gains nothing, because it fills the GPU long before.
_BATCH_BYTES = 1 << 31
# Memory of a view (images, projections and tile lists), measured on rooms.
_BYTES_PER_PIXEL, _BYTES_PER_GAUSSIAN = 64, 48


class DeviceMemoryError(Exception):
    """Raised if one view needs more memory than the GPU has left."""


def device() -> torch.device:
    """Return the device on which gsplat renders."""
    return torch.device("cuda")


@functools.cache
def load() -> Any:
    """Import gsplat with its kernels.

    Raises:
        MissingDependencyError: gsplat or its CUDA kernels are missing.
    """
    try:
        import gsplat
        import gsplat.cuda._backend as built
    except ImportError as error:
        raise MissingDependencyError("rendering on CUDA needs gsplat", extra="cuda") from error
    if built._C is None:
        raise MissingDependencyError(
            "gsplat is installed without its CUDA kernels, and could not build them: install the CUDA toolkit (nvcc) "
            "of torch's CUDA version, or a gsplat wheel built for it (docs/how-to/gpu.md)"
        )
    return gsplat


@dataclass(frozen=True, eq=False)
class DrawableGaussians:
    """Gaussians on the GPU with activated attributes; Gaussians that cannot be drawn are left out.

    Args:
        means: (M, 3).
        quats: (M, 4), none of them zero.
        scales: (M, 3) standard deviations.
        opacities: (M,) in [0, 1].
        sh: (M, K, 3).
        rows: (M,) index of each Gaussian among all N, or None if all can be drawn.
        num_all: N, the number of all Gaussians.
    """

    means: torch.Tensor
    quats: torch.Tensor
    scales: torch.Tensor
    opacities: torch.Tensor
    sh: torch.Tensor
    rows: torch.Tensor | None
    num_all: int

    @classmethod
    def of(cls, tensors: GaussianTensors) -> DrawableGaussians:
        """Activate the attributes of tensors on the GPU, differentiably."""
        means, quats, log_scales, logits, sh = tensors.tensors()
        n = len(means)
        # gsplat does not handle Gaussians that cannot be drawn; the native backend leaves them out.
        sound = drawable(tensors.tensors())
        rows = None if bool(sound.all()) else torch.nonzero(sound)[:, 0]
        if rows is not None:
            means, quats, log_scales, logits, sh = (t[rows] for t in (means, quats, log_scales, logits, sh))
        return cls(means, without_zeros(quats), log_scales.exp(), torch.sigmoid(logits), sh, rows, n)

    @property
    def nbytes(self) -> int:
        parts = (self.means, self.quats, self.scales, self.opacities, self.sh)
        return sum(t.numel() * t.element_size() for t in parts)


@dataclass(frozen=True, eq=False)
class DeviceViews:
    """C cameras of one size on the GPU.

    Args:
        T_camera_frame: (C, 4, 4).
        K: (C, 3, 3).
        centers: (C, 3) in the frame.
    """

    T_camera_frame: torch.Tensor
    K: torch.Tensor
    centers: torch.Tensor
    width: int
    height: int

    @classmethod
    def of(cls, cameras: Cameras, T_camera_frame: torch.Tensor | None = None) -> DeviceViews:
        """Move cameras to the GPU in one copy; ``T_camera_frame``, if given, replaces their poses and is
        differentiable."""
        width, height = image_size(cameras)
        count = len(cameras)
        parts = (cameras.T_camera_frame, cameras.K, cameras.centers)
        flat = np.concatenate([np.ravel(part) for part in parts]).astype(np.float32)
        pose, K, centers = torch.from_numpy(flat).to(device()).split([16 * count, 9 * count, 3 * count])
        if T_camera_frame is None:
            return cls(pose.view(-1, 4, 4), K.view(-1, 3, 3), centers.view(-1, 3), width, height)
        given = T_camera_frame.to(device=device(), dtype=torch.float32)
        rotation, translation = given[:, :3, :3], given[:, :3, 3:]
        return cls(given, K.view(-1, 3, 3), -(rotation.transpose(1, 2) @ translation)[..., 0], width, height)


def drawable(values: Sequence[torch.Tensor]) -> torch.Tensor:
    """Return an (N,) mask of Gaussians whose means, quats, log_scales, logit_opacities and sh are numbers that float32
    can draw."""
    means, quats, log_scales, logits, sh = values
    sound = torch.isfinite(means).all(1) & torch.isfinite(quats).all(1) & torch.isfinite(sh).flatten(1).all(1)
    return sound & ~(torch.isnan(log_scales) | (log_scales >= 80)).any(1) & ~torch.isnan(logits)


def without_zeros(quats: torch.Tensor) -> torch.Tensor:
    """Replace quaternions (N, 4) of length zero by the identity."""
    # No constant from the CPU: it could not be copied while CUDA records.
    real = torch.where(quats.square().sum(1) > 1e-30, quats[:, 0], 1.0)
    return torch.cat([real[:, None], quats[:, 1:]], 1)


class _DeviceCache:
    """Cache of recently rendered Gaussians on the GPU, because a scene is rendered from many cameras one after another.

    The key is the `Gaussians` object, which must not be changed in place after it was rendered.
    """

    def __init__(self) -> None:
        self._entries: OrderedDict[int, tuple[weakref.ref[Gaussians], DrawableGaussians]] = OrderedDict()
        self._lock = threading.RLock()  # several threads of a page's server render at the same time

    def get(self, gaussians: Gaussians) -> DrawableGaussians:
        key = id(gaussians)
        with self._lock:
            if key in self._entries:
                self._entries.move_to_end(key)
                return self._entries[key][1]
            moved = DrawableGaussians.of(GaussianTensors.of(gaussians, device=str(device())))
            self._entries[key] = weakref.ref(gaussians, lambda _: self._forget(key)), moved
            while len(self._entries) > 1 and sum(d.nbytes for _, d in [*self._entries.values()]) > _cache_bytes():
                self._entries.popitem(last=False)
            return moved

    def clear(self) -> None:
        with self._lock:
            self._entries.clear()

    def _forget(self, key: int) -> None:
        with self._lock:
            self._entries.pop(key, None)


_device_cache = _DeviceCache()
_one_at_a_time = threading.Lock()


def _cache_bytes() -> int:
    if device().type != "cuda":
        return 1 << 30
    return int(torch.cuda.get_device_properties(device()).total_memory) // 8


@torch.no_grad()
def render_numpy(gaussians: Gaussians, cameras: Cameras, background: np.ndarray, images: dict[str, Any]) -> None:
    """Render numpy Gaussians on the GPU into arrays from `gsmap.render.native.allocate`.

    Cameras are rendered in batches; with little memory batches are smaller.

    Raises:
        DeviceMemoryError: a single view does not fit into the memory.
    """
    load()
    views, height, width = images["alpha"].shape
    if images["dominant_id"] is not None:
        images["dominant_id"].fill(-1)
    if views == 0 or len(gaussians) == 0:
        images["colour"][:] = background
        for name in ("alpha", "depth"):
            if images[name] is not None:
                images[name].fill(0)
        return
    wants = {name: images[name] is not None for name in ("depth", "dominant_id", "max_weight")}

    def draw(first: int, last: int) -> None:
        scene = _device_cache.get(gaussians)
        found = _draw(scene, DeviceViews.of(cameras[first:last]), background, **wants)
        for name in ("colour", "alpha", "depth", "dominant_id"):
            if images[name] is not None:
                torch.from_numpy(images[name][first:last]).copy_(getattr(found, name))
        if found.max_weight is not None:
            np.maximum(images["max_weight"], found.max_weight.cpu().numpy(), out=images["max_weight"])

    per_view = height * width * _BYTES_PER_PIXEL + len(gaussians) * _BYTES_PER_GAUSSIAN
    in_batches(views, max(1, _BATCH_BYTES // per_view), draw)


def in_batches(count: int, size: int, do: Callable[[int, int], None]) -> None:
    """Call ``do(first, last)`` for ranges that together cover ``count``; ranges are halved if the GPU's memory is
    exhausted.

    Raises:
        DeviceMemoryError: even a range of one does not fit into the memory.
    """
    first = 0
    while first < count:
        last = min(first + size, count)
        try:
            do(first, last)
        except torch.cuda.OutOfMemoryError as error:
            _device_cache.clear()
            if device().type == "cuda":
                torch.cuda.empty_cache()
            if size > 1:
                size = max(1, (last - first) // 2)
                continue
            with _one_at_a_time:  # other threads may have taken the memory
                try:
                    do(first, last)
                except torch.cuda.OutOfMemoryError:
                    raise DeviceMemoryError(str(error)) from error
            first = last
        else:
            first = last


def render_tensors(
    gaussians: GaussianTensors,
    cameras: Cameras,
    T_camera_frame: torch.Tensor,
    background: np.ndarray,
    depth: bool,
    dominant_id: bool,
    max_weight: bool,
) -> Rendering:
    """Run `gsmap.render.render` for tensors; tensors on the CPU are moved to the GPU, and the result is moved back."""
    load()
    width, height = image_size(cameras)
    home = gaussians.means.device
    views, n = len(T_camera_frame), len(gaussians)
    if views == 0 or n == 0:
        return _nothing(views, height, width, n, background, depth, dominant_id, max_weight, home)
    moved = GaussianTensors(*(t.to(device()) for t in gaussians.tensors()))
    views_there = DeviceViews.of(cameras, T_camera_frame)
    found = _draw(DrawableGaussians.of(moved), views_there, background, depth, dominant_id, max_weight)
    return Rendering(*(None if t is None else t.to(home) for t in vars(found).values()))


def _draw(
    scene: DrawableGaussians,
    views: DeviceViews,
    background: np.ndarray,
    depth: bool,
    dominant_id: bool,
    max_weight: bool,
) -> Rendering:
    """Render on the GPU; all tensors of the result are on the GPU."""
    colour, alpha, depths, lists = rasterize(scene, views, depth)
    if background.any():
        colour = colour + (1 - alpha) * torch.tensor(background, device=alpha.device)
    ids = weights = None
    if dominant_id or max_weight:
        ids, weights = blending_weights(lists, views.height, views.width, len(scene.means), max_weight)
        if scene.rows is not None:
            ids = torch.where(ids >= 0, scene.rows.to(torch.int32)[ids.clamp_min(0)], ids)
            if weights is not None:
                weights = weights.new_zeros(scene.num_all).index_copy(0, scene.rows, weights)
    return Rendering(colour, alpha[..., 0], depths, ids if dominant_id else None, weights if max_weight else None)


@dataclass(frozen=True, eq=False)
class Projection:
    """Gaussians projected into C images: (C, N, ...) attributes, or packed (M, ...), a row for each visible Gaussian
    of each image.

    Args:
        radii: int32 pixels, across and down; 0 if a Gaussian is not visible.
        means2d: pixels.
        conics: upper triangle of the inverse covariance.
        colours: at least 0.
        camera, gaussian: (M,) of packed rows, or None.
    """

    radii: torch.Tensor
    means2d: torch.Tensor
    depths: torch.Tensor
    conics: torch.Tensor
    opacities: torch.Tensor
    colours: torch.Tensor
    camera: torch.Tensor | None = None
    gaussian: torch.Tensor | None = None


def project(scene: DrawableGaussians, views: DeviceViews, packed: bool) -> Projection:
    """Project Gaussians into views with gsplat's functions, differentiably."""
    gs = load()
    projected = gs.fully_fused_projection(
        scene.means,
        None,
        scene.quats,
        scene.scales,
        views.T_camera_frame,
        views.K,
        views.width,
        views.height,
        eps2d=DILATION_PX2,
        near_plane=NEAR_PLANE,
        packed=packed,
        opacities=scene.opacities,
    )
    if packed:
        _, camera, gaussian, radii, means2d, depths, conics, _ = projected
        opacities = scene.opacities[gaussian]
        directions = scene.means[gaussian] - views.centers[camera]
        coefficients, mask = scene.sh[gaussian], None
    else:
        camera = gaussian = None
        radii, means2d, depths, conics, _ = projected
        opacities = scene.opacities[None]
        directions = scene.means[None] - views.centers[:, None]
        coefficients, mask = scene.sh[None], (radii > 0).all(-1)
    colours = gs.spherical_harmonics(math.isqrt(scene.sh.shape[1]) - 1, directions, coefficients, masks=mask)
    colours = torch.clamp_min(colours + 0.5, 0)
    return Projection(radii, means2d, depths, conics, opacities, colours, camera, gaussian)


def rasterize(
    scene: DrawableGaussians, views: DeviceViews, depth: bool
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor | None, TileLists]:
    """Project, sort into tiles and blend Gaussians with gsplat's functions, differentiably.

    This is `gsplat.rasterization` without its cost on the CPU: inverted matrices, checks and concatenations. Several
    views are packed, so that each takes memory only for the Gaussians that it sees.

    Returns:
        Colour (C, H, W, 3), alpha (C, H, W, 1), expected depth (C, H, W) or None, and the lists of blended Gaussians.
    """
    gs = load()
    count, width, height = len(views.T_camera_frame), views.width, views.height
    packed = count > 1
    seen = project(scene, views, packed)
    colours = torch.cat([seen.colours, seen.depths[..., None]], -1) if depth else seen.colours
    down, across = -(-height // TILE_PX), -(-width // TILE_PX)
    _, crossings, listed = gs.isect_tiles(
        seen.means2d,
        seen.radii,
        seen.depths,
        TILE_PX,
        across,
        down,
        packed=packed,
        n_images=count,
        image_ids=seen.camera,
        gaussian_ids=seen.gaussian,
    )
    starts = gs.isect_offset_encode(crossings, count, across, down)
    image, alpha = gs.rasterize_to_pixels(
        seen.means2d, seen.conics, colours, seen.opacities, width, height, TILE_PX, starts, listed, packed=packed
    )
    lists = TileLists(seen.means2d, seen.conics, seen.opacities, seen.gaussian, starts, listed)
    if not depth:
        return image, alpha, None, lists
    return image[..., :3], alpha, image[..., 3] / alpha[..., 0].clamp_min(1e-10), lists


def _nothing(
    views: int,
    height: int,
    width: int,
    n: int,
    background: np.ndarray,
    depth: bool,
    dominant_id: bool,
    max_weight: bool,
    device: torch.device,
) -> Rendering:
    shape = (views, height, width)
    return Rendering(
        torch.tensor(background, device=device).expand(*shape, 3).clone(),
        torch.zeros(shape, device=device),
        torch.zeros(shape, device=device) if depth else None,
        torch.full(shape, -1, dtype=torch.int32, device=device) if dominant_id else None,
        torch.zeros(n, device=device) if max_weight else None,
    )
