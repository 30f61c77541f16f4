"""The object layer: what the segmenter finds in renders of the scene, lifted to 3D and associated over views."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from gsmap.describe import embedders, segmenters
from gsmap.describe.associate import Node, associate, region
from gsmap.describe.cloud import Cloud
from gsmap.describe.context import context_histograms
from gsmap.describe.gravity import rotation_to_z
from gsmap.describe.lift import visible
from gsmap.describe.method import method_digest
from gsmap.describe.models import ModelSpec
from gsmap.describe.views import is_blocked, render_views, sample_cameras
from gsmap.types import Cameras, Gaussians, NodeLayer

_VERSION = 2
_NEEDS = {"sam": ("sam-encoder", "sam-decoder"), "clip": ("clip",)}


@dataclass(frozen=True)
class ObjectParams:
    """How objects are found; lengths are metres under the layer's unit.

    Args:
        segmenter: ``builtin``, ``sam``, or ``auto``: sam where its two models are given.
        embedder: ``builtin``, ``clip``, or ``auto``: clip where its model is given.
        num_cameras: views to render, evenly spread.
        longest_side_px: of a render.
        c_mask: masks of lower confidence are dropped (paper).
        min_points: masks that show fewer Gaussians are dropped.
        tau_asso: cosine + GIoU above which a region joins a node (paper).
        min_views: nodes seen in fewer views are dropped.
        voxel_m: a node's points are thinned to one per cell of this size.
        local_distance_m: edges of the local graph that contexts are counted over.
        hops: how far along it.
        context_weight: length of the context against the feature's in the embedding.
        segmenter_params, embedder_params: the back ends' own; their defaults where None.
    """

    segmenter: str = "auto"
    embedder: str = "auto"
    num_cameras: int = 48
    longest_side_px: int = 320
    c_mask: float = 0.5
    min_points: int = 12
    tau_asso: float = 1.1
    min_views: int = 2
    voxel_m: float = 0.03
    local_distance_m: float = 1.5
    hops: int = 3
    context_weight: float = 0.5
    segmenter_params: object = None
    embedder_params: object = None


def resolved(params: ObjectParams, models: Mapping[str, ModelSpec]) -> ObjectParams:
    """The parameters with ``auto`` and None replaced by what they stand for.

    Raises:
        ConfigError: a back end that does not exist.
    """
    segmenter, embedder = params.segmenter, params.embedder
    if segmenter == "auto":
        segmenter = "sam" if all(kind in models for kind in _NEEDS["sam"]) else "builtin"
    if embedder == "auto":
        embedder = "clip" if "clip" in models else "builtin"
    return replace(
        params,
        segmenter=segmenter,
        embedder=embedder,
        segmenter_params=params.segmenter_params or segmenters.params_of(segmenter),
        embedder_params=params.embedder_params or embedders.params_of(embedder),
    )


def object_method(params: ObjectParams, models: Mapping[str, ModelSpec]) -> str:
    """Digest that two comparable object layers share."""
    params = resolved(params, models)
    kinds = [k for name in (params.segmenter, params.embedder) for k in _NEEDS.get(name, ())]
    return method_digest("objects", _VERSION, params, [models[k].digest if k in models else k for k in kinds])


def object_layer(
    gaussians: Gaussians,
    cameras: Cameras | None,
    cloud: Cloud,
    up: np.ndarray | None,
    unit_m: float,
    params: ObjectParams,
    models: Mapping[str, ModelSpec],
    progress: Callable[[float, str], None] | None = None,
) -> tuple[NodeLayer, list[str]]:
    """Objects of a scene and what a person should know of them.

    Sample cameras, render, segment, keep confident masks, lift each to the Gaussians whose centres project into it on
    the visible surface, embed, associate over views; then count contexts and join both to node embeddings.

    Raises:
        ConfigError: a back end that does not exist or lacks its model.
    """
    method = object_method(params, models)
    params = resolved(params, models)
    segmenter = segmenters.make_segmenter(params.segmenter, params.segmenter_params, cloud, len(gaussians), models)
    embedder = embedders.make_embedder(params.embedder, params.embedder_params, up, unit_m, models)
    level = np.eye(3) if up is None else rotation_to_z(up)
    cell = params.voxel_m / unit_m
    nodes: list[Node] = []
    blocked = 0
    if len(cloud) == 0 or cameras is None or len(cameras) == 0:
        return NodeLayer.empty(method, sum(embedder.codebook.shape), unit_m), (
            ["no cameras: no objects"] if len(cloud) else []
        )
    sampled = sample_cameras(cameras, params.num_cameras)
    for i, view in enumerate(render_views(gaussians, sampled, params.longest_side_px)):
        if progress:
            progress(i / len(sampled), f"objects, view {i + 1} of {len(sampled)}")
        if is_blocked(view, 0.1 / unit_m):
            blocked += 1
            continue
        rows, pixel = visible(cloud.points, view)
        masks, points = [], []
        for mask in segmenter.segment(view):
            shown = cloud.points[rows[mask.pixels[pixel[:, 1], pixel[:, 0]]]]
            if mask.confidence >= params.c_mask and len(shown) >= params.min_points:
                masks.append(mask)
                points.append(shown)
        features = embedder.embed(view, masks, points)
        for mask, shown, feature in zip(masks, points, features, strict=True):
            found = region(shown @ level.T, feature, mask.confidence, i, cell, mask.part)
            associate(nodes, found, params.tau_asso, cell)
    enough = min(params.min_views, len(sampled) - blocked)
    nodes = [n for n in nodes if len(n.views) >= enough]
    notes = []
    if blocked:
        notes.append(f"{blocked} of {len(sampled)} sampled cameras see nothing or stand inside something; left out")
    return _layer(nodes, level, embedder.codebook, unit_m, params, method), notes


def _layer(
    nodes: list[Node], level: np.ndarray, codebook: np.ndarray, unit_m: float, params: ObjectParams, method: str
) -> NodeLayer:
    dim = sum(codebook.shape)
    if not nodes:
        return NodeLayer.empty(method, dim, unit_m)
    points = [n.points @ level for n in nodes]
    positions = np.stack([p.mean(0) for p in points])
    features = np.stack([n.feature for n in nodes])
    contexts = context_histograms(
        features, positions, codebook, max_distance=params.local_distance_m / unit_m, hops=params.hops
    )
    both = np.concatenate([features, params.context_weight * contexts], axis=1)
    return NodeLayer(
        positions=positions,
        embeddings=both / np.maximum(np.linalg.norm(both, axis=1, keepdims=True), 1e-12),
        types=np.zeros(len(nodes)),
        weights=np.array([np.mean(n.confidences) for n in nodes]),
        extents=np.stack([np.stack([p.min(0), p.max(0)]) for p in points]),
        features=features,
        num_views=np.array([len(n.views) for n in nodes]),
        method=method,
        unit_m=unit_m,
    )
