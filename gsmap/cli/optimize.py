"""gsmap optimize: a new revision of all scene poses."""

from __future__ import annotations

from gsmap.cli.console import MapPath, progress_bars


def command(map: MapPath) -> None:
    """Solve for all scene poses and keep them as a new revision.

    Example: `gsmap optimize site.gsmap`
    """
    import gsmap
    from gsmap.cli.update import print_map

    with progress_bars() as progress, gsmap.open(map, progress=progress) as m:
        m.optimize()
    with gsmap.open(map) as m:
        print_map(m)
