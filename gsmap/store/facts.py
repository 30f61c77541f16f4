"""Annotations of scenes and objects (names, dates, notes, tags, scales) with time and author, never overwritten."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from sqlalchemy import Connection, Row, insert, select

from gsmap.errors import InputError
from gsmap.store.catalog import now
from gsmap.store.column_types import malformed_as_corrupt
from gsmap.store.scene_refs import is_hexadecimal
from gsmap.store.schema import scene_facts
from gsmap.texts import control_characters
from gsmap.types.scene import SCENE_FACTS, SceneEdits


@dataclass(frozen=True)
class Fact:
    """An annotation that a person gave a scene or an object.

    Args:
        kind: of a scene one of `gsmap.types.scene.SCENE_FACTS`, of an object one of
            `gsmap.types.map_object.OBJECT_FACTS`.
        value: the text; empty if the previous value was withdrawn.
        author: person or source, such as the EXIF data of a frame; empty for an unnamed person.
        created_at: when it was given.
    """

    kind: str
    value: str
    author: str
    created_at: str


def add_facts(connection: Connection, scene: str, facts: Iterable[tuple[str, str]], author: str = "") -> None:
    """Insert facts (kind, value) about a scene."""
    when = now()
    rows = [
        {"scene": scene, "kind": kind, "value": value, "author": author, "created_at": when} for kind, value in facts
    ]
    if rows:
        connection.execute(insert(scene_facts), rows)


def list_facts(connection: Connection, scene: str) -> list[Fact]:
    """Return all facts of a scene, oldest first."""
    query = select(scene_facts).where(scene_facts.c.scene == scene).order_by(scene_facts.c.number)
    return [Fact(row.kind, row.value, row.author, row.created_at) for row in connection.execute(query)]


def current_tags(connection: Connection, scene: str | None = None) -> dict[str, tuple[str, ...]]:
    """Return the current tags, sorted, by scene id; for one scene, or for all scenes with tags."""
    query = select(scene_facts).where(scene_facts.c.kind.in_(("tag", "untag"))).order_by(scene_facts.c.number)
    rows: Iterable[Row[Any]] = connection.execute(query if scene is None else query.where(scene_facts.c.scene == scene))
    current: dict[str, set[str]] = {}
    for row in rows:
        mine = current.setdefault(row.scene, set())
        (mine.add if row.kind == "tag" else mine.discard)(row.value)
    return {known: tuple(sorted(mine)) for known, mine in current.items() if mine}


def latest_notes(connection: Connection) -> dict[str, str]:
    """Return the newest note of each scene that has one, by scene id."""
    query = select(scene_facts).where(scene_facts.c.kind == "note").order_by(scene_facts.c.number)
    return {row.scene: row.value for row in connection.execute(query)}


def specified_metres(connection: Connection) -> dict[str, str]:
    """Return the specified metres per unit by scene id, as `validated_metres` formats them; withdrawn values are left
    out.

    Raises:
        CorruptError: a value is not a scale.
    """
    query = select(scene_facts).where(scene_facts.c.kind == "metres_per_unit").order_by(scene_facts.c.number)
    values = {row.scene: row.value for row in connection.execute(query)}
    with malformed_as_corrupt("an annotation"):
        return {scene: validated_metres(value) for scene, value in values.items() if value}


def validated_metres(value: float | str) -> str:
    """Format metres per unit of a scene as stored in a fact.

    Raises:
        InputError: not a positive number.
    """
    try:
        metres = float(value)
    except ValueError:
        metres = float("nan")
    if not (math.isfinite(metres) and metres > 0):
        raise InputError(
            f"the metres per unit of a scene must be a positive number such as 0.3, got {value!r}", code="invalid_metre"
        )
    return repr(metres)


def validated_facts(edits: SceneEdits) -> list[tuple[str, str]]:
    """Validate facts about a scene; return (kind, value) of each. An empty value withdraws the previous one.

    Raises:
        InputError: an empty name or note, control characters, an invalid date or scale.
        TypeError: an edit of another name.
    """
    if unknown := edits.keys() - SceneEdits.__annotations__.keys():
        raise TypeError(f"a scene has no {', '.join(sorted(unknown))} to edit")
    given = {kind: value for kind, value in edits.items() if value is not None}
    return [(kind, _validated(kind, given[kind])) for kind in SCENE_FACTS if kind in given]


def _validated(kind: str, value: Any) -> str:
    if kind == "name":
        return validated_scene_name(value)
    if kind == "note":
        return validated_text("a note", value, lines=True)
    if not value:
        return ""
    if kind == "captured_at":
        return validated_date(value)
    return validated_metres(value) if kind == "metres_per_unit" else validated_text(f"the {kind}", value)


def validated_text(what: str, text: str, *, lines: bool = False) -> str:
    """Return a text that is safe to print: not empty and without control characters.

    Args:
        what: name of the text in messages.
        lines: allow line breaks.

    Raises:
        InputError: the text is empty or has control characters.
    """
    if not text.strip():
        raise InputError(f"{what} must not be empty", code="invalid_name")
    bad = control_characters(text, lines=lines)
    if bad:
        raise InputError(f"{what} {text!r} has a control character ({bad[0]!r}): remove it", code="invalid_name")
    return text


def validated_scene_name(name: str) -> str:
    """Return a name that a scene may have: one that is safe to print and has not the form of a scene's id.

    Raises:
        InputError: it is no such name.
    """
    if len(name) == 32 and is_hexadecimal(name):
        raise InputError(f"{name!r} has the form of the id of a scene: choose another name", code="invalid_name")
    return validated_text("the name of a scene", name)


def validated_date(when: str) -> str:
    """Format a capture date as it is stored: ISO 8601 with a time zone (default: UTC).

    Raises:
        InputError: not a date.
    """
    try:
        parsed = datetime.fromisoformat(when)
    except ValueError as error:
        raise InputError(
            f"a capture date must be in ISO 8601, such as 2026-05-31T14:00:00+02:00, got {when!r}", code="invalid_date"
        ) from error
    return (parsed if parsed.tzinfo else parsed.replace(tzinfo=UTC)).isoformat()
