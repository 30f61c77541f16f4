"""gsmap ingest: add scenes."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.console import MapPath, progress_bars, say

Paths = Annotated[list[str], typer.Argument(metavar="FILE_OR_FOLDER...", help="Captures: files or folders.")]
CamerasFile = Annotated[str | None, typer.Option("--cameras", help="Cameras of the one capture given.")]
Name = Annotated[str | None, typer.Option("--name", help="Name of the one capture given.")]
CapturedAt = Annotated[str | None, typer.Option("--captured-at", help="When it was captured, ISO 8601.")]
Scale = Annotated[
    str, typer.Option("--scale", help="`known` (metres), `unknown` (any unit) or `auto` (registration finds out).")
]


def command(
    map: MapPath,
    paths: Paths,
    cameras: CamerasFile = None,
    name: Name = None,
    captured_at: CapturedAt = None,
    scale: Scale = "auto",
) -> None:
    """Add scenes: Gaussians with the cameras found beside them. The same content twice is a no-op that says so.

    Example: `gsmap ingest site.gsmap monday.ply tuesday/`
    """
    import gsmap

    with progress_bars() as progress, gsmap.open(map, progress=progress) as m:
        results = m.ingest(*paths, cameras=cameras, name=name, captured_at=captured_at, scale=scale)
    for result in results:
        for note in result.notes:
            say(f"{result.scene.name}: {note}")
        if result.new:
            print(f"{result.scene.name}\t{result.scene.id}\t{result.scene.num_gaussians} Gaussians")
        else:
            print(f"{result.scene.name}\t{result.scene.id}\talready in the map, nothing changed")
