"""gsmap prune: reclaim what nothing names."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.console import MapPath, say


def command(
    map: MapPath,
    keep_revisions: Annotated[
        int | None, typer.Option("--keep-revisions", help="Keep only the newest N revisions exportable; all else.")
    ] = None,
) -> None:
    """Delete leftovers of interrupted work and arrays of removed scenes that no kept revision names.

    Example: `gsmap prune site.gsmap`
    """
    import gsmap

    with gsmap.open(map) as m:
        pruned = m.prune(keep_revisions)
    for name in pruned.scenes:
        say(f"dropped the arrays of {name}")
    print(f"freed {pruned.num_bytes / 1e6:.1f} MB")
