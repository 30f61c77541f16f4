"""Choice of the fitter of a backend, and the fallback where a GPU cannot hold a fit."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import TypeVar

import numpy as np

from gsmap.render.backends import backend as resolved
from gsmap.render.fitter import FitOptions, Fitter, LearningRates
from gsmap.types import Gaussians

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
        backend: as for `gsmap.render.render`. The native one gives the same bits for any number of threads; gsplat adds
            gradients up in another order in every run.

    Raises:
        ConfigError: an unknown backend.
        InputError: arrays that do not fit together.
        MissingDependencyError: gsplat is requested and not installed.
    """
    if resolved(backend) == "gsplat":
        from gsmap.render.gsplat_fit import GsplatFitter

        return GsplatFitter(gaussians, learning_rates, frozen=frozen, options=options)
    from gsmap.render.native_fit import NativeFitter

    return NativeFitter(gaussians, learning_rates, frozen=frozen, options=options)


def with_enough_memory(fit: Callable[[str], Fitted], backend: str = "auto") -> Fitted:
    """Run a fit on a backend; where the GPU's memory runs out, run it once more on the CPU, with a warning.

    Args:
        fit: given the name of a backend, makes a fitter, steps it and returns what was wanted.
    """
    chosen = resolved(backend)
    if chosen == "native":
        return fit(chosen)
    import torch

    try:
        return fit(chosen)
    except torch.cuda.OutOfMemoryError as error:
        logger.warning("the GPU's memory cannot hold an optimization; it runs on the CPU: %s", error)
    torch.cuda.empty_cache()
    return fit("native")
