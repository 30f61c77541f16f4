"""gsmap poses: print scene poses, or write them in formats of other programs."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.console import AsJson, MapPath, Output, opened, print_rows, say, say_heights

PANEL = "Scenes and edges", 7
OUTPUTS = {"poses": Output("scenes.PoseRow", "poses")}


def command(
    map: MapPath,
    out: Annotated[
        str | None,
        typer.Argument(
            metavar="[OUT]",
            help="File to write (for colmap, a folder); a map with several components gets one file for each.",
        ),
    ] = None,
    format: Annotated[
        str | None,
        typer.Option(
            "--format",
            help="`tum` (scene poses), `g2o` (scene poses and edges), `colmap` or `nerfstudio` (camera poses), "
            "or `json`; default: json.",
        ),
    ] = None,
    crs: Annotated[
        str | None,
        typer.Option(
            "--crs",
            metavar="EPSG:N",
            help="CRS of the world coordinates; default: the CRS given to `gsmap georeference`.",
        ),
    ] = None,
    json: AsJson = False,
) -> None:
    """Show the poses of the scenes, or write them to a file for other programs.

    Example: `gsmap poses site.gsmap site.tum --format tum`
    """
    from gsmap.errors import ConfigError

    if format is not None and out is None:
        raise ConfigError(
            f"--format needs a file to write: gsmap poses {map} OUT --format {format}", code="missing_option"
        )
    with opened(map) as m:
        rows = m.pose_rows(crs)
        if out is not None:
            for path in m.write_poses(out, format or "json", crs):
                say(f"wrote {path}")
    if json or out is None:
        print_rows("poses", rows, json)
    if not json:
        say_heights(rows)
