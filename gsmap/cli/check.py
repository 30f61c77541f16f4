"""gsmap check: verify every byte."""

from __future__ import annotations

import typer

from gsmap.cli.console import AsJson, MapPath, opened, print_rows, say, text


def command(map: MapPath, json: AsJson = False) -> None:
    """Read every byte of the map and compare it with what was written. Exit code 1 where anything is wrong.

    Example: `gsmap check site.gsmap`
    """
    with opened(map, bars=True) as m:
        report = m.check()
    if json:
        print_rows("check", report, json)
    else:
        for problem in report.problems:
            print(text(problem))
    if not report.ok:
        count = len(report.problems)
        say(f"{count} problems in {map}: restore the files named from a backup, or ingest their scenes again")
        raise typer.Exit(1)
    say(f"{map} is whole")
