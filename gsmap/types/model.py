"""A checked ONNX model, as stages and workers receive it."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any


@dataclass(frozen=True)
class Tensor:
    """An input or output of a model: its name, shape (None for a free dimension) and ONNX type such as ``float``."""

    name: str
    shape: tuple[int | None, ...]
    dtype: str

    @property
    def is_image(self) -> bool:
        """True for an image tensor of shape (N, 3, H, W) or (N, H, W, 3), or (H, W, 3), which some SAM encoders
        take.
        """
        s = self.shape
        channels_first = len(s) == 4 and s[1] in (3, None)
        return channels_first or (len(s) in (3, 4) and s[-1] == 3)


@dataclass(frozen=True)
class ModelLimits:
    """Resource limits of a model.

    Args:
        time_s: maximum seconds to load it, and for each run.
        memory_mb: maximum memory beside the libraries; enforced on Linux.
    """

    time_s: float = 300.0
    memory_mb: int = 8192


@dataclass(frozen=True)
class ModelSpec:
    """A checked ONNX model.

    Args:
        kind: kind of model: one of the ``MODELS`` of a segmenter or embedder, such as ``sam-encoder`` or ``clip``.
        path: path of the file.
        sha256: digest of the file.
        preset: pixel normalization: a name, or ``mean=r,g,b;std=r,g,b``.
        mean, std: normalization of rgb in [0, 1].
        inputs, outputs: tensors declared by the file.
        limits: resource limits where it runs; not part of its identity.
    """

    kind: str
    path: str
    sha256: str
    preset: str
    mean: tuple[float, float, float]
    std: tuple[float, float, float]
    inputs: tuple[Tensor, ...]
    outputs: tuple[Tensor, ...]
    limits: ModelLimits = field(default_factory=ModelLimits)

    def to_json(self) -> dict[str, Any]:
        """Return the model as plain JSON values, as the catalog stores it."""
        return {name: value for name, value in asdict(self).items() if name != "limits"}

    @property
    def digest(self) -> str:
        """Text that represents the model in a recipe: the digest of its file and its normalization."""
        return f"{self.kind}:{self.sha256}:{self.mean}:{self.std}"
