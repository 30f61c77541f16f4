"""What registration is given of a scene."""

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
    _surfaces: dict[float, Surface] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        if self.scale_policy not in SCALE_POLICIES:
            raise ConfigError(
                f"scale policy must be one of {', '.join(SCALE_POLICIES)}, got {self.scale_policy!r}",
                code="invalid_choice",
            )

    @cached_property
    def centre(self) -> np.ndarray:
        """(3,) middle of the scene's content, in its frame."""
        return np.median(self.gaussians.means, axis=0) if len(self.gaussians) else np.zeros(3)

    def surface(self, unit_m: float = 1.0) -> Surface:
        """The scene's surface in metres; the last two are kept, so a scene met by many others is prepared once."""
        if unit_m not in self._surfaces:
            while len(self._surfaces) > 1:
                self._surfaces.pop(next(iter(self._surfaces)))
            self._surfaces[unit_m] = Surface.of(self.gaussians, unit_m, self.cameras, self.views)
        return self._surfaces[unit_m]

    @cached_property
    def views(self) -> ViewCache | None:
        """Renders of the scene through its own cameras, each made once; None without cameras."""
        if not self.cameras or not len(self.gaussians):
            return None
        return ViewCache(self.gaussians, self.cameras)
