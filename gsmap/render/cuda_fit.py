"""The fitter on the GPU: kernels of fitter.cu do everything in a step but the sorting, which torch does.

A step on one view is replayed as two CUDA graphs: the first projects the Gaussians and counts the entries of the lists
of tiles; the second sorts these, blends, differentiates and updates. What differs between views lies in memory that the
kernels read, so that there is one second graph for each room for entries and size of the image, both rounded up a
quarter of an octave. A graph is recorded when it is used for the second time.
"""

from __future__ import annotations

import contextlib
import functools
import logging
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from gsmap.render import gsplat, native
from gsmap.render.cuda_kernels import launch
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

logger = logging.getLogger(__name__)

# As in fitter.cu.
_TILE, _BUCKET, _MOMENTS, _RECORD, _LOSS = 16, 64, 9, 12, 3
_STEP = np.dtype(
    [("pose", "f8", 12), ("intrinsics", "f8", 4), ("pixels", "u8", 2), ("sizes", "i4", 6), ("unused", "i4", 2)]
)
_OPTIONS = np.dtype([("floats", "f4", 14), ("ints", "i4", 4)])

_MOST_GRAPHS = 64
_FEWEST_ENTRIES, _FEWEST_TILES = 1 << 14, 64
_WIDE = 1 << 15  # number of tiles from which their numbers have 32 bits


class CudaFitter(Fitter):
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
        self._device = gsplat.device()
        held = checked_mask(frozen, len(gaussians))
        self._entries_before: dict[bytes, int] = {}  # by camera, as the kernels read it
        self._corrections = _corrections(self.options.betas).to(self._device)
        self._options_there = torch.empty(_OPTIONS.itemsize, dtype=torch.uint8, device=self._device)
        self._options_on_host = self._on_host(self._options_there)
        self._sent: object = None
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
        n = len(self)
        self._k = values[4].shape[1]
        self._records = torch.empty((n, _RECORD), device=self._device)
        self._depths, self._sorted_depths = torch.empty((2, n), device=self._device)
        self._order, self._upto = torch.empty((2, n), dtype=torch.int64, device=self._device)
        self._counts = torch.empty(n, dtype=torch.int32, device=self._device)
        self._sums = torch.zeros(5, device=self._device)  # see fitter.cu
        self._num_entries = self._on_host(self._upto[-1:])
        self._counted = torch.cuda.Event() if self._device.type == "cuda" else None
        self._unsettled: tuple[bytes, int, int, torch.Tensor] | None = None
        self._gradient_norm, self._max_weight = torch.zeros((2, n), device=self._device)
        self._seen = torch.zeros(n, dtype=torch.int32, device=self._device)
        self._reserve(1)

    def _reserve(self, views: int) -> None:
        """Make room for the moments of so many views, all zero as each step leaves them."""
        self._pixel_moments = torch.zeros((views, len(self), _MOMENTS), device=self._device)
        self._steps = torch.zeros((views, _STEP.itemsize), dtype=torch.uint8, device=self._device)
        self._steps_sent = self._on_host(self._steps)
        self._recorder = _Recorder(self._device)

    def reset_statistics(self) -> None:
        self._settle()
        for counted in (self._gradient_norm, self._seen, self._max_weight):
            counted.zero_()

    def statistics(self) -> Statistics:
        self._settle()
        counted = (self._gradient_norm, self._seen, self._max_weight)
        return Statistics(*(t.cpu().numpy().copy() for t in counted))

    def gaussians(self) -> Gaussians:
        self._settle()
        return Gaussians(*(t.cpu().numpy().copy() for t in self._values))

    def load(self, array: np.ndarray) -> Any:
        try:
            return torch.from_numpy(np.ascontiguousarray(array)).to(self._device)
        except torch.cuda.OutOfMemoryError:
            return array  # the array is then sent to the GPU at every step

    def step(self, cameras: Cameras, images: Any, masks: Any = None) -> _Loss | float:
        self._settle()
        width, height = image_size(cameras)
        count = len(cameras)
        targets = self._pixels(images, (count, height, width, 3), "images")
        weights = None if masks is None else self._pixels(masks, (count, height, width), "masks")
        if count == 0:
            return 0.0
        if count > len(self._steps):
            self._reserve(count)
        self._send_options(count)
        camera = self._send_steps(cameras, targets, weights)
        num_tiles = _rounded(-(-width // _TILE) * -(-height // _TILE), _FEWEST_TILES)
        try:
            if count == 1:
                return self._step_one(camera, num_tiles)
            for v in range(count):
                self._project(v)
                self._count_entries()
                self._blend(v, num_tiles, _room(self._counted_entries()))
            self._update()
        except BaseException:
            self._pixel_moments.zero_()
            raise
        return _Loss(self, self._sums[_LOSS].clone())

    def _step_one(self, camera: bytes, num_tiles: int) -> _Loss:
        """Take a step on one view, with room for as many entries as it had before and a few more, so that the CPU need
        not wait for their number; if they do not fit, the step is taken again in `_settle`."""
        self._recorder("project", functools.partial(self._project, 0))
        self._count_entries()
        before = self._entries_before.get(camera)
        room = _room(self._counted_entries() if before is None else before * 17 // 16)
        self._recorder((num_tiles, room), functools.partial(self._finish, num_tiles, room))
        loss = self._sums[_LOSS].clone()
        self._unsettled = camera, num_tiles, room, loss
        return _Loss(self, loss)

    def _settle(self) -> None:
        """Take the last step again if there was too little room for its entries."""
        if self._unsettled is None:
            return
        camera, num_tiles, room, loss = self._unsettled
        self._unsettled = None
        entries = self._entries_before[camera] = self._counted_entries()
        if entries > room:
            room = _room(entries)
            self._recorder((num_tiles, room), functools.partial(self._finish, num_tiles, room))
            loss.copy_(self._sums[_LOSS])

    def _count_entries(self) -> None:
        if len(self):
            self._num_entries.copy_(self._upto[-1:], non_blocking=True)
        if self._counted is not None:
            self._counted.record()

    def _counted_entries(self) -> int:
        """Wait for the number of entries, after `_count_entries`; what was sent before may then be overwritten."""
        if self._counted is not None:
            self._counted.synchronize()
        return int(self._num_entries) if len(self) else 0

    def _finish(self, num_tiles: int, room: int) -> None:
        self._blend(0, num_tiles, room)
        self._update()

    def _launch(self, kernel: str, blocks: int, threads: int, *arguments: Any, shared: int = 0) -> None:
        launch("fitter.cu", kernel, blocks, threads, *arguments, shared=shared, num_sh=self._k)

    def _project(self, v: int) -> None:
        """Project the Gaussians and sort them by depth."""
        n = len(self)
        if not n:
            self._sums[: _LOSS + int(v == 0)] = 0
            return
        given = (self._steps[v], *self._values, self._frozen, n, self._k, int(v == 0))
        found = (self._records, self._depths, self._counts, self._sums)
        self._launch("project", -(-n // 128), 128, *given, *found, shared=128 * (3 * self._k + 1) * 4)
        torch.sort(self._depths, stable=True, out=(self._sorted_depths, self._order))
        torch.cumsum(self._counts[self._order], 0, out=self._upto)

    def _blend(self, v: int, num_tiles: int, entries: int) -> None:
        """Render a view and differentiate its loss by what was projected."""
        n, where = len(self), self._device
        step, options, sums, narrow = self._steps[v], self._options_there, self._sums, int(num_tiles < _WIDE)
        tiles = torch.empty(entries, dtype=torch.int16 if narrow else torch.int32, device=where)
        listed = torch.empty(entries, dtype=torch.int32, device=where)
        if n:
            by_depth = (self._records, self._order, self._upto, self._counts)
            self._launch("list_tiles", -(-n // 128), 128, step, *by_depth, n, entries, narrow, tiles, listed, sums)
        else:
            tiles.fill_(torch.iinfo(tiles.dtype).max)
        tiles, by_tile = torch.sort(tiles, stable=True)
        first = torch.arange(num_tiles + 1, device=where, dtype=tiles.dtype)
        lists = listed[by_tile], torch.searchsorted(tiles, first, out_int32=True)

        plane = num_tiles * _TILE**2
        colour, gradient = torch.empty((2, 3 * plane), device=where)
        last = torch.empty(plane, dtype=torch.int32, device=where)
        block_last = torch.empty(4 * num_tiles, dtype=torch.int32, device=where)
        checkpoints = torch.empty((entries // _BUCKET + 1, 4 * _TILE**2), device=where)
        left = last, block_last, checkpoints
        blended = (step, options, self._records, *lists, colour, plane, *left, self._max_weight, sums)
        self._launch("blend", num_tiles, 128, *blended)
        slopes = torch.empty(9 * plane if self.options.ssim_weight > 0 else 1, device=where)
        squares, loss = 3 * num_tiles // 4 + 32, (step, options, colour, plane, slopes, sums)
        self._launch("loss_slopes", squares, 256, *loss)
        self._launch("loss_gradient", squares, 256, *loss, gradient)
        image = (colour, gradient, plane, *left, self._pixel_moments[v], sums)
        self._launch("blend_backward", -(-entries // _BUCKET), 128, step, self._records, *lists, tiles, narrow, *image)

    def _update(self) -> None:
        """Differentiate the projections, and apply Adam."""
        n = len(self)
        if not n:
            return
        given = (self._steps, self._options_there, self._corrections, n, self._k, self._pixel_moments, self._updates)
        counted = (self._gradient_norm, self._seen, self._sums)
        changed = (*self._values, *self._moments[0], *self._moments[1])
        self._launch("update", -(-n // 64), 64, *given, *changed, *counted, shared=64 * (6 * self._k + 15) * 4)

    def _send_options(self, views: int) -> None:
        """Send what all views share to the GPU, if it changed."""
        options, wanted = self.options, (self.learning_rates, views)
        if wanted == self._sent:
            return
        rates = [*vars(self.learning_rates).values()]
        floats = (
            options.ssim_weight,
            options.huber_delta,
            *options.background,
            *options.betas,
            options.epsilon,
            *rates,
        )
        packed = np.array([(floats, (views, options.statistics, len(self._corrections) - 1, 0))], _OPTIONS)
        self._options_on_host.copy_(torch.from_numpy(packed.view(np.uint8)))
        self._options_there.copy_(self._options_on_host, non_blocking=True)
        self._sent = wanted

    def _send_steps(self, cameras: Cameras, targets: torch.Tensor, weights: torch.Tensor | None) -> bytes:
        """Send cameras and the addresses of their pictures to the GPU; return the cameras as a key."""
        count = len(cameras)
        self._held = targets, weights  # until the GPU has read them
        steps = self._steps_sent[:count].numpy().view(_STEP)[:, 0]
        width, height = image_size(cameras)
        pose = cameras.T_camera_frame
        steps[:] = np.zeros((), _STEP)
        steps["pose"] = np.concatenate([pose[:, :3, :3].reshape(-1, 9), pose[:, :3, 3]], 1)
        steps["intrinsics"] = cameras.intrinsics_px
        steps["sizes"][:, :4] = width, height, -(-width // _TILE), -(-height // _TILE)
        camera = steps.tobytes()
        steps["pixels"][:, 0] = targets.data_ptr() + np.arange(count) * targets[0].nbytes
        steps["sizes"][:, 4] = targets.dtype == torch.uint8
        if weights is not None:
            steps["pixels"][:, 1] = weights.data_ptr() + np.arange(count) * weights[0].nbytes
            steps["sizes"][:, 5] = weights.dtype == torch.uint8
        self._steps[:count].copy_(self._steps_sent[:count], non_blocking=True)
        return camera

    def _on_host(self, like: torch.Tensor) -> torch.Tensor:
        return torch.empty(like.shape, dtype=like.dtype, pin_memory=self._device.type == "cuda")

    def keep(self, rows: np.ndarray) -> None:
        self._settle()
        at = torch.as_tensor(rows, device=self._device)
        self._set(
            [value[at] for value in self._values],
            [[value[at] for value in moment] for moment in self._moments],
            self._updates[at],
            self._frozen[at],
        )

    def append(self, gaussians: Gaussians, frozen: np.ndarray | None = None) -> None:
        self._settle()
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
        out: torch.Tensor = (values if values.dtype == torch.uint8 else values.float()).contiguous()
        return out


def _corrections(betas: tuple[float, float]) -> torch.Tensor:
    """Return the bias corrections of Adam by number of updates, (T, 2): for the mean and for the root of the mean
    square; from the last row on they are 1."""
    count = max(2, math.ceil(math.log(1e-8) / math.log(max(*betas, 0.5))))
    t = torch.arange(count, dtype=torch.float64).clamp_min(1)
    beta1, beta2 = betas
    return torch.stack([1 / (1 - beta1**t), 1 / (1 - beta2**t).sqrt()], 1).float()


def _room(entries: int) -> int:
    return _rounded(entries, _FEWEST_ENTRIES)


def _rounded(count: int, fewest: int) -> int:
    """Round up to 4, 5, 6 or 7 times a power of two."""
    count = max(count, fewest)
    quarter = 1 << (count.bit_length() - 3)
    return -(-count // quarter) * quarter


class _Loss:
    """A loss on the GPU that may not be final yet."""

    def __init__(self, fitter: CudaFitter, value: torch.Tensor) -> None:
        self._fitter, self._value = fitter, value

    def __float__(self) -> float:
        self._fitter._settle()
        return float(self._value)


class _Recorder:
    """Runs functions without arguments and results, records each when it runs for the second time, then replays it.

    Graphs share one pool of memory: what a graph leaves behind in tensors stays, the rest is used by the next.
    """

    def __init__(self, device: torch.device) -> None:
        self._ran: set[object] = set()
        self._graphs: dict[object, torch.cuda.CUDAGraph] = {}
        self._possible = device.type == "cuda"
        if self._possible:
            self._stream, self._pool = torch.cuda.Stream(), torch.cuda.graph_pool_handle()

    def __call__(self, name: object, do: Callable[[], None]) -> None:
        if self._possible and name in self._ran and name not in self._graphs and len(self._graphs) < _MOST_GRAPHS:
            try:
                self._graphs[name] = self._record(do)
            except torch.cuda.OutOfMemoryError:
                # Graphs have memory of their own, beside that of steps which are not recorded.
                self._possible = False
                self._graphs.clear()
                torch.cuda.empty_cache()
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
        torch.cuda.empty_cache()  # while it records, torch does not give back what it holds
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
