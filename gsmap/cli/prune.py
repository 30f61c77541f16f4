"""gsmap prune: delete unused files of a map."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import typer

from gsmap.cli.console import AsJson, MapPath, Output, opened, print_rows, say

PANEL = "Maintenance", 2
OUTPUTS = {"prune": Output("maps.PruneReport")}


def command(
    map: MapPath,
    keep_revisions: Annotated[
        int | None,
        typer.Option(
            "--keep-revisions",
            help="Keep only the poses of the newest N revisions; older revisions stay listed without poses.",
        ),
    ] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only show what would be deleted.")] = False,
    json: AsJson = False,
) -> None:
    """Delete leftovers of interrupted runs, and arrays of removed scenes that no remaining revision uses.

    Example: `gsmap prune site.gsmap --dry-run`
    """
    with opened(map) as m:
        report = m.prune(keep_revisions, dry_run=dry_run)
    verb = "would drop" if dry_run else "dropped"
    for name in report.scene_names:
        say(f"{verb} the arrays of {name}")
    for first, last in _runs(report.revisions):
        say(f"{verb} revision {first}" if first == last else f"{verb} revisions {first} to {last}")
    if json:
        print_rows("prune", report, json)
    else:
        print(f"{'would free' if dry_run else 'freed'} {report.num_bytes / 1e6:.1f} MB")


def _runs(numbers: Sequence[int]) -> list[tuple[int, int]]:
    """Return the first and the last number of each run of consecutive numbers."""
    out: list[tuple[int, int]] = []
    for number in sorted(numbers):
        if out and number == out[-1][1] + 1:
            out[-1] = (out[-1][0], number)
        else:
            out.append((number, number))
    return out
