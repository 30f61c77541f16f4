"""One optimization step on one view in tensors of fixed size, so that CUDA can replay it.

A step launches about a hundred kernels, which takes the CPU longer than the GPU needs to run them. CUDA therefore
records them once, as two graphs, and replays them: the first projects the Gaussians and counts the tiles that they
touch; the CPU reads this number, because it decides how long the lists of tiles must be; the second graph sorts,
blends, differentiates and updates. There is one second graph for each length, a quarter of an octave apart. A graph is
recorded when it is used for the second time; without CUDA the same functions run as they are.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable

import torch

from gsmap.render import gsplat
from gsmap.render.backends import has_triton
from gsmap.render.blending_weights import TILE_PX
from gsmap.render.image_loss import KnownLoss, image_loss
from gsmap.render.tile_lists import tile_lists, touched_tiles

logger = logging.getLogger(__name__)

_FEWEST_TILES = 1 << 14


class ViewStep:
    """Steps on views of one size.

    Args:
        views, image, mask: a first view, its (1, H, W, 3) image and (1, H, W) mask or None, whose shapes and types all
            later ones have.
        background: (3,) colour, or None for black.
        ssim_weight, huber_delta: see `gsmap.render.fitter.FitOptions`.
    """

    def __init__(
        self,
        views: gsplat.DeviceViews,
        image: torch.Tensor,
        mask: torch.Tensor | None,
        background: torch.Tensor | None,
        ssim_weight: float,
        huber_delta: float,
    ) -> None:
        self._background, self._loss_options = background, (ssim_weight, huber_delta)
        self._down, self._across = -(-views.height // TILE_PX), -(-views.width // TILE_PX)
        poses = (views.T_camera_frame.clone(), views.K.clone(), views.centers.clone())
        self._views = gsplat.DeviceViews(*poses, views.width, views.height)
        self._image, self._mask = image.clone(), None if mask is None else mask.clone()
        self._loss = torch.zeros(1, device=image.device)
        # The tiles below the image take what exceeds the real lists; they are not blended.
        self._blended = torch.ones((1, self._down + 1, self._across), dtype=torch.bool, device=image.device)
        self._blended[:, -1] = False
        self._recorder = _Recorder()

    def __call__(
        self,
        draw: Callable[[], gsplat.DrawableGaussians],
        update: Callable[[gsplat.DrawableGaussians, list[torch.Tensor]], None],
        views: gsplat.DeviceViews,
        image: torch.Tensor,
        mask: torch.Tensor | None,
    ) -> torch.Tensor:
        """Take a step; return the loss before it.

        Args:
            draw: returns the Gaussians as leaves of a new autograd graph. It and ``update`` are the same in all steps.
            update: changes them in place by their gradients (means, quats, scales, opacities and sh).
        """
        kept = (self._views.T_camera_frame, self._views.K, self._views.centers, self._image, self._mask)
        given = (views.T_camera_frame, views.K, views.centers, image, mask)
        for mine, new in zip(kept, given, strict=True):
            if mine is not None and new is not None:
                mine.data.copy_(new)  # data: autograd need not know, the first graph is replayed before it is used
        self._recorder("project", lambda: self._project(draw))
        capacity = _capacity(int(self._touched.upto[-1]))
        self._recorder(capacity, lambda: self._finish(capacity, update))
        return self._loss[0].clone()

    def _project(self, draw: Callable[[], gsplat.DrawableGaussians]) -> None:
        self._drawn = draw()
        self._seen = seen = gsplat.project(self._drawn, self._views, packed=False)
        self._touched = touched_tiles(seen.means2d[0], seen.radii[0], seen.depths[0], self._down, self._across)

    def _finish(self, capacity: int, update: Callable[[gsplat.DrawableGaussians, list[torch.Tensor]], None]) -> None:
        seen, drawn = self._seen, self._drawn
        listed, starts = tile_lists(self._touched, capacity, self._down, self._across)
        colour, alpha = gsplat.load().rasterize_to_pixels(
            seen.means2d,
            seen.conics,
            seen.colours,
            seen.opacities,
            self._views.width,
            self._views.height,
            TILE_PX,
            starts[None],
            listed,
            masks=self._blended,
        )
        if self._background is not None:
            colour = colour + (1 - alpha) * self._background
        losses, gradient = image_loss(colour.detach(), self._image, self._mask, *self._loss_options)
        self._loss.copy_(losses)
        leaves = (drawn.means, drawn.quats, drawn.scales, drawn.opacities, drawn.sh)
        # The autograd graph of the projection, once recorded, is differentiated by several of the second graphs.
        update(drawn, list(torch.autograd.grad(KnownLoss.apply(colour, gradient), leaves, retain_graph=True)))


def _capacity(count: int) -> int:
    """Round up to 4, 5, 6 or 7 times a power of two."""
    count = max(count, _FEWEST_TILES)
    quarter = 1 << (count.bit_length() - 3)
    return -(-count // quarter) * quarter


class _Recorder:
    """Runs functions without arguments and results, records each when it runs for the second time, then replays it.

    Graphs share one pool of memory: what a graph leaves behind in tensors stays, the rest is used by the next.
    """

    def __init__(self) -> None:
        self._ran: set[object] = set()
        self._graphs: dict[object, torch.cuda.CUDAGraph] = {}
        self._possible = gsplat.device().type == "cuda" and has_triton()
        if self._possible:
            self._stream, self._pool = torch.cuda.Stream(), torch.cuda.graph_pool_handle()

    def __call__(self, name: object, do: Callable[[], None]) -> None:
        if name not in self._graphs and self._possible and name in self._ran:
            try:
                self._graphs[name] = self._record(do)
            except torch.cuda.OutOfMemoryError:
                raise
            except RuntimeError as error:
                self._possible = False
                logger.warning("CUDA cannot record optimization steps, which are slower without: %s", error)
        if name in self._graphs:
            self._graphs[name].replay()
        else:
            self._ran.add(name)
            do()

    def _record(self, do: Callable[[], None]) -> torch.cuda.CUDAGraph:
        graph = torch.cuda.CUDAGraph()
        self._stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(self._stream):
            graph.capture_begin(pool=self._pool, capture_error_mode="thread_local")
            try:
                do()
            except BaseException:
                with contextlib.suppress(RuntimeError):
                    graph.capture_end()
                raise
            graph.capture_end()
        torch.cuda.current_stream().wait_stream(self._stream)
        return graph
