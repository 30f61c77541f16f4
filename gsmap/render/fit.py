"""Choose the fitter of a backend, and fall back to the CPU if the GPU has too little memory for a fit."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import TypeVar

import numpy as np

from gsmap.render.backends import backend as resolved
from gsmap.render.fitter import FitOptions, Fitter, LearningRates
from gsmap.types import Gaussians
from gsmap.types.tensors import require_torch

logger = logging.getLogger(__name__)

Fitted = TypeVar("Fitted")


def make_fitter(
    gaussians: Gaussians,
    learning_rates: LearningRates | None = None,
    *,
    frozen: np.ndarray | None = None,
    options: FitOptions | None = None,
    backend: str = "auto",
) -> Fitter:
    """Create the fitter of a backend; see `Fitter`.

    Args:
        backend: see `gsmap.render.render`. The native fitter gives the same bits for any number of threads; that of
            a GPU adds gradients in another order in every run.

    Raises:
        ConfigError: the backend is unknown.
        InputError: the shapes of the arrays do not agree.
        MissingDependencyError: gsplat is requested but not installed.
    """
    if resolved(backend) == "gsplat":
        require_torch("fits by gsplat")
        from gsmap.render.cuda_fit import CudaFitter

        return CudaFitter(gaussians, learning_rates, frozen=frozen, options=options)
    from gsmap.render.native_fit import NativeFitter

    return NativeFitter(gaussians, learning_rates, frozen=frozen, options=options)


def with_enough_memory(fit: Callable[[str], Fitted], backend: str = "auto") -> Fitted:
    """Run a fit on a backend; if the GPU's memory runs out, repeat it on the CPU, with a warning.

    Args:
        fit: function that takes the name of a backend, creates a fitter, steps it and returns the result.
    """
    chosen = resolved(backend)
    if chosen == "native":
        return fit(chosen)
    import torch

    try:
        return fit(chosen)
    except torch.cuda.OutOfMemoryError as error:
        logger.warning("the GPU has too little memory for the optimization, which runs on the CPU instead: %s", error)
    torch.cuda.empty_cache()
    return fit("native")
