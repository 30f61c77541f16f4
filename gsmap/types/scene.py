"""A capture in the catalog."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TypedDict

import numpy as np

from gsmap.types.thinning import Thinning

SCALE_POLICIES = ("auto", "known", "unknown")
SCENE_FACTS = ("name", "captured_at", "note", "tag", "untag", "metres_per_unit")
"""Kinds of annotations of a scene. A kind that is a column of the table of scenes has its newest value there, too."""


class SceneEdits(TypedDict, total=False):
    """New annotations of a scene; its history keeps earlier ones.

    Args:
        name: unused among living scenes.
        captured_at: capture date, ISO 8601, UTC if it has no zone; empty to remove it.
        note: note to add.
        metres_per_unit: metres per unit of the scene's own frame; 0 to remove it.
    """

    name: str | None
    captured_at: str | None
    note: str | None
    metres_per_unit: float | None


@dataclass(frozen=True, eq=False)
class SceneFacts:
    """The facts of an ingested capture that the catalog, the rows of verbs and the page share.

    Args:
        id: content digest (hex) of Gaussians and cameras; the same content has the same id in every map.
        name: unique among the map's living scenes.
        num_gaussians: number of Gaussians.
        sh_degree: degree of its spherical harmonics.
        num_cameras: number of cameras.
        bounds: (2, 3) lowest and highest corner of the Gaussians' centres, scene frame.
        scale_policy: ``known`` (its unit is the metre), ``unknown`` or ``auto`` (registration votes).
        captured_at: capture date, ISO 8601 with zone; None if unknown.
        ingested_at: time of the ingest, ISO 8601 with zone.
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


@dataclass(frozen=True, eq=False)
class Scene(SceneFacts):
    """The facts of one ingested capture, without its arrays.

    Args:
        source: path it was read from.
        cameras_synthesised: true when the source had no cameras.
        antialiased: true when trained with the 2D Mip filter (noted, not yet rendered differently).
        tags: tags, sorted.
        thinning: compact form of a superseded capture; None if it is whole.
        origin: (3,) float64 origin of its frame in the coordinates of its file; zeros unless these exceed float32, as
            map coordinates do.
    """

    source: str = ""
    cameras_synthesised: bool = False
    antialiased: bool = False
    tags: tuple[str, ...] = ()
    thinning: Thinning | None = None
    origin: np.ndarray = field(default_factory=lambda: np.zeros(3))

    def __repr__(self) -> str:
        dated = f", captured_at={self.captured_at!r}" if self.captured_at else ""
        size = " x ".join(f"{side:.3g}" for side in np.ptp(self.bounds, axis=0).tolist())
        sizes = f"{self.num_gaussians} Gaussians, {self.num_cameras} cameras"
        return f"Scene({self.name!r}, id={self.id[:12]!r}, {sizes}, extent={size}{dated})"

    def _repr_html_(self) -> str:
        from gsmap.types.notebook import html_facts

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
