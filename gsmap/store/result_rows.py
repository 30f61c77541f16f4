"""The table of results: one set of rows for each kind (`gsmap.store.results`)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any

from sqlalchemy import ColumnElement, Connection, Delete, MetaData, Select, Table, delete, insert, select

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

    Attributes:
        c: columns of the table.
    """

    def __init__(self, kind: str, is_valid: Callable[[Any], bool]) -> None:
        self.kind = kind
        columns = result_columns(is_valid)
        for column in columns:
            if hasattr(column.type, "for_column"):
                column.type = column.type.for_column(f"results.{column.name} of {kind}")
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
    computed_from_it = (results.c.scene == scene) | results.c.scenes.contains(scene)
    counts = Counter(connection.execute(select(results.c.kind).where(computed_from_it)).scalars())
    connection.execute(delete(results).where(computed_from_it))
    return counts
