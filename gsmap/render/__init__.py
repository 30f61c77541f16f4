"""Rendering of Gaussians: colour, depth, alpha and dominant Gaussian, differentiable, on the CPU or on CUDA."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from gsmap.render.fit import Fitter, LearningRates
from gsmap.render.index import ChunkIndex
from gsmap.render.rendering import Rendered, num_threads, render, set_num_threads

if TYPE_CHECKING:
    from gsmap.render.autograd import GaussianTensors

__all__ = [
    "ChunkIndex",
    "Fitter",
    "GaussianTensors",
    "LearningRates",
    "Rendered",
    "num_threads",
    "render",
    "set_num_threads",
]


def __getattr__(name: str) -> Any:
    if name == "GaussianTensors":  # needs torch
        return importlib.import_module("gsmap.render.autograd").GaussianTensors
    raise AttributeError(f"module 'gsmap.render' has no attribute {name!r}")
