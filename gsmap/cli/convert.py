"""gsmap convert: file to file."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.console import AsJson, print_rows, say


def command(
    source: Annotated[str, typer.Argument(metavar="IN", help="A file of Gaussians.")],
    target: Annotated[str, typer.Argument(metavar="OUT", help="The file to write; its suffix names the format.")],
    json: AsJson = False,
) -> None:
    """Convert a file of Gaussians to another format.

    Example: `gsmap convert scan.ply scan.spz`
    """
    from gsmap import formats
    from gsmap.types.rows import ConvertReport

    gaussians = formats.read(source)
    formats.write(target, gaussians)
    say(f"wrote {len(gaussians)} Gaussians to {target}")
    if json:
        report = ConvertReport(input=source, output=target, num_gaussians=len(gaussians), sh_degree=gaussians.sh_degree)
        print_rows("convert", report, json)
