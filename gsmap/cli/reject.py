"""gsmap reject: rule out an edge or a change by review."""

from __future__ import annotations

from gsmap.cli.confirm import Note, What, Withdraw, review
from gsmap.cli.console import AsJson, MapPath, Output

PANEL = "Scenes and edges", 3
OUTPUTS = {"reject": Output("pairs.EdgeRow"), "reject CHANGE": Output("changes.ChangeRow")}


def command(map: MapPath, what: What, note: Note = "", withdraw: Withdraw = False, json: AsJson = False) -> None:
    """Reject an edge, so that optimize never uses it, or reject a change that is not real.

    Example: `gsmap reject site.gsmap monday:tuesday`
    """
    review("reject", map, what, note, withdraw, json)
