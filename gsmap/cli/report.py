"""gsmap report: write a summary of the map as one HTML page."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.console import AsJson, MapPath, Output, opened, print_rows, say

PANEL = "View and query", 2
OUTPUTS = {"report": Output("reports.WrittenReport")}


def command(
    map: MapPath,
    out: Annotated[str, typer.Argument(metavar="OUT.html", help="Page to write, which replaces an older report.")],
    since: Annotated[
        str | None, typer.Option("--since", metavar="DATE", help="Also list additions since this ISO 8601 date.")
    ] = None,
    pictures: Annotated[
        bool, typer.Option("--pictures/--no-pictures", help="Draw pictures of doubtful pairs and of changes.")
    ] = True,
    json: AsJson = False,
) -> None:
    """Write a self-contained HTML page that shows the map, doubtful edges and open tasks.

    Example: `gsmap report site.gsmap monday.html --since 2026-11-01`
    """
    with opened(map, bars=True) as m:
        written = m.report(out, since=since, pictures=pictures)
    if json:
        print_rows("report", written, json)
        return
    for note in written.notes:
        say(note)
    say(written.verdict)
    say(f"wrote {written.path} ({written.num_bytes / 1e6:.2g} MB)")
