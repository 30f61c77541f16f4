"""gsmap reject: rule out an edge or a change by review."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.console import AsJson, MapPath, Output, opened, print_rows, say

PANEL = "Scenes and edges", 3
OUTPUTS = {"reject": Output("pairs.EdgeRow"), "reject CHANGE": Output("changes.ChangeRow")}


def command(
    map: MapPath,
    what: Annotated[
        str, typer.Argument(metavar="A:B|CHANGE", help="Pair of scenes, by names or ids, or a change such as c12.")
    ],
    note: Annotated[str, typer.Option("--note", help="Reason of the review, which the history keeps.")] = "",
    withdraw: Annotated[
        bool,
        typer.Option(
            "--withdraw", help="Withdraw the last review, or, without a review, the measured edge (`gsmap edge`)."
        ),
    ] = False,
    json: AsJson = False,
) -> None:
    """Reject an edge, so that optimize never uses it, or reject a change that is not real.

    Example: `gsmap reject site.gsmap monday:tuesday`
    """
    from gsmap.types.rows.changes import ChangeRow

    with opened(map) as m:
        row = m.reject(what, note=note, withdraw=withdraw)
    is_change = isinstance(row, ChangeRow)
    say("noted" if is_change else f"noted; run: gsmap optimize {map}")
    print_rows("reject CHANGE" if is_change else "reject", row, json)
