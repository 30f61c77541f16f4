"""gsmap trust: allow connections to the catalog server of a map."""

from __future__ import annotations

import sys
from typing import Annotated

import typer

from gsmap.cli.console import AsJson, MapPath, Output, print_rows, say
from gsmap.texts import shown

PANEL = "Maintenance", 4
OUTPUTS = {"trust": Output("trust.TrustReport")}


def command(
    map: MapPath,
    yes: Annotated[bool, typer.Option("--yes", help="Trust the server without a prompt.")] = False,
    json: AsJson = False,
) -> None:
    """Show the catalog server of a map, and allow gsmap to connect to that server with your password from now on.

    Example: `gsmap trust site.gsmap`
    """
    import gsmap.map

    report = gsmap.map.catalog_of(map)
    if not json:
        print_rows("trust", report, json, map)
    if not report.trusted:
        if not yes and sys.stdin.isatty():
            question = f"allow connections to {report.server} as {report.user or 'yourself'} from now on?"
            yes = typer.confirm(shown(question), err=True)
        if yes:
            report = gsmap.map.trust(map)
        else:
            say(f"not trusted, and nothing was sent; to trust the server: gsmap trust {map} --yes")
    if json:
        print_rows("trust", report, json)
    if not report.trusted:
        raise typer.Exit(1)
    say(f"{map} is trusted")
