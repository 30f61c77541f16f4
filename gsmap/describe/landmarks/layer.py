"""Landmark layer: blobs of the surface and their descriptors."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gsmap.describe.landmarks.context import (
    NUM_RINGS,
    NUM_SHELLS,
    cylinder_context,
    embed,
    metric_digest,
    shell_context,
)
from gsmap.describe.landmarks.detect import MAX_PER_OCTAVE, OctaveCache, find_blobs
from gsmap.geometry.directions import level_frame
from gsmap.methods import RecipeKey
from gsmap.settings.ranges import require_range
from gsmap.types import NodeLayer
from gsmap.types.plain import plain
from gsmap.types.views import PointCloud

VERSION = 8


@dataclass(frozen=True)
class Params:
    """Settings of the landmark layers.

    Args:
        max_per_octave: Largest number of landmarks, at least 1, that are kept per octave of size, the strongest first;
            larger finds more overlap in large scenes, and takes more time and space.
        use_fitted_metric: Transform embeddings by a metric that was fitted on synthetic places; a layer with
            transformed embeddings cannot be matched with a layer without.
    """

    max_per_octave: int = MAX_PER_OCTAVE
    use_fitted_metric: bool = False

    def __post_init__(self) -> None:
        require_range(self, "[1, inf]", "max_per_octave")


def settings(params: Params) -> dict[str, Any]:
    """Return the parameters as plain values, with the digest of the fitted metric if it is used."""
    out: dict[str, Any] = plain(params)
    return out | _metric(params)


def _metric(params: Params) -> dict[str, str]:
    return {"metric": metric_digest()} if params.use_fitted_metric else {}


def descriptor_id(params: Params, *, upright: bool = True) -> str:
    """Return the id that comparable landmark layers share; contexts with and without a vertical are not comparable.

    Layers with different numbers of landmarks are comparable.
    """
    name = "landmarks" if upright else "landmarks_gravity_free"
    return RecipeKey("describe", name, {"landmarks": VERSION}, _metric(params)).recipe


def landmark_layer(
    cloud: PointCloud,
    up: np.ndarray | None,
    unit_m: float,
    params: Params | None = None,
    octaves: OctaveCache | None = None,
) -> NodeLayer:
    """Compute the landmarks of a surface cloud.

    Args:
        cloud: surface cloud in the scene's frame and unit.
        up: (3,) direction against gravity in the scene's frame. With None, contexts are in shells, which are less
            distinctive.
        unit_m: assumed metres per unit of the scene.
        octaves: cache of this cloud, shared by its layers.

    Returns:
        The layer, with positions and extents in the scene's frame and unit. Its ``features`` are the blob's response
        and scale, its ``weights`` the response in multiples of the threshold.
    """
    params = params or Params()
    descriptor = descriptor_id(params, upright=up is not None)
    bins = NUM_SHELLS if up is None else NUM_RINGS
    surroundings = shell_context if up is None else cylinder_context
    dim = 4 * bins
    if not cloud.areas.any():  # no points, or only coincident points
        return NodeLayer.empty(descriptor, dim, unit_m)
    level = np.eye(3) if up is None else level_frame(up)
    octaves = octaves or OctaveCache()
    points, lab, areas = octaves.levelled(cloud, level)
    blobs = find_blobs(points, lab, areas, params.max_per_octave, octaves, unit_m)
    if len(blobs) == 0:
        return NodeLayer.empty(descriptor, dim, unit_m)
    around = surroundings(blobs.positions, points, lab, unit_m)
    positions = blobs.positions @ level / unit_m
    half = (1.5 * blobs.sigmas_m / unit_m)[:, None]
    return NodeLayer(
        positions=positions,
        embeddings=embed(around, params.use_fitted_metric),
        types=blobs.types,
        weights=blobs.responses,
        extents=np.stack([positions - half, positions + half], 1),
        features=np.stack([blobs.responses, blobs.sigmas_m / unit_m], 1),
        num_views=np.zeros(len(blobs)),
        descriptor_id=descriptor,
        unit_m=unit_m,
    )


def find_extrema(
    cloud: PointCloud, up: np.ndarray | None, units_m: Iterable[float], params: Params, octaves: OctaveCache
) -> None:
    """Compute the extrema of the layers of a cloud at several units, and free the memory that this takes."""
    if cloud.areas.any():
        levelled = octaves.levelled(cloud, np.eye(3) if up is None else level_frame(up))
        for unit_m in units_m:
            find_blobs(*levelled, params.max_per_octave, octaves, unit_m)
    octaves.free_workspace()


def gravity_free(layer: NodeLayer, cloud: PointCloud, params: Params | None = None) -> NodeLayer:
    """Recompute the landmarks of an upright scene with shell contexts, which are comparable with scenes of unknown
    vertical.

    Args:
        layer: result of `landmark_layer` for the same cloud and parameters.
    """
    params = params or Params()
    descriptor = descriptor_id(params, upright=False)
    if len(layer) == 0:
        return NodeLayer.empty(descriptor, 4 * NUM_SHELLS, layer.unit_m)
    around = shell_context(layer.positions * layer.unit_m, cloud.points, cloud.lab, layer.unit_m)
    return replace(layer, embeddings=embed(around, params.use_fitted_metric), descriptor_id=descriptor)
