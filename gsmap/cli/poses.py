"""gsmap poses: poses for other programs."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.console import AsJson, MapPath, opened, print_rows, say, say_heights


def command(
    map: MapPath,
    out: Annotated[
        str | None,
        typer.Argument(
            metavar="[OUT]", help="The file to write (for colmap a folder); each component its own where several are."
        ),
    ] = None,
    format: Annotated[
        str | None,
        typer.Option(
            "--format",
            help="`tum` (a pose per scene), `g2o` (with edges), `colmap` or `nerfstudio` (a camera each), or `json`; "
            "by default `json`.",
        ),
    ] = None,
    crs: Annotated[
        str | None,
        typer.Option(
            "--crs", metavar="EPSG:N", help="Of the world coordinates shown; by default that of `gsmap georeference`."
        ),
    ] = None,
    json: AsJson = False,
) -> None:
    """Show where the scenes lie, and write it for other programs.

    Example: `gsmap poses site.gsmap site.tum --format tum`
    """
    from gsmap.errors import ConfigError

    if format is not None and out is None:
        raise ConfigError(
            f"name a file to write as {format}: gsmap poses {map} OUT --format {format}", code="missing_option"
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
