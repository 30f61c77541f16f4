"""Scene graphs from captures."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from gsmap.describe.cloud import surface_cloud
from gsmap.describe.gravity import estimate_up
from gsmap.describe.landmark_layer import LandmarkParams, landmark_layer, landmark_method, unlevelled
from gsmap.describe.models import ModelSpec
from gsmap.describe.object_layer import ObjectParams, object_layer, object_method
from gsmap.describe.unit import LEVEL_STEP, LEVELS, estimate_unit_m
from gsmap.errors import ConfigError
from gsmap.types import Cameras, Gaussians, NodeLayer, SceneGraph
from gsmap.types.scene import SCALE_POLICIES

# A scene whose unit may be a metre: the guess is right to a factor of about 2, and a large hall is still a room.
_PLAUSIBLE_UNIT_M = (0.25, 4.0)
_FEW_NODES = 20


@dataclass(frozen=True)
class DescribeParams:
    """What to describe and how.

    Args:
        landmarks, objects: which layers to make.
        landmark, object: how.
    """

    landmarks: bool = True
    objects: bool = True
    landmark: LandmarkParams = field(default_factory=LandmarkParams)
    object: ObjectParams = field(default_factory=ObjectParams)


def describe(
    scene_id: str,
    gaussians: Gaussians,
    cameras: Cameras | None,
    params: DescribeParams | None = None,
    models: Mapping[str, ModelSpec] | None = None,
    *,
    scale_policy: str = "auto",
    progress: Callable[[float, str], None] | None = None,
) -> SceneGraph:
    """The scene graph of one capture: find the surface, what is up and how long a metre is; then each layer.

    Args:
        scene_id: recorded in the graph.
        gaussians, cameras: the capture, scene frame; cameras may be None or synthesised.
        models: checked ONNX models by kind, for the back ends that need them (`gsmap.describe.models`).
        scale_policy: ``known`` (the unit is the metre: no layers at guessed units), ``unknown`` (only those),
            ``auto`` (both, where a metre is plausible).

    Raises:
        ConfigError: an unknown policy or back end, or a back end without its model.
    """
    params = params or DescribeParams()
    if scale_policy not in SCALE_POLICIES:
        raise ConfigError(f"scale policy must be one of {', '.join(SCALE_POLICIES)}, got {scale_policy!r}")
    report = progress or (lambda fraction, text: None)
    report(0.0, "surface")
    cloud = surface_cloud(gaussians)
    up = estimate_up(cloud.points, cameras)
    unit_m = 1.0 if scale_policy == "known" else estimate_unit_m(cloud.points, cameras, up)
    layers: dict[str, NodeLayer] = {}
    notes: list[str] = []
    if len(cloud) == 0:
        notes.append("no opaque Gaussians: nothing to describe")
    elif up is None:
        notes.append("up is unknown (no cameras, no clear floor): landmarks are matched without it")
    if params.landmarks:
        units = landmark_units(unit_m, scale_policy)
        for i, (name, layer_unit_m) in enumerate(units.items()):
            report(0.05 + 0.55 * i / len(units), name)
            layers[name] = landmark_layer(cloud, up, layer_unit_m, params.landmark)
        if up is not None:
            name = "landmarks" if "landmarks" in layers else "landmarks:1"
            layers[name.replace("landmarks", "unlevelled")] = unlevelled(layers[name], cloud, params.landmark)
    if params.objects:
        layers["objects"], remarks = object_layer(
            gaussians,
            cameras,
            cloud,
            up,
            unit_m,
            params.object,
            models or {},
            lambda fraction, text: report(0.6 + 0.4 * fraction, text),
        )
        notes += remarks
    if len(cloud) and not any(len(layer) >= _FEW_NODES for layer in layers.values()):
        notes.append(f"fewer than {_FEW_NODES} nodes in every layer: little colour or shape to hold on to")
    report(1.0, "described")
    return SceneGraph(scene_id, layers, up, unit_m, tuple(notes))


def landmark_units(guess_m: float, scale_policy: str) -> dict[str, float]:
    """The unit of each landmark layer by its name (see `gsmap.describe.unit`)."""
    levels = {f"landmarks:{i}": guess_m * LEVEL_STEP**power for i, power in enumerate(LEVELS)}
    plausible = _PLAUSIBLE_UNIT_M[0] < guess_m < _PLAUSIBLE_UNIT_M[1]
    if scale_policy == "known":
        return {"landmarks": 1.0}
    return {"landmarks": 1.0, **levels} if scale_policy == "auto" and plausible else levels


def methods(params: DescribeParams | None = None, models: Mapping[str, ModelSpec] | None = None) -> dict[str, str]:
    """Digest by kind of layer of what `describe` would do: equal digests mean that a cached graph can be used."""
    params = params or DescribeParams()
    out = {}
    if params.landmarks:
        out["landmarks"] = landmark_method(params.landmark)
    if params.objects:
        out["objects"] = object_method(params.object, models or {})
    return out
