"""gsmap edit: a scene's name, date, note, tags and unit."""

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
    metres_per_unit: Annotated[
        str | None,
        typer.Option(
            "--metres-per-unit",
            metavar="X",
            help="One unit of its own frame is so many metres: a measured distance by the same in the capture; "
            "`none` takes it back.",
        ),
    ] = None,
    json: AsJson = False,
) -> None:
    """Change what is said of a scene; what was said before stays in its history.

    Example: `gsmap edit site.gsmap monday --captured-at 2024-05-31 --tag ground-floor`
    """
    from gsmap.errors import ConfigError

    said = (name, captured_at, note, metres_per_unit)
    if all(one is None for one in said) and not tag and not untag:
        raise ConfigError("say what to change: --name, --captured-at, --note, --tag, --untag or --metres-per-unit")
    metres = None if metres_per_unit is None else _metres(metres_per_unit)
    with opened(map) as m:
        row = m.edit(
            scene,
            name=name,
            captured_at=captured_at,
            note=note,
            tags=tag or (),
            untag=untag or (),
            metres_per_unit=metres,
        )
    print_rows("edit", row, json, "scene")


def _metres(text: str) -> float:
    """A positive number; 0 for `none`."""
    from gsmap.errors import ConfigError

    try:
        metres = 0.0 if text.strip().lower() == "none" else float(text)
    except ValueError as error:
        raise ConfigError(f"--metres-per-unit is a number such as 0.3, or none, got {text!r}") from error
    if metres == 0.0 and text.strip().lower() != "none":
        raise ConfigError("--metres-per-unit must be positive; none takes back what was said")
    return metres
