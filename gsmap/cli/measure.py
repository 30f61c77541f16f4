"""gsmap measure: measure a distance in metres."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.console import AsJson, MapPath, Output, opened, print_rows, print_table, say, say_heights

PANEL = "Scenes and edges", 9
OUTPUTS = {"measure": Output("world.MeasureReport")}
TAKES_POINTS = True
_POINT = "The first point: X,Y,Z in the map; SCENE:X,Y,Z; SCENE:CAMERA@COLUMN,ROW; world:X,Y,Z or EPSG:N:X,Y,Z."


def command(
    map: MapPath,
    a: Annotated[str, typer.Argument(metavar="A", help=_POINT)],
    b: Annotated[str, typer.Argument(metavar="B", help="The second point, in the same forms.")],
    component: Annotated[
        int | None,
        typer.Option(
            "--component", "--island", help="Component of points given in map coordinates, if the map has several."
        ),
    ] = None,
    crs: Annotated[
        str | None,
        typer.Option(
            "--crs", metavar="EPSG:N", help="CRS of the printed world coordinates; default: the CRS of the map."
        ),
    ] = None,
    json: AsJson = False,
) -> None:
    """Measure the distance between two points in metres, with its standard deviation.

    Example: `gsmap measure site.gsmap monday:1.2,0.4,2.0 monday:0007.jpg@812,410`
    """
    from gsmap.types.rows.world import PointRow

    with opened(map) as m:
        report = m.measure(a, b, component=component, crs=crs)
    for note in report.notes:
        say(note)
    if json:
        print_rows("measure", report, json)
        return
    print(f"{report.distance_m:.4f} m +- {report.sigma_m:.2g} m ({report.known_by})")
    print_table("points", PointRow.columns, [report.a, report.b])
    say_heights([report] if report.a.world is not None or report.b.world is not None else [])
