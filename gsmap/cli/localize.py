"""gsmap localize: estimate the poses of photos and scans in the map."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from gsmap.cli.console import (
    AsJson,
    Executor,
    MapPath,
    Output,
    Preset,
    Scheduler,
    Sets,
    opened,
    print_rows,
    print_table,
    progress_bars,
    say,
)
from gsmap.texts import counted

if TYPE_CHECKING:
    from gsmap.types.rows.localize import LocalizeReport

PANEL = "View and query", 5
OUTPUTS = {"localize": Output("localize.LocalizeReport")}


def command(
    map: MapPath,
    files: Annotated[
        list[str] | None,
        typer.Argument(metavar="FILE...", help="Photos, point clouds, meshes or splats.", show_default=False),
    ] = None,
    intrinsics: Annotated[
        str | None,
        typer.Option(
            "--intrinsics",
            metavar="[MODEL,]FX,FY,CX,CY...",
            help="Intrinsics of all photos, in pixels of the upright image: of a pinhole, or the name and parameters "
            "of a COLMAP camera model.",
        ),
    ] = None,
    focal: Annotated[
        str | None,
        typer.Option(
            "--focal",
            metavar="auto|PX",
            help="Focal length in pixels, or auto to estimate it; default: from EXIF.",
        ),
    ] = None,
    near: Annotated[
        str | None,
        typer.Option("--near", metavar="SCENE|X,Y,Z,R", help="Search only near this scene, or within R of a point."),
    ] = None,
    together: Annotated[
        bool,
        typer.Option(
            "--together",
            help="Localize photos of one place jointly, so that localized photos help with the remaining photos.",
        ),
    ] = False,
    video: Annotated[
        str | None, typer.Option("--video", metavar="FILE", help="Localize the sharpest frames of this video, jointly.")
    ] = None,
    masks: Annotated[
        str | None,
        typer.Option(
            "--masks",
            metavar="DIR",
            help="Folder of masks as in COLMAP: PHOTO.jpg.png, black at pixels to be ignored.",
        ),
    ] = None,
    depth: Annotated[
        str | None,
        typer.Option(
            "--depth",
            metavar="PNG",
            help="Depth image of the same view as the photo (one photo only); needs --intrinsics.",
        ),
    ] = None,
    depth_scale: Annotated[float, typer.Option("--depth-scale", help="Number of depth units per metre.")] = 1000.0,
    changes: Annotated[
        bool, typer.Option("--changes", help="Show where localized photos differ from the map.")
    ] = False,
    pictures: Annotated[
        str | None,
        typer.Option("--pictures", metavar="DIR", help="With --changes: draw the differences into this folder."),
    ] = None,
    add: Annotated[
        bool,
        typer.Option(
            "--add",
            help="Keep localized photos in the map: as object observations, and as reference photos of merged tiles.",
        ),
    ] = False,
    captured_at: Annotated[
        str | None,
        typer.Option("--captured-at", metavar="DATE", help="With --add: date of the photos; default: from EXIF."),
    ] = None,
    sets: Sets = None,
    preset: Preset = None,
    executor: Executor = None,
    scheduler: Scheduler = None,
    json: AsJson = False,
) -> None:
    """Estimate the poses of photos and scans in the map, or reject them with a reason.

    The first run computes an index of the scenes, which the map keeps.

    Example: `gsmap localize site.gsmap phone.jpg`
    """
    from gsmap.errors import ConfigError
    from gsmap.map.small_map.export import is_small
    from gsmap.map.small_map.localize import localize_small
    from gsmap.settings import parse

    if is_small(map):
        if changes or add or pictures is not None or captured_at is not None or depth is not None:
            raise ConfigError(
                "a small map can only localize photos: for --changes, --add and --depth, use the map from which it was "
                "exported",
                code="not_in_small_map",
            )
        with progress_bars() as progress:
            report = localize_small(
                map,
                files or (),
                progress,
                intrinsics=intrinsics,
                focal=focal,
                near=near,
                together=together,
                video=video,
                masks=masks,
                values=dict(parse(one) for one in sets or ()),
                preset=preset,
            )
        _tell(report, json)
        return
    with opened(map, bars=True, sets=sets, preset=preset, executor=executor, scheduler=scheduler) as m:
        report = m.localize(
            *(files or ()),
            intrinsics=intrinsics,
            focal=focal,
            near=near,
            together=together,
            video=video,
            masks=masks,
            depth=depth,
            depth_scale=depth_scale,
            changes=changes,
            pictures=pictures,
            add=add,
            captured_at=captured_at,
        )
    _tell(report, json)
    if add and not json:
        kept = counted(sum(bool(row.added) for row in report.results), "photo")
        say(f"{kept} kept; gsmap list {map} photos lists them")


def _tell(report: LocalizeReport, json: bool) -> None:
    for note in report.notes:
        say(note)
    if json:
        print_rows("localize", report, json)
        return
    print_table("localize", report.results[0].columns, report.results)
    for row in report.results:
        if row.changes:
            print_table(f"{row.file} differs, component {row.component}", row.changes[0].columns, row.changes)
        elif row.changes is not None:
            say(f"{row.file} shows no difference from the map in the compared {row.compared:.0%} of it")
        if row.picture is not None:
            say(f"drawn in {row.picture}")
    say(f"{sum(row.status == 'placed' for row in report.results)} of {len(report.results)} placed")
