"""gsmap branch: create a second catalog that shares the arrays of a map."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal

import typer

from gsmap.cli.console import AsJson, MapPath, Output, opened, print_rows, say

if TYPE_CHECKING:
    from gsmap.types.rows.map_operations import BranchRow

PANEL = "Branches and backups", 1
OUTPUTS = {"branch": Output("map_operations.BranchRow", "branches")}


def command(
    map: MapPath,
    name: Annotated[
        str | None, typer.Argument(metavar="[NAME]", help="Name of the branch.", show_default=False)
    ] = None,
    delete: Annotated[bool, typer.Option("--delete", help="Delete the branch NAME.")] = False,
    list_all: Annotated[bool, typer.Option("--list", help="List the branches of the map.")] = False,
    json: AsJson = False,
) -> None:
    """Create a branch of a map: a second catalog that shares the arrays. Open it as MAP@NAME in any command.

    Changes to a branch do not affect the map; `gsmap merge MAP MAP@NAME` merges them into it. Without NAME, the
    branches are listed.

    Example: `gsmap branch site.gsmap what-if`
    """
    make_or_list("branch", "branches", map, name, delete, list_all, json)


def make_or_list(
    kind: Literal["branch", "tag"], title: str, map: str, name: str | None, delete: bool, list_all: bool, json: bool
) -> None:
    """Create, list or delete branches or tags; ``title`` heads the table."""
    from gsmap.errors import ConfigError

    if (name is None and delete) or (name is not None and list_all):
        raise ConfigError(f"pass the NAME of the {kind} to create or delete, or --list alone", code="nothing_requested")
    with opened(map) as m:
        if name is None:
            rows: list[BranchRow] = m.branches(kind)
        elif delete:
            rows = [m.delete_branch(name, kind)]
            say(f"deleted {kind} {name}; run gsmap prune {map} to free the space of its results")
        else:
            rows = [m.tag(name) if kind == "tag" else m.branch(name)]
            say(f"created {kind} {name}; open it as {rows[0].map}")
    if name is None or json:
        print_rows(kind, rows, json, title)
