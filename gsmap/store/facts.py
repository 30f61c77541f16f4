"""What people said of scenes, such as names, dates and tags, with when and by whom. Nothing is overwritten."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from sqlalchemy import Connection, Row, insert, select

from gsmap.errors import CorruptError, InputError
from gsmap.store.catalog import now
from gsmap.store.schema import scene_facts
from gsmap.texts import control_characters


@dataclass(frozen=True)
class SceneFact:
    """One thing that was said of a scene.

    Args:
        kind: ``name``, ``captured_at``, ``note``, ``tag``, ``untag`` or ``metres_per_unit``.
        value: the text; empty for a ``captured_at`` or ``metres_per_unit`` that was taken back.
        author: who said it, or what did (such as the EXIF of a frame); empty where a person did and was not named.
        created_at: when it was said.
    """

    kind: str
    value: str
    author: str
    created_at: str


def say(connection: Connection, scene: str, facts: Iterable[tuple[str, str]], author: str = "") -> None:
    """Write (kind, value) facts of a scene down."""
    when = now()
    rows = [
        {"scene": scene, "kind": kind, "value": value, "author": author, "created_at": when} for kind, value in facts
    ]
    if rows:
        connection.execute(insert(scene_facts), rows)


def said(connection: Connection, scene: str) -> list[SceneFact]:
    """All facts of a scene, oldest first."""
    query = select(scene_facts).where(scene_facts.c.scene == scene).order_by(scene_facts.c.number)
    return [SceneFact(row.kind, row.value, row.author, row.created_at) for row in connection.execute(query)]


def tags(connection: Connection, scene: str | None = None) -> dict[str, tuple[str, ...]]:
    """The tags that stand, sorted, by scene id; of one scene or of all that have any."""
    query = select(scene_facts).where(scene_facts.c.kind.in_(("tag", "untag"))).order_by(scene_facts.c.number)
    rows: Iterable[Row[Any]] = connection.execute(query if scene is None else query.where(scene_facts.c.scene == scene))
    standing: dict[str, set[str]] = {}
    for row in rows:
        mine = standing.setdefault(row.scene, set())
        (mine.add if row.kind == "tag" else mine.discard)(row.value)
    return {known: tuple(sorted(mine)) for known, mine in standing.items() if mine}


def latest_notes(connection: Connection) -> dict[str, str]:
    """The last note of each scene that has any, by scene id."""
    query = select(scene_facts).where(scene_facts.c.kind == "note").order_by(scene_facts.c.number)
    return {row.scene: row.value for row in connection.execute(query)}


def told_metres(connection: Connection) -> dict[str, str]:
    """Metres per unit that people gave of scenes and did not take back, as `checked_metres` has them, by scene id.

    Raises:
        CorruptError: something else was written there.
    """
    query = select(scene_facts).where(scene_facts.c.kind == "metres_per_unit").order_by(scene_facts.c.number)
    said = {row.scene: row.value for row in connection.execute(query)}
    try:
        return {scene: checked_metres(value) for scene, value in said.items() if value}
    except InputError as error:
        raise CorruptError(
            f"the catalog holds a fact that gsmap did not write: {error}", code="catalog_invalid"
        ) from error


def checked_metres(value: float | str) -> str:
    """Metres per unit of a scene as a fact holds them: a positive number.

    Raises:
        InputError: something else.
    """
    try:
        metres = float(value)
    except ValueError:
        metres = float("nan")
    if not (math.isfinite(metres) and metres > 0):
        raise InputError(
            f"metres per unit of a scene are a positive number such as 0.3, got {value!r}", code="invalid_metre"
        )
    return repr(metres)


def checked(
    name: str | None, captured_at: str | None, note: str | None, metres_per_unit: float | None
) -> list[tuple[str, str]]:
    """What is said of a scene, as (kind, value); an empty date, or 0 metres, takes back what was said before.

    Raises:
        InputError: an empty text, one with control characters, no date, no length.
    """
    new = [] if name is None else [("name", checked_text("the name of a scene", name))]
    if captured_at is not None:
        new.append(("captured_at", captured_at and checked_date(captured_at)))
    if note is not None:
        new.append(("note", checked_text("a note", note, lines=True)))
    if metres_per_unit is not None:
        new.append(("metres_per_unit", checked_metres(metres_per_unit) if metres_per_unit else ""))
    return new


def checked_text(what: str, text: str, *, lines: bool = False) -> str:
    """A text that may be shown on a terminal: not empty, without control characters.

    Args:
        what: how messages call it.
        lines: it may have several lines.

    Raises:
        InputError: otherwise.
    """
    if not text.strip():
        raise InputError(f"{what} must not be empty", code="invalid_name")
    bad = control_characters(text, lines=lines)
    if bad:
        raise InputError(f"{what} {text!r} has a control character ({bad[0]!r}): leave it out", code="invalid_name")
    return text


def checked_date(when: str) -> str:
    """A capture date as the catalog keeps it: ISO 8601 with its zone, UTC where it has none.

    Raises:
        InputError: not a date.
    """
    try:
        parsed = datetime.fromisoformat(when)
    except ValueError as error:
        raise InputError(
            f"a capture date is ISO 8601 such as 2026-05-31T14:00:00+02:00, got {when!r}", code="invalid_date"
        ) from error
    return (parsed if parsed.tzinfo else parsed.replace(tzinfo=UTC)).isoformat()
