"""An ONNX model that was checked, as stages and workers are handed it."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any


@dataclass(frozen=True)
class Tensor:
    """An input or output of a model: its name, shape (None where it is free) and ONNX type such as ``float``."""

    name: str
    shape: tuple[int | None, ...]
    dtype: str

    @property
    def is_image(self) -> bool:
        """Whether it can hold pictures: (N, 3, H, W) or (N, H, W, 3), or (H, W, 3) as some SAM encoders take."""
        s = self.shape
        channels_first = len(s) == 4 and s[1] in (3, None)
        return channels_first or (len(s) in (3, 4) and s[-1] == 3)


@dataclass(frozen=True)
class ModelLimits:
    """What a model may take: a file from elsewhere can ask for anything.

    Args:
        time_s: for loading it, and for each run.
        memory_mb: beside what the libraries take; held on Linux.
    """

    time_s: float = 300.0
    memory_mb: int = 8192


@dataclass(frozen=True)
class ModelSpec:
    """A checked ONNX model.

    Args:
        kind: what it is for: one of the ``MODELS`` of a segmenter or embedder, such as ``sam-encoder`` or ``clip``.
        path: where the file is.
        sha256: of its bytes.
        preset: how its pixels are scaled: a name, or ``mean=r,g,b;std=r,g,b``.
        mean, std: of rgb in [0, 1].
        inputs, outputs: as the file declares them.
        limits: what it may take where it runs; no part of what it is.
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
        """Plain values, for a catalog."""
        return {name: value for name, value in asdict(self).items() if name != "limits"}

    @property
    def digest(self) -> str:
        """What it contributes to a recipe: the same file scaled otherwise gives other features."""
        return f"{self.kind}:{self.sha256}:{self.mean}:{self.std}"
