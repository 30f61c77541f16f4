"""gsmap migrate: bring an older map up to date."""

from __future__ import annotations

from gsmap.cli.console import MapPath, say


def command(map: MapPath) -> None:
    """Upgrade a map made by an older gsmap to this version's schema.

    Example: `gsmap migrate site.gsmap`
    """
    import gsmap.map

    before, after = gsmap.map.migrate(map)
    say(f"{map} is at schema {after}" + ("" if before == after else f" (was {before or 'empty'})"))
