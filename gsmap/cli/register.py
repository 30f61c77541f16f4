"""gsmap register: edges for candidate pairs that lack one."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.console import MapPath, progress_bars


def command(
    map: MapPath,
    pairs: Annotated[
        str, typer.Option("--pairs", help="`auto` (candidates), `all`, or one pair as `A:B` (done again).")
    ] = "auto",
) -> None:
    """Register candidate pairs of scenes that lack an edge.

    Example: `gsmap register site.gsmap --pairs monday:tuesday`
    """
    import gsmap

    with progress_bars() as progress, gsmap.open(map, progress=progress) as m:
        edges = m.register(pairs)
        names = {scene.id: scene.name for scene in m.scenes()}
    for edge in edges:
        print(f"{names[edge.target]}:{names[edge.source]}\t{edge.status}\t{edge.reason}")
