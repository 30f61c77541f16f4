"""What registration is given of a scene."""

from __future__ import annotations

from dataclasses import dataclass

from gsmap.errors import ConfigError
from gsmap.types import Cameras, Gaussians, SceneGraph
from gsmap.types.scene import SCALE_POLICIES


@dataclass(frozen=True, eq=False)
class SceneView:
    """One scene as `register_pair` takes it.

    Args:
        id: the scene's id.
        gaussians, cameras: in the scene's frame; cameras may be None or empty, then nothing is checked through them.
        graph: its nodes.
        scale_policy: ``known`` (metres), ``unknown`` (any unit), or ``auto`` (metres if the match says so).
    """

    id: str
    gaussians: Gaussians
    cameras: Cameras | None
    graph: SceneGraph
    scale_policy: str = "auto"

    def __post_init__(self) -> None:
        if self.scale_policy not in SCALE_POLICIES:
            raise ConfigError(f"scale policy must be one of {', '.join(SCALE_POLICIES)}, got {self.scale_policy!r}")
