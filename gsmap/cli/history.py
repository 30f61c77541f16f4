"""gsmap history: show the objects at a place over time."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from gsmap.cli.console import AsJson, MapPath, Output, Preset, Sets, opened, print_rows, print_table, say

if TYPE_CHECKING:
    from gsmap.types.rows.objects import HistoryReport

PANEL = "Changes over time", 2
OUTPUTS = {"history": Output("objects.HistoryReport")}
TAKES_POINTS = True


def command(
    map: MapPath,
    place: Annotated[
        str | None,
        typer.Argument(metavar="[OBJECT|X,Y,Z]", help="Id or name of an object (gsmap graph), or a point."),
    ] = None,
    box: Annotated[
        tuple[float, float, float, float, float, float] | None,
        typer.Option("--box", metavar="X0 Y0 Z0 X1 Y1 Z1", help="Show all objects that were ever in this box."),
    ] = None,
    sets: Sets = None,
    preset: Preset = None,
    json: AsJson = False,
) -> None:
    """Show the objects at a place over time: seen, absent or unobserved in each capture.

    Example: `gsmap history site.gsmap 1.5,0.2,0.8`
    """
    with opened(map, bars=True, sets=sets, preset=preset) as m:
        report = m.history(place, box=box)
    for note in report.notes:
        say(note)
    if json:
        print_rows("history", report, json)
        return
    print_history(report)


def print_history(report: HistoryReport) -> None:
    """Print the objects of a place, their observations and annotations."""
    from gsmap.types.rows.objects import ObjectFactRow, ObjectObservationRow, ObjectRow

    print_table("objects", ObjectRow.columns, report.objects)
    print_table("sightings", ObjectObservationRow.columns, report.sightings)
    if report.words:
        print_table("words", ObjectFactRow.columns, report.words)
