"""Scene graphs from captures."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from gsmap.describe.cloud import surface_cloud
from gsmap.describe.gravity import estimate_up
from gsmap.describe.landmark_layer import LandmarkParams, landmark_layer, landmark_method
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
        landmarks: make the landmark layers.
        landmark: how.
    """

    landmarks: bool = True
    landmark: LandmarkParams = field(default_factory=LandmarkParams)


def describe(
    scene_id: str,
    gaussians: Gaussians,
    cameras: Cameras | None,
    params: DescribeParams = DescribeParams(),
    models: Mapping[str, object] | None = None,
    *,
    scale_policy: str = "auto",
    progress: Callable[[float, str], None] | None = None,
) -> SceneGraph:
    """The scene graph of one capture: find the surface, what is up and how long a metre is; then each layer.

    Args:
        scene_id: recorded in the graph.
        gaussians, cameras: the capture, scene frame; cameras may be None or synthesised.
        models: ONNX models by name, for segmenters and embedders that need them.
        scale_policy: ``known`` (the unit is the metre: no layers at guessed units), ``unknown`` (only those),
            ``auto`` (both, where a metre is plausible).

    Raises:
        ConfigError: an unknown policy, or back ends without their model.
    """
    if scale_policy not in SCALE_POLICIES:
        raise ConfigError(f"scale policy must be one of {', '.join(SCALE_POLICIES)}, got {scale_policy!r}")
    report = progress or (lambda fraction, text: None)
    report(0.0, "surface")
    cloud = surface_cloud(gaussians)
    up = estimate_up(cloud.points, cameras)
    guess_m = estimate_unit_m(cloud.points, cameras, up)
    layers: dict[str, NodeLayer] = {}
    notes: list[str] = []
    if len(cloud) == 0:
        notes.append("no opaque Gaussians: nothing to describe")
    elif up is None:
        notes.append("up could not be told (no cameras, no clear floor): no landmarks")
    if params.landmarks:
        for i, (name, unit_m) in enumerate(landmark_units(guess_m, scale_policy).items()):
            report(0.1 + 0.2 * i, name)
            layers[name] = landmark_layer(cloud, up, unit_m, params.landmark)
        if up is not None and max(len(layer) for layer in layers.values()) < _FEW_NODES:
            notes.append("few landmarks: little colour or shape to hold on to")
    report(1.0, "described")
    return SceneGraph(scene_id, layers, up, 1.0 if scale_policy == "known" else guess_m, tuple(notes))


def landmark_units(guess_m: float, scale_policy: str) -> dict[str, float]:
    """The unit of each landmark layer by its name (see `gsmap.describe.unit`)."""
    levels = {f"landmarks:{i}": guess_m * LEVEL_STEP**power for i, power in enumerate(LEVELS)}
    plausible = _PLAUSIBLE_UNIT_M[0] < guess_m < _PLAUSIBLE_UNIT_M[1]
    if scale_policy == "known":
        return {"landmarks": 1.0}
    return {"landmarks": 1.0, **levels} if scale_policy == "auto" and plausible else levels


def methods(params: DescribeParams = DescribeParams(), models: Mapping[str, object] | None = None) -> dict[str, str]:
    """Digest by layer kind of what `describe` would do: equal digests mean that a cached graph can be used."""
    return {"landmarks": landmark_method(params.landmark)} if params.landmarks else {}
