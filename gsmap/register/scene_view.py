"""What registration is given of a scene."""

from __future__ import annotations

from dataclasses import dataclass, field

from gsmap.errors import ConfigError
from gsmap.register import surface
from gsmap.register.sight import Sight
from gsmap.register.surface import Surface
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
    _surfaces: dict[tuple[float, surface.Params], Surface] = field(default_factory=dict, init=False, repr=False)
    _sights: dict[int, Sight] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        if self.scale_policy not in SCALE_POLICIES:
            raise ConfigError(f"scale policy must be one of {', '.join(SCALE_POLICIES)}, got {self.scale_policy!r}")

    def surface(self, unit_m: float, params: surface.Params) -> Surface:
        """The scene's surface in metres; the last two are kept, so a scene met by many others is prepared once."""
        key = (unit_m, params)
        if key not in self._surfaces:
            while len(self._surfaces) > 1:
                self._surfaces.pop(next(iter(self._surfaces)))
            self._surfaces[key] = Surface.of(self.gaussians, unit_m, params)
        return self._surfaces[key]

    def sight(self, size_px: int) -> Sight | None:
        """What the scene's cameras see of it, and keep; None without cameras."""
        if not self.cameras or not len(self.gaussians):
            return None
        if size_px not in self._sights:
            self._sights.clear()
            self._sights[size_px] = Sight(self.gaussians, self.cameras, size_px)
        return self._sights[size_px]
