"""gsmap reject: a person's review of an edge."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.console import AsJson, MapPath, opened, print_rows, say


def command(
    map: MapPath,
    pair: Annotated[str, typer.Argument(metavar="A:B", help="The pair, by names or ids.")],
    note: Annotated[str, typer.Option("--note", help="Why, for whoever asks later.")] = "",
    withdraw: Annotated[
        bool, typer.Option("--withdraw", help="Take back the last review of the pair, or else its own measurement.")
    ] = False,
    json: AsJson = False,
) -> None:
    """Rule out an edge, so that it is never used. Kept in history.

    Example: `gsmap reject site.gsmap monday:tuesday`
    """
    with opened(map) as m:
        row = m.reject(pair, note=note, withdraw=withdraw)
    say(f"noted; run: gsmap optimize {map}")
    print_rows("reject", row, json)
