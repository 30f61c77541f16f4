"""Filter scenes by the dates that a user specifies."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime, timedelta

from gsmap.errors import ConfigError
from gsmap.types import Scene

_DAY = len("2024-05-31")
NO_DATE = "set it with gsmap edit MAP SCENE --captured-at DATE"


def parse_moment(text: str) -> datetime:
    """Parse a date in ISO 8601; UTC if it has no zone.

    Raises:
        ConfigError: it is none.
    """
    try:
        found = datetime.fromisoformat(text)
    except ValueError as error:
        raise ConfigError(
            f"{text!r} is not a date: write it as 2024-05-31 or 2024-05-31T12:00:00+02:00", code="invalid_date"
        ) from error
    return found if found.tzinfo else found.replace(tzinfo=UTC)


def end_of_date(text: str) -> datetime:
    """Return the last moment of a date: the end of the day if the text names a day.

    Raises:
        ConfigError: it is none.
    """
    found = parse_moment(text)
    return found + timedelta(days=1, microseconds=-1) if len(text.strip()) <= _DAY else found


def is_after(text: str | None, since: datetime) -> bool:
    """Return true if a date of the catalog lies after a moment; false for None."""
    return text is not None and parse_moment(text) > since


def is_until(text: str | None, until: datetime) -> bool:
    """Return true if a date of the catalog lies at or before a moment; false for None."""
    return text is not None and parse_moment(text) <= until


def undated_note(scenes: Sequence[Scene], as_of: str) -> str:
    """Return a note on undated scenes, which an earlier state of the map leaves out; empty without undated scenes."""
    names = [scene.name for scene in scenes if scene.captured_at is None]
    if not names:
        return ""
    shown = ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")
    have = "has no date" if len(names) == 1 else "have no date"
    return f"{shown} {have}, so whether there by {as_of} is not known: left out ({NO_DATE})"


def capture_time(captured_at: str | None, came_at: str | None) -> tuple[bool, float, str]:
    """Return a sort key of scenes and photos: dated ones by date, then undated ones by arrival."""
    if captured_at is None:
        return True, 0.0, came_at or ""
    return False, parse_moment(captured_at).timestamp(), came_at or ""
