"""gsmap list: list scenes, edges, revisions, tiles or photos."""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from typing import TYPE_CHECKING, Annotated

import typer

from gsmap.cli.console import AsJson, AsOf, MapPath, Output, opened, print_rows, refuse_options, say, say_heights

if TYPE_CHECKING:
    from gsmap.map import Map
    from gsmap.types.rows.base import Row

PANEL = "Map", 8
OUTPUTS = {
    "list scenes": Output("scenes.SceneRow", "scenes"),
    "list edges": Output("pairs.EdgeRow", "edges"),
    "list revisions": Output("revisions.RevisionRow", "revisions"),
    "list tiles": Output("exports.TileRow", "tiles"),
    "list photos": Output("localize.PhotoRow", "photos"),
}


class ListKind(StrEnum):
    scenes = "scenes"
    edges = "edges"
    revisions = "revisions"
    tiles = "tiles"
    photos = "photos"


def command(
    context: typer.Context,
    map: MapPath,
    what: Annotated[ListKind, typer.Argument(help="Kind of rows to list.")],
    component: Annotated[
        int | None,
        typer.Option(
            "--component", "--island", help="List only scenes, edges, tiles and photos of this connected component."
        ),
    ] = None,
    status: Annotated[
        str | None,
        typer.Option(
            "--status",
            help="List only scenes or edges of this status, in the words of the tables (one-pair, used, ...).",
        ),
    ] = None,
    after: Annotated[
        str | None,
        typer.Option(
            "--after",
            metavar="DATE",
            help="List only scenes captured, edges registered or revisions computed after this ISO 8601 time.",
        ),
    ] = None,
    tag: Annotated[
        str | None, typer.Option("--tag", help="List only scenes with this tag, and edges between such scenes.")
    ] = None,
    as_of: AsOf = None,
    json: AsJson = False,
) -> None:
    """List scenes, edges, revisions, tiles, or photos kept by `localize --add`.

    Example: `gsmap list site.gsmap edges --status accepted --json`
    """
    from gsmap.map.date_filter import undated_note

    if what not in (ListKind.scenes, ListKind.edges):
        other = "--component" if what is ListKind.revisions else "--after"
        refuse_options(context, ("--status", other, "--tag", "--as-of"), what)
    with opened(map) as m:
        rows = _rows(m, what, component, status, after, tag, as_of)
        left_out = undated_note(m.scenes(), as_of) if as_of is not None else ""
    if left_out:
        say(left_out)
    print_rows(f"list {what}", rows, json, what)
    if what is ListKind.scenes and not json:
        say_heights(rows)


def _rows(
    m: Map,
    what: ListKind,
    component: int | None,
    status: str | None,
    after: str | None,
    tag: str | None,
    as_of: str | None,
) -> Sequence[Row]:
    if what is ListKind.scenes:
        return m.scene_rows(component=component, status=status, after=after, tag=tag, as_of=as_of)
    if what is ListKind.edges:
        return m.edge_rows(component=component, status=status, after=after, tag=tag, as_of=as_of)
    if what is ListKind.photos:
        return [row for row in m.photo_rows() if component is None or row.component == component]
    if what is ListKind.tiles:
        return [row for row in m.tile_rows() if component is None or row.component == component]
    from gsmap.map.reports import made_after

    return made_after(m.revision_rows(), after)
