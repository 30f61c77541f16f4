"""gsmap remove: take a scene out of the map."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.console import MapPath, say


def command(map: MapPath, scene: Annotated[str, typer.Argument(metavar="SCENE", help="Name or id.")]) -> None:
    """Take a scene out of the map. Older revisions keep it; `gsmap prune` reclaims bytes nothing names.

    Example: `gsmap remove site.gsmap monday`
    """
    import gsmap

    with gsmap.open(map) as m:
        removed = m.remove(scene)
    say(f"removed {removed.name}; run: gsmap optimize {map}")
