"""gsmap remove: take a scene out of the map."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from gsmap.cli.console import AsJson, MapPath, opened, print_rows, say

if TYPE_CHECKING:
    from gsmap.types.rows import PurgeReport


def command(
    map: MapPath,
    scene: Annotated[str, typer.Argument(metavar="SCENE", help="Name or id.")],
    purge: Annotated[
        bool,
        typer.Option("--purge", help="Forget it for good: rows, arrays, tiles made with it. There is no way back."),
    ] = False,
    branches: Annotated[
        bool, typer.Option("--branches", help="With --purge: from the branches and tags of the map, too.")
    ] = False,
    photo: Annotated[
        bool, typer.Option("--photo", help="It names a photograph that is kept: by file, number (p3) or digest.")
    ] = False,
    json: AsJson = False,
) -> None:
    """Take a scene out of the map. Older revisions keep it; `gsmap prune` reclaims bytes nothing names.

    With --purge nothing keeps it, and the receipt says where else it may live. Interrupted, the same command goes on.

    Example: `gsmap remove site.gsmap monday`
    """
    from gsmap.errors import ConfigError

    if branches and not purge:
        raise ConfigError(
            "--branches goes with --purge: without it a branch keeps its own scenes", code="conflicting_options"
        )
    if photo and (purge or branches):
        raise ConfigError(
            "--photo goes alone: gsmap prune reclaims the picture of one that was taken back",
            code="conflicting_options",
        )
    with opened(map) as m:
        if photo:
            taken_back = m.remove_photo(scene)
            say(f"removed photo {taken_back.file}")
            if json:
                print_rows("remove --photo", taken_back, json)
            return
        if purge:
            report = m.purge(scene, branches=branches)
            _tell(report, map)
            print_rows("remove --purge", report, json, "purged")
            return
        row = m.remove(scene)
    say(f"removed {row.name}; run: gsmap optimize {map}")
    if json:
        print_rows("remove", row, json)


def _tell(report: PurgeReport, map: str) -> None:
    """Print the remaining steps and their commands."""
    for name in report.branches:
        say(f"{name} still has it: gsmap remove {map} {report.scene_id} --purge --branches")
    for name in report.backups:
        say(f"the backup {name} may hold it")
    for name in report.exports:
        say(f"tiles or pictures were deleted in {name}: export again to fill the places of tiles")
    for name in report.unreachable:
        say(f"tiles made with it may lie in {name}")
    for name in report.mentions:
        say(f"{name} mentions it: people wrote that, so it stays")
    if report.linked_files:
        say("its files have other names on this disk: a map that it was merged or split into, or a clone, has it")
