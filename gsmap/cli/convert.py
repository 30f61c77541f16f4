"""gsmap convert: convert one file of Gaussians to another format."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.console import AsJson, Output, print_rows, say

PANEL = "Export", 2
OUTPUTS = {"convert": Output("maps.ConvertReport")}


def command(
    source: Annotated[str, typer.Argument(metavar="IN", help="File of Gaussians to read.")],
    target: Annotated[str, typer.Argument(metavar="OUT", help="File to write; its suffix selects the format.")],
    local: Annotated[
        bool,
        typer.Option(
            "--local",
            help="Subtract an offset from all positions, and print the offset; for formats with single precision.",
        ),
    ] = False,
    json: AsJson = False,
) -> None:
    """Convert a file of Gaussians to another format.

    Example: `gsmap convert scan.ply scan.spz`
    """
    from dataclasses import replace

    import numpy as np

    from gsmap import formats
    from gsmap.formats.precision import rounded_to
    from gsmap.types.rows.maps import ConvertReport

    gaussians, about = formats.read(source), formats.info(source)
    offset = gaussians.origin if local else np.zeros(3)
    notes = formats.rewrite(target, replace(gaussians, origin=np.zeros(3)) if local else gaussians, about)
    for note in (f"wrote {len(gaussians)} Gaussians to {target}", *notes):
        say(note)
    step = rounded_to(gaussians) if gaussians.origin.any() else 0.0
    if step:
        say(f"{source} stores positions in single precision, rounded to {step:g} at this distance from the origin")
    if offset.any():
        say(f"positions in {target} equal those in {source} minus {' '.join(f'{value:.15g}' for value in offset)}")
    if json:
        report = ConvertReport(
            input=source,
            output=target,
            num_gaussians=len(gaussians),
            sh_degree=gaussians.sh_degree,
            offset=offset,
        )
        print_rows("convert", report, json)
