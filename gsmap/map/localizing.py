"""What people ask of localisation, as photographs; and what was found, as rows."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from gsmap.errors import ConfigError, ReadOnlyError
from gsmap.formats.scans import is_scan
from gsmap.ingest.dates import CaptureDate, given_date, photo_date
from gsmap.localize import Lens, read_clip, read_photo
from gsmap.map.localizing_scans import scan_rows
from gsmap.map.metres import metre_notes, metres_at
from gsmap.map.photo_changes import Teller, write_picture
from gsmap.map.photos import Told, sighting_of, small_jpeg
from gsmap.map.stages.localize import Localizer, Near, localize, localize_all, parse_near
from gsmap.store import Store
from gsmap.types.localization import Photo, Placement
from gsmap.types.progress import StageProgress
from gsmap.types.rows.localize import LocalizeReport, LocalizeRow

if TYPE_CHECKING:
    from gsmap.map.settings import Settings

Numbers = str | Sequence[float] | None


@dataclass(frozen=True)
class Tells:
    """What is asked of photographs that are placed.

    Args:
        changes: where they show something else than the map.
        pictures: folder for pictures with these parts drawn.
        add: keep them in the map as evidence.
        captured_at: when they were taken, as a person says; by default as the files do (EXIF).

    Raises:
        ConfigError: pictures, or a date, of what is not asked for; or no date.
    """

    changes: bool = False
    pictures: str | os.PathLike[str] | None = None
    add: bool = False
    captured_at: str | None = None

    def __post_init__(self) -> None:
        if self.pictures is not None and not self.changes:
            raise ConfigError("--pictures are of what differs: ask for it by --changes", code="missing_option")
        if self.captured_at is not None:
            if not self.add:
                raise ConfigError(
                    "--captured-at dates photographs that are kept: add them by --add", code="missing_option"
                )
            given_date(self.captured_at)


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
    masks: str | os.PathLike[str] | None = None,
    depth: str | os.PathLike[str] | None = None,
    depth_scale: float = 1000.0,
    tells: Tells | None = None,
) -> LocalizeReport:
    """Read photographs, find them, and tell of each; nothing is begun where one cannot be read. Scans go their own way.

    Args:
        together: the photographs show one place.
        video: a clip, in place of files.
        masks: a folder with a mask of each photograph: black where it does not count.
        depth: a depth picture of the view of the one photo given, which makes a scan of it.
        depth_scale: its values that make a metre.
        tells: what else is asked of photographs that are placed.
    """
    tells = tells or Tells()
    if tells.add and not store.catalog.writable:
        raise ReadOnlyError(f"{store.location} is open to be read only: photographs can be placed in it, but not kept")
    check_named(files, video, masks)
    if depth is not None and masks is not None:
        raise ConfigError(
            "--masks are of photographs: of a depth picture, set what does not count to 0", code="option_not_applicable"
        )
    lens = parse_lens(intrinsics, focal)
    if video is not None:
        return _of_pictures(store, settings, frames_of(video, lens, settings), near, True, progress, tells)
    pictures = photos_of([path for path in files if depth is None and not is_scan(path)], lens, masks)
    of_scans, notes = scan_rows(store, settings, files, depth, depth_scale, lens, near, progress)
    report = LocalizeReport(results=())
    if pictures:
        report = _of_pictures(store, settings, pictures, near, together, progress, tells)
    told = iter(report.results)
    rows = tuple(of_scans[number] if number in of_scans else next(told) for number in range(len(files)))
    return LocalizeReport(results=rows, notes=(*notes, *report.notes))


def check_named(
    files: Sequence[str | os.PathLike[str]],
    video: str | os.PathLike[str] | None,
    masks: str | os.PathLike[str] | None = None,
) -> None:
    """Refuse photographs beside a clip, and neither; and masks of a clip."""
    if video is not None and masks is not None:
        raise ConfigError(
            "--masks are of photographs, by their names: a clip's frames have none", code="option_not_applicable"
        )
    if bool(files) == (video is not None):
        raise ConfigError("name the photographs to localise, or one clip by --video", code="nothing_requested")


def photos_of(
    files: Sequence[str | os.PathLike[str]], lens: Lens, masks: str | os.PathLike[str] | None = None
) -> list[tuple[str, Photo]]:
    """Photographs by name, each with its mask where there are some."""
    return [(os.fspath(path), read_photo(path, lens, masks)) for path in files]


def frames_of(video: str | os.PathLike[str], lens: Lens, settings: Settings) -> list[tuple[str, Photo]]:
    """Frames of a clip, each named by its second."""
    clip = read_clip(video, lens, settings.localize.clips)
    return [(f"{os.fspath(video)}#{at:.2f}", photo) for at, photo in clip]


def find_all(
    localizer: Localizer,
    named: Sequence[tuple[str, Photo]],
    where: Near | None,
    together: bool,
    progress: StageProgress,
) -> list[tuple[Placement, float]]:
    """Where photographs were taken, each with the seconds it took."""
    photos = [photo for _, photo in named]
    if together:
        return list(localize_all(localizer, photos, where))
    return list(localize(localizer, photos, where, progress))


def _of_pictures(
    store: Store,
    settings: Settings,
    named: Sequence[tuple[str, Photo]],
    near: str | None,
    together: bool,
    progress: StageProgress,
    tells: Tells,
) -> LocalizeReport:
    """What is told of photographs, by name."""
    where = None if near is None else parse_near(store, near)
    localizer = Localizer(store, settings, progress)
    found = find_all(localizer, named, where, together, progress)
    names = {scene.id: scene.name for scene in store.scenes.list()}
    rows = [row_of(names, name, *one) for (name, _), one in zip(named, found, strict=True)]
    notes: list[str] = []
    if tells.changes or tells.add:
        rows, notes = _with_what_they_tell(localizer, named, [one for one, _ in found], rows, tells, progress)
    metres = metres_at(store, settings)
    components = {row.component for row in rows if row.component is not None and row.status == "placed"}
    return LocalizeReport(
        results=tuple(rows),
        notes=(*metre_notes({c: metres[c] for c in sorted(components) if c in metres}), *notes),
    )


def _with_what_they_tell(
    localizer: Localizer,
    named: Sequence[tuple[str, Photo]],
    found: Sequence[Placement],
    rows: Sequence[LocalizeRow],
    tells: Tells,
    progress: StageProgress,
) -> tuple[list[LocalizeRow], list[str]]:
    """The rows with what placed photographs show otherwise than the map, and what people should know of it; kept if
    that is asked."""
    teller = Teller(localizer, progress)
    out: list[LocalizeRow] = []
    notes: list[str] = []
    for (name, photo), where, row in zip(named, found, rows, strict=True):
        if not where.is_placed:
            out.append(row)
            continue
        told = teller.tell(photo, where)
        picture = None if tells.pictures is None else write_picture(tells.pictures, name, photo, told, localizer)
        shown = None if picture is None else os.fspath(picture)
        if tells.changes:
            row = replace(row, changes=told.rows, compared=told.found.judged, picture=shown)
            notes += told.notes
        if tells.add:
            added, more = _add(localizer.store, teller, photo, row, told, tells.captured_at)
            row = replace(row, added=added)
            notes += more
        out.append(row)
    return out, notes


def _add(
    store: Store, teller: Teller, photo: Photo, row: LocalizeRow, told: Told, captured_at: str | None
) -> tuple[bool, list[str]]:
    """Keep a placed photo; whether it is new, and what people should know."""
    if captured_at is not None:
        date = given_date(captured_at)
    else:
        date = photo_date(row.file) if os.path.isfile(row.file) else CaptureDate()
    sighting = sighting_of(store, row, photo, teller.things(row, told), date.when)
    if sighting is None:
        return False, [f"{row.file} was not kept: the scene that it was found by is gone"]
    notes = [date.note] if date.note else []
    if date.when is None:
        notes.append(f"{row.file} has no date: what it shows comes last in histories (--captured-at DATE says it)")
    added = store.photos.add(sighting, small_jpeg(photo))
    return added, notes if added else [f"{row.file} is kept already"]


def parse_lens(intrinsics: Numbers, focal: str | float | None) -> Lens:
    """What is said of the lens, as `gsmap localize` takes it.

    Raises:
        ConfigError: not four numbers, a focal length that is none, or both.
    """
    if intrinsics is not None and focal is not None:
        raise ConfigError(
            "intrinsics hold the focal length: give one of --intrinsics and --focal", code="conflicting_options"
        )
    if intrinsics is not None:
        parts = intrinsics.split(",") if isinstance(intrinsics, str) else intrinsics
        try:
            fx, fy, cx, cy = (float(part) for part in parts)
        except ValueError:
            raise ConfigError(
                f"intrinsics are four numbers fx,fy,cx,cy, got {intrinsics!r}", code="invalid_intrinsics"
            ) from None
        return Lens((fx, fy, cx, cy))
    if focal is None:
        return Lens()
    if focal == "auto":
        return Lens(ask_file=False)
    try:
        return Lens(focal_px=float(focal))
    except ValueError:
        raise ConfigError(f"a focal length is auto or pixels, got {focal!r}", code="invalid_intrinsics") from None


def row_of(names: Mapping[str, str], file: str, found: Placement, seconds: float) -> LocalizeRow:
    """What is told of one photo.

    Args:
        names: of scenes, by id.
    """
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
