"""gsmap find: search for objects in all captures."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.console import AsJson, MapPath, Output, Preset, Sets, opened, print_rows, print_table, say
from gsmap.errors import ConfigError

PANEL = "View and query", 4
OUTPUTS = {"find": Output("find.FindReport")}


def command(
    map: MapPath,
    text: Annotated[
        str | None,
        typer.Argument(metavar="[TEXT]", help="Name or label of an object, or a description for `clip-text`."),
    ] = None,
    picture: Annotated[
        str | None, typer.Option("--picture", metavar="FILE", help="Search for the object in this picture.")
    ] = None,
    like: Annotated[
        str | None,
        typer.Option(
            "--like",
            metavar="SCENE:NODE",
            help="Search for objects like this node of a scene (`show --picture`) or object (`graph`).",
        ),
    ] = None,
    at: Annotated[
        str | None,
        typer.Option("--at", metavar="X,Y,Z", help="Search for objects like the one at this point of the map."),
    ] = None,
    top: Annotated[int, typer.Option("--top", help="Maximum number of hits.")] = 10,
    pictures: Annotated[
        str | None, typer.Option("--pictures", metavar="DIR", help="Draw each hit into this folder.")
    ] = None,
    sets: Sets = None,
    preset: Preset = None,
    json: AsJson = False,
) -> None:
    """Find objects in all captures by name, description, picture, example or point. Each hit has a place and dates.

    Example: `gsmap find site.gsmap --like monday:12 --pictures found`
    """
    from gsmap.types.rows.find import FindHit

    with opened(map, bars=True, sets=sets, preset=preset) as m:
        report = m.find(text, picture=picture, like=like, at=_point(at), top=top, pictures=pictures)
    for note in report.notes:
        say(note)
    if json:
        print_rows("find", report, json)
        return
    known = f"{report.described} of {report.placed} captures"
    by = "name" if report.by == "name" else f"{report.by} of objects, embedder {report.embedder}"
    say(f"{report.query}: by {by}, {known}")
    columns = dict(FindHit.columns)
    if pictures is None:
        del columns["picture"]
    print_table("hits", columns, report.hits)


def _point(text: str | None) -> list[float] | None:
    try:
        return None if text is None else [float(part) for part in text.split(",")]
    except ValueError as error:
        raise ConfigError(f"--at needs three numbers such as 1.5,0,2, got {text!r}", code="invalid_point") from error
