"""gsmap diff: show the differences of scene poses between two revisions."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.console import AsJson, MapPath, Output, opened, print_rows

PANEL = "Changes over time", 3
OUTPUTS = {"diff": Output("revisions.PoseChangeRow", "scenes")}


def command(
    map: MapPath,
    before: Annotated[int, typer.Argument(metavar="R1", help="Number of the older revision.")],
    after: Annotated[int, typer.Argument(metavar="R2", help="Number of the newer revision.")],
    json: AsJson = False,
) -> None:
    """Show which scenes moved between two revisions, and by how much (translation at the centre of each scene).

    Example: `gsmap diff site.gsmap 1 2`
    """
    with opened(map) as m:
        rows = m.diff(before, after)
    print_rows("diff", rows, json, f"revision {before} to {after}")
