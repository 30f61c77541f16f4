"""gsmap edit: a scene's name, date, note and tags."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.console import AsJson, MapPath, opened, print_rows


def command(
    map: MapPath,
    scene: Annotated[str, typer.Argument(metavar="SCENE", help="Name or id.")],
    name: Annotated[str | None, typer.Option("--name", help="Call it this.")] = None,
    captured_at: Annotated[
        str | None, typer.Option("--captured-at", help="When it was captured, ISO 8601; `none` takes its date back.")
    ] = None,
    note: Annotated[str | None, typer.Option("--note", help="What people should know of it.")] = None,
    tag: Annotated[list[str] | None, typer.Option("--tag", help="Give it this tag; may be repeated.")] = None,
    untag: Annotated[list[str] | None, typer.Option("--untag", help="Take this tag away; may be repeated.")] = None,
    json: AsJson = False,
) -> None:
    """Change what is said of a scene; what was said before stays in its history.

    Example: `gsmap edit site.gsmap monday --captured-at 2024-05-31 --tag ground-floor`
    """
    from gsmap.errors import ConfigError

    if name is None and captured_at is None and note is None and not tag and not untag:
        raise ConfigError("say what to change: --name, --captured-at, --note, --tag or --untag")
    with opened(map) as m:
        row = m.edit(scene, name=name, captured_at=captured_at, note=note, tags=tag or (), untag=untag or ())
    print_rows("edit", row, json, "scene")
