"""gsmap check: verify every byte of a map."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.console import AsJson, MapPath, Output, opened, print_rows, say
from gsmap.texts import shown

PANEL = "Maintenance", 1
OUTPUTS = {"check": Output("maps.CheckReport")}


def command(
    map: MapPath,
    accept_catalog: Annotated[
        bool,
        typer.Option(
            "--accept-catalog", help="First accept the current catalog, even if another program has changed it."
        ),
    ] = False,
    json: AsJson = False,
) -> None:
    """Read every byte of the map and compare it with the stored digests. The exit code is 1 if anything is damaged.

    Example: `gsmap check site.gsmap`
    """
    if accept_catalog:
        _accept(map)
    with opened(map, bars=True) as m:
        report = m.check()
    if json:
        print_rows("check", report, json)
    else:
        for problem in report.problems:
            print(shown(problem))
        for why in report.unverified:
            print(f"cannot verify the catalog: {shown(why)}")
    if not report.ok:
        count = len(report.problems)
        again = "restore the files from a backup, ingest their scenes again, or describe again (for scene graphs)"
        say(f"{count} problems in {map}: {again}")
        raise typer.Exit(1)
    say(f"no damage found in {map}" if report.unverified else f"{map} is intact")


def _accept(map: str) -> None:
    import gsmap.map

    found = gsmap.map.accept_catalog(map)
    if not found:
        say(f"the catalog of {map} is as gsmap wrote it; nothing to accept")
    for what in found:
        say(f"ACCEPTED: {what}")
    if found:
        say(
            f"SQLite finds the catalog of {map} consistent, but its values may be wrong. From now on gsmap accepts it: "
            "check names, poses and edges, or restore a backup"
        )
