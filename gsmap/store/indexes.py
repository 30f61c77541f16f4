"""Index segments of graphs and of views, and the candidates of scenes; all of this can be recomputed."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from sqlalchemy import Connection, Row, Text, delete, insert, select, type_coerce, update

from gsmap.errors import CorruptError
from gsmap.store.array_groups import manifest, publish, unless_pruned, unname
from gsmap.store.arrays import Arrays, StoredFile, digest
from gsmap.store.branches import OtherCatalogs
from gsmap.store.catalog import Catalog, now
from gsmap.store.column_types import is_index_segment
from gsmap.store.error_translation import NOT_KEPT, translate_errors
from gsmap.store.result_rows import ResultRows
from gsmap.store.scene_refs import living_ids
from gsmap.store.schema import lookups
from gsmap.types.retrieval import Candidate, IndexArrays, IndexedScene

KIND = "indexes"
_SEGMENTS = ResultRows(KIND, is_index_segment, required=("group_id",))


@dataclass(frozen=True, eq=False)
class StoredSegment:
    """A segment of an inverted index, whose arrays are read on demand.

    Args:
        id: digest of its content.
        members: its scenes; None for an outdated member.
        num_nodes: total number of nodes.
    """

    id: str
    members: Sequence[IndexedScene | None]
    num_nodes: int
    _files: tuple[StoredFile, ...]
    _arrays: Arrays
    _catalog: Catalog

    def lists(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the keys (W,) int64 of the inverted lists, and the first row (W + 1,) of each list.

        Raises:
            CorruptError: bytes on disk are missing or differ.
            NotFoundError: another process merged the segment meanwhile.
        """
        found = self._read(("keys", "starts"), None)
        return found["keys"], found["starts"]

    def rows(self, start: int, stop: int) -> np.ndarray:
        """Return the rows of nodes from ``start`` to ``stop``, uint8 (stop - start, B); raises as `lists` does."""
        return self._read(("nodes",), [(start, stop)])["nodes"]

    def _read(self, names: Sequence[str], rows: Sequence[tuple[int, int]] | None) -> dict[str, np.ndarray]:
        shapes = {"nodes": (self.num_nodes, None)}
        with unless_pruned(self._catalog, self.id, "a segment of the index was merged with others"):
            return self._arrays.read(KIND, self.id, self._files, only=names, rows=rows, shapes=shapes)


@dataclass(frozen=True)
class Lookup:
    """Candidates that the index found for a scene.

    Args:
        scene: id of the query scene.
        key: `RecipeKey.digest` of the query recipe and the scene's graph.
        candidates: best first.
        num_left: number of candidates left when the last registration run had enough edges; None before the first run.
    """

    scene: str
    key: str
    candidates: tuple[Candidate, ...]
    num_left: int | None = None


class Indexes:
    """The indexes of a map by recipe, and the lookups in the index of graphs."""

    def __init__(self, catalog: Catalog, arrays: Arrays) -> None:
        self._catalog = catalog
        self._arrays = arrays

    def segments(self, key: str) -> list[StoredSegment]:
        """Return the segments with this recipe, oldest first, without reading arrays."""
        query = _SEGMENTS.select().where(_SEGMENTS.c.key == key).order_by(_SEGMENTS.c.number)
        with self._catalog.read() as connection:
            rows = connection.execute(query).all()
            return [self._segment(row, manifest(connection, row.group_id)) for row in rows]

    def save_segment(
        self,
        key: str,
        members: Sequence[IndexedScene],
        arrays: IndexArrays,
        instead_of: Collection[str],
        beside: Collection[str] = (),
    ) -> bool:
        """Store a segment in place of ``instead_of``; delete these segments, and segments of unused recipes.

        Args:
            key: of the recipe.
            instead_of: ids of the segments whose valid members it contains.
            beside: recipes of the map's other indexes.

        Returns:
            True if it was stored; False if another process replaced one of those segments meanwhile.
        """
        member_rows = [[m.scene, m.graph, m.upright, m.metric, float(m.coarseness)] for m in members]
        group_id = digest(arrays.keys, arrays.starts, arrays.nodes, text=f"{key}{member_rows}")
        content = {"keys": arrays.keys, "starts": arrays.starts, "nodes": arrays.nodes}
        staging = self._arrays.stage(content, KIND, group_id)
        with translate_errors(self._catalog.folder, NOT_KEPT), staging as staged, self._catalog.write() as connection:
            there = connection.execute(_SEGMENTS.select(_SEGMENTS.c.group_id, _SEGMENTS.c.key)).all()
            if not set(instead_of) <= {old.group_id for old in there}:
                return False
            gone = {old.group_id for old in there if old.group_id in instead_of or old.key not in {key, *beside}}
            dropped = self._unname(connection, gone)
            known = manifest(connection, group_id)
            if not known or self._arrays.problems(KIND, group_id, known):
                publish(self._catalog, connection, self._arrays, staged, KIND, group_id)
            if group_id not in {old.group_id for old in there} - gone:  # another process stored the same segment
                _SEGMENTS.insert(
                    connection,
                    key=key,
                    scenes=" ".join(m.scene for m in members) or None,
                    num_items=len(arrays.nodes),
                    about={"members": member_rows},
                    group_id=group_id,
                )
        self._drop(dropped - {group_id})
        return True

    def forget(self, ids: Collection[str]) -> None:
        """Delete segments; the next query indexes their scenes again."""
        with self._catalog.write() as connection:
            dropped = self._unname(connection, ids)
        self._drop(dropped)

    def lookup_states(self) -> dict[str, tuple[str, int | None]]:
        """Return, for each scene, the key of its lookup and the number of candidates left (`Lookup.num_left`)."""
        columns = (type_coerce(lookups.c.scene, Text), type_coerce(lookups.c.key, Text), lookups.c.num_left)
        with self._catalog.read() as connection:  # scenes and keys are only compared
            return {scene: (key, left) for scene, key, left in connection.execute(select(*columns)).all()}

    def lookups(self, scenes: Collection[str]) -> list[Lookup]:
        """Return the stored lookups of these scenes (ids)."""
        query = select(lookups).where(lookups.c.scene.in_(sorted(scenes))).order_by(lookups.c.scene)
        with self._catalog.read() as connection:
            return [_lookup(row) for row in connection.execute(query)]

    def save_lookups(self, found: Sequence[Lookup]) -> None:
        """Store lookups in place of earlier lookups of the same scenes, and delete lookups of removed scenes."""
        rows = [
            {
                "scene": one.scene,
                "key": one.key,
                "candidates": [[c.scene, c.score, c.votes] for c in one.candidates],
                "num_left": one.num_left,
                "created_at": now(),
            }
            for one in found
        ]
        with self._catalog.write() as connection:
            living = living_ids(connection)
            known = set(connection.execute(select(type_coerce(lookups.c.scene, Text))).scalars().all())
            gone = sorted((known - set(living)) | {one.scene for one in found} & known)
            if gone:
                connection.execute(delete(lookups).where(lookups.c.scene.in_(gone)))
            if rows := [row for row in rows if row["scene"] in living]:
                connection.execute(insert(lookups), rows)

    def set_num_left(self, num_left: Mapping[str, int]) -> None:
        """Update the number of candidates left (`Lookup.num_left`) of lookups where it changed."""
        with self._catalog.write() as connection:
            query = select(lookups.c.scene, lookups.c.num_left).where(lookups.c.scene.in_(sorted(num_left)))
            for row in connection.execute(query).all():
                if row.num_left != num_left[row.scene]:
                    mine = lookups.c.scene == row.scene
                    connection.execute(update(lookups).where(mine).values(num_left=num_left[row.scene]))

    def _segment(self, row: Row[Any], files: tuple[StoredFile, ...]) -> StoredSegment:
        members = [
            IndexedScene(scene, graph, bool(up), bool(metric), c)
            for scene, graph, up, metric, c in row.about["members"]
        ]
        if row.num_items < 0:
            raise CorruptError(
                f"the catalog holds the invalid value {row.num_items} in results.num_items: restore the "
                "catalog from a backup",
                code="catalog_invalid",
            )
        return StoredSegment(row.group_id, members, row.num_items, files, self._arrays, self._catalog)

    @staticmethod
    def _unname(connection: Connection, ids: Collection[str]) -> set[str]:
        """Delete segments, and the rows that name their groups."""
        connection.execute(_SEGMENTS.delete(_SEGMENTS.c.group_id.in_(sorted(ids))))
        for group_id in ids:
            unname(connection, group_id)
        return set(ids)

    def _drop(self, group_ids: Collection[str]) -> None:
        """Delete those groups that no row of any branch names; after a crash, `prune` deletes them."""
        if not group_ids:
            return
        others = OtherCatalogs(self._arrays.root.parent, self._catalog.folder)
        with translate_errors(self._catalog.folder), self._arrays.lock():
            with self._catalog.read() as connection:
                free = [group for group in sorted(group_ids) if not manifest(connection, group)]
            for group in free:
                if not others.manifests(group):
                    self._arrays.drop(KIND, group)


def _lookup(row: Row[Any]) -> Lookup:
    candidates = tuple(Candidate(scene, float(score), float(votes)) for scene, score, votes in row.candidates)
    return Lookup(row.scene, row.key, candidates, row.num_left)
