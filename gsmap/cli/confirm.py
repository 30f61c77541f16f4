"""gsmap confirm: a person's review of an edge or a change."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.console import AsJson, MapPath, opened, print_rows, say


def command(
    map: MapPath,
    what: Annotated[
        str, typer.Argument(metavar="A:B|CHANGE", help="The pair, by names or ids; or a change, such as c12.")
    ],
    note: Annotated[str, typer.Option("--note", help="Why, for whoever asks later.")] = "",
    withdraw: Annotated[
        bool, typer.Option("--withdraw", help="Take back the last review, or else the pair's own measurement.")
    ] = False,
    json: AsJson = False,
) -> None:
    """Vouch for an edge, so that it is used whatever the votes say; or for a change. Kept in history.

    Example: `gsmap confirm site.gsmap monday:tuesday`
    """
    from gsmap.types.rows import ChangeRow

    with opened(map) as m:
        row = m.confirm(what, note=note, withdraw=withdraw)
    is_change = isinstance(row, ChangeRow)
    say("noted" if is_change else f"noted; run: gsmap optimize {map}")
    print_rows("confirm CHANGE" if is_change else "confirm", row, json)
