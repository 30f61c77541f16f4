"""gsmap thin: reduce captures that newer captures supersede."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.console import AsJson, MapPath, Output, opened, print_rows, say
from gsmap.errors import ConfigError

PANEL = "Changes over time", 4
OUTPUTS = {"thin": Output("thinning.ThinReport")}
_UNITS = {"": 1, "B": 1} | {
    f"{prefix}{end}": base**power
    for power, prefix in enumerate("KMGT", 1)
    for end, base in (("B", 1000), ("iB", 1024), ("", 1024))
}


def command(
    map: MapPath,
    keep_days: Annotated[
        float | None, typer.Option("--keep-days", help="Do not thin captures of the last N days.")
    ] = None,
    budget: Annotated[
        str | None,
        typer.Option("--budget", help="Stop thinning when all captures together fit into this size, such as 2GiB."),
    ] = None,
    now: Annotated[
        str | None,
        typer.Option(
            "--now",
            metavar="DATE",
            help="Day from which --keep-days counts; default: when the map was last written.",
        ),
    ] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only show what would be thinned.")] = False,
    json: AsJson = False,
) -> None:
    """Drop Gaussians of old captures where newer captures show the same surface. Keeps poses, edges and annotations.

    A thinned capture takes about a sixth of the bytes, and its exports differ by at most 0.1 dB. Its scene graph is
    deleted, with its objects in `gsmap graph`: other scenes are registered with the newer captures instead. To undo
    thinning, ingest the capture again.

    Example: `gsmap thin site.gsmap --keep-days 365 --dry-run`
    """
    size = None if budget is None else parse_size(budget)
    with opened(map) as m:
        report = m.thin(keep_days=keep_days, budget_bytes=size, dry_run=dry_run, now=now)
    if json:
        print_rows("thin", report, json)
        return
    for row in report.scenes:
        if row.thinned:
            verb = "would be thinned" if dry_run else "is thinned"
            say(f"{row.scene_name} {verb}: {row.num_bytes_before / 1e6:.1f} to {row.num_bytes_after / 1e6:.1f} MB")
        else:
            say(f"{row.scene_name} is not thinned: {row.reason}")
    if report.num_undated:
        say(f"{report.num_undated} undated captures are not thinned; gsmap edit MAP SCENE --captured-at DATE sets one")
    print(f"{'captures would take' if dry_run else 'captures take'} {report.num_bytes / 1e6:.1f} MB")
    if not report.fits:
        say(f"this is more than the budget of {budget}, but no other capture can be thinned")


def parse_size(text: str) -> int:
    """Parse a size such as ``500MB``, ``2GiB`` or ``1.5G``; return bytes.

    Raises:
        ConfigError: The text is not a size.
    """
    number = text.strip().rstrip("KMGTiB").strip()
    unit = text.strip()[len(text.strip().rstrip("KMGTiB")) :]
    try:
        return int(float(number) * _UNITS[unit])
    except (ValueError, KeyError, OverflowError) as error:
        raise ConfigError(
            f"a size must be a number and a unit, such as 500MB or 2GiB, got {text!r}", code="invalid_size"
        ) from error
