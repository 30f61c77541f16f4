"""gsmap clone: create a second map with the same content."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.console import AsJson, MapPath, Output, opened, print_rows, say

PANEL = "Branches and backups", 5
OUTPUTS = {"clone": Output("backups.CloneReport")}


def command(
    map: MapPath,
    new: Annotated[str, typer.Argument(metavar="NEW", help="The map to create.", show_default=False)],
    json: AsJson = False,
) -> None:
    """Create a second map with the same content and a new id, which then changes independently.

    Array files, which never change, are shared through hard links if the file system supports them, and copied
    otherwise. Exports and backups stay with the first map.

    Example: `gsmap clone site.gsmap what-if.gsmap`
    """
    with opened(map, bars=True) as m:
        report = m.clone(new)
    say(f"created {new}: {report.num_linked} files shared, {report.num_copied} copied")
    if json:
        print_rows("clone", report, json)
