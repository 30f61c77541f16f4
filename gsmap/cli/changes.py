"""gsmap changes: show the differences between captures."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.console import (
    AsJson,
    AsOf,
    Executor,
    MapPath,
    Output,
    Preset,
    Scheduler,
    Sets,
    opened,
    print_rows,
    print_table,
    say,
)
from gsmap.texts import counted

PANEL = "Changes over time", 1
OUTPUTS = {"changes": Output("changes.ChangesReport")}


def command(
    map: MapPath,
    pair: Annotated[
        str | None,
        typer.Argument(metavar="[A:B]", help="Show only this pair of captures, by names or ids."),
    ] = None,
    since: Annotated[
        str | None,
        typer.Option("--since", metavar="DATE", help="Show only changes whose newer capture is after this date."),
    ] = None,
    between: Annotated[
        tuple[str, str] | None,
        typer.Option(
            "--between", metavar="D1 D2", help="Show only changes whose newer capture is after D1 and not after D2."
        ),
    ] = None,
    as_of: AsOf = None,
    min_confidence: Annotated[
        float, typer.Option("--min-confidence", min=0, max=1, help="Show only changes with at least this confidence.")
    ] = 0.0,
    pictures: Annotated[
        str | None,
        typer.Option("--pictures", metavar="DIR", help="Also draw each change, before and after, into this folder."),
    ] = None,
    sets: Sets = None,
    preset: Preset = None,
    executor: Executor = None,
    scheduler: Scheduler = None,
    json: AsJson = False,
) -> None:
    """Show what changed from each capture to the next. Compares missing pairs first.

    Example: `gsmap changes site.gsmap --since 2024-05-31`
    """
    with opened(map, bars=True, sets=sets, preset=preset, executor=executor, scheduler=scheduler) as m:
        report = m.changes(
            pair, since=since, between=between, as_of=as_of, min_confidence=min_confidence, pictures=pictures
        )
    for note in report.notes:
        say(note)
    for one in report.pairs:
        for note in one.notes:
            say(f"{one.pair}: {note}")
    if json:
        print_rows("changes", report, json)
        return
    if report.changes:
        print_table("changes", report.changes[0].columns, report.changes)
    if report.pairs:
        print_table("compared", report.pairs[0].columns, report.pairs)
    say(f"{counted(len(report.changes), 'change')} in {counted(len(report.pairs), 'pair')}")
