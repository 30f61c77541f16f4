"""gsmap export: tiles of the merged map."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

import typer

from gsmap.cli.console import (
    AsJson,
    AsOf,
    Executor,
    MapPath,
    Preset,
    Scheduler,
    Sets,
    opened,
    print_rows,
    print_table,
    say,
)
from gsmap.cli.thin import parse_size


class Purpose(StrEnum):
    view = "view"
    localize = "localize"


def command(
    map: MapPath,
    out: Annotated[str, typer.Argument(metavar="OUT", help="Folder to write; exporting there again updates it.")],
    format: Annotated[str, typer.Option("--format", help="ply, compressed.ply, splat, spz, glb or 3dtiles.")] = "ply",
    tile_size: Annotated[float, typer.Option("--tile-size", help="Edge of a tile in metres; 0 is one file.")] = 10.0,
    bbox: Annotated[
        tuple[float, float, float, float, float, float] | None,
        typer.Option(
            "--bbox", metavar="X0 Y0 Z0 X1 Y1 Z1", help="Only this box of the map, in its unit, as poses are."
        ),
    ] = None,
    merge: Annotated[
        str | None,
        typer.Option("--merge", help="tto, voxel, union or distance; what the setting merge.method says else."),
    ] = None,
    revision: Annotated[int | None, typer.Option("--revision", help="Poses of this revision; the newest else.")] = None,
    component: Annotated[int | None, typer.Option("--component", help="Only this connected component.")] = None,
    steps: Annotated[
        int | None, typer.Option("--steps", help="Optimisation steps per tile; chosen by size else.")
    ] = None,
    budget: Annotated[
        str | None,
        typer.Option(
            "--budget",
            metavar="SECONDS|SIZE",
            help="Ceiling in seconds per tile; a tile it cuts short is marked. With --for localize a size, as 50MB.",
        ),
    ] = None,
    purpose: Annotated[
        Purpose,
        typer.Option("--for", help="What the export is for: view (tiles), or localize (a small map, see --budget)."),
    ] = Purpose.view,
    provenance: Annotated[
        bool,
        typer.Option("--provenance", help="Add the property `scene` to .ply: which capture each Gaussian is from."),
    ] = False,
    uncompressed: Annotated[
        bool, typer.Option("--uncompressed", help="3dtiles as float32, for viewers that read no SPZ in glTF.")
    ] = False,
    prefer: Annotated[
        str | None,
        typer.Option("--prefer", help="Where captures disagree: newest, best (who saw it best) or both; newest else."),
    ] = None,
    as_of: AsOf = None,
    wait: Annotated[
        bool, typer.Option("--wait", help="If another export is at work in OUT, wait for it; refused else.")
    ] = False,
    sets: Sets = None,
    preset: Preset = None,
    executor: Executor = None,
    scheduler: Scheduler = None,
    json: AsJson = False,
) -> None:
    """Write merged tiles; only what changed since the last export to OUT is computed.

    Example: `gsmap export site.gsmap tiles --format spz --as-of 2024-05-31`
    """
    with opened(map, bars=True, sets=sets, preset=preset, executor=executor, scheduler=scheduler) as m:
        if purpose is Purpose.localize:
            small = m.export_small(out, parse_size(budget or "50MB"))
            if json:
                print_rows("export --for", small, json)
                return
            print_table(f"small map in {out}", small.scenes[0].columns, small.scenes)
            say(f"{small.num_bytes / 1e6:.2f} MB; run: gsmap localize {out} PHOTO")
            return
        report = m.export(
            out,
            format=format,
            tile_size_m=tile_size,
            bbox=bbox,
            merge=merge,
            revision=revision,
            component=component,
            steps=steps,
            budget_s=None if budget is None else _seconds(budget),
            provenance=provenance,
            uncompressed=uncompressed,
            prefer=prefer,
            as_of=as_of,
            wait=wait,
        )
    for note in report.notes:
        say(note)
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
        print_table(f"tiles in {out}", columns, report.tiles)
    say(f"{report.recomputed} tiles made, {report.reused} unchanged, {report.removed} removed")


def _seconds(text: str) -> float:
    from gsmap.errors import ConfigError

    try:
        return float(text)
    except ValueError:
        raise ConfigError(f"--budget of tiles is in seconds, got {text!r}; a size goes with --for localize") from None
