"""OpenSplat's CPU rasteriser, compiled from a checkout for comparison (AGPL: nothing of it enters gsmap).

Used by bench_render.py. The recipe is the one of its model.cpp for the CPU: exp and normalise, project, spherical
harmonics, rasterise all Gaussians, sigmoid opacities.
"""

from __future__ import annotations

import math
import shutil
import tempfile
import time
from pathlib import Path

import numpy as np
import torch

from gsmap.render import native
from gsmap.types import Cameras, Gaussians

_SHIM = """
#include <torch/extension.h>
#include <memory>
#include "gsplat_cpu.cpp"
using torch::Tensor;
struct Hits {
    std::vector<int32_t> *lists = nullptr;
    ~Hits() { delete[] lists; }
};
PYBIND11_MODULE(TORCH_EXTENSION_NAME, m) {
    py::class_<Hits, std::shared_ptr<Hits>>(m, "Hits");
    m.def("project", &project_gaussians_forward_tensor_cpu);
    m.def("sh", &compute_sh_forward_tensor_cpu);
    m.def("forward", [](int w, int h, Tensor xys, Tensor conics, Tensor colors, Tensor opacity, Tensor background,
                        Tensor cov2d, Tensor depths) {
        auto t = rasterize_forward_tensor_cpu(w, h, xys, conics, colors, opacity, background, cov2d, depths);
        auto hits = std::make_shared<Hits>();
        hits->lists = std::get<2>(t);
        return std::make_tuple(std::get<0>(t), std::get<1>(t), hits);
    });
    m.def("backward", [](int h, int w, Tensor xys, Tensor conics, Tensor colors, Tensor opacity, Tensor background,
                         Tensor cov2d, Tensor depths, Tensor t, std::shared_ptr<Hits> hits, Tensor v, Tensor va) {
        return rasterize_backward_tensor_cpu(h, w, xys, conics, colors, opacity, background, cov2d, depths, t,
                                             hits->lists, v, va);
    });
}
"""


class _Rasterise(torch.autograd.Function):
    @staticmethod
    def forward(ctx, module, width, height, xys, conics, colors, opacity, background, cov2d, depths):
        image, t, hits = module.forward(width, height, xys, conics, colors, opacity, background, cov2d, depths)
        ctx.save_for_backward(xys, conics, colors, opacity, background, cov2d, depths, t)
        ctx.rest = module, width, height, hits
        return image

    @staticmethod
    def backward(ctx, v):
        module, width, height, hits = ctx.rest
        *saved, t = ctx.saved_tensors
        v = v.contiguous()
        v_xy, v_conic, v_colors, v_opacity = module.backward(
            height, width, *saved, t, hits, v, torch.zeros_like(v[..., 0])
        )
        return None, None, None, v_xy, v_conic, v_colors, v_opacity, None, None, None


class OpenSplat:
    """Compiles in a temporary folder; about a minute."""

    def __init__(self, checkout: Path):
        from torch.utils.cpp_extension import load

        self._folder = tempfile.TemporaryDirectory()
        folder = Path(self._folder.name)
        source = checkout / "rasterizer"
        shutil.copytree(source / "gsplat", folder / "gsplat")
        (folder / "cpu").mkdir()
        shutil.copy(source / "gsplat-cpu" / "bindings.h", folder / "cpu")
        shutil.copy(source / "gsplat-cpu" / "gsplat_cpu.cpp", folder / "cpu")
        shim = folder / "cpu" / "shim.cpp"
        shim.write_text(_SHIM)
        flags = ["-O3", "-w", "-include", "numeric", "-include", "algorithm"]
        self.module = load("opensplat_cpu", [str(shim)], extra_cflags=flags, build_directory=str(folder))

    def render(self, leaves: list[torch.Tensor], cameras: Cameras, contiguous_depths: bool = True) -> torch.Tensor:
        means, quats, log_scales, logits, sh = leaves
        width, height = cameras.sizes_px[0].tolist()
        fx, fy, cx, cy = cameras.intrinsics_px[0].tolist()
        view = torch.tensor(cameras.T_camera_frame[0], dtype=torch.float32)
        near, far = 0.001, 1000.0
        top, right = near * height / (2 * fy), near * width / (2 * fx)
        proj = torch.zeros(4, 4)
        proj[0, 0], proj[1, 1] = near / right, near / top
        proj[2, 2], proj[2, 3], proj[3, 2] = (far + near) / (far - near), -far * near / (far - near), 1.0
        xys, _, conics, cov2d, depths = self.module.project(
            len(means), means, log_scales.exp(), 1.0, quats / quats.norm(dim=-1, keepdim=True), view, proj @ view,
            fx, fy, cx, cy, height, width, 0.01,
        )  # fmt: skip
        if contiguous_depths:
            depths = depths.contiguous()
        direction = means.detach() - torch.tensor(cameras.centers[0], dtype=torch.float32)
        direction = direction / direction.norm(dim=-1, keepdim=True)
        degree = math.isqrt(sh.shape[1]) - 1
        rgb = (self.module.sh(len(means), degree, degree, direction, sh) + 0.5).clamp_min(0)
        opacity = torch.sigmoid(logits)[:, None]
        background = torch.zeros(3)
        return _Rasterise.apply(self.module, width, height, xys, conics, rgb, opacity, background, cov2d, depths)

    def measure(self, gaussians: Gaussians, cameras: Cameras, repeats: int = 2) -> dict:
        """CPU milliseconds of forward (no gradients recorded) and of forward and backward, one thread; the image."""
        torch.set_num_threads(1)
        leaves = [torch.tensor(a) for a in native.arrays_of(gaussians)]
        forward, both = [], []
        for _ in range(repeats):
            with torch.no_grad():
                start = time.process_time()
                image = self.render(leaves, cameras).numpy()
                forward.append(time.process_time() - start)
            learned = [t.clone().requires_grad_() for t in leaves]
            start = time.process_time()
            gradient = np.random.default_rng(0).normal(size=image.shape).astype(np.float32)
            self.render(learned, cameras).backward(torch.from_numpy(gradient))
            both.append(time.process_time() - start)
        times = {"opensplat_forward_ms": 1e3 * min(forward), "opensplat_forward_backward_ms": 1e3 * min(both)}
        return {**times, "image": image}
