"""Gaussians as torch tensors."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch

from gsmap.errors import InputError
from gsmap.render import native
from gsmap.types import Gaussians


@dataclass(frozen=True, eq=False)
class GaussianTensors:
    """N Gaussians as float32 tensors, shaped as in `gsmap.types.Gaussians`; any of them may require a gradient."""

    means: torch.Tensor
    quats: torch.Tensor
    log_scales: torch.Tensor
    logit_opacities: torch.Tensor
    sh: torch.Tensor

    def __post_init__(self) -> None:
        for f in fields(self):
            value = getattr(self, f.name)
            if not isinstance(value, torch.Tensor) or value.dtype != torch.float32:
                kind = value.dtype if isinstance(value, torch.Tensor) else type(value).__name__
                raise InputError(f"GaussianTensors.{f.name} must be a float32 tensor, got {kind}", code="wrong_type")
            if value.device != self.means.device:
                raise InputError(
                    f"GaussianTensors.{f.name} is on {value.device}, means are on {self.means.device}",
                    code="shape_mismatch",
                )
        n = self.means.shape[0] if self.means.ndim else 0
        expected = {"means": (n, 3), "quats": (n, 4), "log_scales": (n, 3), "logit_opacities": (n,)}
        for name, shape in expected.items():
            if tuple(getattr(self, name).shape) != shape:
                raise InputError(
                    f"GaussianTensors.{name} must have shape {shape}, got {tuple(getattr(self, name).shape)}",
                    code="shape_mismatch",
                )
        sh = tuple(self.sh.shape)
        if len(sh) != 3 or sh[0] != n or sh[1] not in (1, 4, 9, 16) or sh[2] != 3:
            raise InputError(
                f"GaussianTensors.sh must have shape ({n}, K, 3) with K = 1, 4, 9 or 16, got {sh}",
                code="shape_mismatch",
            )

    def __len__(self) -> int:
        return self.means.shape[0]

    @classmethod
    def of(cls, gaussians: Gaussians, device: str = "cpu", requires_grad: bool = False) -> GaussianTensors:
        """Copy numpy Gaussians to torch tensors."""
        tensors = (torch.tensor(a, device=device, requires_grad=requires_grad) for a in native.arrays_of(gaussians))
        return cls(*tensors)

    def numpy(self) -> Gaussians:
        """Copy to numpy Gaussians."""
        return Gaussians(*(t.detach().cpu().numpy().copy() for t in self.tensors()))

    def tensors(self) -> tuple[torch.Tensor, ...]:
        return self.means, self.quats, self.log_scales, self.logit_opacities, self.sh
