"""The landmark layer: blobs of the surface with what surrounds them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmap.describe.cloud import Cloud
from gsmap.describe.cylinder import NUM_BINS, cylinder_context
from gsmap.describe.gravity import rotation_to_z
from gsmap.describe.landmarks import Blobs, find_blobs
from gsmap.describe.method import method_digest
from gsmap.types import NodeLayer

_VERSION = 1


@dataclass(frozen=True)
class LandmarkParams:
    """How landmarks are found; lengths are metres under the layer's unit.

    Args:
        cell_m: grid of the finest octave; its blobs have a scale of 1.6 cells.
        octaves: number of scales, doubling.
        lab_threshold: smallest colour contrast, L*a*b* units.
        density_threshold: smallest excess of occupancy over a plane's.
        max_nodes: the strongest are kept.
    """

    cell_m: float = 0.05
    octaves: int = 3
    lab_threshold: float = 3.0
    density_threshold: float = 0.8
    max_nodes: int = 2500


def landmark_method(params: LandmarkParams) -> str:
    """Digest that two comparable landmark layers share."""
    return method_digest("landmarks", _VERSION, params)


def landmark_layer(
    cloud: Cloud, up: np.ndarray | None, unit_m: float, params: LandmarkParams = LandmarkParams()
) -> NodeLayer:
    """Landmarks of a surface cloud.

    Args:
        cloud: in the scene's frame and unit.
        up: (3,) against gravity, or None: an empty layer (contexts of different verticals cannot be compared).
        unit_m: metres per scene unit to assume.

    Returns:
        Positions and extents in the scene's frame and unit; ``features`` are the blob's own colour and strength,
        ``weights`` its response over the threshold.
    """
    method = landmark_method(params)
    if up is None or len(cloud) == 0:
        return NodeLayer.empty(method, 1 + 4 * NUM_BINS, unit_m)
    level = rotation_to_z(up)
    points = cloud.points @ level.T * unit_m
    blobs = find_blobs(
        points,
        cloud.lab,
        cloud.areas * unit_m**2,
        cell_m=params.cell_m,
        octaves=params.octaves,
        lab_threshold=params.lab_threshold,
        density_threshold=params.density_threshold,
    )
    blobs = Blobs(*(getattr(blobs, n)[: params.max_nodes] for n in ("positions", "types", "responses", "sigmas_m")))
    if len(blobs) == 0:
        return NodeLayer.empty(method, 1 + 4 * NUM_BINS, unit_m)
    context = cylinder_context(blobs.positions, points, cloud.lab, params.cell_m)
    height = blobs.positions[:, 2] - np.percentile(points[:, 2], 2)
    positions = blobs.positions @ level / unit_m
    half = (1.5 * blobs.sigmas_m / unit_m)[:, None]
    return NodeLayer(
        positions=positions,
        embeddings=_embed(context, height),
        types=blobs.types,
        weights=blobs.responses,
        extents=np.stack([positions - half, positions + half], 1),
        features=np.stack([blobs.responses, blobs.sigmas_m / unit_m], 1),
        num_views=np.zeros(len(blobs)),
        method=method,
        unit_m=unit_m,
    )


def _embed(context: np.ndarray, height: np.ndarray) -> np.ndarray:
    """Unit vectors (M, 1 + 4 * bins): occupancy, colour weighted by its square root, height above the floor."""
    occupancy = context[..., 3]
    colour = np.sqrt(occupancy)[..., None] * np.clip(context[..., :3], -2.5, 2.5)
    parts = [occupancy, colour.reshape(len(context), -1)]
    vector = np.concatenate([np.concatenate(parts, 1) / np.sqrt(NUM_BINS), 0.7 * height[:, None]], 1)
    return vector / np.linalg.norm(vector, axis=1, keepdims=True)
