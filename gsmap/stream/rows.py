"""Reading a source in other pieces than its own."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from gsmap.geometry.boxes import box_around
from gsmap.types import Gaussians, GaussianSource
from gsmap.types.gaussians import FIELDS


def loaded(source: GaussianSource) -> Gaussians:
    """All Gaussians of a source in memory; beside them no more than a chunk."""
    n, k = source.num_gaussians, (source.sh_degree + 1) ** 2
    shapes = {"means": (n, 3), "quats": (n, 4), "log_scales": (n, 3), "logit_opacities": (n,), "sh": (n, k, 3)}
    out = {name: np.empty(shapes[name], np.float32) for name in FIELDS}
    start = 0
    for chunk in source.chunks():
        for name in FIELDS:
            out[name][start : start + len(chunk)] = getattr(chunk, name)
        start += len(chunk)
    return Gaussians(**out)


def blocks(source: GaussianSource, rows: int) -> Iterator[Gaussians]:
    """All Gaussians of a source in order, ``rows`` at a time; fewer at the end."""
    held: list[Gaussians] = []
    count = 0
    for chunk in source.chunks():
        held.append(chunk)
        count += len(chunk)
        if count < rows:
            continue
        joined = held[0] if len(held) == 1 else Gaussians.concatenate(held)
        whole = count - count % rows
        for start in range(0, whole, rows):
            yield joined[start : start + rows]
        held, count = [joined[whole:]], count - whole
    if count:
        yield Gaussians.concatenate(held)


def bounds(source: GaussianSource) -> np.ndarray:
    """(2, 3) float32 lowest and highest coordinates of the means of a source that is not empty."""
    corners = [box_around(means) for means in source.columns("means") if len(means)]
    return box_around(np.concatenate(corners))
