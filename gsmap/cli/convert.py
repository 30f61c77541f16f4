"""gsmap convert: file to file."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.console import say


def command(
    source: Annotated[str, typer.Argument(metavar="IN", help="A file of Gaussians.")],
    target: Annotated[str, typer.Argument(metavar="OUT", help="The file to write; its suffix names the format.")],
) -> None:
    """Convert a file of Gaussians to another format.

    Example: `gsmap convert scan.ply scan.spz`
    """
    from gsmap import formats

    gaussians = formats.read(source)
    formats.write(target, gaussians)
    say(f"wrote {len(gaussians)} Gaussians to {target}")
