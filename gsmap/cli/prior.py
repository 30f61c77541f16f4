"""gsmap prior: what is known of a scene's pose from outside."""

from __future__ import annotations

from typing import Annotated

import typer

from gsmap.cli.console import AsJson, MapPath, opened, print_rows, say

# An anchor gives way to nothing; a tape measures to a percent.
_ANCHOR_RAD, _ANCHOR_M, _SCALE_SIGMA = 1e-4, 1e-4, 0.01


def command(
    map: MapPath,
    scene: Annotated[str, typer.Argument(metavar="SCENE", help="Name or id.")],
    position: Annotated[
        tuple[float, float, float] | None,
        typer.Option("--position", metavar="X Y Z", help="Where the scene's origin lies in the map (GPS, survey)."),
    ] = None,
    sigma: Annotated[
        float,
        typer.Option("--sigma", help="Standard deviation of the position, per axis; of one in the world in metres."),
    ] = 1.0,
    latitude: Annotated[
        float | None, typer.Option("--latitude", help="Where the scene's origin lies in the world, degrees north.")
    ] = None,
    longitude: Annotated[float | None, typer.Option("--longitude", help="The same, degrees east.")] = None,
    height: Annotated[
        float | None, typer.Option("--height", help="The same, metres above the WGS 84 ellipsoid (not sea level).")
    ] = None,
    scale: Annotated[float | None, typer.Option("--scale", help="Map units per unit of the scene, to 1 %.")] = None,
    up: Annotated[
        tuple[float, float, float] | None,
        typer.Option("--up", metavar="X Y Z", help="The direction against gravity in the scene's frame."),
    ] = None,
    anchor: Annotated[bool, typer.Option("--anchor", help="The map's frame is this scene's own.")] = False,
    remove: Annotated[bool, typer.Option("--remove", help="Take back what was said.")] = False,
    json: AsJson = False,
) -> None:
    """Tell where a scene lies, in place of what was said of it before. The next optimize weighs it with the edges.

    Example: `gsmap prior site.gsmap monday --position 12.5 3.0 0.8 --sigma 0.5`
    """
    import numpy as np

    from gsmap.errors import ConfigError
    from gsmap.types import Prior, Sim3

    world = [latitude, longitude, height]
    in_world = any(one is not None for one in world)
    if in_world and None in world:
        raise ConfigError("a position in the world has --latitude, --longitude and --height", code="missing_option")
    said = [position is not None or scale is not None or up is not None, anchor, remove, in_world]
    if sum(said) != 1:
        raise ConfigError(
            "say where the scene lies (--position, --scale, --up, or --latitude, --longitude and --height), or "
            "--anchor, or --remove",
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
