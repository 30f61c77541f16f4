"""Contract of fitters, which optimize Gaussians against images of known cameras."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np

from gsmap.errors import InputError
from gsmap.types import Cameras, Gaussians


@dataclass(frozen=True)
class LearningRates:
    """Adam's step size per attribute (the usual ones of 3DGS training; ``means`` is in the frame's unit)."""

    means: float = 1.6e-4
    quats: float = 1e-3
    log_scales: float = 5e-3
    logit_opacities: float = 5e-2
    sh_base: float = 2.5e-3
    sh_rest: float = 1.25e-4


@dataclass(frozen=True)
class FitOptions:
    """Options of the optimization steps of a fitter.

    Args:
        ssim_weight: share of ``1 - SSIM`` in the loss; the rest is Huber's of the colours.
        huber_delta: differences of colours below this count by their square (Huber's loss); 0 is L1.
        background: colour behind everything.
        statistics: also keep what a densifier or pruner needs (about a tenth slower): see `Statistics`.
        betas, epsilon: Adam's (Kingma & Ba 2015).
    """

    ssim_weight: float = 0.0
    huber_delta: float = 0.0
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    statistics: bool = False
    betas: tuple[float, float] = (0.9, 0.999)
    epsilon: float = 1e-15


@dataclass(frozen=True, eq=False)
class Statistics:
    """Statistics of N Gaussians for densification and pruning.

    Args:
        gradient_norm: (N,) float32, sum over views of the norm of dL/d(projected centre), in halves of the image's
            sides as 3DGS counts it (its threshold is 2e-4 per view).
        seen: (N,) int32, views in which the Gaussian had a gradient.
        max_weight: (N,) float32, largest blending weight in any pixel.
    """

    gradient_norm: np.ndarray
    seen: np.ndarray
    max_weight: np.ndarray


class Fitter(ABC):
    """Fits Gaussians to images of known cameras, one Adam step at a time.

    ::

        fitter = make_fitter(gaussians, LearningRates(means=1e-4), frozen=halo)
        for i in schedule:
            loss = fitter.step(cameras[i], images[i : i + 1])
        result = fitter.gaussians()

    Each Gaussian counts its own Adam updates: one that contributes to no pixel of a step's images is not moved by that
    step (stale momentum does not carry it away unseen); where all are seen every step this is `torch.optim.Adam`.

    Args:
        gaussians: where to start; copied.
        learning_rates: may be replaced between steps (``fitter.learning_rates = ...``).
        frozen: (N,) bool, Gaussians that are rendered but never changed.
        options: losses and Adam.

    Raises:
        InputError: arrays that do not fit together.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        learning_rates: LearningRates | None = None,
        *,
        frozen: np.ndarray | None = None,
        options: FitOptions | None = None,
    ) -> None:
        self.learning_rates = learning_rates or LearningRates()
        self.options = options or FitOptions()

    @abstractmethod
    def __len__(self) -> int: ...

    @abstractmethod
    def gaussians(self) -> Gaussians:
        """Return the current Gaussians (a copy)."""

    @abstractmethod
    def step(self, cameras: Cameras, images: Any, masks: Any = None) -> Any:
        """Render, compare, step; returns the loss before the step (its mean over the views).

        The loss is a number, or becomes one by ``float``, which waits for the GPU.

        Args:
            cameras: V views of one size, usually one; memory grows by 64 bytes per visible Gaussian and view.
            images: (V, H, W, 3) float32 in [0, 1], or uint8; or what `load` made of them.
            masks: (V, H, W) weights of the pixels, bool, float32 or uint8; a view without any weight adds nothing.

        Raises:
            InputError: shapes that differ from the cameras'.
        """

    def load(self, array: np.ndarray) -> Any:
        """Move images or masks of many steps to where the fitter computes, as long as there is memory for them."""
        return array

    @abstractmethod
    def keep(self, rows: np.ndarray) -> None:
        """Keep only these Gaussians (boolean mask or indices), with their optimiser state."""

    @abstractmethod
    def append(self, gaussians: Gaussians, frozen: np.ndarray | None = None) -> None:
        """Add Gaussians behind the others, with fresh optimiser state.

        Raises:
            InputError: another SH degree.
        """

    @abstractmethod
    def reset_statistics(self) -> None:
        """Start counting `Statistics` anew; a change of N does so too."""

    @abstractmethod
    def statistics(self) -> Statistics:
        """Return the statistics since the last reset; all zeros unless ``options.statistics``."""


def checked_mask(mask: np.ndarray | None, n: int) -> np.ndarray | None:
    """Validate ``frozen``: (N,) bool, or None."""
    if mask is None:
        return None
    mask = np.ascontiguousarray(mask, dtype=bool)
    if mask.shape != (n,):
        raise InputError(f"frozen must be a mask of shape ({n},), got {mask.shape}", code="shape_mismatch")
    return mask


def check_pixels(values: Any, shape: tuple[int, ...], name: str) -> None:
    """Raise InputError where images or masks differ from the cameras' shape."""
    if tuple(values.shape) != shape:
        raise InputError(
            f"{name} must have the cameras' shape {shape}, got {tuple(values.shape)}", code="shape_mismatch"
        )


def check_appended(gaussians: Gaussians, num_sh: int) -> None:
    """Raise InputError where Gaussians to be appended have another SH degree."""
    if gaussians.sh.shape[1] != num_sh:
        raise InputError(
            f"appended Gaussians have {gaussians.sh.shape[1]} SH coefficients, not {num_sh}", code="shape_mismatch"
        )
