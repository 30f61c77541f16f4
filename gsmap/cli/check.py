"""gsmap check: verify every byte."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.console import AsJson, MapPath, opened, print_rows, say
from gsmap.texts import shown


def command(
    map: MapPath,
    accept_catalog: Annotated[
        bool,
        typer.Option("--accept-catalog", help="First take a catalog that differs from what gsmap wrote as it is."),
    ] = False,
    json: AsJson = False,
) -> None:
    """Read every byte of the map and compare it with what was written. Exit code 1 where anything is wrong.

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
        again = "restore files from a backup, or ingest (of graphs: describe) their scenes again"
        say(f"{count} problems in {map}: {again}")
        raise typer.Exit(1)
    say(f"nothing wrong was found in {map}" if report.unverified else f"{map} is whole")


def _accept(map: str) -> None:
    import gsmap.map

    found = gsmap.map.accept_catalog(map)
    if not found:
        say(f"the catalog of {map} is as gsmap wrote it: there was nothing to accept")
    for what in found:
        say(f"ACCEPTED: {what}")
    if found:
        say(
            f"SQLite finds the catalog of {map} sound, but nobody knows whether what it says there is true. "
            "From now on it counts as written: compare names, poses and edges with what you know, or restore a backup"
        )
