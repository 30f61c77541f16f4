"""gsmap settings: show and change settings."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.console import AsJson, MapPath, Output, opened, print_rows, say

PANEL = "Map", 10
OUTPUTS = {"settings": Output("maps.SettingRow", "settings")}


def command(
    map: MapPath,
    sets: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="A.B=VALUE", help="Change a setting of this map permanently; may be repeated."),
    ] = None,
    preset: Annotated[
        str | None, typer.Option("--preset", help="Preset of this map from now on: `default` or `paper`.")
    ] = None,
    unset: Annotated[
        list[str] | None,
        typer.Option("--unset", metavar="A.B", help="Reset a setting to its default; may be repeated."),
    ] = None,
    json: AsJson = False,
) -> None:
    """Show the settings of a map, or change some in its `settings.toml`. Affected results become stale.

    Example: `gsmap settings site.gsmap --set register.verdict.max_log_nfa=-6`
    """
    from gsmap.settings import parse

    values = dict(parse(one) for one in sets or ())
    changes = bool(values or unset or preset is not None)
    with opened(map) as m:
        if changes:
            m.change_settings(values, preset=preset, unset=unset or ())
        rows = m.setting_rows()
    if changes:
        say(f"noted; run: gsmap update {map}")
    differing = [row for row in rows if row.to_json()["value"] != row.to_json()["default"]]
    print_rows("settings", rows if json or not changes else differing, json)
