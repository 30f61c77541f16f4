"""Describe a capture by a scene graph: surface, vertical, unit, landmark layers, object layer and segments."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from gsmap.describe.cloud import surface_cloud
from gsmap.describe.gravity import estimate_up
from gsmap.describe.landmarks import layer as landmarks
from gsmap.describe.landmarks.detect import OctaveCache
from gsmap.describe.landmarks.layer import Params as LandmarkParams
from gsmap.describe.landmarks.layer import find_extrema, gravity_free, landmark_layer
from gsmap.describe.objects import segments
from gsmap.describe.objects.layer import Params as ObjectParams
from gsmap.describe.objects.layer import choose_methods, object_layer
from gsmap.describe.objects.segments import find_segments
from gsmap.describe.precision import round_graph
from gsmap.describe.unit import VIEW_DISTANCE_M, estimate_unit_m, landmark_units, working_unit_m
from gsmap.errors import ConfigError
from gsmap.methods import RecipeKey
from gsmap.settings.ranges import require_range
from gsmap.types import Cameras, Gaussians, NodeLayer, SceneGraph
from gsmap.types.model import ModelSpec
from gsmap.types.progress import Progress, silent
from gsmap.types.scene import SCALE_POLICIES
from gsmap.types.views import PointCloud, SceneContext

VERSION = 7
_FEW_NODES = 20  # a scene gets a note if none of its layers has this many nodes


@dataclass(frozen=True)
class Params:
    """Settings of `describe`.

    Args:
        landmarks: Compute the landmark layers, which retrieval and registration match; if off, only objects are
            matched.
        objects: Compute the object layer by rendering and segmenting views, which takes most of the time of
            ``describe``.
        things: Group Gaussians into segments, one per physical object, for changes and objects over time.
        min_opacity: Smallest opacity in [0, 1] at which a Gaussian belongs to the surface; larger ignores more haze.
        view_distance_m: Typical distance in metres, positive, from a camera to the surface that it sees, used to
            estimate the unit of a scene without metric scale; the default fits rooms, and outdoor captures need a
            larger value.
        landmark: Settings of the landmark layers.
        object: Settings of the object layer.
    """

    landmarks: bool = True
    objects: bool = True
    things: bool = True
    min_opacity: float = 0.1
    view_distance_m: float = VIEW_DISTANCE_M
    landmark: LandmarkParams = field(default_factory=LandmarkParams)
    object: ObjectParams = field(default_factory=ObjectParams)

    def __post_init__(self) -> None:
        require_range(self, "[0, 1]", "min_opacity")
        require_range(self, "(0, inf]", "view_distance_m")


def recipe_key(params: Params | None = None, models: Mapping[str, ModelSpec] | None = None) -> RecipeKey:
    """Return the recipe of the graphs that `describe` computes, without the scene and its scale policy.

    Raises:
        ConfigError: a segmenter or embedder does not exist.
    """
    params, models = params or Params(), models or {}
    version = {"describe": VERSION}
    settings: dict[str, object] = {
        "layers": [name for name in ("landmarks", "objects", "things") if getattr(params, name)],
        **{name: getattr(params, name) for name in ("min_opacity", "view_distance_m")},
    }
    backend = ""
    if params.landmarks:
        version["landmarks"] = landmarks.VERSION
        settings["landmark"] = landmarks.settings(params.landmark)
    if params.objects:
        chosen = choose_methods(params.object, models)
        version |= chosen.versions
        settings["object"] = chosen.settings(models)
        backend = chosen.params.render_backend
    if params.things:
        version["things"] = segments.VERSION
    return RecipeKey("describe", "graph", version, settings, backend)


@dataclass(frozen=True, eq=False)
class GraphBasis:
    """Surface, vertical and units of a capture, which all layers of its scene graph share.

    Args:
        cloud: the surface.
        up: (3,) direction against gravity in the scene's frame; None if unknown.
        guess_m: metres per scene unit, from `estimate_unit_m`.
        unit_m, working_m: see `SceneGraph`.
        units: from `landmark_units`.
        registration_m: unit of the scene when it is prepared for registration (`gsmap.register.prepare.working_m_of`).
    """

    cloud: PointCloud
    up: np.ndarray | None
    guess_m: float
    unit_m: float
    working_m: float
    units: Mapping[str, float]
    registration_m: float


def find_basis(
    gaussians: Gaussians, cameras: Cameras | None, params: Params | None = None, *, scale_policy: str = "auto"
) -> GraphBasis:
    """Find the surface, vertical and units of one capture; see `describe`."""
    params = params or Params()
    if scale_policy not in SCALE_POLICIES:
        raise ConfigError(
            f"scale policy must be one of {', '.join(SCALE_POLICIES)}, got {scale_policy!r}", code="invalid_choice"
        )
    cloud = surface_cloud(gaussians.degree_0(), params.min_opacity)
    up = estimate_up(cloud.points, cameras)
    guess_m = estimate_unit_m(cloud.points, cameras, up, params.view_distance_m)
    working_m = working_unit_m(guess_m, cameras)
    units = landmark_units(guess_m, scale_policy, working_m=working_m)
    if "landmarks" not in units:  # the unit is not the metre
        working_m = guess_m
    unit_m = 1.0 if scale_policy == "known" else guess_m
    registration_m = working_m if scale_policy == "known" or params.landmarks else unit_m
    return GraphBasis(cloud, up, guess_m, unit_m, working_m, units, registration_m)


def describe(
    scene_id: str,
    gaussians: Gaussians,
    cameras: Cameras | None,
    params: Params | None = None,
    models: Mapping[str, ModelSpec] | None = None,
    *,
    scale_policy: str = "auto",
    basis: GraphBasis | None = None,
    progress: Progress = silent,
) -> SceneGraph:
    """Describe one capture: find its surface, vertical and unit, then compute each layer of its scene graph.

    Args:
        scene_id: id that is recorded in the graph.
        gaussians, cameras: the capture in the scene's frame, of which only the view-independent colours are used;
            cameras may be None or synthesized.
        models: checked ONNX models by kind, for the methods that need them (`gsmap.describe.onnx.check`).
        scale_policy: ``known`` (the unit is the metre: no layers at estimated units), ``unknown`` (only layers at
            estimated units), or ``auto`` (both, where a metre is plausible).
        basis: from `find_basis` with the same arguments, if it was called before.

    Returns:
        The scene graph, with layers, vertical and extents in the scene's frame and unit; ``notes`` are for the user.

    Raises:
        ConfigError: the policy, segmenter or embedder is unknown, or a method lacks its model.
    """
    from gsmap.geometry.threads import run_aside  # imported here, as the recipe key does not need it

    params, gaussians = params or Params(), gaussians.degree_0()
    progress(0.0, "surface")
    basis = basis or find_basis(gaussians, cameras, params, scale_policy=scale_policy)
    cloud, up, units = basis.cloud, basis.up, basis.units
    layers: dict[str, NodeLayer] = {}
    notes: list[str] = []
    if len(cloud) == 0:
        notes.append("the capture has no opaque Gaussians, so there is nothing to describe")
    elif up is None:
        notes.append(
            "the vertical is unknown (no cameras that turn about it, no clear floor): landmarks are matched without it"
        )
    segments_unit_m = 1.0 if "landmarks" in units else basis.unit_m
    with run_aside(lambda: find_segments(gaussians, cloud, up, segments_unit_m) if params.things else None) as segments:
        if params.landmarks:
            layers |= _landmark_layers(cloud, up, units, params.landmark, progress)
        if params.objects:
            seen_m = basis.working_m if scale_policy == "known" else basis.guess_m
            context = SceneContext(cloud, len(gaussians), up, seen_m, models or {})
            layers["objects"], remarks = object_layer(
                gaussians, cameras, context, params.object, lambda fraction, text: progress(0.6 + 0.35 * fraction, text)
            )
            notes += remarks
        progress(0.95, "segments")
        found = segments()
    if len(cloud) and not any(len(layer) >= _FEW_NODES for layer in layers.values()):
        notes.append(f"fewer than {_FEW_NODES} nodes in every layer: too little colour or shape for registration")
    progress(1.0, "described")
    graph = SceneGraph(scene_id, layers, up, basis.unit_m, tuple(notes), found, basis.working_m)
    return round_graph(graph)


def _landmark_layers(
    cloud: PointCloud, up: np.ndarray | None, units: Mapping[str, float], params: LandmarkParams, progress: Progress
) -> dict[str, NodeLayer]:
    """Return the landmark layers by name, at the metres per unit (`landmark_units`) that each assumes."""
    from gsmap.geometry.threads import map_ahead  # imported here, as the recipe key does not need it

    octaves = OctaveCache()
    find_extrema(cloud, up, units.values(), params, octaves)
    layers, free = dict[str, NodeLayer](), dict[str, NodeLayer]()
    found = map_ahead(lambda unit_m: landmark_layer(cloud, up, unit_m, params, octaves), units.values())
    for i, (name, layer) in enumerate(zip(units, found, strict=True)):
        progress(0.05 + 0.55 * (i + 1) / len(units), name)
        layers[name] = layer
    if up is not None:
        for name in [name for name in units if ":" not in name] or ["landmarks:1"]:
            free[name.replace("landmarks", "landmarks_gravity_free")] = gravity_free(layers[name], cloud, params)
    return layers | free
