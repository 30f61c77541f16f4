"""gsmap init: make an empty map."""

from __future__ import annotations

from gsmap.cli.console import MapPath, say


def command(map: MapPath) -> None:
    """Make an empty map.

    Example: `gsmap init site.gsmap`
    """
    import gsmap.map

    gsmap.map.create(map).close()
    say(f"made an empty map at {map}; next: gsmap update {map} CAPTURES...")
