"""Scene graphs from captures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from gsmap.describe.cloud import Params as SurfaceParams
from gsmap.describe.cloud import surface_cloud
from gsmap.describe.gravity import Params as GravityParams
from gsmap.describe.gravity import estimate_up
from gsmap.describe.landmarks import layer as landmarks
from gsmap.describe.landmarks.detect import Octaves
from gsmap.describe.landmarks.layer import Params as LandmarkParams
from gsmap.describe.landmarks.layer import gravity_free, landmark_layer
from gsmap.describe.objects import things
from gsmap.describe.objects.layer import Params as ObjectParams
from gsmap.describe.objects.layer import object_layer, resolved
from gsmap.describe.objects.things import Params as ThingParams
from gsmap.describe.objects.things import find_things
from gsmap.describe.precision import Params as PrecisionParams
from gsmap.describe.precision import rounded
from gsmap.describe.unit import Params as UnitParams
from gsmap.describe.unit import estimate_unit_m, landmark_units, working_unit_m
from gsmap.errors import ConfigError
from gsmap.methods import RecipeKey
from gsmap.types import Cameras, Gaussians, NodeLayer, SceneGraph
from gsmap.types.model import ModelSpec
from gsmap.types.plain import plain
from gsmap.types.progress import Progress, silent
from gsmap.types.scene import SCALE_POLICIES
from gsmap.types.views import SceneContext

VERSION = 5


@dataclass(frozen=True)
class Params:
    """What to describe and how.

    Args:
        landmarks: whether to make the layers of landmarks.
        objects: whether to make the layer of objects.
        things: whether to tell which Gaussians are one thing.
        surface: which Gaussians make up the surface.
        gravity: how the vertical is found.
        unit: what the metre is guessed from.
        landmark: how landmarks are found.
        object: how objects are found.
        thing: how things are told apart.
        precision: how finely positions, embeddings and colours are told.
        few_nodes: a scene none of whose layers has as many nodes gets a note.
    """

    landmarks: bool = True
    objects: bool = True
    things: bool = True
    surface: SurfaceParams = field(default_factory=SurfaceParams)
    gravity: GravityParams = field(default_factory=GravityParams)
    unit: UnitParams = field(default_factory=UnitParams)
    landmark: LandmarkParams = field(default_factory=LandmarkParams)
    object: ObjectParams = field(default_factory=ObjectParams)
    thing: ThingParams = field(default_factory=ThingParams)
    precision: PrecisionParams = field(default_factory=PrecisionParams)
    few_nodes: int = 20


def recipe_key(params: Params | None = None, models: Mapping[str, ModelSpec] | None = None) -> RecipeKey:
    """What names the graphs that `describe` makes with these parameters and models, but for the scene and its policy.

    Raises:
        ConfigError: a segmenter or embedder that does not exist.
    """
    params, models = params or Params(), models or {}
    version = {"describe": VERSION}
    settings: dict[str, object] = {
        "layers": [name for name in ("landmarks", "objects", "things") if getattr(params, name)],
        **{name: plain(getattr(params, name)) for name in ("surface", "gravity", "unit", "precision", "few_nodes")},
    }
    backend = ""
    if params.landmarks:
        version["landmarks"] = landmarks.VERSION
        settings["landmark"] = landmarks.settings(params.landmark)
    if params.objects:
        chosen = resolved(params.object, models)
        version |= chosen.versions
        settings["object"] = chosen.settings(models)
        backend = chosen.params.render_backend
    if params.things:
        version["things"] = things.VERSION
        settings["thing"] = plain(params.thing)
    return RecipeKey("describe", "graph", version, settings, backend)


def describe(
    scene_id: str,
    gaussians: Gaussians,
    cameras: Cameras | None,
    params: Params | None = None,
    models: Mapping[str, ModelSpec] | None = None,
    *,
    scale_policy: str = "auto",
    progress: Progress = silent,
) -> SceneGraph:
    """The scene graph of one capture: find the surface, what is up and how long a metre is; then each layer.

    Args:
        scene_id: recorded in the graph.
        gaussians, cameras: the capture, scene frame; cameras may be None or synthesised.
        models: checked ONNX models by kind, for the methods that need them (`gsmap.describe.onnx.check`).
        scale_policy: ``known`` (the unit is the metre: no layers at guessed units), ``unknown`` (only those),
            ``auto`` (both, where a metre is plausible).

    Returns:
        Layers, vertical and extents in the scene's frame and unit; ``notes`` say what a person should know.

    Raises:
        ConfigError: an unknown policy, segmenter or embedder, or one of these without its model.
    """
    params = params or Params()
    if scale_policy not in SCALE_POLICIES:
        raise ConfigError(
            f"scale policy must be one of {', '.join(SCALE_POLICIES)}, got {scale_policy!r}", code="invalid_choice"
        )
    progress(0.0, "surface")
    cloud = surface_cloud(gaussians, params.surface)
    up = estimate_up(cloud.points, cameras, params.gravity)
    guess_m = estimate_unit_m(cloud.points, cameras, up, params.unit)
    working_m = working_unit_m(guess_m, cameras)
    units = landmark_units(guess_m, scale_policy, params.unit, working_m=working_m)
    if "landmarks" not in units:  # the unit is no metre
        working_m = guess_m
    unit_m = 1.0 if scale_policy == "known" else guess_m
    layers: dict[str, NodeLayer] = {}
    notes: list[str] = []
    if len(cloud) == 0:
        notes.append("no opaque Gaussians: nothing to describe")
    elif up is None:
        notes.append("up is unknown (no cameras that turn about it, no clear floor): landmarks are matched without it")
    if params.landmarks:
        octaves = Octaves()
        for i, (name, layer_unit_m) in enumerate(units.items()):
            progress(0.05 + 0.55 * i / len(units), name)
            layers[name] = landmark_layer(cloud, up, layer_unit_m, params.landmark, octaves)
        if up is not None:
            for name in [name for name in units if ":" not in name] or ["landmarks:1"]:
                free = name.replace("landmarks", "landmarks_gravity_free")
                layers[free] = gravity_free(layers[name], cloud, params.landmark)
    if params.objects:
        seen_m = working_m if scale_policy == "known" else guess_m
        context = SceneContext(cloud, len(gaussians), up, seen_m, models or {})
        layers["objects"], remarks = object_layer(
            gaussians, cameras, context, params.object, lambda fraction, text: progress(0.6 + 0.35 * fraction, text)
        )
        notes += remarks
    if len(cloud) and not any(len(layer) >= params.few_nodes for layer in layers.values()):
        notes.append(f"fewer than {params.few_nodes} nodes in every layer: little colour or shape to hold on to")
    found = None
    if params.things:
        progress(0.95, "things")
        found = find_things(gaussians, cloud, up, 1.0 if "landmarks" in units else unit_m, params.thing)
    progress(1.0, "described")
    graph = SceneGraph(scene_id, layers, up, unit_m, tuple(notes), found, working_m)
    return rounded(graph, params.precision)
