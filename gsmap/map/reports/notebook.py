"""Show a map in a notebook."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import PurePosixPath

from gsmap.store import Store
from gsmap.types.rows.maps import MapStatus
from gsmap.types.rows.scenes import SceneRow


def map_html(store: Store, status: MapStatus, scenes: Sequence[SceneRow]) -> str:
    """Return the content of a map, its open tasks and its scenes as HTML."""
    from gsmap.types.notebook import html_facts, html_table

    facts = [(heading, getattr(status, name)) for name, heading in MapStatus.columns.items()]
    parts = [html_facts(f"Map {PurePosixPath(store.location).name}", facts)]
    if status.todo:
        parts.append(html_table(status.todo))
    if scenes:
        parts.append(html_table(scenes))
    return "".join(parts)
