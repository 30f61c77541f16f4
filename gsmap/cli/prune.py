"""gsmap prune: reclaim what nothing names."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.console import AsJson, MapPath, opened, print_rows, say


def command(
    map: MapPath,
    keep_revisions: Annotated[
        int | None,
        typer.Option(
            "--keep-revisions", help="Keep only the newest N revisions; of older ones their line in the list."
        ),
    ] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Delete nothing: only say what would go.")] = False,
    json: AsJson = False,
) -> None:
    """Delete leftovers of interrupted work and arrays of removed scenes that no kept revision names.

    Example: `gsmap prune site.gsmap --dry-run`
    """
    with opened(map) as m:
        report = m.prune(keep_revisions, dry_run=dry_run)
    verb = "would drop" if dry_run else "dropped"
    for name in report.scene_names:
        say(f"{verb} the arrays of {name}")
    for number in report.revisions:
        say(f"{verb} revision {number}")
    if json:
        print_rows("prune", report, json)
    else:
        print(f"{'would free' if dry_run else 'freed'} {report.num_bytes / 1e6:.1f} MB")
