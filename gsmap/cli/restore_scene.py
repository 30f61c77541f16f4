"""gsmap restore-scene: a removed scene lives again."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.console import AsJson, MapPath, opened, print_rows, say


def command(
    map: MapPath,
    scene: Annotated[str, typer.Argument(metavar="SCENE", help="Last name, id, or the beginning of an id.")],
    source: Annotated[
        str | None,
        typer.Option("--from", metavar="OTHERMAP", help="Take it from this map, branch, tag or restored backup."),
    ] = None,
    json: AsJson = False,
) -> None:
    """Bring back a removed scene whose arrays are still there, or take a scene of another map.

    It comes with its graphs, its edges to scenes that are here, and what people said of it. With --from, arrays of it
    that are here and damaged are mended.

    Example: `gsmap restore-scene site.gsmap monday`
    """
    with opened(map) as m:
        row = m.restore_scene(scene, source)
    say(f"{row.name} is here and whole; run: gsmap update {map}")
    print_rows("restore-scene", row, json, "scene")
