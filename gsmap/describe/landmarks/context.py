"""What surrounds a landmark: colour and occupancy in the rings of an upright cylinder, or in shells without gravity."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, fields
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np

from gsmap.describe.cloud import downsample
from gsmap.errors import ConfigError

METRICS = Path(__file__).with_name("metrics.npz")
_LAB_CENTRE, _LAB_SPREAD = np.array([55.0, 3.0, 8.0]), np.array([20.0, 10.0, 14.0])


@dataclass(frozen=True)
class Params:
    """What is told of a landmark's surroundings; lengths are metres under the layer's unit.

    Args:
        cell_m: the surroundings are thinned to one point per cell of this size.
        radii_m: outer radii of the cylinder's rings.
        heights_m: heights between which its levels lie, relative to the landmark.
        shells_m: outer radii of the spherical shells, where the vertical is unknown.
        occupancy_weight: of a bin's occupancy in the embedding.
        colour_weight: of a bin's colour in the embedding.
        fitted: whether embeddings are brought into the metric that was fitted on made places (`metric`). It holds for
            the other settings as they are by default.
    """

    cell_m: float = 0.07
    radii_m: tuple[float, ...] = (0.2, 0.45, 0.75, 1.1)
    heights_m: tuple[float, ...] = (-1.1, -0.65, -0.35, -0.12, 0.12, 0.35, 0.65, 1.1)
    shells_m: tuple[float, ...] = (0.12, 0.2, 0.3, 0.4, 0.5, 0.65, 0.8, 0.95, 1.1)
    occupancy_weight: float = 0.75
    colour_weight: float = 0.7
    fitted: bool = False

    def __post_init__(self) -> None:
        for name in ("radii_m", "heights_m", "shells_m"):
            edges = getattr(self, name)
            if len(edges) < 1 + (name == "heights_m") or any(b <= a for a, b in pairwise(edges)):
                raise ConfigError(
                    f"{name} must rise from one to the next, got {list(edges)}", code="edges_not_ascending"
                )
        others = [f.name for f in fields(self) if f.name != "fitted" and getattr(self, f.name) != f.default]
        if self.fitted and others:
            raise ConfigError(
                f"the fitted metric of landmarks holds for the default of {others[0]} alone: unset either",
                code="setting_mismatch",
            )

    @property
    def num_rings(self) -> int:
        """Bins of the cylinder."""
        return len(self.radii_m) * (len(self.heights_m) - 1)

    @property
    def num_shells(self) -> int:
        """Bins of the shells."""
        return len(self.shells_m)


def cylinder_context(positions: np.ndarray, points: np.ndarray, lab: np.ndarray, params: Params) -> np.ndarray:
    """Context (M, num_rings, 4) of each position: per ring and height mean L, a, b (standardised) and occupancy.

    Rings do not tell directions apart, so the context is the same however the capture is turned about gravity. A bin's
    occupancy is the number of occupied cells relative to a surface cutting through it, at most 1.

    Args:
        positions: (M, 3) levelled frame (z up), metres.
        points, lab: (N, 3) levelled cloud and its L*a*b*.
    """
    radius, height = np.array(params.radii_m), np.array(params.heights_m)
    levels = len(height) - 1
    inner = np.concatenate([[0], radius[:-1]])
    # A vertical wall through the axis crosses a ring twice; a floor fills it. Expect the smaller of the two.
    wall = 2 * (radius - inner)[:, None] * np.diff(height)[None]
    floor = np.pi * (radius**2 - inner**2)[:, None] * np.ones(levels)[None]

    expected = np.minimum(wall, floor).ravel()
    return _context(positions, points, lab, params.cell_m, radius, height, expected)


def shell_context(positions: np.ndarray, points: np.ndarray, lab: np.ndarray, params: Params) -> np.ndarray:
    """Context (M, num_shells, 4) in spherical shells: the same in any frame, for scenes whose vertical is unknown.

    Args:
        positions: (M, 3) in any frame, metres.
        points, lab: (N, 3) the cloud in that frame and its L*a*b*.
    """
    radius = np.array(params.shells_m)
    inner = np.concatenate([[0], radius[:-1]])

    expected = np.pi * (radius**2 - inner**2)
    return _context(positions, points, lab, params.cell_m, radius, np.zeros(0), expected)


def _context(
    positions: np.ndarray,
    points: np.ndarray,
    lab: np.ndarray,
    cell_m: float,
    radii_m: np.ndarray,
    heights_m: np.ndarray,
    expected_m2: np.ndarray,
) -> np.ndarray:
    """Mean colour and occupancy (M, B, 4) of rings and heights, or of shells where there are no heights."""
    from gsmap import _native

    thin, colour = downsample(points, lab, cell_m)
    values = (colour - _LAB_CENTRE) / _LAB_SPREAD
    sums, counts = _native.landmark_surroundings(
        positions=np.ascontiguousarray(positions, np.float64),
        points=np.ascontiguousarray(thin),
        values=np.ascontiguousarray(values),
        radii=radii_m,
        heights=heights_m,
    )
    out = np.zeros((*counts.shape, 4))
    out[..., :3] = sums / np.maximum(counts, 1)[..., None]
    out[..., 3] = np.minimum(1, counts * cell_m**2 / expected_m2)
    return out


def embed(context: np.ndarray, params: Params) -> np.ndarray:
    """(M, 4 * bins) unit vectors of contexts (M, bins, 4): occupancy and relative colour.

    Another exposure adds to L and stretches it (gain and gamma in the logarithm of light), another white balance adds
    to a and b, so each bin's colour is taken relative to the mean of the whole surrounding and divided by its spread.
    The mean itself is left out: measured, it wins nothing within one light and costs most matches where two captures'
    white balances differ by a fifth. A bin counts by the root of its occupancy.
    """
    occupancy, colour = context[..., 3:], np.clip(context[..., :3], -2.5, 2.5)
    total = np.maximum(occupancy.sum(1), 1e-6)
    relative = colour - ((occupancy * colour).sum(1) / total)[:, None]
    spread = np.sqrt((occupancy * relative**2).sum(1) / total) + 0.15
    relative *= params.colour_weight * np.sqrt(occupancy) / spread[:, None]
    own = params.occupancy_weight * occupancy[..., 0]
    vector = _unit(np.concatenate([own, relative.reshape(len(context), -1)], 1))
    return _unit(vector @ metric(vector.shape[1])) if params.fitted else vector


@cache
def metric(dim: int) -> np.ndarray:
    """(dim, dim) symmetric map under which differences of one landmark's embeddings in two captures are of equal size.

    The inverse root of their scatter, with a share of the identity (`tools/fit/descriptor.py`, which writes the file):
    directions in which true partners differ much count little (Mikolajczyk and Matas 2007; Hua, Brown and Winder 2007).
    `metric_digest` is part of the recipe of graphs that use it: a metric that is fitted anew needs no new version.
    """
    with np.load(METRICS) as stored:
        out: np.ndarray = stored[str(dim)].astype(np.float64)
        return out


@cache
def metric_digest() -> str:
    """32 hex digits (SHA-256) of the file that holds the fitted metrics."""
    return hashlib.sha256(METRICS.read_bytes()).hexdigest()[:32]


def _unit(vectors: np.ndarray) -> np.ndarray:
    out: np.ndarray = vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-9)
    return out
