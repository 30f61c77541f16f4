"""gsmap graph: show the objects of the map and their relations."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.console import AsJson, MapPath, Output, Preset, Sets, opened, print_rows, print_table, say

PANEL = "View and query", 3
OUTPUTS = {"graph": Output("objects.ObjectsReport")}


def command(
    map: MapPath,
    out: Annotated[str | None, typer.Argument(metavar="[OUT]", help="File to write.")] = None,
    format: Annotated[
        str | None,
        typer.Option(
            "--format", help="Format of OUT: `json` (as --json prints it) or `graphml`; default: by the suffix of OUT."
        ),
    ] = None,
    sets: Sets = None,
    preset: Preset = None,
    json: AsJson = False,
) -> None:
    """Show the objects of the map over all captures, their relations and rooms, or write them to a file.

    Example: `gsmap graph site.gsmap site.graphml`
    """
    from gsmap.errors import ConfigError
    from gsmap.types.rows.objects import ObjectRow, RelationRow, RoomRow

    if format is not None and out is None:
        raise ConfigError(
            f"--format needs a file to write: gsmap graph {map} OUT --format {format}", code="missing_option"
        )
    with opened(map, bars=True, sets=sets, preset=preset) as m:
        if out is None:
            report = m.objects()
        else:
            report = m.write_graph(out, format or ("graphml" if out.endswith(".graphml") else "json"))
            say(f"wrote {out}")
    for note in report.notes:
        say(note)
    if json:
        print_rows("graph", report, json)
        return
    if out is None:
        columns = dict(ObjectRow.columns)
        for word in ("name", "label", "room"):
            if not any(getattr(row, word) for row in report.objects):
                del columns[word]
        print_table("objects", columns, report.objects)
        print_table("relations", RelationRow.columns, report.relations)
        print_table("rooms", RoomRow.columns, report.rooms)
    say(f"{len(report.objects)} objects, {len(report.relations)} relations, {len(report.rooms)} rooms")
