"""gsmap clean: remove floaters and other Gaussians that are no surface from a file."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.console import AsJson, Output, print_rows, say

PANEL = "Export", 3
OUTPUTS = {"clean": Output("maps.CleanReport")}


def command(
    source: Annotated[str, typer.Argument(metavar="IN", help="File of Gaussians to read.")],
    target: Annotated[str, typer.Argument(metavar="OUT", help="File to write; its suffix selects the format.")],
    bbox: Annotated[
        tuple[float, float, float, float, float, float] | None,
        typer.Option(
            "--bbox",
            metavar="X0 Y0 Z0 X1 Y1 Z1",
            help="Remove everything outside this box, in the coordinates of the file.",
        ),
    ] = None,
    json: AsJson = False,
) -> None:
    """Remove invalid values, impossible scales, background and floaters from a file; say how many of each.

    Background is a shell far around all surfaces, as trainers put it there for the sky. Floaters are Gaussians that
    overlap no surface, and small groups of them away from every surface.

    Example: `gsmap clean scan.ply cleaned.ply`
    """
    from gsmap import formats
    from gsmap.ingest.clean import clean
    from gsmap.types.rows.maps import CleanReport

    cleaned, about = clean(formats.read(source), bbox, where=source), formats.info(source)
    notes = formats.rewrite(target, cleaned.gaussians, about)
    for note in (f"{target}: {cleaned.note}", *notes):
        say(note)
    report = CleanReport(
        input=source,
        output=target,
        num_gaussians=len(cleaned.gaussians),
        **{f"num_{kind}": count for kind, count in cleaned.removed.items()},
        is_judged=cleaned.is_judged,
    )
    print_rows("clean", report, json)
