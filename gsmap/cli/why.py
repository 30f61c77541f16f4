"""gsmap why: explain the decision on a pair of scenes."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.console import AsJson, MapPath, Output, opened, print_facts, print_rows, print_table, say

PANEL = "Scenes and edges", 1
OUTPUTS = {"why A:B": Output("pairs.PairExplanation")}


def command(
    map: MapPath,
    pair: Annotated[str, typer.Argument(metavar="A:B", help="Pair of scenes, by names or ids.")],
    pictures: Annotated[
        str | None,
        typer.Option(
            "--pictures", metavar="DIR", help="Also draw both captures from the same cameras into this folder."
        ),
    ] = None,
    json: AsJson = False,
) -> None:
    """Explain why a pair of scenes is, or is not, an edge.

    Example: `gsmap why site.gsmap monday:tuesday --pictures why`
    """
    from gsmap.types.rows.pairs import ExplanationStep

    with opened(map) as m:
        report = m.why(pair, pictures=pictures)
    if json:
        print_rows("why A:B", report, json)
        return
    print_facts(report.pair, {"status": report.status, "reason": report.reason, "advice": report.advice})
    print_table("steps", ExplanationStep.columns, report.steps)
    if report.picture:
        say(f"wrote {report.picture}")
