"""gsmap register: register candidate pairs of scenes."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gsmap.cli.console import AsJson, Executor, MapPath, Output, Preset, Scheduler, Sets, opened, print_rows

PANEL = "Map", 5
OUTPUTS = {"register": Output("pairs.EdgeRow", "edges")}


def command(
    map: MapPath,
    pairs: Annotated[
        str,
        typer.Option(
            "--pairs",
            metavar="auto|all|A:B|FILE",
            help="`auto` (candidates), `all`, one pair `A:B`, or a file with one pair per line, `A B` or `A:B`; "
            "pairs given explicitly are registered again.",
        ),
    ] = "auto",
    sets: Sets = None,
    preset: Preset = None,
    executor: Executor = None,
    scheduler: Scheduler = None,
    json: AsJson = False,
) -> None:
    """Register candidate pairs of scenes that have not been registered.

    Example: `gsmap register site.gsmap --pairs monday:tuesday`
    """
    named = pairs in ("auto", "all") or (":" in pairs and not Path(pairs).is_file())
    with opened(map, bars=True, sets=sets, preset=preset, executor=executor, scheduler=scheduler) as m:
        rows = m.register(pairs if named else Path(pairs))
    print_rows("register", rows, json, "edges")
