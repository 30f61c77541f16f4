"""Optimisation of Gaussians against images: render, loss, backward pass and Adam, all native."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmap._native import fit_step, image_loss
from gsmap.errors import InputError
from gsmap.render import native
from gsmap.render.outputs import image_size
from gsmap.types import Cameras, Gaussians

_NAMES = ("means", "quats", "log_scales", "logit_opacities", "sh")


@dataclass(frozen=True)
class LearningRates:
    """Adam's step size per attribute (the usual ones of 3DGS training; ``means`` is in the frame's unit)."""

    means: float = 1.6e-4
    quats: float = 1e-3
    log_scales: float = 5e-3
    logit_opacities: float = 5e-2
    sh_base: float = 2.5e-3
    sh_rest: float = 1.25e-4


class Fitter:
    """Fits Gaussians to images of known cameras, one Adam step at a time.

    ::

        fitter = Fitter(gaussians, LearningRates(means=1e-4), frozen=halo)
        for i in schedule:
            loss = fitter.step(cameras[i], images[i : i + 1])
        result = fitter.gaussians()

    Each Gaussian counts its own Adam updates: one that contributes to no pixel of a step's images is not moved by that
    step (stale momentum does not carry it away unseen); where all are seen every step this is `torch.optim.Adam`.
    The arrays ``means quats log_scales logit_opacities sh`` are live and may be edited in place between steps (to reset
    opacities, say). The same inputs give the same bits for any number of threads.

    Args:
        gaussians: where to start; copied.
        learning_rates: may be replaced between steps (``fitter.learning_rates = ...``).
        frozen: (N,) bool, Gaussians that are rendered but never changed.
        ssim_weight: share of ``1 - SSIM`` in the loss; the rest is Huber's of the colours.
        huber_delta: differences of colours below this count by their square (Huber's loss); 0 is L1.
        background: colour behind everything.
        statistics: also keep what a densifier or pruner needs (about a tenth slower):
            ``gradient_norm`` (N,) float32, sum over views of the norm of dL/d(projected centre), in halves of the
            image's sides as 3DGS counts it (its threshold is 2e-4 per view); ``seen`` (N,) int32, views in which the
            Gaussian had a gradient; ``max_weight`` (N,) float32, largest blending weight in any pixel. All since the
            last `reset_statistics` or change of N.

    Raises:
        InputError: arrays that do not fit together.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        learning_rates: LearningRates | None = None,
        *,
        frozen: np.ndarray | None = None,
        ssim_weight: float = 0.0,
        huber_delta: float = 0.0,
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
        statistics: bool = False,
        betas: tuple[float, float] = (0.9, 0.999),
        epsilon: float = 1e-15,
    ) -> None:
        self.learning_rates = learning_rates or LearningRates()
        self.ssim_weight, self.huber_delta = float(ssim_weight), float(huber_delta)
        self.statistics = statistics
        self._background = np.asarray(background, np.float32)
        self._betas, self._epsilon = betas, epsilon
        self._views: list[native.View] = []
        self._set([a.copy() for a in native.arrays_of(gaussians)])
        self._moments = [[np.zeros_like(a) for a in self._values] for _ in range(2)]
        self._updates = np.zeros(len(self), np.uint32)
        self.frozen = _mask(frozen, len(self))

    def __len__(self) -> int:
        return len(self.means)

    def _set(self, values: list[np.ndarray]) -> None:
        self._values = values
        self.means, self.quats, self.log_scales, self.logit_opacities, self.sh = values
        self.reset_statistics()

    def reset_statistics(self) -> None:
        """Start counting ``gradient_norm``, ``seen`` and ``max_weight`` anew."""
        n = len(self)
        self.gradient_norm = np.zeros(n, np.float32)
        self.seen = np.zeros(n, np.int32)
        self.max_weight = np.zeros(n, np.float32)

    def gaussians(self) -> Gaussians:
        """The Gaussians as they are now (a copy)."""
        return Gaussians(*(a.copy() for a in self._values))

    def step(self, cameras: Cameras, images: np.ndarray, masks: np.ndarray | None = None) -> float:
        """Render, compare, step; returns the loss before the step (its mean over the views).

        Args:
            cameras: V views of one size, usually one; memory grows by 64 bytes per visible Gaussian and view.
            images: (V, H, W, 3) float32 in [0, 1], or uint8.
            masks: (V, H, W) weights of the pixels, bool or float32; a view without any weight adds nothing.

        Raises:
            InputError: shapes that differ from the cameras'.
        """
        width, height = image_size(cameras)
        count = len(cameras)
        images = _pixels(images, (count, height, width, 3), "images")
        masks = None if masks is None else _pixels(masks, (count, height, width), "masks")
        if count == 0:
            return 0.0
        while len(self._views) < count:
            self._views.append(native.View())
        out = native.allocate(count, height, width, 0, False, False, False)
        out["max_weight"] = self.max_weight if self.statistics else None
        gradient = np.empty_like(out["colour"])
        arrays = tuple(self._values)
        loss = 0.0
        for i in range(count):
            pose, intrinsics = cameras.T_camera_frame[i], cameras.intrinsics_px[i]
            mask = None if masks is None else masks[i]
            looked_at = None if self.statistics else mask  # statistics are of whole pictures
            native.forward(self._views[i], arrays, pose, intrinsics, self._background, out, i, None, looked_at)
            loss += (
                image_loss(out["colour"][i], images[i], mask, self.ssim_weight, self.huber_delta, gradient[i]) / count
            )
        if count > 1:
            gradient /= count
        rates = self.learning_rates
        fit_step(
            self._views[:count],
            background=self._background,
            colour=out["colour"],
            alpha=out["alpha"],
            g_colour=gradient,
            values=self._values,
            m=self._moments[0],
            v=self._moments[1],
            updates=self._updates,
            frozen=None if self.frozen is None else self.frozen.view(np.uint8),
            rates=[
                rates.means,
                rates.quats,
                rates.log_scales,
                rates.logit_opacities,
                rates.sh_base,
                rates.sh_rest,
            ],
            beta1=self._betas[0],
            beta2=self._betas[1],
            epsilon=self._epsilon,
            gradient_norm=self.gradient_norm if self.statistics else None,
            seen=self.seen if self.statistics else None,
        )
        return loss

    def keep(self, rows: np.ndarray) -> None:
        """Keep only these Gaussians (boolean mask or indices), with their optimiser state."""
        self._moments = [[a[rows] for a in moment] for moment in self._moments]
        self._updates = self._updates[rows]
        self.frozen = None if self.frozen is None else self.frozen[rows]
        self._set([np.ascontiguousarray(a[rows]) for a in self._values])

    def append(self, gaussians: Gaussians, frozen: np.ndarray | None = None) -> None:
        """Add Gaussians behind the others, with fresh optimiser state.

        Raises:
            InputError: another SH degree.
        """
        if gaussians.sh.shape[1] != self.sh.shape[1]:
            raise InputError(f"appended Gaussians have {gaussians.sh.shape[1]} SH coefficients, not {self.sh.shape[1]}")
        before, more = len(self), len(gaussians)
        added = _mask(frozen, more)
        if self.frozen is not None or added is not None:
            old = np.zeros(before, bool) if self.frozen is None else self.frozen
            self.frozen = np.concatenate([old, np.zeros(more, bool) if added is None else added])
        new = native.arrays_of(gaussians)
        self._moments = [
            [np.concatenate([a, np.zeros_like(b)]) for a, b in zip(moment, new, strict=True)]
            for moment in self._moments
        ]
        self._updates = np.concatenate([self._updates, np.zeros(more, np.uint32)])
        self._set([np.concatenate([a, b]) for a, b in zip(self._values, new, strict=True)])

    def reset_state(self, attribute: str, rows: np.ndarray | slice = slice(None)) -> None:
        """Forget Adam's moments of one attribute (``means``, ``logit_opacities``, ...), after editing its values."""
        for moment in self._moments:
            moment[_NAMES.index(attribute)][rows] = 0


def _mask(mask: np.ndarray | None, n: int) -> np.ndarray | None:
    if mask is None:
        return None
    mask = np.ascontiguousarray(mask, dtype=bool)
    if mask.shape != (n,):
        raise InputError(f"frozen must be a mask of shape ({n},), got {mask.shape}")
    return mask


def _pixels(values: np.ndarray, shape: tuple[int, ...], name: str) -> np.ndarray:
    values = np.asarray(values)
    if values.shape != shape:
        raise InputError(f"{name} must have the cameras' shape {shape}, got {values.shape}")
    if values.dtype == np.uint8:
        return values.astype(np.float32) / np.float32(255.0)
    return np.ascontiguousarray(values, dtype=np.float32)
