"""Array groups that are computed from one scene, stored under their recipe and inputs, and can be recomputed."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any, TypeVar

import numpy as np
from sqlalchemy import Row, Table, delete, insert, select

from gsmap.errors import MALFORMED, CorruptError, InputError
from gsmap.methods import RecipeKey
from gsmap.store import recipes
from gsmap.store.array_groups import manifest, publish, unless_pruned, unname
from gsmap.store.arrays import Arrays, digest
from gsmap.store.catalog import Catalog, now
from gsmap.store.error_translation import NOT_KEPT, translate_errors
from gsmap.store.layout import Shape
from gsmap.store.scene_refs import resolve

Value = TypeVar("Value")


class DerivedArrays:
    """Array groups of one kind, one per scene.

    Args:
        table: with the columns key, recipe, scene, group_id and created_at.
        kind: of the array groups.
        types: type of each array.
        noun: description for messages.
    """

    def __init__(
        self, catalog: Catalog, arrays: Arrays, table: Table, kind: str, types: Mapping[str, np.dtype[Any]], noun: str
    ) -> None:
        self._catalog = catalog
        self._arrays = arrays
        self._table, self._kind, self._types, self._noun = table, kind, types, noun

    def put(self, scene: str, key: RecipeKey, arrays: Mapping[str, np.ndarray], columns: Mapping[str, Any]) -> None:
        """Store arrays of a scene in place of all earlier ones of that scene.

        Args:
            key: their recipe; the scene must be among its inputs.
            columns: further columns of the row.
        """
        if scene not in key.inputs:
            raise InputError(
                f"the recipe key of {self._noun} must have their scene {scene} among its inputs",
                code="key_input_mismatch",
            )
        table, group_id = self._table, digest(*arrays.values(), text=key.digest)
        row = {"key": key.digest, "scene": scene, "group_id": group_id, **columns}
        staging = self._arrays.stage(arrays, self._kind, group_id)
        with translate_errors(self._catalog.folder, NOT_KEPT), staging as staged, self._catalog.write() as connection:
            resolve(connection, scene)
            known = manifest(connection, group_id)
            if not known or self._arrays.problems(self._kind, group_id, known):
                publish(self._catalog, connection, self._arrays, staged, self._kind, group_id)
            mine = table.c.scene == scene
            older = set(connection.execute(select(table.c.group_id).where(mine)).scalars()) - {group_id}
            connection.execute(delete(table).where(mine))
            for gone in older:
                unname(connection, gone)
            made = {"recipe": recipes.save_recipe(connection, key), "created_at": now()}
            connection.execute(insert(table), row | made)

    def stored_keys(self, keys: Iterable[RecipeKey | str]) -> set[str]:
        """Return, as digests, the keys that are stored."""
        with self._catalog.read() as connection:
            return recipes.stored_keys(connection, self._table.c.key, keys)

    def forget_damaged(self, scenes: Iterable[str]) -> None:
        """Forget arrays of these scenes that differ from their digests; reads every byte."""
        table = self._table
        with self._catalog.write() as connection:
            mine = select(table.c.key, table.c.group_id).where(table.c.scene.in_(list(scenes)))
            for row in connection.execute(mine).all():
                if self._arrays.problems(self._kind, row.group_id, manifest(connection, row.group_id)):
                    connection.execute(delete(table).where(table.c.key == row.key))
                    unname(connection, row.group_id)

    def get(
        self,
        scene: str,
        key: RecipeKey | str,
        shapes: Callable[[Row[Any]], Mapping[str, Shape]],
        parse: Callable[[Row[Any], dict[str, np.ndarray]], Value],
    ) -> Value | None:
        """Read the arrays of a scene with this key; None without such arrays.

        Args:
            shapes: returns the shapes of the arrays from the row.
            parse: returns what the row and the arrays describe, or raises InputError or one of `MALFORMED`.

        Raises:
            CorruptError: bytes on disk are missing, differ, or describe nothing valid.
            NotFoundError: another process replaced them meanwhile.
        """
        table = self._table
        wanted = table.c.key == recipes.digest_of(key)
        with self._catalog.read() as connection:
            row = connection.execute(select(table).where(wanted, table.c.scene == scene)).first()
            if row is None:
                return None
            files = manifest(connection, row.group_id)
        with unless_pruned(self._catalog, row.group_id, f"{self._noun} {scene[:12]} were computed again"):
            known = shapes(row)
            arrays = self._arrays.read(self._kind, row.group_id, files, only=list(known), shapes=known)
        try:
            for name, dtype in self._types.items():
                if arrays[name].dtype != dtype:
                    raise InputError(f"{name} are {arrays[name].dtype}", code="invalid_record")
            return parse(row, arrays)
        except (InputError, *MALFORMED) as error:
            raise CorruptError(
                f"{self._noun} {scene[:12]} are invalid ({error}): run gsmap check", code="arrays_corrupt"
            ) from error
