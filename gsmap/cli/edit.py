"""gsmap edit: a scene's name, date, note, tags and unit; an object's name, label and note."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.console import AsJson, MapPath, opened, print_rows


def command(
    map: MapPath,
    scene: Annotated[str, typer.Argument(metavar="SCENE|OBJECT", help="A scene's name or id, or an object (`o12`).")],
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
    label: Annotated[
        str | None, typer.Option("--label", help="Of an object: what kind of thing it is; `none` takes it back.")
    ] = None,
    same_as: Annotated[
        str | None,
        typer.Option("--same-as", metavar="OBJECT", help="Of an object: it is one with this one; `none`: it is not."),
    ] = None,
    author: Annotated[str, typer.Option("--author", metavar="NAME", help="Who says so; kept in its history.")] = "",
    json: AsJson = False,
) -> None:
    """Change what is said of a scene, or of an object (`gsmap graph`); what was said before stays in its history.

    Example: `gsmap edit site.gsmap monday --captured-at 2024-05-31 --tag ground-floor`, or
    `gsmap edit site.gsmap o12 --name "grandmother's sofa" --label sofa`
    """
    from gsmap.errors import ConfigError

    of_scene = captured_at is not None or metres_per_unit is not None or bool(tag) or bool(untag)
    of_object = label is not None or same_as is not None
    if name is None and note is None and not of_scene and not of_object:
        raise ConfigError(
            "say what to change: --name, --note, of a scene --captured-at, --tag, --untag or --metres-per-unit, of an "
            "object --label or --same-as",
            code="nothing_requested",
        )
    metres = None if metres_per_unit is None else _metres(metres_per_unit)
    with opened(map, bars=True) as m:
        if m.is_object(scene) or of_object:
            if of_scene:
                raise ConfigError(
                    f"{scene} is an object: dates, tags and metres are of scenes", code="option_not_applicable"
                )
            done = m.edit_object(scene, name=name, label=label, note=note, same_as=same_as, author=author)
            print_rows("edit OBJECT", done, json, "object")
            return
        row = m.edit(
            scene,
            name=name,
            captured_at=captured_at,
            note=note,
            tags=tag or (),
            untag=untag or (),
            metres_per_unit=metres,
            author=author,
        )
    print_rows("edit", row, json, "scene")


def _metres(text: str) -> float:
    """A positive number; 0 for `none`."""
    from gsmap.errors import ConfigError

    try:
        metres = 0.0 if text.strip().lower() == "none" else float(text)
    except ValueError as error:
        raise ConfigError(
            f"--metres-per-unit is a number such as 0.3, or none, got {text!r}", code="invalid_metre"
        ) from error
    if metres == 0.0 and text.strip().lower() != "none":
        raise ConfigError("--metres-per-unit must be positive; none takes back what was said", code="invalid_metre")
    return metres
