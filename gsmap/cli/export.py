"""gsmap export: write tiles of the merged map."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from gsmap.cli.console import (
    AsJson,
    AsOf,
    Executor,
    MapPath,
    Output,
    Preset,
    Scheduler,
    Sets,
    opened,
    print_rows,
    print_table,
    refuse_options,
    say,
)
from gsmap.cli.thin import parse_size

PANEL = "Export", 1
OUTPUTS = {"export": Output("exports.ExportReport"), "export --for": Output("exports.SmallMapReport")}
_SURVEY_SUFFIXES = (".las", ".laz", ".tif", ".tiff", ".geojson", ".dxf")
_NOT_FOR_FILES = ("--tile-size", "--budget", "--provenance", "--uncompressed", "--up", "--nonrigid", "--wait")
_NOT_FOR_PAGES = (
    *("--bbox", "--merge", "--revision", "--component", "--steps", "--budget", "--provenance", "--uncompressed"),
    *("--prefer", "--as-of", "--static", "--nonrigid", "--tile-size", "--up", "--crs", "--pixel-size"),
)


class Purpose(StrEnum):
    view = "view"
    localize = "localize"


class Up(StrEnum):
    y = "y"
    z = "z"


def command(
    context: typer.Context,
    map: MapPath,
    out: Annotated[
        str,
        typer.Argument(
            metavar="OUT",
            help="Folder to write, which a later export to it updates; or a file .las, .laz, .tif, .geojson or .dxf.",
        ),
    ],
    format: Annotated[
        str | None,
        typer.Option(
            "--format",
            help="ply, compressed.ply, splat, spz, sog, glb, usdc, 3dtiles, streamed-sog, or html (one page to view). "
            "Default: spz, or ply with --provenance.",
        ),
    ] = None,
    tile_size: Annotated[
        float | None,
        typer.Option(
            "--tile-size",
            help="Edge length of a tile in metres; 0 writes one file per component. Default: one file up to 1.5 "
            "million Gaussians, which viewers load at once, and tiles of 10 m beyond.",
        ),
    ] = None,
    up: Annotated[
        Up | None,
        typer.Option(
            "--up",
            help="Vertical axis of the files: z, as in the map, or y, as viewers of the format expect it. Default: z "
            "for ply, 3dtiles and streamed-sog, y for the others.",
        ),
    ] = None,
    bbox: Annotated[
        tuple[float, float, float, float, float, float] | None,
        typer.Option(
            "--bbox", metavar="X0 Y0 Z0 X1 Y1 Z1", help="Export only the part of the map in this box, in map units."
        ),
    ] = None,
    merge: Annotated[
        str | None,
        typer.Option("--merge", help="Merge method: tto, voxel, union or distance; default: the setting merge.method."),
    ] = None,
    revision: Annotated[
        int | None, typer.Option("--revision", help="Use the poses of this revision; default: the newest.")
    ] = None,
    component: Annotated[int | None, typer.Option("--component", help="Export only this connected component.")] = None,
    steps: Annotated[
        int | None,
        typer.Option(
            "--steps", help="Number of optimization steps per tile; default: depends on the size of the tile."
        ),
    ] = None,
    budget: Annotated[
        str | None,
        typer.Option(
            "--budget",
            metavar="SECONDS|SIZE",
            help="Time limit per tile in seconds; tiles that reach it are marked. With --for localize: a size as 50MB.",
        ),
    ] = None,
    purpose: Annotated[
        Purpose,
        typer.Option("--for", help="Purpose: view (tiles) or localize (a small map of at most --budget)."),
    ] = Purpose.view,
    provenance: Annotated[
        bool,
        typer.Option(
            "--provenance",
            help="Add the property `scene` to .ply files: the index of the source capture of each Gaussian.",
        ),
    ] = False,
    uncompressed: Annotated[
        bool, typer.Option("--uncompressed", help="Write 3dtiles as float32, for viewers without SPZ in glTF.")
    ] = False,
    prefer: Annotated[
        str | None,
        typer.Option(
            "--prefer",
            help="Capture to show where captures disagree: newest, best (the best-observed) or both; default: newest.",
        ),
    ] = None,
    as_of: AsOf = None,
    static: Annotated[
        bool,
        typer.Option(
            "--static", help="Export static content only, without objects that moved, appeared or disappeared."
        ),
    ] = False,
    nonrigid: Annotated[
        bool,
        typer.Option(
            "--nonrigid",
            help="Warp captures that are stretched or bent onto those they overlap with; the capture that agrees with "
            "most others keeps its shape.",
        ),
    ] = False,
    wait: Annotated[
        bool, typer.Option("--wait", help="Wait until another export to OUT has ended; default: fail.")
    ] = False,
    crs: Annotated[
        str | None,
        typer.Option("--crs", metavar="EPSG:N", help="CRS of a .las, .laz or .tif file; default: that of the map."),
    ] = None,
    pixel_size: Annotated[
        float | None,
        typer.Option("--pixel-size", help="Side of a pixel of a .tif file, in the unit of its CRS."),
    ] = None,
    sets: Sets = None,
    preset: Preset = None,
    executor: Executor = None,
    scheduler: Scheduler = None,
    page_mb: Annotated[
        float, typer.Option("--page-mb", help="With --format html: maximum size of the levels of detail, in megabytes.")
    ] = 20.0,
    json: AsJson = False,
) -> None:
    """Write the merged map, one file per component or tiles. Only files that changed since the last export to OUT are
    made, and a further format or OUT merges nothing again.

    If OUT ends in .las, .laz (points), .tif (orthophoto), .geojson or .dxf (floor plan), it is one file in world
    coordinates.

    Example: `gsmap export site.gsmap house`, then `gsmap export site.gsmap tiles --format 3dtiles`
    """
    if format == "html":
        refuse_options(context, _NOT_FOR_PAGES, "--format html, which shows the captures without merging them")
        _write_page(map, out, page_mb, sets, preset, json)
        return
    is_survey = Path(out).suffix.lower() in _SURVEY_SUFFIXES and format is None and purpose is Purpose.view
    if is_survey:
        refuse_options(context, _NOT_FOR_FILES, f"a {Path(out).suffix} file")
    else:
        refuse_options(context, ("--crs", "--pixel-size"), "tiles; name a file that ends in .laz or .tif")
    content: dict[str, Any] = {
        "bbox": bbox,
        "merge": merge,
        "revision": revision,
        "component": component,
        "steps": steps,
        "prefer": prefer,
        "as_of": as_of,
        "static": static,
    }
    with opened(map, bars=True, sets=sets, preset=preset, executor=executor, scheduler=scheduler) as m:
        if purpose is Purpose.localize:
            refuse_options(context, ("--nonrigid",), "--for localize")
            small = m.export_small(out, parse_size(budget or "50MB"), static=static)
            if json:
                print_rows("export --for", small, json)
                return
            print_table(f"small map in {out}", small.scenes[0].columns, small.scenes)
            say(f"{small.num_bytes / 1e6:.2f} MB; run: gsmap localize {out} PHOTO")
            return
        if is_survey:
            report = m.export_survey(out, crs=crs, pixel_size=pixel_size, **content)
        else:
            report = m.export(
                out,
                format=format,
                tile_size_m=tile_size,
                budget_s=None if budget is None else _seconds(budget),
                provenance=provenance,
                uncompressed=uncompressed,
                up=up,
                nonrigid=nonrigid,
                wait=wait,
                **content,
            )
    for note in report.notes:
        say(note)
    if is_survey:
        if json:
            print_rows("export", report, json)
        say(f"wrote {out}")
        return
    about: dict[str, list[str]] = {}
    for tile in report.tiles:
        for note in tile.notes:
            about.setdefault(note, []).append(tile.path)
    for note, paths in about.items():
        say(f"{paths[0] if len(paths) == 1 else f'{len(paths)} tiles'}: {note}")
    if json:
        print_rows("export", report, json)
    else:
        columns = {"path": "file", "component": "component", "num_gaussians": "Gaussians", "truncated": "truncated"}
        print_table(f"files in {out}", columns, report.tiles)
    written = f"{report.recomputed} file{'s' * (report.recomputed != 1)} written"
    counts = f"{written}, {report.reused} unchanged, {report.removed} removed"
    say(f"{counts}; {'z is up' if report.up == 'z' else 'y is vertical, as viewers of the format expect'}")


def _write_page(map: str, out: str, megabytes: float, sets: Sets, preset: Preset, json: bool) -> None:
    """Write the page with the unmerged captures of the map as one file."""
    from gsmap.types.rows.exports import ExportReport

    with opened(map, bars=True, sets=sets, preset=preset) as m:
        written = m.write_page(out, megabytes=megabytes)
    for note in written.notes:
        say(note)
    if json:
        report = ExportReport(out=out, tiles=(), recomputed=0, reused=0, removed=0, notes=written.notes)
        print_rows("export", report, json)
    say(f"{written.num_bytes:,} bytes in {out}: open it in a browser")


def _seconds(text: str) -> float:
    from gsmap.errors import ConfigError

    try:
        return float(text)
    except ValueError:
        raise ConfigError(
            f"--budget must be a number of seconds per tile, got {text!r}; a size such as 50MB needs --for localize",
            code="invalid_budget",
        ) from None
