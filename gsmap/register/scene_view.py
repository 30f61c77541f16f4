"""A scene as the input of registration: Gaussians, cameras and scene graph."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from gsmap.errors import ConfigError
from gsmap.register.prepare import prepare, working_m_of
from gsmap.register.surface import Surface
from gsmap.register.view_cache import PreparedViews, ViewCache
from gsmap.types import Cameras, Gaussians, SceneGraph
from gsmap.types.prepared_scene import PreparedScene
from gsmap.types.scene import SCALE_POLICIES


@dataclass(frozen=True, eq=False)
class SceneView:
    """A scene as the input of `register_pair`.

    Args:
        id: the scene's id.
        gaussians, cameras: Gaussians and cameras in the scene's frame; without cameras free space is not verified.
            Gaussians of a map may be read on demand (`gsmap.store.scene_content.UnreadGaussians`).
        graph: the scene graph.
        scale_policy: ``known`` (metres), ``unknown`` (any unit), or ``auto`` (metres if the match confirms it).
        known: the prepared scene, if it was computed before.
    """

    id: str
    gaussians: Gaussians
    cameras: Cameras | None
    graph: SceneGraph
    scale_policy: str = "auto"
    known: PreparedScene | None = None
    _surfaces: dict[float, Surface] = field(default_factory=dict, init=False, repr=False)

    def __post_init__(self) -> None:
        if self.scale_policy not in SCALE_POLICIES:
            raise ConfigError(
                f"scale policy must be one of {', '.join(SCALE_POLICIES)}, got {self.scale_policy!r}",
                code="invalid_choice",
            )

    @cached_property
    def prepared(self) -> PreparedScene:
        """Preparation that all pairs of the scene share; computed unless it is known."""
        if self.known is not None:
            return self.known
        unit_m = working_m_of(self.graph, self.scale_policy)
        return prepare(self.id, self.gaussians.degree_0(), self.cameras, unit_m)

    @property
    def centre(self) -> np.ndarray:
        """(3,) median of the Gaussians' centres, in the scene's frame."""
        return self.prepared.centre

    @cached_property
    def splats(self) -> Gaussians:
        """The surface Gaussians in the scene's unit, with SH coefficients of degree 0 alone."""
        return self.gaussians.degree_0(self.prepared.is_surface)

    def surface(self, unit_m: float = 1.0) -> Surface:
        """Return the scene's surface in metres. The last two surfaces are cached, because a scene is registered with
        many others."""
        if unit_m not in self._surfaces:
            while len(self._surfaces) > 1:
                self._surfaces.pop(next(iter(self._surfaces)))
            prepared = self.prepared if self.prepared.unit_m == unit_m else None
            self._surfaces[unit_m] = Surface.from_splats(
                self.splats, unit_m, self.gaussians, self.cameras, self.views, prepared
            )
        return self._surfaces[unit_m]

    @cached_property
    def views(self) -> ViewCache | None:
        """The scene from its own cameras; None without cameras."""
        return PreparedViews(self.prepared) if len(self.prepared.cameras) else None

    @property
    def num_bytes(self) -> int:
        """Return the size in memory of the Gaussians, views and cells that were read so far."""
        held = [vars(self).get("splats"), vars(self).get("prepared", self.known)]
        for surface in self._surfaces.values():
            held += [value for value in vars(surface).values() if isinstance(value, np.ndarray)]
            held += [vars(surface).get("splats")] if surface.unit_m != 1.0 else []
        return sum(int(getattr(one, "num_bytes", getattr(one, "nbytes", 0))) for one in held if one is not None)
