"""gsmap migrate: bring an older map up to date."""

from __future__ import annotations

from gsmap.cli.console import AsJson, MapPath, print_rows, say


def command(map: MapPath, json: AsJson = False) -> None:
    """Upgrade a map made by an older gsmap to this version's schema.

    Example: `gsmap migrate site.gsmap`
    """
    import gsmap.map
    from gsmap.types.rows import MigrateReport

    before, after = gsmap.map.migrate(map)
    say(f"{map} is at schema {after}" + ("" if before == after else f" (was {before or 'empty'})"))
    if json:
        print_rows("migrate", MigrateReport(map=map, before=before, after=after), json)
