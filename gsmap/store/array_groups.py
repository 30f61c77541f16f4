"""Publish and delete array groups together with the catalog rows that name them, such as results (`ArrayResults`)."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Generic, TypeVar

import numpy as np
from sqlalchemy import Connection, delete, insert, select

from gsmap.errors import CorruptError, InputError, NotFoundError
from gsmap.methods import RecipeKey
from gsmap.store import recipes
from gsmap.store.arrays import Arrays, StagedGroup, StoredFile, digest
from gsmap.store.branches import OtherCatalogs
from gsmap.store.catalog import Catalog, now
from gsmap.store.catalog_rows import located_files
from gsmap.store.error_translation import NOT_KEPT, translate_errors
from gsmap.store.result_rows import ResultRows
from gsmap.store.scene_refs import resolve
from gsmap.store.schema import files, groups, results

Value = TypeVar("Value")


def has_group(connection: Connection, group_id: str) -> bool:
    return connection.execute(select(groups.c.id).where(groups.c.id == group_id)).first() is not None


def publish(
    catalog: Catalog, connection: Connection, arrays: Arrays, staged: StagedGroup, kind: str, group_id: str
) -> None:
    """Move a staged group to its final path and insert its rows, inside a write transaction; replace a damaged group.

    Where another branch has the group and its files are sound, they are kept with that branch's manifest.
    """
    catalog.hold_until_commit(arrays.lock())
    known = OtherCatalogs(arrays.root.parent, catalog.folder).manifests(group_id)
    whole = next((manifest for manifest in known if not arrays.problems(kind, group_id, manifest)), None)
    if whole is None:
        arrays.publish(staged, kind, group_id)
    name(connection, kind, group_id, staged.files if whole is None else whole)


def name(connection: Connection, kind: str, group_id: str, manifest: Sequence[StoredFile]) -> None:
    """Insert the rows that name a group and its files."""
    if not has_group(connection, group_id):
        connection.execute(insert(groups), {"id": group_id, "kind": kind, "created_at": now()})
    connection.execute(delete(files).where(files.c.group_id == group_id))
    rows = [{"group_id": group_id, "path": f.path, "size_bytes": f.size_bytes, "sha256": f.sha256} for f in manifest]
    connection.execute(insert(files), rows)


def unname(connection: Connection, group_id: str) -> None:
    """Delete the rows that name a group; rows that refer to the group must change in the same transaction."""
    connection.execute(delete(files).where(files.c.group_id == group_id))
    connection.execute(delete(groups).where(groups.c.id == group_id))


def forget_derived(connection: Connection, scene: str) -> None:
    """Delete the results of one scene, as its stored Gaussians change."""
    of_scene = results.c.scene == scene
    old = connection.execute(select(results.c.group_id).where(of_scene, results.c.group_id.is_not(None)))
    groups = set(old.scalars())
    connection.execute(delete(results).where(of_scene))
    for group in groups:
        unname(connection, group)


@contextlib.contextmanager
def unless_pruned(catalog: Catalog, group_id: str, gone: str) -> Iterator[None]:
    """Raise `NotFoundError` instead of `CorruptError` if the group was pruned while it was read.

    Args:
        gone: description of what happened to the group, for the message.

    Raises:
        NotFoundError: the group could not be read, and no row names it any more.
    """
    try:
        yield
    except CorruptError:
        with catalog.read(newest=True) as connection:
            if has_group(connection, group_id):
                raise
        raise NotFoundError(
            f"{gone}, and its arrays were pruned during the read: try again", code="changed_meanwhile"
        ) from None


def num_bytes(connection: Connection, group_id: str) -> int:
    """Return the size of a group's files in bytes, as they were written."""
    return sum(file.size_bytes for file in manifest(connection, group_id))


def manifest(connection: Connection, group_id: str) -> tuple[StoredFile, ...]:
    """Return the files of a group with their digests."""
    if (known := located_files(connection, group_id)) is not None:
        return known
    rows = connection.execute(select(files).where(files.c.group_id == group_id).order_by(files.c.path))
    return tuple(StoredFile(r.path, r.size_bytes, r.sha256) for r in rows)


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
                    raise InputError(
                        f"a worker returned invalid metadata of {self._noun} {found.scene[:12]}", code="invalid_record"
                    )
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
