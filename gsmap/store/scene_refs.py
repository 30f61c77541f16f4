"""Resolve references to scenes (name, id or id prefix), and find unused names."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from typing import Any

from sqlalchemy import Connection, Row, Text, select, type_coerce

from gsmap.errors import InputError, NotFoundError
from gsmap.store.catalog_rows import located_scene
from gsmap.store.schema import scenes

_MIN_PREFIX = 6  # digits of an id that are taken for it


def living_ids(connection: Connection) -> set[str]:
    """Return the ids of the living scenes."""
    ids = select(type_coerce(scenes.c.id, Text)).where(scenes.c.removed_at.is_(None))  # only compared, so not validated
    return set(connection.execute(ids).scalars().all())


def resolve(connection: Connection, ref: str) -> str:
    """Return the id of a referenced scene; see `Scenes.get`."""
    return str(find(connection, ref).id)


def scene_name(connection: Connection, ref: str) -> str:
    """Return the name of a referenced scene."""
    return str(find(connection, ref).name)


def name_taken(connection: Connection, name: str) -> bool:
    """Return True if a living scene has this name."""
    same = select(scenes.c.id).where(scenes.c.name == name, scenes.c.removed_at.is_(None))
    return connection.execute(same).first() is not None


def unused_name(connection: Connection, wanted: str) -> str:
    """Return the wanted name, or ``name-2`` and so on if a living scene has that name."""
    name, number = wanted, 2
    while name_taken(connection, name):
        name, number = f"{wanted}-{number}", number + 1
    return name


def find_living(connection: Connection, ref: str) -> Row[Any]:
    """Return the row of a referenced scene; raise `NotFoundError` if the scene was removed."""
    row = find(connection, ref)
    if row.removed_at is not None:
        raise NotFoundError(f"scene {ref} was removed on {row.removed_at}", code="scene_removed")
    return row


def find(connection: Connection, ref: str) -> Row[Any]:
    """Return the row of a referenced scene; see `Scenes.get`."""
    if (known := located_scene(connection, ref)) is not None:
        return known
    if (row := _exact(connection, ref)) is not None:
        return row
    rows = _by_prefix(connection, ref, scenes.c.removed_at.is_(None))
    if len(rows) == 1:
        return rows[0]
    if rows:
        several = ", ".join(r.name for r in rows)
        raise NotFoundError(
            f"several scene ids begin with {ref!r} ({several}): give more digits", code="scene_ambiguous"
        )
    raise NotFoundError(
        f"no scene is called {ref!r}, and no id begins with it: gsmap list MAP scenes shows the scenes",
        code="scene_not_found",
    )


def find_any(connection: Connection, ref: str) -> Row[Any]:
    """Return the row of a living scene, or else of a removed one; a name or whole id counts before an id prefix."""
    if (row := _exact(connection, ref)) is not None:
        return row
    if _removed_by_name(connection, ref):
        return find_removed(connection, ref)
    with contextlib.suppress(NotFoundError):
        return find(connection, ref)
    return find_removed(connection, ref)


def _exact(connection: Connection, ref: str) -> Row[Any] | None:
    """Return the row of the scene with an id, or else of the living scene with a name."""
    if (row := by_id(connection, ref)) is not None:
        return row
    named = select(scenes).where(scenes.c.name == ref, scenes.c.removed_at.is_(None))
    return connection.execute(named).first()


def _by_prefix(connection: Connection, ref: str, which: Any) -> Sequence[Row[Any]]:
    """Return the rows whose id begins with ``ref``, which needs at least `_MIN_PREFIX` digits: fewer are a name."""
    if len(ref) < _MIN_PREFIX or not is_hexadecimal(ref):
        return []
    return connection.execute(select(scenes).where(scenes.c.id.startswith(ref), which).limit(3)).all()


def is_hexadecimal(text: str) -> bool:
    """Return whether a text consists of the digits of ids, which are lower case."""
    return all(c in "0123456789abcdef" for c in text)


def _removed_by_name(connection: Connection, ref: str) -> Sequence[Row[Any]]:
    gone = scenes.c.removed_at.is_not(None)
    return connection.execute(select(scenes).where(gone, scenes.c.name == ref)).all()


def find_removed(connection: Connection, ref: str) -> Row[Any]:
    """Return the row of a removed scene by its id, id prefix, or last name."""
    row = by_id(connection, ref)
    named: Sequence[Row[Any]] = [row] if row is not None and row.removed_at is not None else []
    named = named or _removed_by_name(connection, ref)
    named = named or _by_prefix(connection, ref, scenes.c.removed_at.is_not(None))
    if len(named) == 1:
        return named[0]
    if named:
        several = ", ".join(f"{row.name} {row.id[:12]}" for row in named)
        raise NotFoundError(
            f"several removed scenes have the name {ref!r} ({several}): give an id", code="scene_ambiguous"
        )
    with contextlib.suppress(NotFoundError):
        raise InputError(
            f"scene {find(connection, ref).name} was not removed, so it cannot be restored", code="not_removed"
        )
    raise NotFoundError(f"no removed scene is called {ref!r}, and no id begins with it", code="scene_not_found")


def by_id(connection: Connection, wanted: str) -> Row[Any] | None:
    """Return the row of the scene with an id, living or removed; None without such a scene."""
    return connection.execute(select(scenes).where(scenes.c.id == wanted)).first()
