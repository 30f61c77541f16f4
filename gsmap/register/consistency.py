"""Compute the compatibility graph of correspondences: an edge joins two correspondences that one similarity could
explain."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from gsmap.errors import ConfigError
from gsmap.register.correspondences import Correspondences
from gsmap.settings.ranges import require_range

Test = Literal["absolute", "ratio"]


SIGMA_M = 0.03  # standard deviation of a landmark's position
_RELATIVE = 0.01  # share of the smaller distance that the absolute test allows on top of six standard deviations
_RATIO = 0.1  # tolerance of the relative test
MIN_DISTANCE_M = 0.25  # nodes closer than this hardly constrain the pose


@dataclass(frozen=True)
class Params:
    """Pairwise test of correspondences.

    Args:
        test: Test whether two correspondences are compatible: their distance in one scene may differ from their
            distance in the other scene by a fixed error (``absolute``) or by a fraction of the distance (``ratio``, as
            in Graph-GSReg).
        height_slope: Largest difference, per metre of distance, between the height difference of two correspondences in
            one scene and that in the other, at least 0, where gravity is known in both scenes; a larger value tolerates
            tilted scenes, and inf switches the test off.
    """

    test: Test = "absolute"
    height_slope: float = 0.05

    def __post_init__(self) -> None:
        require_range(self, "[0, inf]", "height_slope")
        if self.test not in get_args(Test):
            raise ConfigError(
                f"the consistency test must be one of {', '.join(get_args(Test))}, got {self.test!r}",
                code="invalid_choice",
            )


def consistency_graph(
    matches: Correspondences,
    params: Params | None = None,
    *,
    scale: float = 1.0,
    sigma_m: float = SIGMA_M,
    min_distance_m: float = MIN_DISTANCE_M,
) -> np.ndarray:
    """Compute the compatibility graph of correspondences.

    Two correspondences are compatible when the distance of their target nodes and that of their scaled source nodes
    differ by less than ``6 sigma + relative * distance`` and they share no node (one-to-one). Where gravity is known in
    both scenes, their height differences must agree as well. The test ``ratio`` of the Graph-GSReg paper
    (`Params.test`) divides by the distance instead; it drops correct correspondences that are close together and passes
    wrong ones that are far apart.

    Args:
        scale: factor by which the source's distances are multiplied.
        sigma_m: standard deviation of a node's position.
        min_distance_m: correspondences whose nodes are nearer to each other are not compatible, as they hardly
            constrain the pose.

    Returns:
        (M, ceil(M / 64)) uint64 bit rows, symmetric: bit j of row i is set if i and j are compatible.
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
        slack=6.0 * sigma_m,
        relative_slack=_RELATIVE,
        ratio=_RATIO if params.test == "ratio" else 0.0,
        min_distance=min_distance_m,
        height_slack=6.0 * sigma_m,
        height_slope=float(params.height_slope) if heights else 0.0,
    )
    return rows


def unpack(rows: np.ndarray) -> np.ndarray:
    """Convert bit rows to an (M, M) boolean adjacency matrix."""
    count = len(rows)
    return np.unpackbits(rows.view(np.uint8), axis=1, bitorder="little")[:, :count].astype(bool)


def pack(adjacency: np.ndarray) -> np.ndarray:
    """Convert an (M, M) boolean adjacency matrix to bit rows."""
    count = len(adjacency)
    padded = np.zeros((count, -(-count // 64) * 64), dtype=bool)
    padded[:, :count] = adjacency
    return np.packbits(padded, axis=1, bitorder="little").view(np.uint64)
