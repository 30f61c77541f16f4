"""gsmap split: copy part of a map to a new map."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.console import AsJson, MapPath, Output, opened, print_rows, say

PANEL = "Branches and backups", 4
OUTPUTS = {"split": Output("map_operations.SplitReport")}


def command(
    map: MapPath,
    out: Annotated[str, typer.Argument(metavar="OUT", help="The map to create.")],
    island: Annotated[
        int | None, typer.Option("--island", "--component", help="Copy the scenes of this connected component.")
    ] = None,
    box: Annotated[
        tuple[float, float, float, float, float, float] | None,
        typer.Option(
            "--box",
            metavar="X0 Y0 Z0 X1 Y1 Z1",
            help="Copy the scenes that reach into this box of --component; default: the largest component.",
        ),
    ] = None,
    by_name: Annotated[bool, typer.Option("--scenes", help="Copy the scenes named after OUT.")] = False,
    scenes: Annotated[list[str] | None, typer.Argument(metavar="[SCENES]...", help="Names or ids of scenes.")] = None,
    json: AsJson = False,
) -> None:
    """Copy some scenes of MAP, with their results and annotations, to a new map. MAP is not changed.

    Nothing is computed. The new map has the newest poses only, without older revisions.

    Example: `gsmap split site.gsmap hall.gsmap --scenes monday tuesday`
    """
    with opened(map) as m:
        report = m.split(out, island=island, box=box, scenes=scenes if by_name or scenes else None)
    for note in report.notes:
        say(note)
    print_rows("split", report, json, out)
