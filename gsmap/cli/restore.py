"""gsmap restore: a map from a backup."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.backup import Dest
from gsmap.cli.console import AsJson, print_rows, progress_bars, say


def command(
    dest: Dest,
    map: Annotated[str, typer.Argument(metavar="MAP", help="The map to make.", show_default=False)],
    at: Annotated[
        str | None,
        typer.Option(
            "--at", metavar="TIME|SNAPSHOT", help="The last snapshot at or before a time, or one by its name."
        ),
    ] = None,
    catalog: Annotated[
        str | None,
        typer.Option("--catalog", metavar="URL", help="Keep the catalog in this empty PostgreSQL database."),
    ] = None,
    json: AsJson = False,
) -> None:
    """Make a map from a backup, by default from its newest snapshot.

    Every byte is verified; MAP appears whole or not at all, and nothing that exists is overwritten.

    It is the same map, with the same id. For another one that begins with the same content: `gsmap clone`.

    Example: `gsmap restore /mnt/backup/site site.gsmap --at 2026-11-20`
    """
    import gsmap.map

    with progress_bars() as progress:
        report = gsmap.map.restore(dest, map, at, progress, catalog_url=catalog)
    say(f"restored {map} as of {report.snapshot.created_at} (snapshot {report.snapshot.snapshot})")
    if report.needs_migration:
        say(f"it was written by an older gsmap: run gsmap migrate {map}")
    if json:
        print_rows("restore", report, json)
