"""gsmap evaluate: the field's metrics against ground truth."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.console import AsJson, MapPath, opened, print_facts, print_rows, print_table


def command(
    map: MapPath,
    truth: Annotated[str, typer.Option("--truth", help="Folder of NAME.json files holding `T_scene_world` (4x4).")],
    images: Annotated[
        str | None, typer.Option("--images", help="Folder of NAME_CAMERA.jpg frames to compare renders with.")
    ] = None,
    lpips: Annotated[
        str | None,
        typer.Option("--lpips", metavar="FILE", help="Also compare images by this LPIPS network, an ONNX file."),
    ] = None,
    json: AsJson = False,
) -> None:
    """Compare poses with ground truth (and renders with the captures' own images).

    Example: `gsmap evaluate house.gsmap --truth captures/truth`
    """
    from gsmap.errors import ConfigError

    if lpips is not None and images is None:
        raise ConfigError("--lpips compares images: give --images too")
    with opened(map, bars=images is not None) as m:
        report = m.evaluate(truth, images=images, lpips=lpips)
    if json:
        print_rows("evaluate", report, json)
        return
    if report.edges:
        print_table("edges", report.edges[0].columns, report.edges)
    if report.pairs:
        print_table("pairs", report.pairs[0].columns, report.pairs)
    if report.images:
        print_table("images", report.images[0].columns, report.images)
    print_facts("summary", {heading: getattr(report, name) for name, heading in report.columns.items()})
