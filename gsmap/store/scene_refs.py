"""What people call a scene by: its name, its id, the beginning of its id; and which names are free."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from typing import Any

from sqlalchemy import Connection, Row, Text, select, type_coerce

from gsmap.errors import InputError, NotFoundError
from gsmap.store.schema import scenes


def living_ids(connection: Connection) -> set[str]:
    """Of the scenes that were not removed."""
    ids = select(type_coerce(scenes.c.id, Text)).where(scenes.c.removed_at.is_(None))  # to be compared with
    return set(connection.execute(ids).scalars().all())


def resolve(connection: Connection, ref: str) -> str:
    """The id that a ref means; see `Scenes.get`."""
    return str(find(connection, ref).id)


def scene_name(connection: Connection, ref: str) -> str:
    """What people call the scene that a ref means."""
    return str(find(connection, ref).name)


def name_taken(connection: Connection, name: str) -> bool:
    """Whether a living scene is called so."""
    same = select(scenes.c.id).where(scenes.c.name == name, scenes.c.removed_at.is_(None))
    return connection.execute(same).first() is not None


def free_name(connection: Connection, wanted: str) -> str:
    """The name, or ``name-2`` and so on where living scenes have it."""
    name, number = wanted, 2
    while name_taken(connection, name):
        name, number = f"{wanted}-{number}", number + 1
    return name


def alive(connection: Connection, ref: str) -> Row[Any]:
    """As `find`, and NotFoundError where it was removed."""
    row = find(connection, ref)
    if row.removed_at is not None:
        raise NotFoundError(f"scene {ref} was removed on {row.removed_at}", code="scene_removed")
    return row


def find(connection: Connection, ref: str) -> Row[Any]:
    """The row that a ref means; see `Scenes.get`."""
    living = scenes.c.removed_at.is_(None)
    row = connection.execute(select(scenes).where(scenes.c.name == ref, living)).first() or by_id(connection, ref)
    if row is not None:
        return row
    rows: Sequence[Row[Any]] = []
    if ref and all(c in "0123456789abcdef" for c in ref):
        rows = connection.execute(select(scenes).where(scenes.c.id.startswith(ref), living).limit(3)).all()
    if len(rows) == 1:
        return rows[0]
    if rows:
        several = ", ".join(r.name for r in rows)
        raise NotFoundError(
            f"{ref!r} is the beginning of several scene ids ({several}): add digits", code="scene_ambiguous"
        )
    raise NotFoundError(
        f"no scene is called {ref!r}, and no id begins so: gsmap list MAP scenes shows what there is",
        code="scene_not_found",
    )


def find_removed(connection: Connection, ref: str) -> Row[Any]:
    """A removed scene by its id, the beginning of it, or its last name."""
    gone = scenes.c.removed_at.is_not(None)
    named = connection.execute(select(scenes).where(gone, (scenes.c.id == ref) | (scenes.c.name == ref))).all()
    if not named and ref and all(c in "0123456789abcdef" for c in ref):
        named = connection.execute(select(scenes).where(gone, scenes.c.id.startswith(ref))).all()
    if len(named) == 1:
        return named[0]
    if named:
        several = ", ".join(f"{row.name} {row.id[:12]}" for row in named)
        raise NotFoundError(
            f"several removed scenes are called {ref!r} ({several}): give more of an id", code="scene_ambiguous"
        )
    with contextlib.suppress(NotFoundError):
        raise InputError(
            f"scene {find(connection, ref).name} was not removed: there is nothing to bring back", code="not_removed"
        )
    raise NotFoundError(f"no removed scene is called {ref!r}, and no id begins so", code="scene_not_found")


def by_id(connection: Connection, wanted: str) -> Row[Any] | None:
    """The row of an id, living or removed; None where there is none."""
    return connection.execute(select(scenes).where(scenes.c.id == wanted)).first()
