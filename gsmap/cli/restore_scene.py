"""gsmap restore-scene: restore a removed scene."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.console import AsJson, MapPath, Output, opened, print_rows, say

PANEL = "Scenes and edges", 11
OUTPUTS = {"restore-scene": Output("scenes.SceneRow")}


def command(
    map: MapPath,
    scene: Annotated[
        str, typer.Argument(metavar="SCENE", help="Last name of the scene, its id, or the start of its id.")
    ],
    source: Annotated[
        str | None,
        typer.Option(
            "--from", metavar="OTHERMAP", help="Copy the scene from this map, branch, tag or restored backup."
        ),
    ] = None,
    json: AsJson = False,
) -> None:
    """Restore a removed scene whose arrays still exist, or copy a scene from another map.

    The scene comes with its scene graphs, its annotations and its edges to scenes of MAP. With --from, damaged arrays
    of the scene in MAP are repaired.

    Example: `gsmap restore-scene site.gsmap monday`
    """
    with opened(map) as m:
        row = m.restore_scene(scene, source)
    say(f"{row.name} is restored; run: gsmap update {map}")
    print_rows("restore-scene", row, json, "scene")
