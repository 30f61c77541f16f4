"""Object layer: masks of the segmenter in renders of the scene, lifted to 3D and associated over views."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, Literal

import numpy as np

from gsmap.describe.objects.associate import Node, associate, make_region
from gsmap.describe.objects.lift import find_visible
from gsmap.describe.objects.views import is_blocked, render_views
from gsmap.errors import ConfigError
from gsmap.geometry.directions import level_frame
from gsmap.methods import Family, MethodParams, RecipeKey, family
from gsmap.render import backend
from gsmap.settings.ranges import require_range
from gsmap.types import Cameras, Gaussians, NodeLayer
from gsmap.types.model import ModelLimits, ModelSpec
from gsmap.types.plain import plain
from gsmap.types.progress import Progress, silent
from gsmap.types.views import SceneContext, View

VERSION = 4
_NEAR_M = 0.1  # a view that is mostly nearer than this is inside an object and left out
_MIN_POINTS = 12  # masks with fewer Gaussians are dropped
_MIN_SIMILARITY = 1.1  # a region joins a node if cosine + GIoU is larger (Graph-GSReg, tau_asso)
_VOXEL_M = 0.03  # a node's points are thinned to one per cell of this size, metres by the layer's unit
_MANY = 400_000  # points of the surface; of a larger surface an even sample is lifted
# Settings that change the set of nodes, but not the meaning of a node and its embedding.
_NOT_COMPARED = ("render_backend", "num_cameras", "longest_side_px", "depth_tolerance", "min_confidence", "min_views")

# Settings without effect on the layer: the backend is a separate part of the key, and a model beyond its limits gives
# no layer.
_NOT_NAMED = ("render_backend", "model_time_s", "model_memory_mb")


@dataclass(frozen=True)
class Params:
    """Settings of the object layer.

    Args:
        segmenter: Segmenter that finds masks in renders: ``builtin``, ``per_view``, ``sam`` or one from another
            package; ``auto`` takes the first segmenter whose models are all in the map, and ``builtin`` if
            there is none.
        segmenters: Settings of each segmenter.
        embedder: Embedder that describes masks: ``builtin``, ``clip`` or one from another package; ``auto`` takes the
            first that needs models and has them all, or ``builtin``.
        embedders: Settings of each embedder.
        render_backend: Renderer of the views: ``native`` (CPU), ``gsplat`` (CUDA), or ``auto``, which takes gsplat if
            it finds a CUDA GPU.
        num_cameras: Largest number of cameras of a scene, at least 1 and evenly spread, from which views are rendered;
            larger finds more objects and takes longer.
        longest_side_px: Longer side of a rendered view in pixels, positive; larger resolves smaller objects and takes
            longer.
        depth_tolerance: Largest difference between the depth of a visible Gaussian and the rendered depth, as a
            positive fraction of the rendered depth; larger assigns more hidden Gaussians to a mask, and inf assigns
            every Gaussian that projects into the mask (as Graph-GSReg does).
        min_confidence: Smallest confidence in [0, 1] of a mask that is kept; larger keeps fewer, more certain masks.
        min_views: Number of views, at least 1, that must show an object; larger drops more spurious objects.
        model_time_s: Longest time in seconds, positive, that a model may take to load, or to run once, before it is
            ended with an error; larger allows slower models.
        model_memory_mb: Largest memory in MB, positive, that a model may use in addition to its libraries before it is
            ended with an error (on Linux); larger allows larger models.
    """

    segmenter: str = "auto"
    segmenters: MethodParams = MethodParams("segmenter")  # noqa: RUF009
    embedder: str = "auto"
    embedders: MethodParams = MethodParams("embedder")  # noqa: RUF009
    render_backend: Literal["auto", "native", "gsplat"] = "auto"
    num_cameras: int = 48
    longest_side_px: int = 320
    depth_tolerance: float = 0.03
    min_confidence: float = 0.5
    min_views: int = 2
    model_time_s: float = ModelLimits.time_s
    model_memory_mb: int = ModelLimits.memory_mb

    def __post_init__(self) -> None:
        require_range(self, "[1, inf]", "num_cameras", "min_views")
        require_range(self, "(0, inf]", "longest_side_px", "depth_tolerance", "model_time_s", "model_memory_mb")
        require_range(self, "[0, 1]", "min_confidence")
        for kind, name in (("segmenter", self.segmenter), ("embedder", self.embedder)):
            if name != "auto":
                family(kind).get(name)

    @property
    def limits(self) -> ModelLimits:
        """Time and memory limits of every model that runs."""
        return ModelLimits(self.model_time_s, self.model_memory_mb)


@dataclass(frozen=True)
class MethodChoice:
    """Parameters in which every ``auto`` is replaced by the chosen method.

    Args:
        params: parameters with names of methods and a backend.
        versions: versions of the layer, the segmenter and the embedder.
        kinds: kinds of the models that the two methods need.
        fallbacks: the families for which ``auto`` chose the built-in method, for a note.
    """

    params: Params
    versions: dict[str, int]
    kinds: tuple[str, ...]
    fallbacks: tuple[str, ...]

    def settings(self, models: Mapping[str, ModelSpec]) -> dict[str, Any]:
        """Return the plain settings that can change the layer: the settings of the chosen methods, and the digests of
        their models."""
        p = self.params
        out = {field.name: plain(getattr(p, field.name)) for field in fields(p) if field.name not in _NOT_NAMED}
        out["segmenters"] = {p.segmenter: plain(p.segmenters[p.segmenter])}
        out["embedders"] = {p.embedder: plain(p.embedders[p.embedder])}
        return out | {"models": [models[kind].digest if kind in models else kind for kind in self.kinds]}


def choose_methods(params: Params, models: Mapping[str, ModelSpec]) -> MethodChoice:
    """Choose the methods for these parameters and models.

    Raises:
        ConfigError: a method does not exist.
    """
    segmenters, embedders = family("segmenter"), family("embedder")
    segmenter, embedder = _chosen(segmenters, params.segmenter, models), _chosen(embedders, params.embedder, models)
    fallbacks = [
        name
        for name, wanted, taken in (("segmenter", params.segmenter, segmenter), ("embedder", params.embedder, embedder))
        if wanted == "auto" and taken == "builtin"
    ]
    return MethodChoice(
        replace(params, segmenter=segmenter, embedder=embedder, render_backend=backend(params.render_backend)),
        {"objects": VERSION, **segmenters.version(segmenter), **embedders.version(embedder)},
        (*segmenters.get(segmenter).MODELS, *embedders.get(embedder).MODELS),
        (f"built-in {' and '.join(fallbacks)} used, because the map has no models for other methods",)
        if fallbacks
        else (),
    )


def descriptor_id(params: Params, models: Mapping[str, ModelSpec]) -> str:
    """Return the id that comparable object layers share."""
    chosen = choose_methods(params, models)
    decides = {name: value for name, value in chosen.settings(models).items() if name not in _NOT_COMPARED}
    return RecipeKey("describe", "objects", chosen.versions, decides).recipe


def object_layer(
    gaussians: Gaussians,
    cameras: Cameras | None,
    context: SceneContext,
    params: Params | None = None,
    progress: Progress = silent,
) -> tuple[NodeLayer, list[str]]:
    """Compute the object layer of a scene; return it with notes for the user.

    Cameras are sampled, and their views rendered and segmented. Each confident mask is lifted to the visible surface
    Gaussians whose centres project into it, embedded, and associated over views. Contexts are computed when two layers
    are compared.

    Args:
        gaussians, cameras: the capture in the scene's frame and unit.
        context: input of the segmenter and embedder.

    Returns:
        The layer in the scene's frame and unit, and notes.

    Raises:
        ConfigError: a method does not exist or lacks its model.
    """
    from gsmap.geometry.threads import map_ahead  # imported here, as the recipe key does not need it

    descriptor = descriptor_id(params or Params(), context.models)
    chosen = choose_methods(params or Params(), context.models)
    params = chosen.params
    limited = {kind: replace(model, limits=params.limits) for kind, model in context.models.items()}
    context = replace(context, models=limited)
    segmenter = _make_method(family("segmenter"), params.segmenter, params.segmenters, context)
    embedder = _make_method(family("embedder"), params.embedder, params.embedders, context)
    cloud, up, unit_m = context.cloud.evenly(_MANY), context.up, context.unit_m
    level = np.eye(3) if up is None else level_frame(up)
    cell = _VOXEL_M / unit_m
    nodes: list[Node] = []
    blocked = 0
    if len(cloud) == 0 or cameras is None or len(cameras) == 0:
        return NodeLayer.empty(descriptor, unit_m=unit_m), (
            ["the scene has no cameras, so objects are not computed"] if len(cloud) else []
        )
    sampled = cameras.evenly(params.num_cameras)

    def find_regions(at: tuple[int, View]) -> list[Node] | None:
        """Return the regions of a view; None if its camera is blocked."""
        i, view = at
        if is_blocked(view, _NEAR_M / unit_m):
            return None
        rows, pixel = find_visible(cloud.points, view, params.depth_tolerance)
        masks, points = [], []
        for mask in segmenter.segment(view):
            shown = cloud.points[rows[mask.pixels[pixel[:, 1], pixel[:, 0]]]]
            if mask.confidence >= params.min_confidence and len(shown) >= _MIN_POINTS:
                masks.append(mask)
                points.append(shown)
        return [
            make_region(shown @ level.T, feature, mask.confidence, i, cell, mask.part)
            for mask, shown, feature in zip(masks, points, embedder.embed(view, masks, points), strict=True)
        ]

    views = enumerate(render_views(gaussians, sampled, params.longest_side_px, params.render_backend))
    # A model runs on one picture at a time, and so does a plug-in that does not say otherwise.
    are_safe = all(getattr(method, "is_thread_safe", False) for method in (segmenter, embedder))
    threads = None if are_safe and not chosen.kinds else 1
    for i, regions in enumerate(map_ahead(find_regions, views, threads)):
        progress(i / len(sampled), f"objects, view {i + 1} of {len(sampled)}")
        blocked += regions is None
        for region in regions or ():
            associate(nodes, region, _MIN_SIMILARITY, cell)
    enough = min(params.min_views, len(sampled) - blocked)
    nodes = [n for n in nodes if len(n.views) >= enough]
    notes = list(chosen.fallbacks)
    if blocked:
        notes.append(
            f"{blocked} of {len(sampled)} sampled cameras see nothing or are inside an object; they are left out"
        )
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
    """Return the name of the chosen method; see the settings for ``auto``."""
    if name != "auto":
        methods.get(name)
        return name
    for candidate in methods.usable() if models else ():
        needs = methods.get(candidate).MODELS
        if needs and all(kind in models for kind in needs):
            return candidate
    return "builtin"


def _make_method(methods: Family, name: str, params: MethodParams, context: SceneContext) -> Any:
    """Create the method for the scene."""
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
