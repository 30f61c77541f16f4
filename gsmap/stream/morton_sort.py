"""Sort Gaussians externally along a Morton curve: a sample sort with buckets on disk.

A sample of the codes determines cuts of the curve such that every bucket fits in memory. One pass writes each Gaussian
to the file of its bucket, and each bucket is sorted when it is read. Every step is stable, so the result equals that of
sorting everything at once.
"""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gsmap.geometry.morton import morton_codes
from gsmap.types import Gaussians, GaussianSource
from gsmap.types.gaussians import CHUNK_ROWS

BUCKET_BYTES = 128 << 20
"""Number of bytes that are sorted in memory at once; the sort needs about three times as much memory."""

_SAMPLES = 1 << 20
_MAX_BUCKETS = 256  # number of files that are open at the same time


@contextlib.contextmanager
def sorted_along_morton_curve(
    source: GaussianSource, box: np.ndarray, scratch: Path, *, bucket_bytes: int = BUCKET_BYTES
) -> Iterator[GaussianSource]:
    """Sort the Gaussians of a source along the Morton curve of its box, as `gsmap.geometry.morton.morton_order` does.

    Args:
        source: a source with finite means.
        box: (2, 3) bounds of these means (`gsmap.stream.bounds`).
        scratch: path of a folder that does not exist yet, on a disk with space for all Gaussians; the folder is deleted
            when the ``with`` block ends.
        bucket_bytes: a source of at most this size is sorted in memory, without a folder.
    """
    row_bytes = 4 * _width(source.sh_degree)
    if source.num_gaussians * row_bytes <= bucket_bytes:
        whole = source.load()
        yield whole[np.argsort(morton_codes(whole.means, box), kind="stable")]
        return
    scratch.mkdir(parents=True)
    try:
        rows = max(bucket_bytes // row_bytes, source.num_gaussians // _MAX_BUCKETS)
        cuts = _cuts(source, box, rows)
        counts = _distribute(source, box, cuts, scratch)
        yield _Buckets(scratch, counts, source.sh_degree, box)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


@dataclass(frozen=True, eq=False)
class _Buckets:
    """Gaussians in bucket files; each bucket is sorted when it is read."""

    folder: Path
    counts: np.ndarray
    sh_degree: int
    box: np.ndarray

    @property
    def num_gaussians(self) -> int:
        return int(self.counts.sum())

    def chunks(self) -> Iterator[Gaussians]:
        for bucket in np.flatnonzero(self.counts).tolist():
            table = np.fromfile(_file(self.folder, bucket), np.float32).reshape(-1, _width(self.sh_degree))
            order = np.argsort(morton_codes(table[:, :3], self.box), kind="stable")
            for start in range(0, len(order), CHUNK_ROWS):
                yield _gaussians(table[order[start : start + CHUNK_ROWS]])

    def columns(self, name: str) -> Iterator[np.ndarray]:
        for chunk in self.chunks():
            yield getattr(chunk, name)

    def load(self) -> Gaussians:
        from gsmap.stream.blocks import load_all

        return load_all(self)


def _cuts(source: GaussianSource, box: np.ndarray, rows: int) -> np.ndarray:
    """Compute the codes that cut the curve into parts of about ``rows`` Gaussians each."""
    step = -(-source.num_gaussians // _SAMPLES)
    sampled, at = [], 0
    for means in source.columns("means"):
        sampled.append(morton_codes(means[-at % step :: step], box))
        at += len(means)
    codes = np.sort(np.concatenate(sampled))
    cuts: np.ndarray = np.unique(codes[:: max(1, rows // step)][1:])
    return cuts


def _distribute(source: GaussianSource, box: np.ndarray, cuts: np.ndarray, folder: Path) -> np.ndarray:
    """Write every Gaussian to the file of its bucket; return the number of Gaussians in each bucket."""
    counts = np.zeros(len(cuts) + 1, np.int64)
    with contextlib.ExitStack() as opened:
        files = [opened.enter_context(open(_file(folder, i), "xb")) for i in range(len(counts))]
        for chunk in source.chunks():
            bucket = np.searchsorted(cuts, morton_codes(chunk.means, box), side="right")
            table = _table(chunk)[np.argsort(bucket, kind="stable")]
            here = np.bincount(bucket, minlength=len(counts))
            ends = np.cumsum(here)
            for i in np.flatnonzero(here):
                files[i].write(table[ends[i] - here[i] : ends[i]].data)
            counts += here
    return counts


def _file(folder: Path, bucket: int) -> Path:
    return folder / f"{bucket}.f32"


def _width(sh_degree: int) -> int:
    """Return the number of values of a Gaussian."""
    return 3 + 4 + 3 + 1 + 3 * (sh_degree + 1) ** 2


def _table(gaussians: Gaussians) -> np.ndarray:
    """Convert Gaussians to an array (n, width) float32."""
    g = gaussians
    return np.concatenate(
        [g.means, g.quats, g.log_scales, g.logit_opacities[:, None], g.sh.reshape(len(g), -1)], axis=1
    )


def _gaussians(table: np.ndarray) -> Gaussians:
    sh = table[:, 11:].reshape(len(table), -1, 3)
    return Gaussians(table[:, :3], table[:, 3:7], table[:, 7:10], table[:, 10], sh)
