"""Small deterministic outputs of every piece of this room that carries a version."""

from __future__ import annotations

from collections.abc import Callable
from unittest import mock

import numpy as np
from describe_places import room

from gsmap.describe import Params, describe, gravity
from gsmap.describe.cloud import surface_cloud
from gsmap.describe.embedders import builtin as embedder
from gsmap.describe.gravity import estimate_up
from gsmap.describe.landmarks.layer import gravity_free, landmark_layer
from gsmap.describe.objects.layer import Params as ObjectParams
from gsmap.describe.objects.layer import object_layer
from gsmap.describe.objects.lift import find_visible
from gsmap.describe.objects.segments import find_segments
from gsmap.describe.objects.views import render_views
from gsmap.describe.segmenters import builtin as segmenter
from gsmap.describe.unit import estimate_unit_m
from gsmap.types import NodeLayer
from gsmap.types.views import SceneContext

_UP = np.array([0.0, 0.0, 1.0])
_FEW = ObjectParams(
    segmenter="builtin", embedder="builtin", render_backend="native", num_cameras=4, longest_side_px=96, min_views=1
)


def _arrays(layer: NodeLayer, prefix: str = "") -> dict[str, np.ndarray]:
    names = ("positions", "embeddings", "types", "weights", "extents", "features", "num_views")
    return {prefix + name: getattr(layer, name) for name in names}


def _context() -> SceneContext:
    gaussians, _ = room(n=4000)
    return SceneContext(surface_cloud(gaussians), len(gaussians), _UP, 1.0)


def _describe() -> dict[str, np.ndarray]:
    """The whole, and the vertical and the metre with and without cameras."""
    gaussians, cameras = room(n=4000)
    points = surface_cloud(gaussians).points
    with mock.patch.object(gravity, "_MAX_NORMALS", 500):
        graph = describe("room", gaussians, cameras, Params(object=_FEW), scale_policy="unknown")
        blind = estimate_up(points, None)
    assert graph.up is not None
    out = {
        "up": graph.up,
        "up_without_cameras": np.zeros(3) if blind is None else blind,
        "unit_m": np.array([graph.unit_m, estimate_unit_m(points, None, _UP), estimate_unit_m(points, None, None)]),
    }
    for name, layer in graph.layers.items():
        out[f"{name}/positions"], out[f"{name}/embeddings"] = layer.positions, layer.embeddings
    return out


def _landmarks() -> dict[str, np.ndarray]:
    cloud = surface_cloud(room(n=6000)[0])
    layer = landmark_layer(cloud, _UP, 1.0)
    return _arrays(layer) | {"gravity_free": gravity_free(layer, cloud).embeddings}


def _objects() -> dict[str, np.ndarray]:
    return _arrays(object_layer(*room(n=4000), _context(), _FEW)[0])


def _things() -> dict[str, np.ndarray]:
    gaussians, _ = room(n=4000)
    found = find_segments(gaussians, surface_cloud(gaussians), _UP, 1.0)
    return {
        name: getattr(found, name)
        for name in ("members", "positions", "extents", "colours", "samples", "sample_colours")
    }


def _segmenter() -> dict[str, np.ndarray]:
    gaussians, cameras = room(n=4000)
    cut = segmenter.make(_context(), segmenter.Params())
    masks = [mask for view in render_views(gaussians, cameras[[0, 7]], 96, "native") for mask in cut.segment(view)]
    return {
        "sizes": np.array([mask.pixels.sum() for mask in masks]),
        "parts": np.array([mask.part for mask in masks]),
        "confidences": np.array([mask.confidence for mask in masks]),
        "cover": np.sum([mask.pixels for mask in masks], axis=0, dtype=np.int64),
    }


def _embedder() -> dict[str, np.ndarray]:
    gaussians, cameras = room(n=4000)
    context = _context()
    view = next(render_views(gaussians, cameras[[0]], 96, "native"))
    masks = segmenter.make(context, segmenter.Params()).segment(view)
    rows, pixel = find_visible(context.cloud.points, view)
    shown = [context.cloud.points[rows[mask.pixels[pixel[:, 1], pixel[:, 0]]]] for mask in masks]
    some = [i for i, points in enumerate(shown) if len(points) >= 4]
    words = embedder.make(context, embedder.Params())
    features = words.embed(view, [masks[i] for i in some], [shown[i] for i in some])
    return {"features": features}


CASES: dict[str, Callable[[], dict[str, np.ndarray]]] = {
    "describe": _describe,
    "landmarks": _landmarks,
    "objects": _objects,
    "things": _things,
    "segmenter.builtin": _segmenter,
    "embedder.builtin": _embedder,
}
