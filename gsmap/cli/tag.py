"""gsmap tag: a state of a map that stays."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.console import AsJson, MapPath, opened, print_rows, say


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
    from gsmap.errors import ConfigError

    if (name is None and delete) or (name is not None and list_all):
        raise ConfigError("name the tag to make or to delete, or give --list alone")
    with opened(map) as m:
        if name is None:
            rows = m.branches("tag")
        elif delete:
            rows = [m.delete_branch(name, "tag")]
            say(f"deleted tag {name}; gsmap prune {map} reclaims what only it named")
        else:
            rows = [m.tag(name)]
            say(f"made tag {name}: open it as {rows[0].map}")
    if name is None or json:
        print_rows("tag", rows, json, "tags")
