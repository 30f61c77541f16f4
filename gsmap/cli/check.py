"""gsmap check: verify every byte."""

from __future__ import annotations

import typer

from gsmap.cli.console import AsJson, MapPath, print_json, progress_bars, say


def command(map: MapPath, json: AsJson = False) -> None:
    """Read every byte of the map and compare it with what was written. Exit code 1 where anything is wrong.

    Example: `gsmap check site.gsmap`
    """
    import gsmap

    with progress_bars() as progress, gsmap.open(map, progress=progress) as m:
        problems = m.check()
    if json:
        print_json(problems)
    else:
        for problem in problems:
            print(problem)
    if problems:
        say(f"{len(problems)} problems in {map}: restore the files named from a backup, or ingest their scenes again")
        raise typer.Exit(1)
    say(f"{map} is whole")
