"""gsmap georeference: estimate the pose of a map in the world."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from gsmap.cli.console import AsJson, MapPath, Output, Sets, opened, print_facts, print_rows, print_table, say

if TYPE_CHECKING:
    from gsmap.types.rows.world import WorldReport

PANEL = "Scenes and edges", 8
OUTPUTS = {"georeference": Output("world.WorldReport")}


def command(
    map: MapPath,
    crs: Annotated[
        str | None,
        typer.Option("--crs", metavar="EPSG:N", help="Coordinate reference system of the map."),
    ] = None,
    gcp: Annotated[
        str | None,
        typer.Option(
            "--gcp", metavar="FILE", help="Control points marked in photos, in OpenDroneMap's format gcp_list.txt."
        ),
    ] = None,
    photos: Annotated[
        str | None,
        typer.Option(
            "--photos",
            metavar="DIR",
            help="Folder of photos that --gcp names and that belong to no capture; these photos are localized first.",
        ),
    ] = None,
    exif: Annotated[
        str | None,
        typer.Option(
            "--exif",
            metavar="DIR",
            help="Folder of the captures' photos with EXIF positions; equal file names need one subfolder per scene.",
        ),
    ] = None,
    scale_bar: Annotated[
        tuple[str, str, float] | None,
        typer.Option(
            "--scale-bar",
            metavar="A B METRES",
            help="Measured distance between two points, each SCENE:X,Y,Z or SCENE:CAMERA@COLUMN,ROW.",
        ),
    ] = None,
    check: Annotated[
        str | None,
        typer.Option(
            "--check", metavar="NAME,...", help="Names of control points to hold out as check points; '' for none."
        ),
    ] = None,
    sigma: Annotated[
        float | None,
        typer.Option(
            "--sigma",
            metavar="M",
            help="Standard deviation of control points or of the scale bar; default: 0.01 m, or 0.2 %.",
        ),
    ] = None,
    height_sigma: Annotated[
        float | None,
        typer.Option(
            "--height-sigma", metavar="M", help="Standard deviation of the heights of control points; default: --sigma."
        ),
    ] = None,
    photo_size: Annotated[
        tuple[int, int] | None,
        typer.Option(
            "--photo-size",
            metavar="WIDTH HEIGHT",
            help="Size of the photos in which --gcp marks points, if larger than the photos of the capture.",
        ),
    ] = None,
    remove: Annotated[
        bool, typer.Option("--remove", help="Remove the observations that --name lists, or all observations.")
    ] = False,
    name: Annotated[
        list[str] | None,
        typer.Option("--name", help="With --remove: name of a control point, photo or scale bar; may be repeated."),
    ] = None,
    sets: Sets = None,
    json: AsJson = False,
) -> None:
    """Georeference a map by control points, photo positions and scale bars. Without options, show the residuals.

    Example: `gsmap georeference site.gsmap --crs EPSG:25832 --gcp gcp_list.txt --check P4,P7`
    """
    from gsmap.errors import ConfigError
    from gsmap.map.localization.photo_poses import photo_localizer
    from gsmap.map.world.georeference import Request

    given = any(one is not None for one in (crs, gcp, exif, scale_bar, check))
    if remove and given:
        raise ConfigError("--remove can only be combined with --name", code="conflicting_options")
    if name and not remove:
        raise ConfigError("--name needs --remove", code="conflicting_options")
    if not given and (sigma is not None or height_sigma is not None or photo_size is not None):
        raise ConfigError(
            "--sigma, --height-sigma and --photo-size need --gcp or --scale-bar", code="conflicting_options"
        )
    for value in (sigma, height_sigma, *(photo_size or ())):
        if value is not None and not value > 0:
            raise ConfigError("--sigma, --height-sigma and --photo-size must be positive", code="invalid_sigma")
    sigmas = None if sigma is None and height_sigma is None else (sigma or 0.01, height_sigma or sigma or 0.01)
    request = Request(
        crs=crs,
        gcp=gcp,
        exif=exif,
        bars=() if scale_bar is None else (scale_bar,),
        check=None if check is None else tuple(one.strip() for one in check.split(",") if one.strip()),
        sigma_m=sigmas,
        bar_sigma_m=sigma if scale_bar is not None else None,
        photo_size_px=photo_size,
    )
    if photos is not None and gcp is None:
        raise ConfigError("--photos needs --gcp", code="conflicting_options")
    with opened(map, bars=True, sets=sets) as m:
        localise = None if photos is None else photo_localizer(m.store, m.localize, photos)
        taken_back = tuple(name or ()) if remove else None
        report = m.georeference(request if given else None, remove=taken_back, localise=localise)
    for note in report.notes:
        say(note)
    if json:
        print_rows("georeference", report, json)
    else:
        _print(map, report)


def _print(map: str, report: WorldReport) -> None:
    from gsmap.types.rows.world import GeoreferenceRow, ResidualRow, ResidualSummaryRow

    origin = None
    if report.origin is not None:
        latitude, longitude, height = report.origin
        origin = f"{latitude:.4f} N, {longitude:.4f} E, {height:g} m above the ellipsoid"
    facts = {
        "CRS": None if report.crs is None else f"{report.crs} ({report.crs_name})",
        "heights": report.heights or None,
        "frame": None if origin is None else f"metres east, north, up at {origin}",
        "unseen points": ", ".join(report.unseen),
        "stale": f"observations have changed: run gsmap optimize {map}" if report.stale else None,
    }
    print_facts("world", facts)
    for tie in report.components:
        print_table(f"component {tie.component}", GeoreferenceRow.columns, [tie])
        if tie.by_kind:
            print_table("residuals by kind", ResidualSummaryRow.columns, tie.by_kind)
        print_table("residuals", ResidualRow.columns, tie.residuals)
        for note in tie.notes:
            say(f"component {tie.component}: {note}")
        for one in tie.contradictions if not tie.problem else ():
            say(f"component {tie.component}: {one.text} Left out: {one.group}, reason {one.cause}")
        if tie.problem:
            say(f"component {tie.component} is not georeferenced: {tie.problem}")
