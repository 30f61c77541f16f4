"""gsmap tag: a state of a map that stays."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.branch import make_or_list
from gsmap.cli.console import AsJson, MapPath


def command(
    map: MapPath,
    name: Annotated[str | None, typer.Argument(metavar="[NAME]", help="What to call it.", show_default=False)] = None,
    delete: Annotated[bool, typer.Option("--delete", help="Delete the tag NAME.")] = False,
    list_all: Annotated[bool, typer.Option("--list", help="List the tags of the map.")] = False,
    json: AsJson = False,
) -> None:
    """Tag a map: its state as of now, which cannot change any more, opened as MAP@NAME wherever a map is given.

    It shares the arrays of the map, which keep as long as the tag does. Without NAME the tags are listed.

    Example: `gsmap tag site.gsmap handover-2024`
    """
    make_or_list("tag", "tags", map, name, delete, list_all, json)
