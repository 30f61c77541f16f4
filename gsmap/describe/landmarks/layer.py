"""The landmark layer: blobs of the surface with what surrounds them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from gsmap.describe.landmarks.context import Params as ContextParams
from gsmap.describe.landmarks.context import cylinder_context, embed, metric_digest, shell_context
from gsmap.describe.landmarks.detect import Octaves, find_blobs, thinned
from gsmap.describe.landmarks.detect import Params as DetectParams
from gsmap.geometry.directions import level_frame
from gsmap.methods import RecipeKey
from gsmap.types import NodeLayer
from gsmap.types.plain import plain
from gsmap.types.views import Cloud

VERSION = 7


@dataclass(frozen=True)
class Params:
    """Landmarks: where they are, and what is told of what surrounds them.

    Args:
        detect: how they are found.
        context: what is told of their surroundings.
    """

    detect: DetectParams = field(default_factory=DetectParams)
    context: ContextParams = field(default_factory=ContextParams)


def settings(params: Params) -> dict[str, Any]:
    """The parameters as plain values, and the digest of the fitted metric where it is used."""
    out: dict[str, Any] = plain(params)
    if params.context.fitted:
        out["context"]["metric"] = metric_digest()
    return out


def descriptor_id(params: Params, *, upright: bool = True) -> str:
    """What two comparable landmark layers share; contexts with and without a vertical do not compare.

    How many landmarks are kept, and how strong they must be, does not keep layers from being compared.
    """
    decides = {"cell_m": params.detect.cell_m, "octaves": params.detect.octaves, "context": settings(params)["context"]}
    name = "landmarks" if upright else "landmarks_gravity_free"
    return RecipeKey("describe", name, {"landmarks": VERSION}, decides).recipe


def landmark_layer(
    cloud: Cloud, up: np.ndarray | None, unit_m: float, params: Params | None = None, octaves: Octaves | None = None
) -> NodeLayer:
    """Landmarks of a surface cloud.

    Args:
        cloud: in the scene's frame and unit.
        up: (3,) against gravity, scene frame, or None: contexts are then counted in shells, which tell places apart
            less well.
        unit_m: metres per scene unit to assume.
        octaves: of this cloud, shared by its layers.

    Returns:
        Positions and extents in the scene's frame and unit; ``features`` are the blob's response and scale,
        ``weights`` its response over the threshold.
    """
    params = params or Params()
    descriptor = descriptor_id(params, upright=up is not None)
    bins = params.context.num_shells if up is None else params.context.num_rings
    surroundings = shell_context if up is None else cylinder_context
    dim = 4 * bins
    if not cloud.areas.any():  # nothing, or only coincident points
        return NodeLayer.empty(descriptor, dim, unit_m)
    level = np.eye(3) if up is None else level_frame(up)
    octaves = octaves or Octaves()
    points, lab, areas = octaves.levelled(cloud, level)
    spacing_m2 = float(np.median(areas)) * unit_m**2
    finest_m = params.detect.cell_m
    points, lab, areas = thinned(points * unit_m, lab, areas * unit_m**2, finest_m)
    blobs = find_blobs(points, lab, areas, params.detect, octaves, unit_m, spacing_m2, finest_m)
    if len(blobs) == 0:
        return NodeLayer.empty(descriptor, dim, unit_m)
    around = surroundings(blobs.positions, points, lab, params.context)
    positions = blobs.positions @ level / unit_m
    half = (1.5 * blobs.sigmas_m / unit_m)[:, None]
    return NodeLayer(
        positions=positions,
        embeddings=embed(around, params.context),
        types=blobs.types,
        weights=blobs.responses,
        extents=np.stack([positions - half, positions + half], 1),
        features=np.stack([blobs.responses, blobs.sigmas_m / unit_m], 1),
        num_views=np.zeros(len(blobs)),
        descriptor_id=descriptor,
        unit_m=unit_m,
    )


def gravity_free(layer: NodeLayer, cloud: Cloud, params: Params | None = None) -> NodeLayer:
    """An upright scene's landmarks as scenes whose vertical is unknown see theirs: with contexts in shells.

    Args:
        layer: from `landmark_layer`, with the same cloud and parameters.
    """
    params = params or Params()
    descriptor = descriptor_id(params, upright=False)
    if len(layer) == 0:
        return NodeLayer.empty(descriptor, 4 * params.context.num_shells, layer.unit_m)
    points = cloud.points * layer.unit_m
    around = shell_context(layer.positions * layer.unit_m, points, cloud.lab, params.context)
    return replace(layer, embeddings=embed(around, params.context), descriptor_id=descriptor)
