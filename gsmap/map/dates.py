"""Dates that people give to choose by, and captures that lie before or after them."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime, timedelta

from gsmap.errors import ConfigError
from gsmap.types import Scene

_DAY = len("2024-05-31")
NO_DATE = "gsmap edit MAP SCENE --captured-at DATE tells"


def parsed(text: str) -> datetime:
    """A date that a person gave, ISO 8601; UTC where it has no zone.

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


def last_of(text: str) -> datetime:
    """The last moment of a date that a person gave: of a day its end, since who names a day means all of it.

    Raises:
        ConfigError: it is none.
    """
    found = parsed(text)
    return found + timedelta(days=1, microseconds=-1) if len(text.strip()) <= _DAY else found


def is_after(text: str | None, since: datetime) -> bool:
    """Whether a date of the catalog lies after a moment; what has no date does not."""
    return text is not None and parsed(text) > since


def is_until(text: str | None, until: datetime) -> bool:
    """Whether a date of the catalog lies at or before a moment; what has no date does not."""
    return text is not None and parsed(text) <= until


def undated_note(scenes: Sequence[Scene], as_of: str) -> str:
    """A remark on the captures that are left out of an earlier state of the map; empty where there are none."""
    names = [scene.name for scene in scenes if scene.captured_at is None]
    if not names:
        return ""
    shown = ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")
    have = "has no date" if len(names) == 1 else "have no date"
    return f"{shown} {have}, so whether there by {as_of} is not known: left out ({NO_DATE})"
