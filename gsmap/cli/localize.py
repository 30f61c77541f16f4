"""gsmap localize: where photographs were taken, and where scans lie."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from gsmap.cli.console import (
    AsJson,
    Executor,
    MapPath,
    Preset,
    Scheduler,
    Sets,
    opened,
    print_rows,
    print_table,
    progress_bars,
    say,
)

if TYPE_CHECKING:
    from gsmap.types.rows import LocalizeReport


def command(
    map: MapPath,
    files: Annotated[
        list[str] | None,
        typer.Argument(metavar="FILE...", help="Photographs, point clouds, meshes, splats.", show_default=False),
    ] = None,
    intrinsics: Annotated[
        str | None,
        typer.Option("--intrinsics", metavar="FX,FY,CX,CY", help="Of all photos, in pixels of the upright picture."),
    ] = None,
    focal: Annotated[
        str | None,
        typer.Option(
            "--focal",
            metavar="auto|PX",
            help="Focal length in pixels; auto solves for it, whatever the file says. By default the file's (EXIF).",
        ),
    ] = None,
    near: Annotated[
        str | None,
        typer.Option("--near", metavar="SCENE|X,Y,Z,R", help="Look only at what this scene shows, or around a point."),
    ] = None,
    together: Annotated[
        bool,
        typer.Option("--together", help="The photos show one place: whoever is placed helps the others."),
    ] = False,
    video: Annotated[
        str | None, typer.Option("--video", metavar="FILE", help="A clip: its sharpest frames, together.")
    ] = None,
    masks: Annotated[
        str | None,
        typer.Option(
            "--masks", metavar="DIR", help="A mask of each photo, black where people stand: PHOTO.jpg.png, as COLMAP's."
        ),
    ] = None,
    depth: Annotated[
        str | None,
        typer.Option("--depth", metavar="PNG", help="A depth picture of the one photo's view; needs --intrinsics."),
    ] = None,
    depth_scale: Annotated[
        float, typer.Option("--depth-scale", help="Values of the depth picture that make a metre.")
    ] = 1000.0,
    changes: Annotated[
        bool, typer.Option("--changes", help="Say where placed photos show something else than the map.")
    ] = False,
    pictures: Annotated[
        str | None, typer.Option("--pictures", metavar="DIR", help="With --changes: draw these parts, in this folder.")
    ] = None,
    add: Annotated[
        bool,
        typer.Option(
            "--add", help="Keep placed photos: evidence of what stood there, and what merged captures are to look like."
        ),
    ] = False,
    captured_at: Annotated[
        str | None,
        typer.Option("--captured-at", metavar="DATE", help="With --add: when they were taken. By default EXIF's."),
    ] = None,
    sets: Sets = None,
    preset: Preset = None,
    executor: Executor = None,
    scheduler: Scheduler = None,
    json: AsJson = False,
) -> None:
    """Find where photographs were taken and scans lie, or say why not. What scenes are found by is made once, and kept.

    Example: `gsmap localize site.gsmap phone.jpg`
    """
    from gsmap.errors import ConfigError
    from gsmap.map.small_map import is_small
    from gsmap.map.small_map_localization import localize_small
    from gsmap.settings import parse

    if is_small(map):
        if changes or add or pictures is not None or captured_at is not None or depth is not None:
            raise ConfigError(
                "a small map places photographs, and no more: ask the map that it is of", code="not_in_small_map"
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
        say(f"{sum(bool(row.added) for row in report.results)} kept: gsmap list {map} photos")


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
            say(f"{row.file} shows what the map does, as far as it could be compared ({row.compared:.0%} of it)")
        if row.picture is not None:
            say(f"drawn in {row.picture}")
    say(f"{sum(row.status == 'placed' for row in report.results)} of {len(report.results)} placed")
