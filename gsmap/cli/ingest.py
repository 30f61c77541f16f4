"""gsmap ingest: add scenes."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.console import AsJson, MapPath, opened, print_rows, say

Paths = Annotated[list[str], typer.Argument(metavar="FILE_OR_FOLDER...", help="Captures: files or folders.")]
CamerasFile = Annotated[str | None, typer.Option("--cameras", help="Cameras of the one capture given.")]
Name = Annotated[str | None, typer.Option("--name", help="Name of the one capture given.")]
CapturedAt = Annotated[
    str | None, typer.Option("--captured-at", help="When all of these were captured, ISO 8601; found beside each else.")
]
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
    supersedes: Annotated[
        str | None,
        typer.Option(
            "--supersedes",
            metavar="SCENE",
            help="The one capture given was trained again of this scene's frames: it takes its place.",
        ),
    ] = None,
    json: AsJson = False,
) -> None:
    """Add scenes: Gaussians with the cameras found beside them. The same content twice is a no-op that says so.

    Example: `gsmap ingest site.gsmap monday.ply tuesday/`
    """
    with opened(map, bars=True) as m:
        rows = m.ingest(*paths, cameras=cameras, name=name, captured_at=captured_at, scale=scale, supersedes=supersedes)
    for row in rows:
        for note in row.notes:
            say(f"{row.scene_name}: {note}")
    print_rows("ingest", rows, json)
