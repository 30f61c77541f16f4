"""gsmap remove: remove a scene or a photo."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from gsmap.cli.console import AsJson, MapPath, Output, opened, print_rows, say

if TYPE_CHECKING:
    from gsmap.types.rows.map_operations import PurgeReport

PANEL = "Scenes and edges", 10
OUTPUTS = {
    "remove": Output("scenes.SceneRow"),
    "remove --purge": Output("map_operations.PurgeReport"),
    "remove --photo": Output("localize.PhotoRow"),
}


def command(
    map: MapPath,
    scene: Annotated[str, typer.Argument(metavar="SCENE", help="Name or id of the scene.")],
    purge: Annotated[
        bool,
        typer.Option("--purge", help="Delete the scene with all its results and tiles. This cannot be undone."),
    ] = False,
    branches: Annotated[
        bool, typer.Option("--branches", help="With --purge: also purge it from the branches and tags of the map.")
    ] = False,
    photo: Annotated[
        bool,
        typer.Option(
            "--photo", help="Remove a photo kept by `localize --add`; name it by file, number (p3) or digest."
        ),
    ] = False,
    json: AsJson = False,
) -> None:
    """Remove a scene from the map. Older revisions keep it; `gsmap prune` frees the space of unused files.

    With --purge it is deleted everywhere in the map, and the output lists other places that may hold it. If
    interrupted, run the same command again.

    Example: `gsmap remove site.gsmap monday`
    """
    from gsmap.errors import ConfigError

    if branches and not purge:
        raise ConfigError("--branches needs --purge: remove alone does not change branches", code="conflicting_options")
    if photo and (purge or branches):
        raise ConfigError(
            "--photo cannot be combined with --purge or --branches: gsmap prune deletes the files of removed photos",
            code="conflicting_options",
        )
    with opened(map) as m:
        if photo:
            removed = m.remove_photo(scene)
            say(f"removed photo {removed.file}")
            if json:
                print_rows("remove --photo", removed, json)
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
    """Print the steps that remain after a purge, with their commands."""
    for name in report.branches:
        say(f"{name} still has the scene: gsmap remove {map} {report.scene_id} --purge --branches")
    for name in report.backups:
        say(f"the backup {name} may hold the scene")
    for name in report.exports:
        say(f"tiles or pictures were deleted in {name}: export again to replace the tiles")
    for name in report.unreachable:
        say(f"tiles made from the scene may lie in {name}")
    for name in report.mentions:
        say(f"{name} mentions the scene; annotations by people are kept")
    if report.linked_files:
        say("a clone, or a map into which the scene was merged or split, shares the scene's files through hard links")
