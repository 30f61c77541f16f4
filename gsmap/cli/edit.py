"""gsmap edit: change the name, date, note, tags and unit of a scene, or the name, label and note of an object."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.console import AsJson, MapPath, Output, opened, print_rows

PANEL = "Scenes and edges", 6
OUTPUTS = {"edit": Output("scenes.SceneRow"), "edit OBJECT": Output("objects.ObjectRow")}


def command(
    map: MapPath,
    scene: Annotated[str, typer.Argument(metavar="SCENE|OBJECT", help="Name or id of a scene, or an object (`o12`).")],
    name: Annotated[str | None, typer.Option("--name", help="New name.")] = None,
    captured_at: Annotated[
        str | None, typer.Option("--captured-at", help="Date of the capture, ISO 8601; `none` removes it.")
    ] = None,
    note: Annotated[str | None, typer.Option("--note", help="Free text about the scene or object.")] = None,
    tag: Annotated[list[str] | None, typer.Option("--tag", help="Add this tag to the scene; may be repeated.")] = None,
    untag: Annotated[
        list[str] | None, typer.Option("--untag", help="Remove this tag from the scene; may be repeated.")
    ] = None,
    metres_per_unit: Annotated[
        str | None,
        typer.Option(
            "--metres-per-unit",
            metavar="X",
            help="Metres per unit of the scene frame: a measured distance divided by the same distance in the "
            "capture; `none` removes it.",
        ),
    ] = None,
    label: Annotated[
        str | None, typer.Option("--label", help="Kind of the object, such as sofa; `none` removes it.")
    ] = None,
    same_as: Annotated[
        str | None,
        typer.Option(
            "--same-as",
            metavar="OBJECT",
            help="Mark the object as the same as this object; `none` separates them again.",
        ),
    ] = None,
    author: Annotated[
        str, typer.Option("--author", metavar="NAME", help="Author of the edit, which the history keeps.")
    ] = "",
    json: AsJson = False,
) -> None:
    """Edit the annotations of a scene or of an object (`gsmap graph`). The history keeps the previous values.

    Example: `gsmap edit site.gsmap monday --captured-at 2024-05-31 --tag ground-floor`, or
    `gsmap edit site.gsmap o12 --name "grandmother's sofa" --label sofa`
    """
    from gsmap.errors import ConfigError

    of_scene = captured_at is not None or metres_per_unit is not None or bool(tag) or bool(untag)
    of_object = label is not None or same_as is not None
    if name is None and note is None and not of_scene and not of_object:
        raise ConfigError(
            "nothing to change: pass --name or --note; for a scene --captured-at, --tag, --untag or --metres-per-unit; "
            "for an object --label or --same-as",
            code="nothing_requested",
        )
    metres = None if metres_per_unit is None else _metres(metres_per_unit)
    with opened(map, bars=True) as m:
        if m.is_object(scene) or of_object:
            if of_scene:
                raise ConfigError(
                    f"{scene} is an object: only scenes have dates, tags and a metric scale",
                    code="option_not_applicable",
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
    """Parse a positive number; return 0 for `none`."""
    from gsmap.errors import ConfigError

    try:
        metres = 0.0 if text.strip().lower() == "none" else float(text)
    except ValueError as error:
        raise ConfigError(
            f"--metres-per-unit takes a number such as 0.3, or none, got {text!r}", code="invalid_metre"
        ) from error
    if metres == 0.0 and text.strip().lower() != "none":
        raise ConfigError("--metres-per-unit must be positive, or none to remove it", code="invalid_metre")
    return metres
