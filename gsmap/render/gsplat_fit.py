"""The fitter on the GPU: gsplat renders and differentiates; the loss and Adam are one kernel each."""

from __future__ import annotations

import weakref
from collections import Counter
from typing import Any

import numpy as np
import torch

from gsmap.render import adam, gsplat, native
from gsmap.render.blending_weights import TileLists, blending_weights
from gsmap.render.fitter import (
    FitOptions,
    Fitter,
    LearningRates,
    Statistics,
    check_appended,
    check_pixels,
    checked_mask,
)
from gsmap.render.image_loss import KnownLoss, image_loss
from gsmap.render.outputs import image_size
from gsmap.render.view_step import ViewStep
from gsmap.types import Cameras, Gaussians

_RARE, _MOST_SIZES = 2, 8  # uses of a size of pictures before it is recorded, and number of sizes that are


class GsplatFitter(Fitter):
    """See `gsmap.render.fitter.Fitter`. Gradients are added in another order in every run, so results vary slightly."""

    def __init__(
        self,
        gaussians: Gaussians,
        learning_rates: LearningRates | None = None,
        *,
        frozen: np.ndarray | None = None,
        options: FitOptions | None = None,
    ) -> None:
        super().__init__(gaussians, learning_rates, options=options)
        gsplat.load()
        self._device = gsplat.device()
        held = checked_mask(frozen, len(gaussians))
        self._background = torch.tensor(self.options.background, dtype=torch.float32, device=self._device)
        self._views: weakref.WeakKeyDictionary[Cameras, gsplat.DeviceViews] = weakref.WeakKeyDictionary()
        self._corrections = adam.corrections(self.options.betas, self._device)
        self._rates, self._sent = adam.rates_on(self.learning_rates, self._device), self.learning_rates
        values = self._moved(gaussians)
        self._set(
            values,
            [[torch.zeros_like(value) for value in values] for _ in range(2)],
            torch.zeros(len(gaussians), dtype=torch.int32, device=self._device),
            torch.tensor(np.zeros(len(gaussians), bool) if held is None else held, device=self._device),
        )

    def _moved(self, gaussians: Gaussians) -> list[torch.Tensor]:
        return [torch.tensor(a, device=self._device) for a in native.arrays_of(gaussians)]

    def __len__(self) -> int:
        return len(self._values[0])

    def _set(
        self,
        values: list[torch.Tensor],
        moments: list[list[torch.Tensor]],
        updates: torch.Tensor,
        frozen: torch.Tensor,
    ) -> None:
        self._values, self._moments, self._updates, self._frozen = values, moments, updates, frozen
        hidden = ~gsplat.drawable(values)
        # Gaussians that cannot be drawn do not change; in their place something that no pixel shows is drawn.
        self._hidden = hidden if bool(hidden.any()) else None
        self._view_steps: dict[tuple[object, ...], ViewStep] = {}
        self._uses: Counter[tuple[object, ...]] = Counter()
        self.reset_statistics()

    def reset_statistics(self) -> None:
        n = len(self)
        self._gradient_norm = torch.zeros(n, device=self._device)
        self._seen = torch.zeros(n, dtype=torch.int32, device=self._device)
        self._max_weight = torch.zeros(n, device=self._device)

    def statistics(self) -> Statistics:
        counted = (self._gradient_norm, self._seen, self._max_weight)
        return Statistics(*(t.cpu().numpy().copy() for t in counted))

    def gaussians(self) -> Gaussians:
        return Gaussians(*(t.cpu().numpy().copy() for t in self._values))

    def load(self, array: np.ndarray) -> Any:
        try:
            return torch.from_numpy(np.ascontiguousarray(array)).to(self._device)
        except torch.cuda.OutOfMemoryError:
            return array  # the array is then sent to the GPU at every step

    def step(self, cameras: Cameras, images: Any, masks: Any = None) -> torch.Tensor | float:
        width, height = image_size(cameras)
        count, options = len(cameras), self.options
        targets = self._pixels(images, (count, height, width, 3), "images")
        weights = None if masks is None else self._pixels(masks, (count, height, width), "masks")
        if count == 0:
            return 0.0
        if self.learning_rates != self._sent:
            self._rates.copy_(adam.rates_on(self.learning_rates, torch.device("cpu")), non_blocking=True)
            self._sent = self.learning_rates
        views = self._seen_from(cameras)
        kind = (width, height, targets.dtype, None if weights is None else weights.dtype)
        self._uses[kind] += 1
        # A recorded size keeps memory, so sizes that are rare, and more than a few sizes, are not recorded.
        known = kind in self._view_steps or (self._uses[kind] > _RARE and len(self._view_steps) < _MOST_SIZES)
        if count > 1 or options.statistics or not known:
            return self._step_packed(views, targets, weights)
        if kind not in self._view_steps:
            background = self._background if any(options.background) else None
            loss = (options.ssim_weight, options.huber_delta)
            self._view_steps[kind] = ViewStep(views, targets, weights, background, *loss)
        return self._view_steps[kind](self._drawn, self._update, views, targets, weights)

    def _step_packed(
        self, views: gsplat.DeviceViews, targets: torch.Tensor, weights: torch.Tensor | None
    ) -> torch.Tensor:
        """Take a step on several views at once, with statistics, or on a view of a rare size."""
        options = self.options
        drawn = self._drawn()
        colour, alpha, _, lists = gsplat.rasterize(drawn, views, depth=False)
        if any(options.background):
            colour = colour + (1 - alpha) * self._background
        if options.statistics:
            lists.means2d.retain_grad()
        losses, gradient = image_loss(colour.detach(), targets, weights, options.ssim_weight, options.huber_delta)
        if len(lists.listed):
            KnownLoss.apply(colour, gradient).backward()
            leaves = (drawn.means, drawn.quats, drawn.scales, drawn.opacities, drawn.sh)
            gradients = [leaf.grad for leaf in leaves if leaf.grad is not None]
            if options.statistics:
                self._count(gradients, lists, views.width, views.height)
            self._update(drawn, gradients)
        return losses.mean()

    def _update(self, drawn: gsplat.DrawableGaussians, gradients: list[torch.Tensor]) -> None:
        adam.step(
            self._values,
            gradients,
            self._moments,
            drawn.scales,
            drawn.opacities,
            self._frozen,
            self._updates,
            self._corrections,
            self._rates,
            self.options.betas,
            self.options.epsilon,
        )

    @torch.no_grad()
    def _drawn(self) -> gsplat.DrawableGaussians:
        """Return the Gaussians as they are drawn, as leaves of a new graph."""
        means, quats, log_scales, logits, sh = self._values
        scales, opacities = log_scales.exp(), torch.sigmoid(logits)
        if self._hidden is not None:
            hidden = self._hidden[:, None]
            means, quats, scales = (torch.where(hidden, 1.0, t) for t in (means, quats, scales))
            opacities, sh = torch.where(self._hidden, 0.0, opacities), torch.where(hidden[..., None], 0.0, sh)
        return gsplat.DrawableGaussians(
            means.detach().requires_grad_(),
            gsplat.without_zeros(quats).requires_grad_(),
            scales.requires_grad_(),
            opacities.requires_grad_(),
            sh.detach().requires_grad_(),
            rows=None,
            num_all=len(means),
        )

    def _seen_from(self, cameras: Cameras) -> gsplat.DeviceViews:
        """Return the cameras on the GPU; they are cached, because a schedule uses the same cameras many times."""
        if cameras not in self._views:
            self._views[cameras] = gsplat.DeviceViews.of(cameras)
        return self._views[cameras]

    @torch.no_grad()
    def _count(self, gradients: list[torch.Tensor], lists: TileLists, width: int, height: int) -> None:
        """Add the views of a step to the statistics."""
        _, weights = blending_weights(lists, height, width, len(self), max_weight=True)
        assert weights is not None
        self._max_weight = torch.maximum(self._max_weight, weights)
        gradient = lists.means2d.grad
        assert gradient is not None
        norm = (gradient * gradient.new_tensor([width / 2, height / 2])).norm(dim=-1)
        if lists.gaussian is None:
            seen, norm = adam.touched(gradients).int(), norm[0]
        else:  # packed: one row for each visible Gaussian of each view
            owner = lists.gaussian.long()
            seen = self._seen.new_zeros(len(self)).index_add(0, owner, (norm > 0).int())
            norm = norm.new_zeros(len(self)).index_add(0, owner, norm)
        self._gradient_norm += norm * ~self._frozen
        self._seen += seen * ~self._frozen

    def keep(self, rows: np.ndarray) -> None:
        at = torch.as_tensor(rows, device=self._device)
        self._set(
            [value[at] for value in self._values],
            [[value[at] for value in moment] for moment in self._moments],
            self._updates[at],
            self._frozen[at],
        )

    def append(self, gaussians: Gaussians, frozen: np.ndarray | None = None) -> None:
        check_appended(gaussians, self._values[4].shape[1])
        added = checked_mask(frozen, len(gaussians))
        new = self._moved(gaussians)
        more = torch.tensor(np.zeros(len(gaussians), bool) if added is None else added, device=self._device)
        self._set(
            [torch.cat([a, b]) for a, b in zip(self._values, new, strict=True)],
            [[torch.cat([a, torch.zeros_like(b)]) for a, b in zip(m, new, strict=True)] for m in self._moments],
            torch.cat([self._updates, self._updates.new_zeros(len(gaussians))]),
            torch.cat([self._frozen, more]),
        )

    def _pixels(self, values: Any, shape: tuple[int, ...], name: str) -> torch.Tensor:
        """Move images or masks to the GPU, as bytes or float32."""
        check_pixels(values, shape, name)
        if not isinstance(values, torch.Tensor):
            values = torch.from_numpy(np.ascontiguousarray(values))
        values = values.to(self._device)
        out: torch.Tensor = values if values.dtype == torch.uint8 else values.float()
        return out
