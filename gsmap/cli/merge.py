"""gsmap merge: merge another map into a map."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.console import AsJson, MapPath, Output, opened, print_rows, say

PANEL = "Branches and backups", 3
OUTPUTS = {"merge": Output("map_operations.MergeReport")}


def command(
    map: MapPath,
    source: Annotated[str, typer.Argument(metavar="SOURCE", help="Map, branch or tag to merge, which is not changed.")],
    json: AsJson = False,
) -> None:
    """Merge another map into MAP: its scenes, scene graphs, edges, annotations, reviews and revisions.

    Nothing is computed. The next `gsmap update MAP` registers only pairs across the two maps.

    Example: `gsmap merge site.gsmap site.gsmap@what-if`
    """
    with opened(map) as m:
        report = m.merge(source)
    for note in report.notes:
        say(note)
    for old, new in report.renamed.items():
        say(f"scene {old} was renamed to {new}, because {map} has a scene {old}")
    print_rows("merge", report, json, f"from {source}")
