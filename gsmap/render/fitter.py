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
    """Step sizes of Adam for each attribute; the defaults are usual in 3DGS training. ``means`` is in the frame's
    unit."""

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
        ssim_weight: share of ``1 - SSIM`` in the loss; the rest is Huber's loss of the colours.
        huber_delta: differences of colours below this count by their square (Huber's loss); 0 gives the L1 loss.
        background: colour behind all Gaussians.
        statistics: also keep the `Statistics` that densification and pruning need, which is about a tenth slower.
        betas, epsilon: parameters of Adam (Kingma & Ba 2015).
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
        gradient_norm: (N,) float32 sum over views of the norm of dL/d(projected centre), in halves of the image's sides
            as in 3DGS (whose threshold is 2e-4 per view).
        seen: (N,) int32 number of views in which the Gaussian had a gradient.
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

    Each Gaussian counts its own Adam updates. A step does not move a Gaussian that contributes to no pixel of its
    images, so old momentum does not carry away unseen Gaussians. If all Gaussians are seen in every step, this is
    `torch.optim.Adam`.

    Args:
        gaussians: initial Gaussians, which are copied.
        learning_rates: step sizes; they may be replaced between steps (``fitter.learning_rates = ...``).
        frozen: (N,) mask of Gaussians that are rendered but never changed.
        options: options of the loss and of Adam.

    Raises:
        InputError: the shapes of the arrays do not agree.
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
        self._options = options or FitOptions()

    @property
    def options(self) -> FitOptions:
        return self._options

    @abstractmethod
    def __len__(self) -> int: ...

    @abstractmethod
    def gaussians(self) -> Gaussians:
        """Return a copy of the current Gaussians."""

    @abstractmethod
    def step(self, cameras: Cameras, images: Any, masks: Any = None) -> Any:
        """Render, compare with the images and take a step; return the loss before the step, its mean over the views.

        The loss is a number or can be converted to one by ``float``, which waits for the GPU.

        Args:
            cameras: V views of one size, usually one; memory grows by 64 bytes per visible Gaussian and view.
            images: (V, H, W, 3) float32 in [0, 1], or uint8; or the result of `load` for them.
            masks: (V, H, W) weights of the pixels, bool, float32 or uint8; a view whose weights are all 0 adds nothing.

        Raises:
            InputError: the shapes do not agree with the cameras.
        """

    def load(self, array: np.ndarray) -> Any:
        """Move images or masks that are used in many steps to the device of the fitter, as long as there is memory for
        them."""
        return array

    @abstractmethod
    def keep(self, rows: np.ndarray) -> None:
        """Keep only the given Gaussians (a mask or indices), with their optimizer state."""

    @abstractmethod
    def append(self, gaussians: Gaussians, frozen: np.ndarray | None = None) -> None:
        """Append Gaussians, with fresh optimizer state.

        Raises:
            InputError: the SH degree differs.
        """

    @abstractmethod
    def reset_statistics(self) -> None:
        """Reset `Statistics` to zero; a change of N does so too."""

    @abstractmethod
    def statistics(self) -> Statistics:
        """Return the statistics since the last reset; all zeros unless ``options.statistics``."""


def checked_mask(mask: np.ndarray | None, n: int) -> np.ndarray | None:
    """Check ``frozen``, an (N,) mask or None, and return it."""
    if mask is None:
        return None
    mask = np.ascontiguousarray(mask, dtype=bool)
    if mask.shape != (n,):
        raise InputError(f"frozen must be a mask of shape ({n},), got {mask.shape}", code="shape_mismatch")
    return mask


def check_pixels(values: Any, shape: tuple[int, ...], name: str) -> None:
    """Raise InputError if images or masks do not have the shape of the cameras."""
    if tuple(values.shape) != shape:
        raise InputError(
            f"{name} must have the shape {shape} of the cameras, got {tuple(values.shape)}", code="shape_mismatch"
        )


def check_appended(gaussians: Gaussians, num_sh: int) -> None:
    """Raise InputError if Gaussians to be appended have another SH degree."""
    if gaussians.sh.shape[1] != num_sh:
        raise InputError(
            f"appended Gaussians have {gaussians.sh.shape[1]} SH coefficients, not {num_sh}", code="shape_mismatch"
        )
