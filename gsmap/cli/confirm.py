"""gsmap confirm: a person's word on an edge."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.console import MapPath, say


def command(
    map: MapPath,
    pair: Annotated[str, typer.Argument(metavar="A:B", help="The pair, by names or ids.")],
    note: Annotated[str, typer.Option("--note", help="Why, for whoever asks later.")] = "",
) -> None:
    """Vouch for an edge, so that it is used whatever the votes say. Kept in history.

    Example: `gsmap confirm site.gsmap monday:tuesday`
    """
    import gsmap

    with gsmap.open(map) as m:
        m.confirm(pair, note=note)
    say(f"noted; run: gsmap optimize {map}")
