"""gsmap clone: another map with the same content."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.console import AsJson, MapPath, opened, print_rows, say


def command(
    map: MapPath,
    new: Annotated[str, typer.Argument(metavar="NEW", help="The map to make.", show_default=False)],
    json: AsJson = False,
) -> None:
    """Make another map that begins with what this one holds now: a new id, and a history that goes on by itself.

    Arrays, which never change, are shared through hard links where the disk has them, else copied. Exports and backups
    stay with the first map.

    Example: `gsmap clone site.gsmap what-if.gsmap`
    """
    with opened(map, bars=True) as m:
        report = m.clone(new)
    say(f"made {new}: {report.num_linked} files shared, {report.num_copied} copied")
    if json:
        print_rows("clone", report, json)
