"""Localize photos in a small map, without changing it."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence

from gsmap.errors import ConfigError
from gsmap.formats.scans import is_scan
from gsmap.map.localization.photo_localization import (
    Numbers,
    check_named,
    find_all,
    frames_of,
    lens_notes,
    parse_lens,
    photos_of,
    row_of,
)
from gsmap.map.progress_logging import log_progress
from gsmap.map.settings import settings_of
from gsmap.map.small_map.export import SmallLocalizer
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
    masks: str | os.PathLike[str] | None = None,
    values: Mapping[str, object] | None = None,
    preset: str | None = None,
) -> LocalizeReport:
    """Localize photos in a small map, as `Map.localize` does in the whole map.

    Args:
        folder: folder that ``gsmap export MAP OUT --for localize`` wrote.
        values, preset: settings of this run, by dotted name.

    Raises:
        ConfigError: a scan, which takes the whole map; or settings that do not fit.
        CorruptError: the small map is damaged.
        NotFoundError, InputError: as `Map.localize`.
    """
    check_named(files, video, masks)
    scans = [os.fspath(path) for path in files if is_scan(path)]
    if scans:
        raise ConfigError(
            f"{scans[0]} is a scan, but a small map can only localize photos: use the map from which it was exported",
            code="not_in_small_map",
        )
    lens, settings = parse_lens(intrinsics, focal), settings_of(dict(values or {}), preset)
    named = photos_of(files, lens, masks) if video is None else frames_of(video, lens, settings)
    localizer = SmallLocalizer(folder, settings)
    where = None if near is None else localizer.near(near)
    found = find_all(localizer, named, where, together or video is not None, log_progress(progress))
    names = {scene.id: scene.name for scene in localizer.small.values()}
    rows = [row_of(names, name, *one) for (name, _), one in zip(named, found, strict=True)]
    return LocalizeReport(results=tuple(rows), notes=tuple(lens_notes(named)))
