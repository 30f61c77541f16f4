"""A scene as the input of registration: Gaussians, cameras and scene graph."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from gsmap.errors import ConfigError
from gsmap.register.surface import Surface
from gsmap.register.view_cache import ViewCache
from gsmap.types import Cameras, Gaussians, SceneGraph
from gsmap.types.scene import SCALE_POLICIES


@dataclass(frozen=True, eq=False)
class SceneView:
    """A scene as the input of `register_pair`.

    Args:
        id: the scene's id.
        gaussians, cameras: Gaussians and cameras in the scene's frame; without cameras free space is not verified.
        graph: the scene graph.
        scale_policy: ``known`` (metres), ``unknown`` (any unit), or ``auto`` (metres if the match confirms it).
    """

    id: str
    gaussians: Gaussians
    cameras: Cameras | None
    graph: SceneGraph
    scale_policy: str = "auto"
    _surfaces: dict[float, Surface] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        if self.scale_policy not in SCALE_POLICIES:
            raise ConfigError(
                f"scale policy must be one of {', '.join(SCALE_POLICIES)}, got {self.scale_policy!r}",
                code="invalid_choice",
            )

    @cached_property
    def centre(self) -> np.ndarray:
        """(3,) median of the Gaussians' centres, in the scene's frame."""
        return np.median(self.gaussians.means, axis=0) if len(self.gaussians) else np.zeros(3)

    def surface(self, unit_m: float = 1.0) -> Surface:
        """Return the scene's surface in metres. The last two surfaces are cached, because a scene is registered with
        many others."""
        if unit_m not in self._surfaces:
            while len(self._surfaces) > 1:
                self._surfaces.pop(next(iter(self._surfaces)))
            self._surfaces[unit_m] = Surface.of(self.gaussians, unit_m, self.cameras, self.views)
        return self._surfaces[unit_m]

    @cached_property
    def views(self) -> ViewCache | None:
        """Renders of the scene through its own cameras, each computed once and cached; None without cameras."""
        if not self.cameras or not len(self.gaussians):
            return None
        return ViewCache(self.gaussians, self.cameras)
