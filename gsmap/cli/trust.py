"""gsmap trust: allow a map to connect to the server that it names."""

from __future__ import annotations

import sys
from typing import Annotated

import typer

from gsmap.cli.console import AsJson, MapPath, print_rows, say
from gsmap.texts import shown


def command(
    map: MapPath,
    yes: Annotated[bool, typer.Option("--yes", help="Trust it without asking.")] = False,
    json: AsJson = False,
) -> None:
    """Show which server a map keeps its catalog on, and trust it: from then on it is connected to, with your password.

    Example: `gsmap trust site.gsmap`
    """
    import gsmap.map

    report = gsmap.map.catalog_of(map)
    if not json:
        print_rows("trust", report, json, map)
    if not report.trusted:
        if not yes and sys.stdin.isatty():
            question = f"connect to {report.server} as {report.user or 'yourself'}, from now on?"
            yes = typer.confirm(shown(question), err=True)
        if yes:
            report = gsmap.map.trust(map)
        else:
            say(f"nothing was sent; gsmap trust {map} --yes trusts it")
    if json:
        print_rows("trust", report, json)
    if not report.trusted:
        raise typer.Exit(1)
    say(f"{map} is trusted")
