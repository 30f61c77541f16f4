"""gsmap evaluate: the field's metrics against ground truth."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.console import AsJson, MapPath, print_json, print_table


def command(
    map: MapPath,
    truth: Annotated[str, typer.Option("--truth", help="Folder of NAME.json files holding `T_scene_world` (4x4).")],
    images: Annotated[
        str | None, typer.Option("--images", help="Folder of NAME_CAMERA.jpg frames to compare renders with.")
    ] = None,
    json: AsJson = False,
) -> None:
    """Compare poses with ground truth (and renders with the captures' own images).

    Example: `gsmap evaluate house.gsmap --truth captures/truth`
    """
    import gsmap

    with gsmap.open(map) as m:
        report = m.evaluate(truth, images=images)
    if json:
        print_json(report)
        return
    for title, rows in report.items():
        if isinstance(rows, list) and rows:
            print_table(title, list(rows[0]), [list(row.values()) for row in rows])
    summary = {k: v for k, v in report.items() if not isinstance(v, list)}
    print_table("summary", ["metric", "value"], list(summary.items()))
