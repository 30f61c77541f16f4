"""Localize photos and report the results as rows."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from gsmap.errors import ConfigError, ReadOnlyError
from gsmap.formats.scans import is_scan
from gsmap.ingest.dates import CaptureDate, given_date, photo_date
from gsmap.localize import Lens, checked_model, combine_faces, photo_in_memory, read_clip, read_photo
from gsmap.map.localization.localize import Localizer, SearchRegion, localize, localize_all, parse_near
from gsmap.map.localization.photo_changes import PhotoReporter, write_picture
from gsmap.map.localization.photos import PhotoObservation, localized_photo_of, small_jpeg
from gsmap.map.localization.scan_localization import scan_rows
from gsmap.map.metric_scales import metre_notes, metres_at
from gsmap.store import Store
from gsmap.texts import counted
from gsmap.types.localization import LocalizationResult, Photo, PhotoLocalization
from gsmap.types.plain import fields_of
from gsmap.types.progress import StageProgress
from gsmap.types.rows.localize import LocalizeReport, LocalizeRow

if TYPE_CHECKING:
    from gsmap.map.settings import Settings

Numbers = str | Sequence[float] | None
Pictured = str | os.PathLike[str] | Any
"""A file of a photo or scan, or a photo in memory: an array or a PIL image (`gsmap.localize.photo_in_memory`)."""


@dataclass(frozen=True)
class PhotoOptions:
    """Options for photos that were localized.

    Args:
        changes: report differences between the photo and the map.
        pictures: folder for images with these differences drawn.
        add: store the photos in the map as evidence.
        captured_at: capture date given by the user; default: the EXIF date.

    Raises:
        ConfigError: pictures, or a date, of what is not asked for; or no date.
    """

    changes: bool = False
    pictures: str | os.PathLike[str] | None = None
    add: bool = False
    captured_at: str | None = None

    def __post_init__(self) -> None:
        if self.pictures is not None and not self.changes:
            raise ConfigError("--pictures draws changes: add --changes", code="missing_option")
        if self.captured_at is not None:
            if not self.add:
                raise ConfigError("--captured-at dates stored photos: add --add", code="missing_option")
            given_date(self.captured_at)


def localize_files(
    store: Store,
    settings: Settings,
    files: Sequence[Pictured],
    *,
    intrinsics: Numbers,
    focal: str | float | None,
    near: str | None,
    together: bool,
    video: str | os.PathLike[str] | None,
    progress: StageProgress,
    masks: str | os.PathLike[str] | None = None,
    depth: str | os.PathLike[str] | None = None,
    depth_scale: float = 1000.0,
    options: PhotoOptions | None = None,
) -> LocalizeReport:
    """Read and localize photos and scans; if a file cannot be read, raise an error before localizing any.

    Args:
        files: files, or photos in memory, which are called ``photo_0`` and so on by their position.
        together: the photographs show one place.
        video: a video, in place of files.
        masks: folder with a mask for each photo; black pixels are ignored.
        depth: a depth image of the view of the single photo, which makes a scan of it.
        depth_scale: depth value of one metre.
        options: options for photos that were localized.
    """
    options = options or PhotoOptions()
    if options.add and not store.catalog.writable:
        raise ReadOnlyError(f"{store.location} is open read-only: photos can be localized, but not stored")
    check_named(files, video, masks)
    if depth is not None and masks is not None:
        raise ConfigError(
            "--masks applies to photos only: give the value 0 to pixels of a depth image that are to be ignored",
            code="option_not_applicable",
        )
    lens = parse_lens(intrinsics, focal)
    if video is not None:
        return _of_pictures(store, settings, frames_of(video, lens, settings), near, True, progress, options)
    paths = [one if is_path(one) else f"photo_{number}" for number, one in enumerate(files)]
    if len(paths) != sum(map(is_path, files)) and (masks is not None or depth is not None):
        raise ConfigError(
            "--masks and --depth need photos in files, not in memory: write the photo to a file",
            code="option_not_applicable",
        )
    in_memory = {paths[number]: one for number, one in enumerate(files) if not is_path(one)}
    photos = [path for path in paths if depth is None and (path in in_memory or not is_scan(path))]
    pictures = photos_of(photos, lens, masks, in_memory)
    of_scans, notes = scan_rows(store, settings, paths, depth, depth_scale, lens, near, progress)
    report = LocalizeReport(results=())
    if pictures:
        report = _of_pictures(store, settings, pictures, near, together, progress, options)
    observation = iter(report.results)
    rows = tuple(of_scans[number] if number in of_scans else next(observation) for number in range(len(files)))
    return LocalizeReport(results=rows, notes=(*notes, *report.notes))


def check_named(
    files: Sequence[Pictured],
    video: str | os.PathLike[str] | None,
    masks: str | os.PathLike[str] | None = None,
) -> None:
    """Raise an error for photos together with a video, for neither, and for masks of a video."""
    if video is not None and masks is not None:
        raise ConfigError(
            "--masks apply to photos by name: frames of a video have no names", code="option_not_applicable"
        )
    if bool(files) == (video is not None):
        raise ConfigError("name the photos to localize, or one video with --video", code="nothing_requested")


def photos_of(
    files: Sequence[str | os.PathLike[str]],
    lens: Lens,
    masks: str | os.PathLike[str] | None = None,
    in_memory: Mapping[Any, Any] = MappingProxyType({}),
) -> list[tuple[str, Photo]]:
    """Read photos by name, each with its mask if there is one; those in memory are converted."""
    return [
        (os.fspath(path), photo_in_memory(in_memory[path], lens, os.fspath(path)))
        if path in in_memory
        else (os.fspath(path), read_photo(path, lens, masks))
        for path in files
    ]


def is_path(given: object) -> bool:
    """Return whether an input names a file."""
    return isinstance(given, (str, os.PathLike))


def frames_of(video: str | os.PathLike[str], lens: Lens, settings: Settings) -> list[tuple[str, Photo]]:
    """Read the frames of a video, each named by its time in seconds."""
    clip = read_clip(video, lens, settings.localize.clips)
    return [(f"{os.fspath(video)}#{at:.2f}", photo) for at, photo in clip]


def find_all(
    localizer: Localizer,
    named: Sequence[tuple[str, Photo]],
    where: SearchRegion | None,
    together: bool,
    progress: StageProgress,
) -> list[tuple[LocalizationResult, float]]:
    """Localize photos; return each result with its wall time in seconds."""
    photos = [part for _, photo in named for part in ([face for face, _ in photo.faces] or [photo])]
    parts = iter(localize_all(localizer, photos, where) if together else localize(localizer, photos, where, progress))
    out = []
    for _, photo in named:
        found = [next(parts) for _ in photo.faces or (photo,)]
        result = combine_faces(photo, [one for one, _ in found]) if photo.faces else found[0][0]
        out.append((result, sum(seconds for _, seconds in found)))
    return out


def lens_notes(named: Sequence[tuple[str, Photo]]) -> list[str]:
    """Return notes on photos that were undistorted, and on panoramas."""
    notes = []
    for model in sorted({photo.lens for _, photo in named if photo.lens}):
        bent = sum(photo.lens == model and not photo.faces for _, photo in named)
        wide = sum(photo.lens == model and bool(photo.faces) for _, photo in named)
        if bent:
            notes.append(f"{counted(bent, 'photo')} undistorted ({model}); the intrinsics are those after it")
        if wide:
            notes.append(f"{counted(wide, 'photo')} localized by pinhole faces of 90 degrees ({model})")
    return notes


def _of_pictures(
    store: Store,
    settings: Settings,
    named: Sequence[tuple[str, Photo]],
    near: str | None,
    together: bool,
    progress: StageProgress,
    options: PhotoOptions,
) -> LocalizeReport:
    """Localize named photos and report the results."""
    where = None if near is None else parse_near(store, near)
    localizer = Localizer(store, settings, progress)
    found = find_all(localizer, named, where, together, progress)
    names = {scene.id: scene.name for scene in store.scenes.list()}
    rows = [row_of(names, name, *one) for (name, _), one in zip(named, found, strict=True)]
    notes: list[str] = []
    if options.changes or options.add:
        rows, notes = _with_what_they_tell(localizer, named, [one for one, _ in found], rows, options, progress)
    metres = metres_at(store)
    components = {row.component for row in rows if row.component is not None and row.status == "placed"}
    return LocalizeReport(
        results=tuple(rows),
        notes=(
            *lens_notes(named),
            *metre_notes({c: metres[c] for c in sorted(components) if c in metres}),
            *notes,
        ),
    )


def _with_what_they_tell(
    localizer: Localizer,
    named: Sequence[tuple[str, Photo]],
    found: Sequence[LocalizationResult],
    rows: Sequence[LocalizeRow],
    options: PhotoOptions,
    progress: StageProgress,
) -> tuple[list[LocalizeRow], list[str]]:
    """Add differences from the map to the rows of localized photos, and store the photos if requested. Return the
    rows and notes."""
    reporter = PhotoReporter(localizer, progress)
    out: list[LocalizeRow] = []
    notes: list[str] = []
    for (name, photo), where, row in zip(named, found, rows, strict=True):
        if not where.is_placed or photo.faces:
            if where.is_placed:
                notes.append(f"{name} is a panorama, which is neither compared with the map nor kept")
            out.append(row)
            continue
        observation = reporter.compare(photo, where)
        picture = (
            None if options.pictures is None else write_picture(options.pictures, name, photo, observation, localizer)
        )
        shown = None if picture is None else os.fspath(picture)
        if options.changes:
            row = replace(row, changes=observation.rows, compared=observation.found.compared_fraction, picture=shown)
            notes += observation.notes
        if options.add:
            added, more = _add(localizer.store, reporter, photo, row, observation, options.captured_at)
            row = replace(row, added=added)
            notes += more
        out.append(row)
    return out, notes


def _add(
    store: Store,
    reporter: PhotoReporter,
    photo: Photo,
    row: LocalizeRow,
    observation: PhotoObservation,
    captured_at: str | None,
) -> tuple[bool, list[str]]:
    """Store a localized photo; return true if it is new, and notes."""
    if captured_at is not None:
        date = given_date(captured_at)
    else:
        date = photo_date(row.file) if os.path.isfile(row.file) else CaptureDate()
    sighting = localized_photo_of(store, row, photo, reporter.observed_objects(row, observation), date.when)
    if sighting is None:
        return False, [f"{row.file} was not stored: its supporting scene was removed"]
    notes = [date.note] if date.note else []
    if date.when is None:
        notes.append(f"{row.file} has no date: its observations come last in histories; set --captured-at DATE")
    added = store.photos.add(sighting, small_jpeg(photo))
    return added, notes if added else [f"{row.file} is stored already"]


def parse_lens(intrinsics: Numbers, focal: str | float | None) -> Lens:
    """Parse the lens options of `gsmap localize`.

    Raises:
        ConfigError: not four numbers, a focal length that is none, or both.
    """
    if intrinsics is not None and focal is not None:
        raise ConfigError(
            "pass --intrinsics or --focal, not both, as intrinsics include the focal length", code="conflicting_options"
        )
    if intrinsics is not None:
        model, *parts = intrinsics.split(",") if isinstance(intrinsics, str) else intrinsics
        is_model = isinstance(model, str) and model.strip().replace("_", "").isalpha()
        try:
            values = tuple(float(part) for part in (parts if is_model else (model, *parts)))
            if is_model:
                return Lens(model=(checked_model(str(model).strip().upper(), values), values))
            fx, fy, cx, cy = values
        except (ValueError, RuntimeError):
            raise ConfigError(
                "--intrinsics needs four numbers fx,fy,cx,cy, or the name of a COLMAP camera model and its parameters "
                f"(only the name for EQUIRECTANGULAR), got {intrinsics!r}",
                code="invalid_intrinsics",
            ) from None
        return Lens((fx, fy, cx, cy))
    if focal is None:
        return Lens()
    if focal == "auto":
        return Lens(use_exif=False)
    try:
        return Lens(focal_px=float(focal))
    except ValueError:
        raise ConfigError(
            f"--focal must be auto or a number of pixels, got {focal!r}", code="invalid_intrinsics"
        ) from None


def row_of(names: Mapping[str, str], file: str, found: LocalizationResult, seconds: float) -> LocalizeRow:
    """Convert a localization result to a row.

    Args:
        names: scene names by id.
    """
    row = {
        "file": file,
        "status": "placed" if found.is_placed else "refused",
        "reason_code": found.reason_code,
        "scenes": tuple(names.get(scene, scene) for scene in found.scenes),
        "seconds": seconds,
    }
    return LocalizeRow(**fields_of(found, PhotoLocalization) | row)
