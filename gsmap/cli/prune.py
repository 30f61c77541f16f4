"""gsmap prune: reclaim what nothing names."""

from __future__ import annotations

from gsmap.cli.console import MapPath


def command(map: MapPath) -> None:
    """Delete leftovers of interrupted work and arrays of removed scenes that no kept revision names.

    Example: `gsmap prune site.gsmap`
    """
    import gsmap

    with gsmap.open(map) as m:
        freed_bytes = m.prune()
    print(f"freed {freed_bytes / 1e6:.1f} MB")
