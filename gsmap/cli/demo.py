"""gsmap demo: the whole job on small captures it makes itself."""

from __future__ import annotations

from typing import Annotated

import typer


def command(
    folder: Annotated[
        str, typer.Argument(metavar="[DIR]", help="Where to work; made if it is missing.")
    ] = "gsmap-demo",
    seed: Annotated[int, typer.Option("--seed", help="Another flat, other walks through it.")] = 0,
) -> None:
    """Make three small captures of a furnished flat, map them, and show how close the map comes to the truth.

    Example: `gsmap demo`
    """
    raise NotImplementedError
