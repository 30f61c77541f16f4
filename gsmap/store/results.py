"""Results that are computed from scenes, stored under their recipe and inputs, and computed again if lost.

All kinds of results share one table, so that purging, pruning, thinning and merging maps treat every kind alike. A new
kind needs a class in a file of its own: `DerivedArrays` with its arrays, or `ResultRows` for anything else. Workers
stage arrays, so that the process that writes the catalog inserts rows alone.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, TypeVar

import numpy as np
from sqlalchemy import Connection, Row

from gsmap.errors import MALFORMED, CorruptError, InputError
from gsmap.methods import RecipeKey
from gsmap.store.array_groups import ArrayResults, manifest, unless_pruned, unname
from gsmap.store.arrays import Arrays
from gsmap.store.catalog import Catalog
from gsmap.store.column_types import is_counts
from gsmap.store.layout import Shape
from gsmap.store.result_rows import ResultRows

Value = TypeVar("Value")
ArrayTypes = Mapping[str, tuple[type[np.generic], Shape]]
"""Type and shape of each array of a result; None for an unknown length."""


class DerivedArrays(ArrayResults[Value]):
    """Results of a kind of which a scene has one at most; a later one takes the place of earlier ones.

    Args:
        kind: name of the kind.
        noun: description for messages.
    """

    def __init__(self, catalog: Catalog, arrays: Arrays, kind: str, noun: str) -> None:
        super().__init__(catalog, arrays, ResultRows(kind, is_counts), noun)
        self._kind = kind

    def _insert(self, connection: Connection, row: Mapping[str, Any]) -> None:
        rows = self._rows
        mine = rows.c.scene == row["scene"]
        older = set(connection.execute(rows.select(rows.c.group_id).where(mine)).scalars()) - {row["group_id"]}
        connection.execute(rows.delete(mine))
        for gone in older:
            unname(connection, gone)
        rows.insert(connection, **row)

    def forget_damaged(self, scenes: Iterable[str]) -> None:
        """Forget arrays of these scenes that differ from their digests; reads every byte."""
        rows = self._rows
        with self._catalog.write() as connection:
            mine = rows.select(rows.c.number, rows.c.group_id).where(rows.c.scene.in_(list(scenes)))
            for row in connection.execute(mine).all():
                if self._arrays.problems(self._kind, row.group_id, manifest(connection, row.group_id)):
                    connection.execute(rows.delete(rows.c.number == row.number))
                    unname(connection, row.group_id)

    def get(
        self,
        scene: str,
        key: RecipeKey | str,
        layout: Callable[[Mapping[str, int]], ArrayTypes],
        parse: Callable[[Row[Any], dict[str, np.ndarray]], Value],
    ) -> Value | None:
        """Read the arrays of a scene with this key; None without such arrays.

        Args:
            layout: returns the types and shapes of the arrays from the numbers that describe them.
            parse: returns what the row and the arrays describe, or raises InputError or one of `MALFORMED`.

        Raises:
            CorruptError: bytes on disk are missing, differ, or describe nothing valid.
            NotFoundError: another process replaced them meanwhile.
        """
        rows = self._rows
        wanted = rows.select().where(rows.has_key(key), rows.c.scene == scene)
        with self._catalog.read() as connection:
            row = connection.execute(wanted).first()
            if row is None:
                return None
            files = manifest(connection, row.group_id)
        with self._invalid_as_corrupt(scene):
            known = layout({name: int(value) for name, value in row.about.items()})
            shapes = {name: shape for name, (_, shape) in known.items()}
        with unless_pruned(self._catalog, row.group_id, f"{self._noun} {scene[:12]} were computed again"):
            arrays = self._arrays.read(self._kind, row.group_id, files, only=list(known), shapes=shapes)
        with self._invalid_as_corrupt(scene):
            for name, (dtype, _) in known.items():
                if arrays[name].dtype != dtype:
                    raise InputError(f"{name} are {arrays[name].dtype}", code="invalid_record")
            return parse(row, arrays)

    @contextlib.contextmanager
    def _invalid_as_corrupt(self, scene: str) -> Iterator[None]:
        try:
            yield
        except (InputError, *MALFORMED) as error:
            raise CorruptError(
                f"{self._noun} {scene[:12]} are invalid ({error}): run gsmap check", code="arrays_corrupt"
            ) from error
