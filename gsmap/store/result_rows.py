"""The table of results: one set of rows for each kind (`gsmap.store.results`)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

from sqlalchemy import (
    ColumnElement,
    Connection,
    Delete,
    MetaData,
    Select,
    Table,
    Text,
    delete,
    insert,
    select,
    type_coerce,
)

from gsmap.methods import RecipeKey
from gsmap.store.catalog import now
from gsmap.store.column_types import is_graph
from gsmap.store.recipes import digest_of
from gsmap.store.schema import result_columns, results


class ResultRows:
    """The rows of one kind of result.

    Args:
        kind: name of the kind, and of its array groups.
        is_valid: condition that the metadata of each row meets.
        required: columns that are not null in rows of this kind.

    Attributes:
        kind, is_valid: as given.
        c: columns of the table.
    """

    def __init__(
        self, kind: str, is_valid: Callable[[Any], bool], required: Sequence[str] = ("scene", "group_id")
    ) -> None:
        self.kind, self.is_valid = kind, is_valid
        columns = result_columns(is_valid)
        for column in columns:
            if hasattr(column.type, "for_column"):
                made: Any = column.type.for_column(f"results.{column.name} of {kind}")
                made.is_required = column.name in required
                column.type = made
        self._table = Table(results.name, MetaData(), *columns)
        self.c = self._table.c

    def select(self, *columns: Any) -> Select[Any]:
        """Select some columns of the rows, by default all."""
        return select(*(columns or (self._table,))).where(self.c.kind == self.kind)

    def delete(self, *where: ColumnElement[bool]) -> Delete:
        """Delete the rows that meet all conditions."""
        return delete(self._table).where(self.c.kind == self.kind, *where)

    def insert(self, connection: Connection, **values: Any) -> None:
        """Insert a row."""
        connection.execute(insert(self._table), {"created_at": now(), **values, "kind": self.kind})

    def has_key(self, key: RecipeKey | str) -> ColumnElement[bool]:
        """Return the condition that a row has a key."""
        return self.c.key == digest_of(key)


GRAPHS = ResultRows("graphs", is_graph)
"""Scene graphs (`gsmap.store.graphs`), of which a scene may have several."""


def delete_results_of(connection: Connection, scene: str) -> Counter[str]:
    """Delete the results that were computed from a scene, alone or with others; return their numbers by kind."""
    named = results.c.scenes.contains(scene) | type_coerce(results.c.about, Text).contains(scene)
    computed_from_it = (results.c.scene == scene) | (results.c.scene.is_(None) & named)
    counts = Counter(connection.execute(select(results.c.kind).where(computed_from_it)).scalars())
    connection.execute(delete(results).where(computed_from_it))
    return counts
