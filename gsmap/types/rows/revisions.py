"""Revisions of the poses, and what an update did."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from gsmap.types.rows.base import Row
from gsmap.types.rows.pairs import EdgeRow, PairRef
from gsmap.types.rows.scenes import IngestRow, SceneRef, SceneRow


@dataclass(frozen=True, eq=False, kw_only=True)
class RevisionRow(Row):
    """One answer of the optimiser.

    Args:
        number: from 1.
        created_at: when, ISO 8601 with zone.
        scenes: how many scenes it has.
        components: how many connected components they form.
        edges_used: how many edges it used.
        edges_tentative: how many of its edges no cycle confirms.
        edges_refused: how many edges it did not use.
        undecided: the edges that nothing could decide.
        solver: ``batch`` (everything solved anew) or ``incremental`` (new scenes placed in the answer before).
        contradicted_priors: scenes whose prior the edges outweighed.
        settings: what the optimiser was set to.
        notes: what a person should know of it.
        note: why it was made.
        key: digest of everything that it was made from.
        dropped_at: when `gsmap prune` let it go; null while it can be exported.
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
class PoseChangeRow(Row):
    """How one scene differs between two revisions.

    Args:
        scene: id.
        scene_name: name.
        change: ``added``, ``removed``, ``moved`` or ``same``.
        rotation_deg: angle turned; null where the scene is in only one of the two.
        translation_m: how far the scene's middle went, by the metre of the later revision; null as above.
        scale_ratio: new scale by old; null as above.
        component_before: its component in the older revision; null where it is absent.
        component_after: its component in the newer revision; null where it is absent.
        status_before: its status in the older revision; null where it is absent.
        status_after: its status in the newer revision; null where it is absent.
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

    scene: str
    scene_name: str
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
    """What an update took in and changed; ``gsmap list MAP scenes`` and ``edges`` have the whole map.

    Args:
        ingested: the captures given.
        scenes: those that came, were described, or whose pose or status changed.
        edges: the current edge of every pair that was registered, or whose use changed.
        revision: the newest revision, with how many scenes and edges it has; null where there is none.
    """

    ingested: tuple[IngestRow, ...]
    scenes: tuple[SceneRow, ...]
    edges: tuple[EdgeRow, ...]
    revision: RevisionRow | None
