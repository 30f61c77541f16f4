"""gsmap split: part of a map as a map of its own."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.console import AsJson, MapPath, opened, print_rows, say


def command(
    map: MapPath,
    out: Annotated[str, typer.Argument(metavar="OUT", help="The map to make.")],
    island: Annotated[
        int | None, typer.Option("--island", "--component", help="The scenes of this connected component.")
    ] = None,
    box: Annotated[
        tuple[float, float, float, float, float, float] | None,
        typer.Option(
            "--box",
            metavar="X0 Y0 Z0 X1 Y1 Z1",
            help="The scenes that reach into this box of the component of --island, else of the largest.",
        ),
    ] = None,
    by_name: Annotated[bool, typer.Option("--scenes", help="The scenes that follow.")] = False,
    scenes: Annotated[list[str] | None, typer.Argument(metavar="[SCENES]...", help="Names or ids.")] = None,
    json: AsJson = False,
) -> None:
    """Make a new map of some scenes of MAP, with all that is known of and among them. MAP stays as it is.

    Nothing is computed. Of the history the newest poses come along.

    Example: `gsmap split site.gsmap hall.gsmap --scenes monday tuesday`
    """
    with opened(map) as m:
        report = m.split(out, island=island, box=box, scenes=scenes if by_name or scenes else None)
    for note in report.notes:
        say(note)
    print_rows("split", report, json, out)
