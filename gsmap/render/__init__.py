"""Render Gaussians: colour, depth, alpha and dominant Gaussian, differentiably, on the CPU or on CUDA."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from gsmap.render.backends import backend
from gsmap.render.fit import make_fitter
from gsmap.render.fitter import FitOptions, Fitter, LearningRates
from gsmap.render.index import ChunkIndex
from gsmap.render.native import num_threads, set_num_threads
from gsmap.render.outputs import Rendering
from gsmap.render.rendering import render
from gsmap.types.tensors import require_torch

if TYPE_CHECKING:
    from gsmap.render.tensors import GaussianTensors

__all__ = [
    "ChunkIndex",
    "FitOptions",
    "Fitter",
    "GaussianTensors",
    "LearningRates",
    "Rendering",
    "backend",
    "make_fitter",
    "num_threads",
    "render",
    "set_num_threads",
]


def __getattr__(name: str) -> Any:
    if name == "GaussianTensors":
        require_torch("tensors of Gaussians")
        return importlib.import_module("gsmap.render.tensors").GaussianTensors
    raise AttributeError(f"module 'gsmap.render' has no attribute {name!r}")
