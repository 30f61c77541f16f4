"""The compatibility graph of a pair of scenes: which correspondences one similarity could explain together."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from gsmap.errors import ConfigError
from gsmap.register.correspondences import Correspondences

Test = Literal["absolute", "ratio"]


@dataclass(frozen=True)
class Params:
    """How two correspondences are tested against each other.

    Args:
        test: ``absolute`` (distances may differ by ``6 sigma_m + relative * distance``) or ``ratio`` (Graph-GSReg's
            relative test, ``| |dq| - s|dp| | < ratio * max``).
        sigma_m: standard deviation of a node's position, for the absolute test.
        relative: share of the smaller distance that the absolute test allows on top.
        ratio: tolerance of the relative test.
        min_distance_m: nodes closer than this tell nothing about the pose.
        height_slope: allowed height difference per metre of distance where both scenes know gravity (the sine of
            twice the error of an up vector); inf switches the height test off.
    """

    test: Test = "absolute"
    sigma_m: float = 0.03
    relative: float = 0.01
    ratio: float = 0.1
    min_distance_m: float = 0.25
    height_slope: float = 0.05

    def __post_init__(self) -> None:
        if self.test not in get_args(Test):
            raise ConfigError(
                f"the consistency test must be one of {', '.join(get_args(Test))}, got {self.test!r}",
                code="invalid_choice",
            )


def consistency_graph(matches: Correspondences, params: Params | None = None, *, scale: float = 1.0) -> np.ndarray:
    """Graph whose vertices are correspondences and whose edges join those that one similarity could explain.

    Two correspondences agree when the distances of their ends differ by less than ``6 sigma + relative * distance``
    after scaling the source, they share no node (one-to-one), and, where both scenes know gravity, the differences in
    height agree as well. The paper's test (`Params.test`) divides by the distance instead: measured, it drops true
    pairs that are close together and passes wrong pairs that are far apart.

    Returns:
        (M, ceil(M / 64)) uint64 bit rows, symmetric, bit j of row i set where i and j agree.
    """
    from gsmap import _native

    params = params or Params()
    heights = matches.target_heights is not None and np.isfinite(params.height_slope)
    rows: np.ndarray = _native.consistency_graph(
        target=matches.target,
        source=matches.source,
        target_ids=matches.target_ids,
        source_ids=matches.source_ids,
        target_heights=matches.target_heights if heights else None,
        source_heights=matches.source_heights if heights else None,
        scale=float(scale),
        slack=6.0 * params.sigma_m,
        relative_slack=params.relative,
        ratio=params.ratio if params.test == "ratio" else 0.0,
        min_distance=params.min_distance_m,
        height_slack=6.0 * params.sigma_m,
        height_slope=float(params.height_slope) if heights else 0.0,
    )
    return rows


def unpack(rows: np.ndarray) -> np.ndarray:
    """(M, M) boolean adjacency of bit rows."""
    count = len(rows)
    return np.unpackbits(rows.view(np.uint8), axis=1, bitorder="little")[:, :count].astype(bool)


def pack(adjacency: np.ndarray) -> np.ndarray:
    """Bit rows of an (M, M) boolean adjacency."""
    count = len(adjacency)
    padded = np.zeros((count, -(-count // 64) * 64), dtype=bool)
    padded[:, :count] = adjacency
    return np.packbits(padded, axis=1, bitorder="little").view(np.uint64)
