"""The object layer: what the segmenter finds in renders of the scene, lifted to 3D and associated over views."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, Literal

import numpy as np

from gsmap.describe.objects.associate import Node, associate, region
from gsmap.describe.objects.lift import visible
from gsmap.describe.objects.views import is_blocked, render_views
from gsmap.errors import ConfigError
from gsmap.geometry.directions import level_frame
from gsmap.methods import Family, MethodParams, RecipeKey, family
from gsmap.render import backend
from gsmap.types import Cameras, Gaussians, NodeLayer
from gsmap.types.model import ModelLimits, ModelSpec
from gsmap.types.plain import plain
from gsmap.types.progress import Progress, silent
from gsmap.types.views import SceneContext

VERSION = 3
_MANY = 400_000  # points of the surface; of more, an even share is lifted
# What decides which things are nodes and how often they are seen, not what a node and its embedding mean.
_NOT_COMPARED = (
    *("render_backend", "num_cameras", "longest_side_px", "near_m", "min_seen", "depth_tolerance"),
    *("c_mask", "min_points", "tau_asso", "min_views", "voxel_m"),
)

# What the layer is the same with: the backend is a part of the key by itself, a model beyond its limits makes none.
_NOT_NAMED = ("render_backend", "model_time_s", "model_memory_mb")


@dataclass(frozen=True)
class Params:
    """How objects are found; lengths are metres under the layer's unit.

    Args:
        segmenter: finds masks; a method of that family, or ``auto``: the first that needs models and has them all, else
            ``builtin``.
        segmenters: the settings of each.
        embedder: describes masks; a method of that family, or ``auto``, likewise.
        embedders: the settings of each.
        render_backend: ``native`` (CPU), ``gsplat`` (CUDA), or ``auto``: gsplat where there is a GPU for it.
        num_cameras: views to render, evenly spread.
        longest_side_px: of a render.
        near_m: a view most of which is nearer than this looks out of the inside of something, and is left out.
        min_seen: a view of which a smaller share shows anything is left out.
        depth_tolerance: a Gaussian is visible where its depth is that of the render to within this share; inf takes
            every one whose centre projects into a mask (paper).
        c_mask: masks of lower confidence are dropped (paper).
        min_points: masks that show fewer Gaussians are dropped.
        tau_asso: cosine + GIoU above which a region joins a node (paper).
        min_views: nodes seen in fewer views are dropped.
        voxel_m: a node's points are thinned to one per cell of this size.
        model_time_s: a model that loads, or runs once, for longer is ended, which is an error.
        model_memory_mb: a model that takes more, beside what the libraries take, is ended likewise (on Linux).
    """

    segmenter: str = "auto"
    segmenters: MethodParams = MethodParams("segmenter")  # noqa: RUF009
    embedder: str = "auto"
    embedders: MethodParams = MethodParams("embedder")  # noqa: RUF009
    render_backend: Literal["auto", "native", "gsplat"] = "auto"
    num_cameras: int = 48
    longest_side_px: int = 320
    near_m: float = 0.1
    min_seen: float = 0.2
    depth_tolerance: float = 0.03
    c_mask: float = 0.5
    min_points: int = 12
    tau_asso: float = 1.1
    min_views: int = 2
    voxel_m: float = 0.03
    model_time_s: float = ModelLimits.time_s
    model_memory_mb: int = ModelLimits.memory_mb

    def __post_init__(self) -> None:
        if not (self.model_time_s > 0 and self.model_memory_mb > 0):
            raise ConfigError(
                "model_time_s and model_memory_mb of describe.object must be positive, got "
                f"{self.model_time_s} and {self.model_memory_mb}",
                code="out_of_range",
            )
        for kind, name in (("segmenter", self.segmenter), ("embedder", self.embedder)):
            if name != "auto":
                family(kind).get(name)

    @property
    def limits(self) -> ModelLimits:
        """Of every model that runs."""
        return ModelLimits(self.model_time_s, self.model_memory_mb)


@dataclass(frozen=True)
class Resolved:
    """Parameters with every ``auto`` replaced by what it stands for here.

    Args:
        params: with names of methods and a backend.
        versions: of the layer, the segmenter and the embedder.
        kinds: of the models that the two methods need.
        fallbacks: what a person should know of the choices.
    """

    params: Params
    versions: dict[str, int]
    kinds: tuple[str, ...]
    fallbacks: tuple[str, ...]

    def settings(self, models: Mapping[str, ModelSpec]) -> dict[str, Any]:
        """Plain settings that can change the layer: those of the chosen methods only, and the models' digests."""
        p = self.params
        out = {field.name: plain(getattr(p, field.name)) for field in fields(p) if field.name not in _NOT_NAMED}
        out["segmenters"] = {p.segmenter: plain(p.segmenters[p.segmenter])}
        out["embedders"] = {p.embedder: plain(p.embedders[p.embedder])}
        return out | {"models": [models[kind].digest if kind in models else kind for kind in self.kinds]}


def resolved(params: Params, models: Mapping[str, ModelSpec]) -> Resolved:
    """What the parameters stand for, given these models.

    Raises:
        ConfigError: a method that does not exist.
    """
    segmenters, embedders = family("segmenter"), family("embedder")
    segmenter, embedder = _chosen(segmenters, params.segmenter, models), _chosen(embedders, params.embedder, models)
    fallbacks = [
        name
        for name, asked, took in (("segmenter", params.segmenter, segmenter), ("embedder", params.embedder, embedder))
        if asked == "auto" and took == "builtin"
    ]
    return Resolved(
        replace(params, segmenter=segmenter, embedder=embedder, render_backend=backend(params.render_backend)),
        {"objects": VERSION, **segmenters.version(segmenter), **embedders.version(embedder)},
        (*segmenters.get(segmenter).MODELS, *embedders.get(embedder).MODELS),
        (f"built-in {' and '.join(fallbacks)}: no models were added for others",) if fallbacks else (),
    )


def descriptor_id(params: Params, models: Mapping[str, ModelSpec]) -> str:
    """What two comparable object layers share: what a node is, and what its feature means."""
    chosen = resolved(params, models)
    decides = {name: value for name, value in chosen.settings(models).items() if name not in _NOT_COMPARED}
    return RecipeKey("describe", "objects", chosen.versions, decides).recipe


def object_layer(
    gaussians: Gaussians,
    cameras: Cameras | None,
    context: SceneContext,
    params: Params | None = None,
    progress: Progress = silent,
) -> tuple[NodeLayer, list[str]]:
    """Objects of a scene and what a person should know of them.

    Sample cameras, render, segment, keep confident masks, lift each to the Gaussians whose centres project into it on
    the visible surface, embed, associate over views. Contexts are counted when two layers are compared.

    Args:
        gaussians, cameras: the capture, scene frame and unit.
        context: what the segmenter and embedder may know of it.

    Returns:
        The layer, scene frame and unit; and notes.

    Raises:
        ConfigError: a method that does not exist or lacks its model.
    """
    descriptor = descriptor_id(params or Params(), context.models)
    chosen = resolved(params or Params(), context.models)
    params = chosen.params
    limited = {kind: replace(model, limits=params.limits) for kind, model in context.models.items()}
    context = replace(context, models=limited)
    segmenter = _made(family("segmenter"), params.segmenter, params.segmenters, context)
    embedder = _made(family("embedder"), params.embedder, params.embedders, context)
    cloud, up, unit_m = context.cloud.evenly(_MANY), context.up, context.unit_m
    level = np.eye(3) if up is None else level_frame(up)
    cell = params.voxel_m / unit_m
    nodes: list[Node] = []
    blocked = 0
    if len(cloud) == 0 or cameras is None or len(cameras) == 0:
        return NodeLayer.empty(descriptor, unit_m=unit_m), (["no cameras: no objects"] if len(cloud) else [])
    sampled = cameras.evenly(params.num_cameras)
    for i, view in enumerate(render_views(gaussians, sampled, params.longest_side_px, params.render_backend)):
        progress(i / len(sampled), f"objects, view {i + 1} of {len(sampled)}")
        if is_blocked(view, params.near_m / unit_m, params.min_seen):
            blocked += 1
            continue
        rows, pixel = visible(cloud.points, view, params.depth_tolerance)
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
    notes = list(chosen.fallbacks)
    if blocked:
        notes.append(f"{blocked} of {len(sampled)} sampled cameras see nothing or stand inside something; left out")
    return _layer(nodes, level, unit_m, descriptor), notes


def _layer(nodes: list[Node], level: np.ndarray, unit_m: float, descriptor: str) -> NodeLayer:
    if not nodes:
        return NodeLayer.empty(descriptor, unit_m=unit_m)
    points = [n.points @ level for n in nodes]
    features = np.stack([n.feature for n in nodes])
    return NodeLayer(
        positions=np.stack([p.mean(0) for p in points]),
        embeddings=features,
        types=np.zeros(len(nodes)),
        weights=np.array([np.mean(n.confidences) for n in nodes]),
        extents=np.stack([np.stack([p.min(0), p.max(0)]) for p in points]),
        features=features,
        num_views=np.array([len(n.views) for n in nodes]),
        descriptor_id=descriptor,
        unit_m=unit_m,
    )


def _chosen(methods: Family, name: str, models: Mapping[str, ModelSpec]) -> str:
    """The name of the method that is meant."""
    if name != "auto":
        methods.get(name)
        return name
    for candidate in methods.usable():
        needs = methods.get(candidate).MODELS
        if needs and all(kind in models for kind in needs):
            return candidate
    return "builtin"


def _made(methods: Family, name: str, params: MethodParams, context: SceneContext) -> Any:
    """The method, ready for the scene."""
    method = methods.get(name)
    missing = [kind for kind in method.MODELS if kind not in context.models]
    if missing:
        raise ConfigError(
            f"{methods.name} {name} needs the models {' and '.join(missing)}: add them with `gsmap models add`"
            if len(missing) > 1
            else f"{methods.name} {name} needs a model: add one with `gsmap models add MAP {missing[0]} FILE.onnx`",
            code="model_required",
        )
    return method.make(context, params[name])
