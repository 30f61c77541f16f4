"""gsmap tag: create a read-only state of a map under a name."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.branch import make_or_list
from gsmap.cli.console import AsJson, MapPath, Output

PANEL = "Branches and backups", 2
OUTPUTS = {"tag": Output("map_operations.BranchRow", "tags")}


def command(
    map: MapPath,
    name: Annotated[str | None, typer.Argument(metavar="[NAME]", help="Name of the tag.", show_default=False)] = None,
    delete: Annotated[bool, typer.Option("--delete", help="Delete the tag NAME.")] = False,
    list_all: Annotated[bool, typer.Option("--list", help="List the tags of the map.")] = False,
    json: AsJson = False,
) -> None:
    """Tag the current state of a map. A tag cannot change; open it as MAP@NAME in any command.

    It shares the arrays of the map, which are kept as long as the tag exists. Without NAME, the tags are listed.

    Example: `gsmap tag site.gsmap handover-2024`
    """
    make_or_list("tag", "tags", map, name, delete, list_all, json)
