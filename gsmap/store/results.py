"""Results that are computed from scenes, stored under their recipe and inputs, and computed again if lost.

All kinds of results share one table, so that purging, pruning, thinning and merging maps treat every kind alike. A new
kind needs a class in a file of its own: `DerivedArrays` with its arrays, or `ResultRows` for anything else. Workers
stage arrays, so that the process that writes the catalog inserts rows alone.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Generic, TypeVar

import numpy as np
from sqlalchemy import Connection, Row

from gsmap.errors import MALFORMED, CorruptError, InputError
from gsmap.methods import RecipeKey
from gsmap.store import recipes
from gsmap.store.array_groups import manifest, publish, unless_pruned, unname
from gsmap.store.arrays import Arrays, StagedGroup, digest
from gsmap.store.catalog import Catalog
from gsmap.store.column_types import is_counts
from gsmap.store.error_translation import NOT_KEPT, translate_errors
from gsmap.store.layout import Shape
from gsmap.store.result_rows import ResultRows
from gsmap.store.scene_refs import resolve

Value = TypeVar("Value")


@dataclass(frozen=True)
class PackedResult:
    """A result as it is stored.

    Args:
        scene: id of the scene that it was computed from.
        num_items: number of items: nodes, features, cells.
        about: metadata of its row.
        arrays: arrays of its group by name.
    """

    scene: str
    num_items: int
    about: Mapping[str, Any]
    arrays: Mapping[str, np.ndarray]


@dataclass(frozen=True)
class StagedResult:
    """A result whose arrays are staged, often by a worker. It counts once it is saved (`ArrayResults.save`).

    Args:
        scene, num_items, about: as in `PackedResult`.
        group_id: id of its array group.
        staged: the array group.
    """

    scene: str
    num_items: int
    about: Mapping[str, Any]
    group_id: str
    staged: StagedGroup


class ArrayResults(Generic[Value]):
    """Results of one kind, each of one scene and with an array group.

    Args:
        rows: their rows; the kind is also that of the array groups.
        noun: description for messages.
    """

    def __init__(self, catalog: Catalog, arrays: Arrays, rows: ResultRows, noun: str) -> None:
        self._catalog, self._arrays, self._rows, self._noun = catalog, arrays, rows, noun

    def save(self, found: Value | StagedResult, key: RecipeKey) -> int:
        """Store a result, or one that is staged already (`stage`); return the number of its items.

        Args:
            key: its recipe; the scene must be among its inputs.

        Raises:
            InputError: the scene is not among the inputs of the key.
            StoreError: a staged result is not in an inbox of this process.
        """
        with contextlib.ExitStack() as until_end:
            until_end.enter_context(translate_errors(self._catalog.folder, NOT_KEPT))
            if isinstance(found, StagedResult):
                self._check_key(found.scene, key)
                if not self._rows.is_valid(found.about):
                    raise InputError(f"a worker returned invalid metadata of {self._noun} {found.scene[:12]}")
                result = replace(found, staged=self._arrays.received(found.staged, self._rows.kind, found.group_id))
            else:
                packed, group_id = self._packed(found, key)
                staged = until_end.enter_context(self._arrays.stage(packed.arrays, self._rows.kind, group_id))
                result = StagedResult(packed.scene, packed.num_items, packed.about, group_id, staged)
            self._save(result, key)
        return result.num_items

    def stage(self, found: Value, key: RecipeKey, inbox: str) -> StagedResult:
        """Stage a result for another process to save; works with a map that is open for reading.

        Args:
            inbox: open inbox of that process (`Arrays.inbox`).

        Raises:
            OSError, StoreError: this process cannot write arrays.
        """
        packed, group_id = self._packed(found, key)
        staged = self._arrays.stage_into(inbox, packed.arrays, self._rows.kind, group_id)
        return StagedResult(packed.scene, packed.num_items, packed.about, group_id, staged)

    def stored_keys(self, keys: Iterable[RecipeKey | str]) -> set[str]:
        """Return, as digests, the keys that are stored."""
        with self._catalog.read() as connection:
            return recipes.stored_keys(connection, self._rows.c.key, keys, self._rows.c.kind == self._rows.kind)

    def _pack(self, found: Value) -> PackedResult:
        """Return the arrays and the metadata of a result."""
        raise NotImplementedError

    def _insert(self, connection: Connection, row: Mapping[str, Any]) -> None:
        """Insert the row of a result whose array group is stored, and delete the rows that it replaces."""
        raise NotImplementedError

    def _packed(self, found: Value, key: RecipeKey) -> tuple[PackedResult, str]:
        packed = self._pack(found)
        self._check_key(packed.scene, key)
        return packed, digest(*packed.arrays.values(), text=f"{key.digest}{packed.about}")

    def _check_key(self, scene: str, key: RecipeKey) -> None:
        if scene not in key.inputs:
            raise InputError(
                f"the recipe key of {self._noun} {scene} must have the scene among its inputs",
                code="key_input_mismatch",
            )

    def _save(self, found: StagedResult, key: RecipeKey) -> None:
        kind, group_id = self._rows.kind, found.group_id
        with self._catalog.write() as connection:
            resolve(connection, found.scene)
            known = manifest(connection, group_id)
            if not known or self._arrays.problems(kind, group_id, known):
                publish(self._catalog, connection, self._arrays, found.staged, kind, group_id)
            row = {"scene": found.scene, "num_items": found.num_items, "about": found.about, "group_id": group_id}
            self._insert(connection, row | {"key": key.digest, "recipe": recipes.save_recipe(connection, key)})


class DerivedArrays(ArrayResults[Value]):
    """Results of a kind of which a scene has one at most; a later one takes the place of earlier ones.

    Args:
        kind: name of the kind.
        types: type of each array.
        noun: description for messages.
    """

    def __init__(
        self, catalog: Catalog, arrays: Arrays, kind: str, types: Mapping[str, np.dtype[Any]], noun: str
    ) -> None:
        super().__init__(catalog, arrays, ResultRows(kind, is_counts), noun)
        self._kind, self._types = kind, types

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
        shapes: Callable[[Mapping[str, int]], Mapping[str, Shape]],
        parse: Callable[[Row[Any], dict[str, np.ndarray]], Value],
    ) -> Value | None:
        """Read the arrays of a scene with this key; None without such arrays.

        Args:
            shapes: returns the shapes of the arrays from the numbers that describe them.
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
            known = shapes({name: int(value) for name, value in row.about.items()})
        with unless_pruned(self._catalog, row.group_id, f"{self._noun} {scene[:12]} were computed again"):
            arrays = self._arrays.read(self._kind, row.group_id, files, only=list(known), shapes=known)
        with self._invalid_as_corrupt(scene):
            for name, dtype in self._types.items():
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
