"""A capture, as the catalog knows it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from gsmap.types.notebook import html_facts
from gsmap.types.thinning import Thinning

SCALE_POLICIES = ("auto", "known", "unknown")


@dataclass(frozen=True, eq=False)
class Scene:
    """One ingested capture: everything about it but its arrays.

    Args:
        id: content digest (hex) of Gaussians and cameras; the same content has the same id in every map.
        name: unique among the map's living scenes.
        num_gaussians, sh_degree, num_cameras: sizes of its arrays.
        bounds: (2, 3) float64 lowest and highest corner of the Gaussians' means, scene frame.
        scale_policy: ``known`` (metres), ``unknown`` (any unit), ``auto`` (registration votes).
        captured_at: ISO 8601 time with zone, or None.
        ingested_at: ISO 8601 time with zone.
        source: where it was read from, for people.
        cameras_synthesised: true when the source had no cameras.
        antialiased: true when trained with the 2D Mip filter (noted, not yet rendered differently).
        tags: words that people gave it, sorted.
        thinning: how it is kept where newer captures supersede it; None for one that is kept as it came.
        origin: (3,) float64 of its frame in the coordinates of its file: a point of the scene and this are the file's
            own coordinates. Zeros unless these are too large for float32, as map coordinates are.
    """

    id: str
    name: str
    num_gaussians: int
    sh_degree: int
    num_cameras: int
    bounds: np.ndarray
    scale_policy: str = "auto"
    captured_at: str | None = None
    ingested_at: str | None = None
    source: str = ""
    cameras_synthesised: bool = False
    antialiased: bool = False
    tags: tuple[str, ...] = ()
    thinning: Thinning | None = None
    origin: np.ndarray = field(default_factory=lambda: np.zeros(3))

    def _repr_html_(self) -> str:
        facts = {
            "id": self.id,
            "Gaussians": self.num_gaussians,
            "SH degree": self.sh_degree,
            "cameras": f"{self.num_cameras}{', synthesised' if self.cameras_synthesised else ''}",
            "captured": self.captured_at,
            "size, units": np.ptp(self.bounds, axis=0),
            "scale": self.scale_policy,
            "tags": self.tags,
        }
        return html_facts(f"Scene {self.name}", facts.items())
