"""gsmap remove: take a scene out of the map."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.console import AsJson, MapPath, opened, print_rows, say


def command(
    map: MapPath,
    scene: Annotated[str, typer.Argument(metavar="SCENE", help="Name or id.")],
    json: AsJson = False,
) -> None:
    """Take a scene out of the map. Older revisions keep it; `gsmap prune` reclaims bytes nothing names.

    Example: `gsmap remove site.gsmap monday`
    """
    with opened(map) as m:
        row = m.remove(scene)
    say(f"removed {row.name}; run: gsmap optimize {map}")
    if json:
        print_rows("remove", row, json)
