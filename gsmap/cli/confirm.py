"""gsmap confirm: accept an edge or a change by review."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.console import AsJson, MapPath, Output, opened, print_rows, say

PANEL = "Scenes and edges", 2
OUTPUTS = {"confirm": Output("pairs.EdgeRow"), "confirm CHANGE": Output("changes.ChangeRow")}

What = Annotated[
    str, typer.Argument(metavar="A:B|CHANGE", help="Pair of scenes, by names or ids, or a change such as c12.")
]
Note = Annotated[str, typer.Option("--note", help="Reason of the review, which the history keeps.")]
Withdraw = Annotated[
    bool,
    typer.Option(
        "--withdraw", help="Withdraw the last review, or, without a review, the measured edge (`gsmap edge`)."
    ),
]


def command(map: MapPath, what: What, note: Note = "", withdraw: Withdraw = False, json: AsJson = False) -> None:
    """Confirm an edge, so that optimize uses it even if other edges contradict it, or confirm a change.

    Example: `gsmap confirm site.gsmap monday:tuesday`
    """
    review("confirm", map, what, note, withdraw, json)


def review(verb: str, map: str, what: str, note: str, withdraw: bool, json: bool) -> None:
    """Store a review of an edge or a change, and print its row."""
    from gsmap.types.rows.changes import ChangeRow

    with opened(map) as m:
        row = (m.confirm if verb == "confirm" else m.reject)(what, note=note, withdraw=withdraw)
    is_change = isinstance(row, ChangeRow)
    say("noted" if is_change else f"noted; run: gsmap optimize {map}")
    print_rows(f"{verb} CHANGE" if is_change else verb, row, json)
