"""gsmap thin: keep captures compact that newer ones supersede."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.console import AsJson, MapPath, opened, print_rows, say
from gsmap.errors import ConfigError

_UNITS = {"": 1, "B": 1} | {
    f"{prefix}{end}": base**power
    for power, prefix in enumerate("KMGT", 1)
    for end, base in (("B", 1000), ("iB", 1024), ("", 1024))
}


def command(
    map: MapPath,
    keep_days: Annotated[
        float | None, typer.Option("--keep-days", help="Captures of the last N days stay as they are.")
    ] = None,
    budget: Annotated[
        str | None, typer.Option("--budget", help="Thin only until the captures fit into this, such as 2GiB.")
    ] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Change nothing: only say what would be thinned.")] = False,
    json: AsJson = False,
) -> None:
    """Keep old captures compact where newer ones looked at all they show; poses, edges and words stay.

    A thinned capture is exported, also as of its date, as before to within 0.1 dB, in about a sixth of the bytes. Its
    graph goes, and with it its things in `gsmap graph`: the newer captures stand for it when others are registered.
    This cannot be undone but by ingesting the capture again.

    Example: `gsmap thin site.gsmap --keep-days 365 --dry-run`
    """
    size = None if budget is None else parse_size(budget)
    with opened(map) as m:
        report = m.thin(keep_days=keep_days, budget_bytes=size, dry_run=dry_run)
    if json:
        print_rows("thin", report, json)
        return
    for row in report.scenes:
        if row.thinned:
            verb = "would be thinned" if dry_run else "is thinned"
            say(f"{row.scene_name} {verb}: {row.num_bytes_before / 1e6:.1f} to {row.num_bytes_after / 1e6:.1f} MB")
        else:
            say(f"{row.scene_name} stays as it is: {row.reason}")
    if report.num_undated:
        say(f"{report.num_undated} captures have no date and stay: gsmap edit MAP SCENE --captured-at DATE gives one")
    print(f"{'would hold' if dry_run else 'holds'} {report.num_bytes / 1e6:.1f} MB")
    if not report.fits:
        say(f"that is more than {budget}: nothing else is old, superseded and dated")


def parse_size(text: str) -> int:
    """Bytes of a size such as ``500MB``, ``2GiB`` or ``1.5G``.

    Raises:
        ConfigError: it is none.
    """
    number = text.strip().rstrip("KMGTiB").strip()
    unit = text.strip()[len(text.strip().rstrip("KMGTiB")) :]
    try:
        return int(float(number) * _UNITS[unit])
    except (ValueError, KeyError, OverflowError) as error:
        raise ConfigError(
            f"a size is a number and a unit, such as 500MB or 2GiB, got {text!r}", code="invalid_size"
        ) from error
