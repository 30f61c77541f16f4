"""Convert scene graphs to arrays and catalog metadata, and back.

Arrays of the same name and width of all layers are concatenated: a graph then has a dozen arrays instead of seven per
layer, and the positions that landmarks of one capture share between layers compress to almost nothing.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import numpy as np

from gsmap.errors import CorruptError
from gsmap.store.array_encoding import decode_array, encode_array, encoded_shape
from gsmap.store.layout import Shape
from gsmap.store.matrices import from_array, to_array
from gsmap.types import NodeLayer, SceneGraph, Segments
from gsmap.types.plain import plain

_THINGS = ("members", "positions", "extents", "colours", "samples", "sample_colours", "sample_counts")
_NODES = tuple(field.name for field in fields(NodeLayer) if field.type == "np.ndarray")


def to_arrays(graph: SceneGraph) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Return the arrays of a graph by name, and the metadata for its row."""
    parts: dict[str, list[np.ndarray]] = {}
    layers: dict[str, dict[str, Any]] = {}
    around = all(_is_around(nodes) for nodes in graph.layers.values())
    for name, nodes in graph.layers.items():
        own = {field.name: getattr(nodes, field.name) for field in fields(nodes)}
        layer = layers[name] = {
            "count": len(nodes),
            "widths": [nodes.embeddings.shape[1], nodes.features.shape[1]],
            "features_embed": _is_same(nodes.embeddings, nodes.features),
            "rest": {part: plain(value) for part, value in own.items() if part not in _NODES},
        }
        if around:
            own["extents"] = _around(nodes)
        for part, key in _keys(layer).items():
            parts.setdefault(key, []).append(own[part])
    whole = {key: np.concatenate(found) for key, found in parts.items()}
    about: dict[str, Any] = {
        "up": from_array(graph.up),
        "unit_m": float(graph.unit_m),
        "working_m": float(graph.working_m),
        "notes": list(graph.notes),
        "layers": layers,
        "extents_around_positions": around,
    }
    if graph.segments is not None:
        whole |= {f"things.{name}": getattr(graph.segments, name) for name in _THINGS}
        about["things"] = {"count": len(graph.segments), "unit_m": float(graph.segments.unit_m)}
    kept = {key: encode_array(array) for key, array in whole.items()}
    about["arrays"] = {key: how for key, (_, how) in kept.items()}
    return {key: array for key, (array, _) in kept.items()}, about


def shapes_of(about: Mapping[str, Any]) -> dict[str, Shape]:
    """Return the shapes of a graph's arrays from its metadata.

    Raises:
        CorruptError: invalid metadata.
    """
    return {key: encoded_shape(how) for key, how in about["arrays"].items()}


def from_arrays(scene_id: str, about: Mapping[str, Any], stored: Mapping[str, np.ndarray]) -> SceneGraph:
    """Rebuild a graph from its metadata and arrays.

    Raises:
        CorruptError: arrays and metadata do not match.
    """
    up, unit_m, known = to_array(about["up"]), about["unit_m"], about["arrays"]
    try:
        whole = {key: decode_array(array, known[key]) for key, array in stored.items()}
        layers = _layers(about, whole)
        things = None
        if (segments := about.get("things")) is not None:
            own: dict[str, Any] = {name: whole[f"things.{name}"] for name in _THINGS}
            things = Segments(**own, unit_m=segments["unit_m"])
    except (KeyError, ValueError, TypeError) as error:
        raise CorruptError(
            f"the graph of scene {scene_id[:12]} does not match its row in the catalog ({error!r}): run gsmap check",
            code="catalog_invalid",
        ) from error
    return SceneGraph(scene_id, layers, up, unit_m, tuple(about["notes"]), things, about["working_m"])


def _layers(about: Mapping[str, Any], whole: Mapping[str, np.ndarray]) -> dict[str, NodeLayer]:
    taken = dict.fromkeys(whole, 0)
    out = {}
    for name, layer in about["layers"].items():
        own: dict[str, Any] = {}
        for part, key in _keys(layer).items():
            own[part] = whole[key][taken[key] : taken[key] + layer["count"]]
            taken[key] += layer["count"]
        own.setdefault("embeddings", own["features"])
        if about["extents_around_positions"]:
            own["extents"] = own["extents"] + own["positions"][:, None]
        out[name] = NodeLayer(**own, **layer["rest"])
        if len(out[name]) != layer["count"]:
            raise ValueError(f"layer {name} has {len(out[name])} nodes of {layer['count']}")
    return out


def _keys(layer: Mapping[str, Any]) -> dict[str, str]:
    """Return the array name of each part of a layer; embeddings of object nodes equal their features, stored once."""
    embeddings, features = layer["widths"]
    own = {part: f"nodes.{part}" for part in _NODES}
    own |= {"embeddings": f"nodes.embeddings.{embeddings}", "features": f"nodes.features.{features}"}
    if layer["features_embed"]:
        del own["embeddings"]
    return own


def _is_same(a: np.ndarray, b: np.ndarray) -> bool:
    return a.shape == b.shape and a.tobytes() == b.tobytes()


def _around(nodes: NodeLayer) -> np.ndarray:
    """Return extents relative to positions; the extent of a landmark is equal on all sides."""
    out: np.ndarray = nodes.extents - nodes.positions[:, None]
    return out


def _is_around(nodes: NodeLayer) -> bool:
    """Return True if extents relative to positions are exact, as for rounded values (`gsmap.describe.precision`)."""
    return bool((_around(nodes) + nodes.positions[:, None]).tobytes() == nodes.extents.tobytes())
