"""What people ask of a small map: where photographs were taken. It is only read."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence

from gsmap.errors import ConfigError
from gsmap.formats.scans import is_scan
from gsmap.localize import read_clip, read_photo
from gsmap.map.localizing import Numbers, parse_lens, row_of
from gsmap.map.logs import logged
from gsmap.map.settings import settings_of
from gsmap.map.small_map import SmallLocalizer
from gsmap.map.stages.localize import localize, localize_all
from gsmap.types.progress import StageProgress
from gsmap.types.rows.localize import LocalizeReport


def localize_small(
    folder: str | os.PathLike[str],
    files: Sequence[str | os.PathLike[str]],
    progress: StageProgress | None = None,
    *,
    intrinsics: Numbers = None,
    focal: str | float | None = None,
    near: str | None = None,
    together: bool = False,
    video: str | os.PathLike[str] | None = None,
    values: Mapping[str, object] | None = None,
    preset: str | None = None,
) -> LocalizeReport:
    """Where photographs were taken, by a small map; as `Map.localize` does with the whole one.

    Args:
        folder: that ``gsmap export MAP OUT --for localize`` wrote.
        values, preset: settings of this run, by dotted name.

    Raises:
        ConfigError: a scan, which takes the whole map; or settings that do not fit.
        CorruptError: the small map is damaged.
        NotFoundError, InputError: as `Map.localize`.
    """
    if bool(files) == (video is not None):
        raise ConfigError("name the photographs to localise, or one clip by --video")
    scans = [os.fspath(path) for path in files if is_scan(path)]
    if scans:
        raise ConfigError(f"{scans[0]} is a scan: a small map places photographs alone; ask the map that it is of")
    lens, settings = parse_lens(intrinsics, focal), settings_of(dict(values or {}), preset)
    if video is not None:
        clip = read_clip(video, lens, settings.localize.clips)
        named = [(f"{os.fspath(video)}#{at:.2f}", photo) for at, photo in clip]
    else:
        named = [(os.fspath(path), read_photo(path, lens)) for path in files]
    localizer = SmallLocalizer(folder, settings)
    where = None if near is None else localizer.near(near)
    photos = [photo for _, photo in named]
    if together or video is not None:
        found = localize_all(localizer, photos, where)
    else:
        found = localize(localizer, photos, where, logged(progress))
    names = {scene.id: scene.name for scene in localizer.small.values()}
    rows = [row_of(names, name, *one) for (name, _), one in zip(named, found, strict=True)]
    return LocalizeReport(results=tuple(rows))
