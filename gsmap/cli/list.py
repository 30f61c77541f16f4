"""gsmap list: tables of what the map holds."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

import typer

from gsmap.cli.console import AsJson, MapPath, print_json, print_table


class What(StrEnum):
    scenes = "scenes"
    edges = "edges"
    revisions = "revisions"
    tiles = "tiles"


COLUMNS = {
    What.scenes: ["name", "id", "num_gaussians", "num_nodes", "component", "captured_at", "status"],
    What.edges: ["target", "source", "status", "used", "overlap", "num_inliers", "scale", "reason"],
    What.revisions: ["number", "created_at", "scenes", "components", "edges_used", "edges_tentative", "edges_refused"],
    What.tiles: ["out", "path", "component", "merge", "num_gaussians", "truncated"],
}


def command(map: MapPath, what: Annotated[What, typer.Argument(help="What to list.")], json: AsJson = False) -> None:
    """List scenes, edges, revisions or tiles.

    Example: `gsmap list site.gsmap edges --json`
    """
    import gsmap

    with gsmap.open(map) as m:
        rows = {
            What.scenes: m.scene_rows,
            What.edges: m.edge_rows,
            What.revisions: m.revision_rows,
            What.tiles: m.tile_rows,
        }[what]()
    if json:
        print_json(rows)
        return
    columns = COLUMNS[what]
    print_table(what, columns, [[_short(c, row[c]) for c in columns] for row in rows])


def _short(column: str, value: object) -> object:
    """Content digests are long; a dozen digits tell them apart."""
    return value[:12] if column in {"id", "target", "source"} and isinstance(value, str) and len(value) >= 32 else value
