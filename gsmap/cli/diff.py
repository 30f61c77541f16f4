"""gsmap diff: what moved between two revisions."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.console import AsJson, MapPath, print_json, print_table


def command(
    map: MapPath,
    before: Annotated[int, typer.Argument(metavar="R1", help="Number of the older revision.")],
    after: Annotated[int, typer.Argument(metavar="R2", help="Number of the newer revision.")],
    json: AsJson = False,
) -> None:
    """Show which scenes moved between two revisions, and by how much (translation at each scene's centroid).

    Example: `gsmap diff site.gsmap 1 2`
    """
    import gsmap

    with gsmap.open(map) as m:
        rows = m.diff(before, after)
    if json:
        print_json(rows)
        return
    columns = ["scene", "change", "rotation_deg", "translation_m", "log_scale"]
    print_table(f"revision {before} to {after}", columns, [[row[c] for c in columns] for row in rows])
