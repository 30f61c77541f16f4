"""gsmap prior: set a pose prior of a scene."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.console import AsJson, MapPath, Output, opened, print_rows, say

PANEL = "Scenes and edges", 5
OUTPUTS = {"prior": Output("scenes.PriorRow", "prior", is_list=False)}
# Standard deviations: an anchor is practically fixed; a tape measure is exact to one percent.
_ANCHOR_RAD, _ANCHOR_M, _SCALE_SIGMA = 1e-4, 1e-4, 0.01


def command(
    map: MapPath,
    scene: Annotated[str, typer.Argument(metavar="SCENE", help="Name or id of the scene.")],
    position: Annotated[
        tuple[float, float, float] | None,
        typer.Option(
            "--position", metavar="X Y Z", help="Position of the origin of the scene frame, in the map frame."
        ),
    ] = None,
    sigma: Annotated[
        float,
        typer.Option(
            "--sigma",
            help="Standard deviation of the position per axis, in map units, or in metres for a world position.",
        ),
    ] = 1.0,
    latitude: Annotated[
        float | None, typer.Option("--latitude", help="Latitude of the origin of the scene frame, in degrees north.")
    ] = None,
    longitude: Annotated[
        float | None, typer.Option("--longitude", help="Longitude of the origin of the scene frame, in degrees east.")
    ] = None,
    height: Annotated[
        float | None,
        typer.Option(
            "--height",
            help="Height of the origin of the scene frame, in metres above the WGS 84 ellipsoid (not sea level).",
        ),
    ] = None,
    scale: Annotated[
        float | None,
        typer.Option(
            "--scale", help="Number of map units per scene unit, to which a standard deviation of 1 % is assigned."
        ),
    ] = None,
    up: Annotated[
        tuple[float, float, float] | None,
        typer.Option("--up", metavar="X Y Z", help="Direction opposite to gravity, in the scene frame."),
    ] = None,
    anchor: Annotated[bool, typer.Option("--anchor", help="Use the scene frame as the map frame.")] = False,
    remove: Annotated[bool, typer.Option("--remove", help="Remove the prior.")] = False,
    json: AsJson = False,
) -> None:
    """Set a pose prior for a scene, replacing the previous one. The next optimize combines it with the edges.

    Example: `gsmap prior site.gsmap monday --position 12.5 3.0 0.8 --sigma 0.5`
    """
    import numpy as np

    from gsmap.errors import ConfigError
    from gsmap.types import Prior, Sim3

    world = [latitude, longitude, height]
    in_world = any(one is not None for one in world)
    if in_world and None in world:
        raise ConfigError("a world position needs all of --latitude, --longitude and --height", code="missing_option")
    kinds = [position is not None or scale is not None or up is not None, anchor, remove, in_world]
    if sum(kinds) != 1:
        raise ConfigError(
            "pass exactly one kind of prior: --position, --scale and --up; or --latitude, --longitude and --height; or "
            "--anchor; or --remove",
            code="nothing_requested",
        )
    if not sigma > 0 or (scale is not None and not scale > 0):
        raise ConfigError("--sigma and --scale must be positive", code="invalid_sigma")
    sigmas = np.full(7, np.inf)
    if anchor:
        sigmas = np.r_[np.full(3, _ANCHOR_RAD), np.full(3, _ANCHOR_M), np.inf]
    if position is not None:
        # The residual is in the scene's unit: (t - t_hat) / s_hat.
        sigmas[3:6] = sigma / (scale or 1.0)
    if scale is not None:
        sigmas[6] = _SCALE_SIGMA
    row = None
    with opened(map) as m:
        if remove:
            m.remove_prior(scene)
        elif latitude is not None and longitude is not None and height is not None:
            m.set_world_position(scene, (longitude, latitude, height), (sigma, sigma))
        else:
            pose = Sim3(np.eye(3), np.array(position or (0.0, 0.0, 0.0)), scale or 1.0)
            row = m.set_prior(Prior(scene, pose, sigmas, None if up is None else np.array(up)))
    say(f"noted; run: gsmap optimize {map}")
    if json:
        print_rows("prior", row, json)
