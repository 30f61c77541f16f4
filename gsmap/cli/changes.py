"""gsmap changes: what changed between captures."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.console import (
    AsJson,
    AsOf,
    Executor,
    MapPath,
    Preset,
    Scheduler,
    Sets,
    opened,
    print_rows,
    print_table,
    say,
)


def command(
    map: MapPath,
    pair: Annotated[
        str | None,
        typer.Argument(metavar="[A:B]", help="Only these two captures, by names or ids; compared if need be."),
    ] = None,
    since: Annotated[
        str | None, typer.Option("--since", metavar="DATE", help="Only what captures after this show to have changed.")
    ] = None,
    between: Annotated[
        tuple[str, str] | None,
        typer.Option("--between", metavar="D1 D2", help="Only what captures after D1, up to D2, show to have changed."),
    ] = None,
    as_of: AsOf = None,
    min_confidence: Annotated[
        float, typer.Option("--min-confidence", min=0, max=1, help="Only changes that are at least as sure.")
    ] = 0.0,
    pictures: Annotated[
        str | None, typer.Option("--pictures", metavar="DIR", help="Also draw each change before and after, to here.")
    ] = None,
    sets: Sets = None,
    preset: Preset = None,
    executor: Executor = None,
    scheduler: Scheduler = None,
    json: AsJson = False,
) -> None:
    """Show what changed from each capture to the next; what has not been compared yet is.

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
    say(f"{len(report.changes)} changes in {len(report.pairs)} pairs")
