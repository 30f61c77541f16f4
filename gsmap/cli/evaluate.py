"""gsmap evaluate: compute the errors of edges, poses and renders against ground truth."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.console import AsJson, MapPath, Output, opened, print_facts, print_rows, print_table

PANEL = "View and query", 6
OUTPUTS = {"evaluate": Output("evaluation.EvaluationReport")}


def command(
    map: MapPath,
    truth: Annotated[str, typer.Option("--truth", help="Folder of NAME.json files with `T_scene_world` (4x4).")],
    images: Annotated[
        str | None, typer.Option("--images", help="Folder of NAME_CAMERA.jpg frames to compare renders with.")
    ] = None,
    tiles: Annotated[
        str | None,
        typer.Option(
            "--tiles", metavar="DIR", help="Also compare renders of the tiles in this folder with the images."
        ),
    ] = None,
    lpips: Annotated[
        str | None,
        typer.Option("--lpips", metavar="FILE", help="Also compute LPIPS with this ONNX network."),
    ] = None,
    max_rre: Annotated[
        float | None,
        typer.Option(
            "--max-rre", metavar="DEG", help="Largest rotation error of an edge that counts as correct; default: 1."
        ),
    ] = None,
    max_rte: Annotated[
        float | None,
        typer.Option(
            "--max-rte", metavar="M", help="Largest translation error of an edge that counts as correct; default: 0.05."
        ),
    ] = None,
    truth_sigma: Annotated[
        tuple[float, float] | None,
        typer.Option(
            "--truth-sigma",
            metavar="DEG M",
            help="Standard deviations of the true scene poses, in degrees and metres.",
        ),
    ] = None,
    json: AsJson = False,
) -> None:
    """Compare edges and poses with ground truth, and renders with the images of the captures.

    Example: `gsmap evaluate house.gsmap --truth captures/truth`
    """
    from gsmap.errors import ConfigError

    if images is None and (tiles is not None or lpips is not None):
        option = "--tiles" if tiles is not None else "--lpips"
        raise ConfigError(f"{option} needs --images DIR", code="missing_option")
    with opened(map, bars=images is not None) as m:
        report = m.evaluate(
            truth,
            images=images,
            tiles=tiles,
            lpips=lpips,
            max_rre_deg=max_rre,
            max_rte_m=max_rte,
            truth_sigma=truth_sigma,
        )
    if json:
        print_rows("evaluate", report, json)
        return
    for title, rows in {
        "edges": report.edges,
        "edges by true overlap": report.bands,
        "pairs": report.pairs,
        "components": report.components,
        "covariances": report.nees,
        "images": report.images,
    }.items():
        if rows:
            print_table(title, rows[0].columns, rows)
    print_facts("summary", {heading: getattr(report, name) for name, heading in report.columns.items()})
