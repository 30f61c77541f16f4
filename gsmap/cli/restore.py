"""gsmap restore: restore a map from a backup."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.backup import Dest
from gsmap.cli.console import AsJson, Output, print_rows, progress_bars, say

PANEL = "Branches and backups", 7
OUTPUTS = {"restore": Output("backups.RestoreReport")}


def command(
    dest: Dest,
    map: Annotated[str, typer.Argument(metavar="MAP", help="The map to create.", show_default=False)],
    at: Annotated[
        str | None,
        typer.Option(
            "--at",
            metavar="TIME|SNAPSHOT",
            help="Restore the newest snapshot at or before this time, or the snapshot with this name.",
        ),
    ] = None,
    catalog: Annotated[
        str | None,
        typer.Option("--catalog", metavar="URL", help="Keep the catalog in this empty PostgreSQL database."),
    ] = None,
    json: AsJson = False,
) -> None:
    """Restore a map from a backup; default: from its newest snapshot.

    Every byte is verified. MAP is created completely or not at all, and no existing file is overwritten. The restored
    map has the id of the original; use `gsmap clone` to create a different map with the same content.

    Example: `gsmap restore /mnt/backup/site site.gsmap --at 2026-11-20`
    """
    import gsmap.map

    with progress_bars() as progress:
        report = gsmap.map.restore(dest, map, at, progress, catalog_url=catalog)
    say(f"restored {map} as of {report.snapshot.created_at} (snapshot {report.snapshot.snapshot})")
    if report.needs_migration:
        say(f"the backup is from an older gsmap: run gsmap migrate {map}")
    if json:
        print_rows("restore", report, json)
