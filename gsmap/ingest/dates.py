"""Find the date of a capture in files beside it; ignore modification times, since copying changes them."""

from __future__ import annotations

import json
import os
import re
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, TypeVar

from gsmap.errors import ConfigError, InputError
from gsmap.formats.pictures import open_picture
from gsmap.ingest.capture_search import CaptureFiles

MAX_FRAMES = 32
"""Largest number of photos that are opened to date one capture."""

_T = TypeVar("_T")
_MAX_SIDECAR_BYTES = 1 << 20  # what is larger is something else that happens to have the name
_FIRST_YEAR = 1990  # a digital camera that says less lost its clock
_PHOTOGRAPHS = ("JPEG", "TIFF", "WEBP")
_SUFFIXES = (".jpg", ".jpeg", ".tif", ".tiff", ".webp")
_EXIF_IFD, _TAKEN, _TAKEN_OFFSET = 0x8769, 0x9003, 0x9011
# Compact dates stand alone, since eight digits are often a number or part of a digest; those with their time follow a
# camera's word (DJI_20260531140000). After a minus a time has its seconds (rosbag), or is a number.
_DATE = re.compile(
    r"""(?: (?<!\d) (?P<y>\d{4}) (?P<s>[-_]) (?P<m>\d\d) (?P=s) (?P<d>\d\d) (?!\d)
          | (?<![A-Za-z0-9.]) (?P<day>\d{8}) (?![0-9A-SU-Za-z])
          | (?<=[A-Za-z][-_]) (?P<stamp>\d{14}) (?![0-9A-Za-z]) )
        (?: (?: (?:(?P<T>T)|[_\ ]) (?!\d{4}[-_]\d\d[-_]\d\d)  # another date is no time
              | - (?=\d\d[-_:]\d\d[-_:]\d\d(?!\d) | \d{6}(?:\d{3})?(?!\d)) )
            (?P<h>\d\d) (?P<t>[-_:]?) (?P<min>\d\d) (?: (?P=t) (?P<sec>\d\d) (?: (?<=\d{6}) (?P<ms>\d{3}) )? )?
            (?: \.\d{1,9} (?=Z|[-+]\d\d) )?
            (?P<z> Z | \+\d\d(?::?\d\d)? | -\d\d:\d\d  # -0700 after 140000 or 14:00, not after 14-00-00
              | (?(T)(?<=[\d:]\d\d)-(?:0\d|1[0-2])(?:00|30|45)|(?!)) )? (?![0-9A-Za-z]) )?
    """,
    re.VERBOSE | re.ASCII,
)
_ZONE_OR_NUMBER = re.compile(r"-(?:0\d|1[0-2])(?:00|30|45)(?![0-9A-Za-z])", re.ASCII)


@dataclass(frozen=True)
class CaptureDate:
    """The date of a capture, with its source.

    Args:
        when: ISO 8601 with zone; None if unknown.
        source: source of the date; empty if unknown or specified by the user.
        note: remark for the user, or empty.
    """

    when: str | None = None
    source: str = ""
    note: str = ""


def parse_date(when: str | datetime | None) -> str | None:
    """Return a date as ISO 8601 text with a zone (UTC if it has none); None for None.

    Raises:
        ConfigError: not a date.
    """
    date = _parsed(when)
    return None if date is None else _zoned(date).isoformat()


def given_date(when: str | datetime | None) -> CaptureDate:
    """Check and return the date that the user specified.

    Raises:
        ConfigError: not a date, or one that lies more than a day in the future.
    """
    date = _parsed(when)
    if date is None:
        return CaptureDate()
    known = _zoned(date).isoformat()
    if _zoned(date) > datetime.now(UTC) + timedelta(days=1):
        raise ConfigError(
            f"captured-at {known} lies in the future: correct it, or this computer's clock", code="date_in_future"
        )
    return CaptureDate(
        known, "", "" if date.tzinfo else f"dated {known} as specified: no zone was given, so UTC was assumed"
    )


def photo_date(path: str | os.PathLike[str]) -> CaptureDate:
    """Return the EXIF date of a photo; empty without a plausible date."""
    found = _exif_date(Path(path))
    if found is None:
        return CaptureDate()
    date, zoned = found
    name = shown(Path(path).name)
    if not _plausible(date, datetime.now(UTC) + timedelta(days=1)):
        return CaptureDate(note=f"no date: {_in_future(date, f'the EXIF of {name}')}")
    return _dated(date, f"the EXIF of {name}", "" if zoned else f"{name}: its EXIF has no zone, so UTC was assumed")


def find_date(
    found: CaptureFiles, cameras: Path | None = None, frames: Sequence[str] = (), *, now: datetime | None = None
) -> CaptureDate:
    """Find the date of a capture on disk.

    The sources are tried in this order: a sidecar beside the capture (``NAME.json`` or ``NAME.meta.json`` with
    ``captured_at``), where NAME is the name of its file or, for the output of trainers, of its folder; the earliest
    EXIF ``DateTimeOriginal`` of its frames; a date in the name of its file, or in the names of the folders that name or
    contain it.

    Args:
        cameras: the file or folder its cameras were read from.
        frames: the names that its cameras have, which may be those of picture files.
        now: to refuse what lies more than a day after it.

    Raises:
        InputError: a sidecar whose date is none.
    """
    latest = (now or datetime.now(UTC)) + timedelta(days=1)
    notes: list[str] = []
    date = (
        _from_sidecar(found, latest)
        or _from_frames(_photographs(found, cameras, frames), latest, notes)
        or _from_names(found, latest, notes)
        or CaptureDate()
    )
    if not notes:
        return date
    return replace(date, note="; ".join([date.note or "no date", *notes]))


def date_in_name(name: str, *, now: datetime | None = None) -> tuple[datetime | None, str]:
    """Find a date in a name such as ``hall_2026-05-31T14-00`` (UTC if it has no zone); return it with a note.

    None where there is no date, where there are several, or where it lies in the future.
    """
    notes: list[str] = []
    date, note = _date_in_name(name, (now or datetime.now(UTC)) + timedelta(days=1), notes)
    return date, "; ".join([*([note] if note else []), *notes])


def _date_in_name(name: str, latest: datetime, notes: list[str]) -> tuple[datetime | None, str]:
    """Find a date in a name; for a date in the future, append a note to ``notes`` and find none."""
    dates = [date for match in _DATE.finditer(name) if (date := _matched(match)) is not None]
    future = [day for day, _ in dates if day > latest]
    dates = [(day, note) for day, note in dates if day <= latest]
    if future and not dates:
        notes.append(_in_future(min(future), f"the name {shown(name)}"))
    if len({day.date() for day, _ in dates}) > 1:
        return None, f"the name {shown(name)} has several dates, so none was used"
    return max(dates, key=lambda date: not date[1], default=(None, ""))


def _in_future(date: datetime, source: str) -> str:
    return f"{date.isoformat()} by {source} lies in the future and was not used; check this computer's clock"


def shown(name: str) -> str:
    """Escape a file name for terminals and the catalog."""
    return "".join(c if c.isprintable() else "?" for c in name)


# --- sidecars --------------------------------------------------------------------------------------------------------


def _from_sidecar(found: CaptureFiles, latest: datetime) -> CaptureDate | None:
    for folder, name in _names(found):
        for path in (folder / f"{name}.json", folder / f"{name}.meta.json"):
            said = _captured_at(path) if name else None
            if said is None:
                continue
            try:
                date = datetime.fromisoformat(said)
            except (TypeError, ValueError) as error:
                raise InputError(
                    f"{path}: captured_at must be ISO 8601 text such as 2026-05-31T14:00:00+02:00, got {said!r}: "
                    "correct it, or give --captured-at",
                    code="invalid_date",
                ) from error
            if _zoned(date) > latest:
                raise InputError(
                    f"{path}: captured_at {said} lies in the future: correct it, or give --captured-at",
                    code="date_in_future",
                )
            return _dated(date, shown(path.name), "" if date.tzinfo else "no zone was given, so UTC was assumed")
    return None


def _captured_at(path: Path) -> Any:
    """Read the capture date from a sidecar file; None if the file is missing or has no date."""
    try:
        if not path.is_file() or path.stat().st_size > _MAX_SIDECAR_BYTES:
            return None
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}", code="file_unreadable") from error
    if b"captured_at" not in data:
        return None
    try:
        content = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} is not JSON: {error}: correct it, or give --captured-at", code="not_json") from error
    return content.get("captured_at") if isinstance(content, dict) else None


# --- photographs -----------------------------------------------------------------------------------------------------


def _photographs(found: CaptureFiles, cameras: Path | None, frames: Sequence[str]) -> list[Path]:
    """Choose evenly spaced images of a capture, found by the names of its cameras.

    Where they name none, those in ``images/`` beside it, unless other captures lie there too.
    """
    folders = [] if cameras is None else _picture_folders(cameras)
    named = [path for name in _evenly(sorted(frames)) if (path := _picture(name, folders)) is not None]
    if named:
        return named
    folder = found.path.resolve().parent / "images"
    if not found.alone or not folder.is_dir():
        return []
    return _evenly(sorted(path for path in folder.iterdir() if path.suffix.lower() in _SUFFIXES and path.is_file()))


def _picture_folders(cameras: Path) -> list[Path]:
    """Return the folders that may hold the images of a camera file or COLMAP model."""
    root = cameras.resolve()
    root = root if root.is_dir() else root.parent
    while root.name in ("0", "sparse", "colmap"):
        root = root.parent
    return [root, root / "images"]


def _picture(name: str, folders: Sequence[Path]) -> Path | None:
    """Return the image file of a camera, whose name may lack the suffix, as gaussian-splatting writes it."""
    if not name or "\0" in name:
        return None
    for folder in folders:
        for ending in ("", *_SUFFIXES, ".JPG", ".JPEG"):
            path = folder / f"{name}{ending}"
            try:
                if path.is_file():
                    return path
            except OSError:  # a name too long for a file
                return None
    return None


def _from_frames(pictures: Sequence[Path], latest: datetime, notes: list[str]) -> CaptureDate | None:
    read = [(*date, path) for path in pictures if (date := _exif_date(path)) is not None]
    taken = [one for one in read if _plausible(one[0], latest)]
    if not taken and read:
        earliest, _, path = min(read, key=lambda one: one[0])
        notes.append(_in_future(earliest, f"the EXIF of {shown(path.name)}"))
    if not taken:
        return None
    first, has_zone, path = min(taken, key=lambda one: one[0])
    last = max(one[0] for one in taken)
    note = (
        f"this is the earliest of {len(taken)} dates in {len(pictures)} frames read; the latest is {last.isoformat()}"
    )
    if not has_zone:
        note += "; no zone was given, so UTC was assumed"
    return _dated(first, f"the EXIF of {shown(path.name)}", note)


def _exif_date(path: Path) -> tuple[datetime, bool] | None:
    """Return the EXIF date of a photo, and true if it has a zone; None without a plausible date."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of large pictures and of damaged tags: only the header is read
            with open_picture(path, formats=_PHOTOGRAPHS) as picture:
                tags = picture.getexif().get_ifd(_EXIF_IFD)
        said = str(tags.get(_TAKEN, "")).strip("\0 ")
        offset = str(tags.get(_TAKEN_OFFSET, "")).strip("\0 ")
        date = datetime.strptime(said, "%Y:%m:%d %H:%M:%S")
    except Exception:  # damaged pictures raise whatever their readers do, and none of it is an answer
        return None
    zoned = re.fullmatch(r"[+-]\d\d:\d\d|Z", offset) is not None
    if zoned:
        try:
            date = datetime.fromisoformat(date.isoformat() + offset)
        except ValueError:  # an offset of more than a day
            zoned = False
    date = _zoned(date)
    return (date, zoned) if date.year >= _FIRST_YEAR else None


# --- names -----------------------------------------------------------------------------------------------------------


def _from_names(found: CaptureFiles, latest: datetime, notes: list[str]) -> CaptureDate | None:
    for name in _telling_names(found):
        date, note = _date_in_name(name, latest, notes)
        if date is not None:
            return _dated(date, f"the name {shown(name)}", note)
        if note:
            return CaptureDate(note=f"no date: {note}")
    return None


def _names(found: CaptureFiles) -> Sequence[tuple[Path, str]]:
    """Return the names of a capture (see `CaptureFiles`), or only its name with the folder of its file."""
    return found.names or ((found.path.parent, found.name),)


def _telling_names(found: CaptureFiles) -> Iterator[str]:
    """Yield the names of the capture and of its folder."""
    names = _names(found)
    around = names[-1][0].resolve()
    for folder, name in (*names, (around.parent, around.name)):
        if not (folder / name / "nerfstudio_models").is_dir():  # such a folder is named by when its training began
            yield name


def _matched(match: re.Match[str]) -> tuple[datetime, str] | None:
    """Return the date of a regular expression's match with a note; None if it is not a plausible date."""
    if match["stamp"]:
        try:
            date = _zoned(datetime.strptime(match["stamp"], "%Y%m%d%H%M%S"))
        except ValueError:
            return None
        return (date, "no zone was given, so UTC was assumed") if date.year >= _FIRST_YEAR else None
    day = match["day"] or match["y"] + match["m"] + match["d"]
    try:
        date = datetime.strptime(day, "%Y%m%d")
    except ValueError:
        return None
    note = "no time of day was given, so 00:00 UTC was assumed"
    if match["h"]:
        try:
            milliseconds = int(match["ms"] or 0)
            date = date.replace(
                hour=int(match["h"]),
                minute=int(match["min"]),
                second=int(match["sec"] or 0),
                microsecond=1000 * milliseconds,
            )
            note = "" if match["z"] else "no zone was given, so UTC was assumed"
            if not match["z"] and (unread := _ZONE_OR_NUMBER.match(match.string, match.end())) is not None:
                note = f"{unread[0]} may be a number and was not read as a zone, so UTC was assumed"
            date = datetime.fromisoformat(date.isoformat() + (match["z"] or ""))
        except ValueError:  # a number that follows, and no time
            date, note = datetime.strptime(day, "%Y%m%d"), "no time of day was given, so 00:00 UTC was assumed"
    date = _zoned(date)
    return (date, note) if date.year >= _FIRST_YEAR else None


# --- what they share -------------------------------------------------------------------------------------------------


def _parsed(when: str | datetime | None) -> datetime | None:
    try:
        return datetime.fromisoformat(when) if isinstance(when, str) else when
    except ValueError as error:
        raise ConfigError(
            f"captured-at must be ISO 8601 such as 2026-05-31T14:00:00+02:00, got {when!r}", code="invalid_date"
        ) from error


def _dated(date: datetime, source: str, note: str) -> CaptureDate:
    when = _zoned(date).isoformat()
    return CaptureDate(when, source, f"dated {when} by {source}" + (f": {note}" if note else ""))


def _zoned(date: datetime) -> datetime:
    return date if date.tzinfo else date.replace(tzinfo=UTC)


def _plausible(date: datetime, latest: datetime) -> bool:
    return date.year >= _FIRST_YEAR and date <= latest


def _evenly(things: Sequence[_T]) -> list[_T]:
    """Return at most `MAX_FRAMES` evenly spaced items, including the first and the last."""
    if len(things) <= MAX_FRAMES:
        return list(things)
    return [things[round(i * (len(things) - 1) / (MAX_FRAMES - 1))] for i in range(MAX_FRAMES)]
