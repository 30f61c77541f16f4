"""gsmap merge: take in all that another map knows."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.console import AsJson, MapPath, opened, print_rows, say


def command(
    map: MapPath,
    source: Annotated[
        str, typer.Argument(metavar="SOURCE", help="The map, branch or tag to take in; it stays as it is.")
    ],
    json: AsJson = False,
) -> None:
    """Take all that another map knows into MAP: scenes, graphs, edges, what people said, revisions.

    Nothing is computed. `gsmap update MAP` then registers only pairs across the two.

    Example: `gsmap merge site.gsmap site.gsmap@what-if`
    """
    with opened(map) as m:
        report = m.merge(source)
    for note in report.notes:
        say(note)
    for old, new in report.renamed.items():
        say(f"{old} is called {new} here: its name was taken")
    print_rows("merge", report, json, f"from {source}")
