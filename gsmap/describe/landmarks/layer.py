"""The landmark layer: blobs of the surface with what surrounds them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gsmap.describe.cloud import Cloud
from gsmap.describe.gravity import rotation_to_z
from gsmap.describe.landmarks import find_blobs
from gsmap.describe.method import method_digest
from gsmap.describe.surroundings import NUM_RINGS, NUM_SHELLS, cylinder_context, shell_context
from gsmap.types import NodeLayer

_VERSION = 6


@dataclass(frozen=True)
class LandmarkParams:
    """How landmarks are found; lengths are metres under the layer's unit.

    Args:
        cell_m: grid of the finest octave; its blobs have a scale of 1.6 cells.
        octaves: number of scales, doubling; those finer than the capture's Gaussians are skipped.
        lab_threshold: smallest colour contrast, L*a*b* units.
        density_threshold: smallest excess of surface over a plane's.
        max_per_octave: the strongest are kept.
        context_cell_m: the surroundings are thinned to one point per cell of this size.
    """

    cell_m: float = 0.025
    octaves: int = 4
    lab_threshold: float = 2.0
    density_threshold: float = 0.6
    max_per_octave: int = 1500
    context_cell_m: float = 0.07


def landmark_method(params: LandmarkParams, *, upright: bool = True) -> str:
    """Digest that two comparable landmark layers share; contexts with and without a vertical do not compare."""
    return method_digest("landmarks", _VERSION, params, upright)


def landmark_layer(
    cloud: Cloud, up: np.ndarray | None, unit_m: float, params: LandmarkParams | None = None
) -> NodeLayer:
    """Landmarks of a surface cloud.

    Args:
        cloud: in the scene's frame and unit.
        up: (3,) against gravity, or None: contexts are then counted in shells, which tell places apart less well.
        unit_m: metres per scene unit to assume.

    Returns:
        Positions and extents in the scene's frame and unit; ``features`` are the blob's response and scale,
        ``weights`` its response over the threshold.
    """
    params = params or LandmarkParams()
    method = landmark_method(params, upright=up is not None)
    surroundings, bins = (shell_context, NUM_SHELLS) if up is None else (cylinder_context, NUM_RINGS)
    dim = 4 * bins
    if not cloud.areas.any():  # nothing, or only coincident points
        return NodeLayer.empty(method, dim, unit_m)
    level = np.eye(3) if up is None else rotation_to_z(up)
    points = cloud.points @ level.T * unit_m
    blobs = find_blobs(
        points,
        cloud.lab,
        cloud.areas * unit_m**2,
        cell_m=params.cell_m,
        octaves=params.octaves,
        lab_threshold=params.lab_threshold,
        density_threshold=params.density_threshold,
        max_per_octave=params.max_per_octave,
    )
    if len(blobs) == 0:
        return NodeLayer.empty(method, dim, unit_m)
    context = surroundings(blobs.positions, points, cloud.lab, params.context_cell_m)
    positions = blobs.positions @ level / unit_m
    half = (1.5 * blobs.sigmas_m / unit_m)[:, None]
    return NodeLayer(
        positions=positions,
        embeddings=_embed(context),
        types=blobs.types,
        weights=blobs.responses,
        extents=np.stack([positions - half, positions + half], 1),
        features=np.stack([blobs.responses, blobs.sigmas_m / unit_m], 1),
        num_views=np.zeros(len(blobs)),
        method=method,
        unit_m=unit_m,
    )


def unlevelled(layer: NodeLayer, cloud: Cloud, params: LandmarkParams | None = None) -> NodeLayer:
    """An upright scene's landmarks as scenes whose vertical is unknown see theirs: with contexts in shells."""
    params = params or LandmarkParams()
    method = landmark_method(params, upright=False)
    if len(layer) == 0:
        return NodeLayer.empty(method, 4 * NUM_SHELLS, layer.unit_m)
    points = cloud.points * layer.unit_m
    context = shell_context(layer.positions * layer.unit_m, points, cloud.lab, params.context_cell_m)
    return replace(layer, embeddings=_embed(context), method=method)


def _embed(context: np.ndarray) -> np.ndarray:
    """Unit vectors (M, 4 * bins) of contexts (M, bins, 4): occupancy and relative colour.

    Another exposure adds to L and stretches it (gain and gamma in the logarithm of light), another white balance adds
    to a and b, so each bin's colour is taken relative to the mean of the whole surrounding and divided by its spread.
    The mean itself is left out: measured, it wins nothing within one light and costs most matches where two captures'
    white balances differ by a fifth. A bin counts by the root of its occupancy.
    """
    occupancy, colour = context[..., 3:], np.clip(context[..., :3], -2.5, 2.5)
    total = np.maximum(occupancy.sum(1), 1e-6)
    relative = colour - ((occupancy * colour).sum(1) / total)[:, None]
    spread = np.sqrt((occupancy * relative**2).sum(1) / total) + 0.15
    relative *= 0.7 * np.sqrt(occupancy) / spread[:, None]
    vector = np.concatenate([0.75 * occupancy[..., 0], relative.reshape(len(context), -1)], 1)
    return vector / np.maximum(np.linalg.norm(vector, axis=1, keepdims=True), 1e-9)
