"""gsmap describe: compute missing scene graphs."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.console import AsJson, Executor, MapPath, Output, Preset, Scheduler, Sets, opened, print_rows

PANEL = "Map", 4
OUTPUTS = {"describe": Output("scenes.GraphRow", "graphs")}


def command(
    map: MapPath,
    scenes: Annotated[
        list[str] | None, typer.Argument(metavar="[SCENE...]", help="Names or ids of scenes; default: all.")
    ] = None,
    sets: Sets = None,
    preset: Preset = None,
    executor: Executor = None,
    scheduler: Scheduler = None,
    json: AsJson = False,
) -> None:
    """Compute missing scene graphs; for scenes given by name, also replace damaged graphs.

    Example: `gsmap describe site.gsmap`
    """
    with opened(map, bars=True, sets=sets, preset=preset, executor=executor, scheduler=scheduler) as m:
        rows = m.describe(*(scenes or ()))
    print_rows("describe", rows, json, "graphs")
