"""What people ask of localisation, as photographs; and what was found, as rows."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import TYPE_CHECKING

from gsmap.errors import ConfigError
from gsmap.formats.scans import is_scan
from gsmap.localize import Lens, read_clip, read_photo
from gsmap.map.localizing_scans import scan_rows
from gsmap.map.metres import metre_notes, metres_at
from gsmap.map.stages.localize import Localizer, localize, localize_all, parse_near
from gsmap.store import Store
from gsmap.types.localization import Photo, Placement
from gsmap.types.progress import StageProgress
from gsmap.types.rows.localize import LocalizeReport, LocalizeRow

if TYPE_CHECKING:
    from gsmap.map.settings import Settings

Numbers = str | Sequence[float] | None


def localize_files(
    store: Store,
    settings: Settings,
    files: Sequence[str | os.PathLike[str]],
    *,
    intrinsics: Numbers,
    focal: str | float | None,
    near: str | None,
    together: bool,
    video: str | os.PathLike[str] | None,
    progress: StageProgress,
    depth: str | os.PathLike[str] | None = None,
    depth_scale: float = 1000.0,
) -> LocalizeReport:
    """Read photographs, find them, and tell of each; nothing is begun where one cannot be read. Scans go their own way.

    Args:
        together: the photographs show one place.
        video: a clip, in place of files.
        depth: a depth picture of the view of the one photo given, which makes a scan of it.
        depth_scale: its values that make a metre.
    """
    if bool(files) == (video is not None):
        raise ConfigError("name the photographs to localise, or one clip by --video")
    lens = parse_lens(intrinsics, focal)
    if video is not None:
        clip = read_clip(video, lens, settings.localize.clips)
        frames = [(f"{os.fspath(video)}#{at:.2f}", photo) for at, photo in clip]
        return _of_pictures(store, settings, frames, near, True, progress)
    pictures = [(os.fspath(path), read_photo(path, lens)) for path in files if depth is None and not is_scan(path)]
    of_scans, notes = scan_rows(store, settings, files, depth, depth_scale, lens, near, progress)
    report = LocalizeReport(results=())
    if pictures:
        report = _of_pictures(store, settings, pictures, near, together, progress)
    told = iter(report.results)
    rows = tuple(of_scans[number] if number in of_scans else next(told) for number in range(len(files)))
    return LocalizeReport(results=rows, notes=(*notes, *report.notes))


def _of_pictures(
    store: Store,
    settings: Settings,
    named: Sequence[tuple[str, Photo]],
    near: str | None,
    together: bool,
    progress: StageProgress,
) -> LocalizeReport:
    """What is told of photographs, by name."""
    where = None if near is None else parse_near(store, near)
    localizer = Localizer(store, settings, progress)
    photos = [photo for _, photo in named]
    if together:
        found = localize_all(localizer, photos, where)
    else:
        found = localize(localizer, photos, where, progress)
    rows = [row_of(store, name, *one) for (name, _), one in zip(named, found, strict=True)]
    metres = metres_at(store, settings)
    components = {row.component for row in rows if row.component is not None and row.status == "placed"}
    return LocalizeReport(
        results=tuple(rows), notes=metre_notes({c: metres[c] for c in sorted(components) if c in metres})
    )


def parse_lens(intrinsics: Numbers, focal: str | float | None) -> Lens:
    """What is said of the lens, as `gsmap localize` takes it.

    Raises:
        ConfigError: not four numbers, a focal length that is none, or both.
    """
    if intrinsics is not None and focal is not None:
        raise ConfigError("intrinsics hold the focal length: give one of --intrinsics and --focal")
    if intrinsics is not None:
        parts = intrinsics.split(",") if isinstance(intrinsics, str) else intrinsics
        try:
            fx, fy, cx, cy = (float(part) for part in parts)
        except ValueError:
            raise ConfigError(f"intrinsics are four numbers fx,fy,cx,cy, got {intrinsics!r}") from None
        return Lens((fx, fy, cx, cy))
    if focal is None:
        return Lens()
    if focal == "auto":
        return Lens(ask_file=False)
    try:
        return Lens(focal_px=float(focal))
    except ValueError:
        raise ConfigError(f"a focal length is auto or pixels, got {focal!r}") from None


def row_of(store: Store, file: str, found: Placement, seconds: float) -> LocalizeRow:
    """What is told of one photo; scenes by name."""
    names = {scene.id: scene.name for scene in store.scenes.list()} if found.scenes else {}
    return LocalizeRow(
        file=file,
        status="placed" if found.is_placed else "refused",
        reason=found.reason,
        T_map_camera=found.T_map_camera,
        covariance=found.covariance,
        component=found.component,
        scenes=tuple(names.get(scene, scene) for scene in found.scenes),
        intrinsics_px=found.intrinsics_px,
        probability=found.probability,
        evidence=found.evidence,
        num_gaussians=found.num_gaussians,
        seconds=seconds,
    )
