"""The fitter on the CPU: rendering, loss, backward pass and Adam are all native."""

from __future__ import annotations

from typing import Any

import numpy as np

from gsmap._native import fit_step, image_loss
from gsmap.render import native
from gsmap.render.fitter import (
    FitOptions,
    Fitter,
    LearningRates,
    Statistics,
    check_appended,
    check_pixels,
    checked_mask,
)
from gsmap.render.outputs import image_size
from gsmap.types import Cameras, Gaussians


class NativeFitter(Fitter):
    """See `gsmap.render.fitter.Fitter`; the same inputs give the same bits for any number of threads.

    The arrays ``means quats log_scales logit_opacities sh`` are the fitter's own and may be edited in place between
    steps.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        learning_rates: LearningRates | None = None,
        *,
        frozen: np.ndarray | None = None,
        options: FitOptions | None = None,
    ) -> None:
        super().__init__(gaussians, learning_rates, options=options)
        self._background = np.asarray(self.options.background, np.float32)
        self._views: list[native.View] = []
        self._pixels = np.empty(0, np.float32)  # memory of images, which is used again: new pages must be cleared
        self._set([a.copy() for a in native.arrays_of(gaussians)])
        self._moments = [[np.zeros_like(a) for a in self._values] for _ in range(2)]
        self._updates = np.zeros(len(self), np.uint32)
        self.frozen = checked_mask(frozen, len(self))

    def __len__(self) -> int:
        return len(self.means)

    def _set(self, values: list[np.ndarray]) -> None:
        self._values = values
        self.means, self.quats, self.log_scales, self.logit_opacities, self.sh = values
        self.reset_statistics()

    def reset_statistics(self) -> None:
        n = len(self)
        self._statistics = Statistics(np.zeros(n, np.float32), np.zeros(n, np.int32), np.zeros(n, np.float32))

    def statistics(self) -> Statistics:
        return Statistics(*(a.copy() for a in vars(self._statistics).values()))

    def gaussians(self) -> Gaussians:
        return Gaussians(*(a.copy() for a in self._values))

    def step(self, cameras: Cameras, images: np.ndarray, masks: np.ndarray | None = None) -> float:
        options = self.options
        width, height = image_size(cameras)
        count = len(cameras)
        images = _pixels(images, (count, height, width, 3), "images")
        masks = None if masks is None else _pixels(masks, (count, height, width), "masks")
        if count == 0:
            return 0.0
        while len(self._views) < count:
            self._views.append(native.View())
        counted = self._statistics if options.statistics else None
        out, gradient = self._images(count, height, width)
        out["max_weight"] = None if counted is None else counted.max_weight
        arrays = tuple(self._values)
        loss = 0.0
        for i in range(count):
            pose, intrinsics = cameras.T_camera_frame[i], cameras.intrinsics_px[i]
            mask = None if masks is None else masks[i]
            looked_at = None if options.statistics else mask  # statistics need whole images
            native.forward(self._views[i], arrays, pose, intrinsics, self._background, out, i, None, looked_at)
            colour = out["colour"][i]
            loss += image_loss(colour, images[i], mask, options.ssim_weight, options.huber_delta, gradient[i]) / count
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
            beta1=options.betas[0],
            beta2=options.betas[1],
            epsilon=options.epsilon,
            gradient_norm=None if counted is None else counted.gradient_norm,
            seen=None if counted is None else counted.seen,
        )
        return loss

    def _images(self, count: int, height: int, width: int) -> tuple[dict[str, Any], np.ndarray]:
        """Return images by name as in `native.allocate`, and (V, H, W, 3) for gradients; all undefined."""
        n = count * height * width
        if len(self._pixels) < 7 * n:
            self._pixels = np.empty(7 * n, np.float32)
        shape = (count, height, width)
        colour, gradient, alpha = np.split(self._pixels[: 7 * n], [3 * n, 6 * n])
        images: dict[str, Any] = dict.fromkeys(("depth", "dominant_id", "max_weight"))
        images |= {"colour": colour.reshape(*shape, 3), "alpha": alpha.reshape(shape)}
        return images, gradient.reshape(*shape, 3)

    def keep(self, rows: np.ndarray) -> None:
        self._moments = [[a[rows] for a in moment] for moment in self._moments]
        self._updates = self._updates[rows]
        self.frozen = None if self.frozen is None else self.frozen[rows]
        self._set([np.ascontiguousarray(a[rows]) for a in self._values])

    def append(self, gaussians: Gaussians, frozen: np.ndarray | None = None) -> None:
        check_appended(gaussians, self.sh.shape[1])
        before, more = len(self), len(gaussians)
        added = checked_mask(frozen, more)
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


def _pixels(values: np.ndarray, shape: tuple[int, ...], name: str) -> np.ndarray:
    values = np.asarray(values)
    check_pixels(values, shape, name)
    if values.dtype == np.uint8:
        return values.astype(np.float32) / np.float32(255.0)
    return np.ascontiguousarray(values, dtype=np.float32)
