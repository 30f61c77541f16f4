"""gsmap migrate: upgrade a map to the current schema."""

from __future__ import annotations

from gsmap.cli.console import AsJson, MapPath, Output, print_rows, say

PANEL = "Maintenance", 3
OUTPUTS = {"migrate": Output("maps.MigrateReport")}


def command(map: MapPath, json: AsJson = False) -> None:
    """Upgrade a map of an older gsmap to the schema of this version.

    Example: `gsmap migrate site.gsmap`
    """
    import gsmap.map
    from gsmap.types.rows.maps import MigrateReport

    before, after = gsmap.map.migrate(map)
    say(f"{map} is at schema {after}" + ("" if before == after else f" (was {before or 'empty'})"))
    if json:
        print_rows("migrate", MigrateReport(map=map, before=before, after=after), json)
