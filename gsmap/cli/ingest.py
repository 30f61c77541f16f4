"""gsmap ingest: add scenes to a map."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from gsmap.cli.console import AsJson, MapPath, Output, opened, print_rows, say

PANEL = "Map", 2
OUTPUTS = {"ingest": Output("scenes.IngestRow", "ingested")}
Paths = Annotated[list[str] | None, typer.Argument(metavar="FILE_OR_FOLDER...", help="Files or folders of captures.")]
CamerasFile = Annotated[
    str | None, typer.Option("--cameras", help="Camera file of the capture; only for a single capture.")
]
Name = Annotated[str | None, typer.Option("--name", help="Name of the scene; only for a single capture.")]
CapturedAt = Annotated[
    str | None,
    typer.Option(
        "--captured-at", help="Date of all these captures, ISO 8601; default: the date found beside each capture."
    ),
]
Scale = Annotated[
    str,
    typer.Option(
        "--scale", help="Unit of the captures: `known` (metres), `unknown`, or `auto` (registration decides)."
    ),
]
Clean = Annotated[
    bool, typer.Option("--clean", help="Remove invalid Gaussians, floaters and background; see gsmap clean.")
]
NoCreate = Annotated[
    bool, typer.Option("--no-create", help="Fail if MAP is missing, for example because its disk is not mounted.")
]


def command(
    map: MapPath,
    paths: Paths = None,
    cameras: CamerasFile = None,
    name: Name = None,
    captured_at: CapturedAt = None,
    scale: Scale = "auto",
    clean: Clean = False,
    bbox: Annotated[
        tuple[float, float, float, float, float, float] | None,
        typer.Option(
            "--bbox",
            metavar="X0 Y0 Z0 X1 Y1 Z1",
            help="With --clean, remove everything outside this box, too, in the coordinates of the file.",
        ),
    ] = None,
    supersedes: Annotated[
        str | None,
        typer.Option(
            "--supersedes",
            metavar="SCENE",
            help="Replace this scene by the capture, which was trained again from the same frames.",
        ),
    ] = None,
    no_create: NoCreate = False,
    json: AsJson = False,
) -> None:
    """Add scenes to MAP, with the cameras found beside them. Creates a missing MAP; skips scenes that MAP has already.

    Example: `gsmap ingest site.gsmap monday.ply tuesday/`
    """
    from gsmap.errors import ConfigError

    refuse_capture_as_map("ingest", map, paths or [])
    if not paths:
        raise ConfigError(
            f"no captures given: gsmap ingest {shlex.quote(map)} FILE_OR_FOLDER...",
            code="nothing_requested",
        )
    create = False
    if supersedes is None and not no_create:
        create = makes_map(map, paths, captured_at, cameras=cameras, name=name, scale=scale, clean=clean, bbox=bbox)
    with opened(map, create=create, bars=True) as m:
        if create:
            say(f"created {map}")
        rows = m.ingest(
            *paths,
            cameras=cameras,
            name=name,
            captured_at=captured_at,
            scale=scale,
            clean=clean,
            bbox=bbox,
            supersedes=supersedes,
        )
    for row in rows:
        for note in row.notes:
            say(f"{row.scene_name}: {note}")
    print_rows("ingest", rows, json)


def makes_map(
    map: str,
    paths: Sequence[str],
    captured_at: str | None,
    *,
    cameras: str | None = None,
    name: str | None = None,
    scale: str = "auto",
    clean: bool = False,
    bbox: Sequence[float] | None = None,
) -> bool:
    """Return true if MAP is missing and these captures can be ingested into a new map.

    Raises:
        GsmapError: see `gsmap.map.Map.ingest`.
    """
    from gsmap.map.stages.ingest import check_captures
    from gsmap.store import Store

    if Store.exists(map):
        return False
    check_captures(paths, cameras=cameras, name=name, captured_at=captured_at, scale=scale, clean=clean, bbox=bbox)
    return True


def refuse_capture_as_map(verb: str, map: str, paths: Sequence[str]) -> None:
    """Raise an error if a capture or a folder of captures is given in place of MAP, and suggest the correct command.

    The suggested map is one named after it, or the only map in the working folder.

    Raises:
        ConfigError: MAP is not a map, but holds captures or photos.
    """
    from gsmap.errors import ConfigError, InputError
    from gsmap.ingest import search_captures
    from gsmap.store.branches import has_catalog

    given = Path(map)
    if not given.exists() or given.suffix == ".gsmap" or has_catalog(given):
        return
    if given.is_dir() and ((given / "arrays").is_dir() or not any(given.iterdir())):
        return  # a damaged map, or an empty folder for a new one
    try:
        search_captures([given])
    except InputError as error:
        raise ConfigError(f"{map} is not a gsmap map: {error}", code="not_a_map") from error
    named = [path for path in paths if has_catalog(Path(path))]
    near = named or sorted(path.name for path in Path().iterdir() if has_catalog(path))
    guess = near[0] if len(near) == 1 else f"{given.resolve().stem or 'site'}.gsmap" if not near else "MAP"
    meant = ["gsmap", verb, guess, map, *(path for path in paths if path not in named)]
    also = f" (MAP is one of {', '.join(near)})" if len(near) > 1 else ""
    raise ConfigError(
        f"{map} holds captures and is not a map, but MAP must come first. Did you mean: {shlex.join(meant)}{also}",
        code="map_argument_first",
    )
