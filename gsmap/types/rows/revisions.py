"""Revisions of the scene poses, and results of an update."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from gsmap.types.rows.base import Row
from gsmap.types.rows.pairs import EdgeRow, PairRef
from gsmap.types.rows.scenes import IngestRow, SceneRef, SceneRow


@dataclass(frozen=True, eq=False, kw_only=True)
class RevisionRow(Row):
    """A revision of the poses.

    Args:
        number: number, from 1.
        created_at: time, ISO 8601 with zone.
        scenes: number of scenes.
        components: number of connected components.
        edges_used: number of used edges.
        edges_tentative: number of edges without an agreeing cycle.
        edges_refused: number of unused edges.
        undecided: undecided edges.
        solver: ``batch`` (all poses solved) or ``incremental`` (new scenes added to the last solution).
        contradicted_priors: scenes whose prior contradicts the edges.
        settings: settings of the optimization.
        notes: remarks on it.
        note: reason why it was made.
        key: digest of its recipe and inputs.
        dropped_at: time when `gsmap prune` deleted it; null while it can be exported.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "number": "revision",
        "created_at": "created",
        "scenes": "scenes",
        "components": "components",
        "edges_used": "used",
        "edges_tentative": "tentative",
        "edges_refused": "refused",
        "solver": "solver",
    }

    number: int
    created_at: str
    scenes: int
    components: int
    edges_used: int
    edges_tentative: int
    edges_refused: int
    undecided: tuple[PairRef, ...] = ()
    solver: str = "batch"
    contradicted_priors: tuple[SceneRef, ...] = ()
    settings: Mapping[str, Any]
    notes: tuple[str, ...] = ()
    note: str = ""
    key: str = ""
    dropped_at: str | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class PoseChangeRow(SceneRef):
    """The difference of a scene's pose between two revisions.

    Args:
        change: ``added``, ``removed``, ``moved`` or ``same``.
        rotation_deg: rotation angle; null if the scene is in only one of the two.
        translation_m: displacement of the scene's centre, by the metric scale of the later revision; null if the scene
            is in only one of the two.
        scale_ratio: new scale divided by old; null if the scene is in only one of the two.
        component_before: component in the older revision; null if absent.
        component_after: component in the newer revision; null if absent.
        status_before: status in the older revision; null if absent.
        status_after: status in the newer revision; null if absent.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "scene_name": "scene",
        "change": "change",
        "rotation_deg": "rotation, deg",
        "translation_m": "translation, m",
        "scale_ratio": "scale ratio",
        "component_after": "component",
        "status_after": "status",
    }

    change: str
    rotation_deg: float | None
    translation_m: float | None
    scale_ratio: float | None
    component_before: int | None
    component_after: int | None
    status_before: str | None
    status_after: str | None


@dataclass(frozen=True, eq=False, kw_only=True)
class UpdateReport(Row):
    """The results of an update: what this run added or changed, not the whole map.

    Args:
        ingested: the given captures.
        scenes: scenes that are new, were described, or whose pose or status changed.
        edges: current edges of the pairs that were registered or whose use changed.
        revision: the newest revision; null if there is none.
        notes: remarks, such as differences between overlapping captures without dates.
    """

    ingested: tuple[IngestRow, ...]
    scenes: tuple[SceneRow, ...]
    edges: tuple[EdgeRow, ...]
    revision: RevisionRow | None
    notes: tuple[str, ...] = ()
