"""gsmap update: everything that is missing."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from gsmap.cli.console import MapPath, print_table, progress_bars, say

if TYPE_CHECKING:
    from gsmap.map import Map


def command(
    map: MapPath,
    paths: Annotated[
        list[str] | None, typer.Argument(metavar="[FILE_OR_FOLDER...]", help="Captures to ingest first.")
    ] = None,
) -> None:
    """Make MAP if it is missing, ingest the files, then describe, register and optimize whatever is missing.

    Example: `gsmap update house.gsmap captures/*.ply`
    """
    import gsmap.map

    with progress_bars() as progress, gsmap.map.open_or_create(map, progress=progress) as m:
        for result in m.update(*(paths or ())):
            for note in result.notes:
                say(f"{result.scene.name}: {note}")
            if not result.new:
                say(f"{result.scene.name}: already in the map, nothing changed")
    with gsmap.open(map) as m:
        print_map(m)


def print_map(m: Map) -> None:
    """The closing table: scenes placed, edges with reasons, islands."""
    rows = m.scene_rows()
    print_table(
        "scenes",
        ["scene", "status", "island", "Gaussians", "nodes"],
        [[r["name"], r["status"], r["component"], r["num_gaussians"], r["num_nodes"]] for r in rows],
    )
    names = {r["id"]: r["name"] for r in rows}
    edges = m.edge_rows()
    print_table(
        "edges",
        ["pair", "status", "used", "overlap", "inliers", "reason"],
        [
            [
                f"{names[e['target']]}:{names[e['source']]}",
                e["status"],
                e["used"],
                round(e["overlap"], 2),
                e["num_inliers"],
                e["reason"],
            ]
            for e in edges
        ],
    )
    placed = [r for r in rows if r["S_map_scene"] is not None]
    islands = {r["component"] for r in placed}
    accepted = sum(e["status"] == "accepted" for e in edges)
    print(
        f"{len(placed)} of {len(rows)} scenes placed on {len(islands)} island{'s' * (len(islands) != 1)}; "
        f"{accepted} edges accepted, {len(edges) - accepted} not"
    )
