"""gsmap describe: scene graphs for what lacks one."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.console import MapPath, progress_bars


def command(
    map: MapPath,
    scenes: Annotated[
        list[str] | None, typer.Argument(metavar="[SCENE...]", help="Names or ids; all where none is given.")
    ] = None,
) -> None:
    """Make the scene graph of every scene that lacks one.

    Example: `gsmap describe site.gsmap`
    """
    import gsmap

    with progress_bars() as progress, gsmap.open(map, progress=progress) as m:
        graphs = m.describe(*(scenes or ()))
        names = {scene.id: scene.name for scene in m.scenes()}
    for graph in graphs:
        layers = ", ".join(f"{len(layer)} {name}" for name, layer in graph.layers.items()) or "no nodes"
        print(f"{names[graph.scene_id]}\t{layers}")
        for note in graph.notes:
            print(f"{names[graph.scene_id]}\tnote: {note}")
