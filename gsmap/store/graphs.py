"""Scene graphs, which are stored under their recipe and inputs (`RecipeKey`)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from sqlalchemy import Connection, Row, Text, true, type_coerce

from gsmap.methods import RecipeKey
from gsmap.store import recipes
from gsmap.store.array_groups import ArrayResults, PackedResult, manifest, num_bytes, unless_pruned, unname
from gsmap.store.arrays import Arrays
from gsmap.store.catalog import Catalog, next_timestamp
from gsmap.store.catalog_rows import located_graphs
from gsmap.store.graph_content import from_arrays, shapes_of, to_arrays
from gsmap.store.result_rows import GRAPHS
from gsmap.store.row_index_maps import RowIndexMaps
from gsmap.store.scene_refs import resolve
from gsmap.store.schema import scenes
from gsmap.types import SceneGraph

KIND = GRAPHS.kind


@dataclass(frozen=True)
class StoredGraph:
    """A scene graph as recorded in the catalog, without its arrays.

    Args:
        key: `RecipeKey.digest`; keys of registrations include it.
        scene: scene id.
        layers: number of nodes by layer.
        unit_m: estimated metres per scene unit.
        up: (3,) direction against gravity in the scene frame, or None.
        recipe: digest of its recipe (`gsmap.store.recipes.Recipes.get`).
        notes: remarks on it.
        about_layers: ``descriptor_id`` and ``unit_m`` of each layer (`NodeLayer`).
    """

    key: str
    scene: str
    layers: dict[str, int]
    created_at: str
    unit_m: float = 1.0
    up: tuple[float, ...] | None = None
    recipe: str = ""
    notes: tuple[str, ...] = ()
    about_layers: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    @property
    def num_nodes(self) -> int:
        return sum(self.layers.values())


class Graphs(ArrayResults[SceneGraph]):
    """The scene graphs of a map, one per scene and recipe. Saving one again repairs its damaged arrays."""

    def __init__(self, catalog: Catalog, arrays: Arrays) -> None:
        super().__init__(catalog, arrays, GRAPHS, "the graph of scene")
        self._row_maps = RowIndexMaps(catalog, arrays)
        self._listed: dict[tuple[Any, ...], StoredGraph] = {}  # by number, key, array group and time of the row

    def _pack(self, graph: SceneGraph) -> PackedResult:
        arrays, about = to_arrays(self._with_whole_members(graph))
        return PackedResult(graph.scene_id, graph.num_nodes, about, arrays)

    def _insert(self, connection: Connection, row: Mapping[str, Any]) -> None:
        mine = GRAPHS.has_key(row["key"])
        old = connection.execute(GRAPHS.select().where(mine)).first()
        if old is not None:
            if old.group_id == row["group_id"]:
                return
            connection.execute(GRAPHS.delete(mine))
            if self._is_damaged(connection, old.group_id):
                unname(connection, old.group_id)
        of_scene = (GRAPHS.c.kind == KIND) & (GRAPHS.c.scene == row["scene"])
        GRAPHS.insert(connection, **row, created_at=next_timestamp(connection, GRAPHS.c.created_at, of_scene))

    def find(self, key: RecipeKey | str) -> StoredGraph | None:
        """Return the record of the graph with this key or digest; None without such a graph."""
        with self._catalog.read() as connection:
            row = connection.execute(GRAPHS.select().where(GRAPHS.has_key(key))).first()
        return None if row is None else _stored(row)

    def load(self, ref: str, key: RecipeKey | str | None = None) -> SceneGraph | None:
        """Load the graph of a scene with this key or digest, by default the newest graph; None without such a graph.

        Segment members refer to the scene's Gaussians as stored now. Segments are left out if the row map of a thinned
        scene is unknown (`gsmap.store.row_index_maps`).

        Raises:
            CorruptError: bytes on disk are missing or differ.
            NotFoundError: no such scene, or another process pruned the graph meanwhile.
        """
        with self._catalog.read() as connection:
            row = self._row(connection, resolve(connection, ref), None if key is None else recipes.digest_of(key))
            if row is None:
                return None
            files = manifest(connection, row.group_id)
        shapes = shapes_of(row.about)
        with unless_pruned(self._catalog, row.group_id, f"the graph of scene {row.scene[:12]} was dropped or replaced"):
            arrays = self._arrays.read(KIND, row.group_id, files, only=list(shapes), shapes=shapes)
        return self._with_kept_members(from_arrays(row.scene, row.about, arrays))

    def _row(self, connection: Connection, scene: str, key: str | None) -> Row[Any] | None:
        """Return the row of the newest graph of a scene, or of the graph with a key."""
        if (known := located_graphs(connection, scene)) is not None:
            return next((row for row in reversed(known) if key in (None, row.key)), None)
        query = GRAPHS.select().where(GRAPHS.c.scene == scene)
        if key is not None:
            query = query.where(GRAPHS.c.key == key)
        return connection.execute(query.order_by(GRAPHS.c.created_at.desc()).limit(1)).first()

    def _with_whole_members(self, graph: SceneGraph) -> SceneGraph:
        """Convert segment members to rows of the whole capture; see `gsmap.store.row_index_maps`."""
        if graph.segments is None:
            return graph
        members = self._row_maps.of(graph.scene_id).values_of_whole(graph.segments.members, -1)
        return replace(graph, segments=replace(graph.segments, members=members))

    def _with_kept_members(self, graph: SceneGraph) -> SceneGraph:
        """Convert segment members to rows of the stored Gaussians: the inverse of `_with_whole_members`."""
        if graph.segments is None:
            return graph
        members = self._row_maps.of(graph.scene_id).values_of_kept(graph.segments.members)
        return replace(graph, segments=None if members is None else replace(graph.segments, members=members))

    def num_bytes(self, ref: str) -> int:
        """Return the size of the arrays of all graphs of a scene, as written."""
        with self._catalog.read() as connection:
            made = GRAPHS.select(GRAPHS.c.group_id).where(GRAPHS.c.scene == resolve(connection, ref)).distinct()
            return sum(num_bytes(connection, group) for group in connection.execute(made).scalars())

    def damaged(self, keys: Iterable[RecipeKey | str]) -> set[str]:
        """Return, as digests, the keys whose graph differs from its file digests; reads every byte."""
        wanted = {recipes.digest_of(key) for key in keys}
        with self._catalog.read() as connection:
            rows = connection.execute(GRAPHS.select(GRAPHS.c.key, GRAPHS.c.group_id)).all()
            return {row.key for row in rows if row.key in wanted and self._is_damaged(connection, row.group_id)}

    def forget(self, keys: Iterable[RecipeKey | str]) -> None:
        """Delete graphs; the next prune reclaims their arrays."""
        mine = GRAPHS.c.key.in_({recipes.digest_of(key) for key in keys})
        with self._catalog.write() as connection:
            group_ids = connection.execute(GRAPHS.select(GRAPHS.c.group_id).where(mine)).scalars().all()
            connection.execute(GRAPHS.delete(mine))
            for group_id in group_ids:
                unname(connection, group_id)

    def _is_damaged(self, connection: Connection, group_id: str) -> bool:
        return bool(self._arrays.problems(KIND, group_id, manifest(connection, group_id)))

    def groups(self) -> dict[str, str]:
        """Return the scene of every graph, by array group."""
        query = GRAPHS.select(GRAPHS.c.group_id, GRAPHS.c.scene)
        with self._catalog.read() as connection:
            return {row.group_id: row.scene for row in connection.execute(query)}

    def node_counts(self) -> dict[str, int]:
        """Return the number of nodes of the newest graph of each living scene, by scene id."""
        query = GRAPHS.select(GRAPHS.c.scene, GRAPHS.c.num_items).join(scenes, scenes.c.id == GRAPHS.c.scene)
        with self._catalog.read() as connection:
            rows = connection.execute(query.where(scenes.c.removed_at.is_(None)).order_by(GRAPHS.c.created_at))
            return {row.scene: row.num_items for row in rows}

    def list(self) -> list[StoredGraph]:
        """Return the graphs of all living scenes, oldest first.

        Parsed rows are cached, because an update needs them several times.
        """
        key, group_id = (type_coerce(column, Text) for column in (GRAPHS.c.key, GRAPHS.c.group_id))  # only compared
        named = GRAPHS.select(GRAPHS.c.number, key, group_id, GRAPHS.c.created_at)
        living = named.join(scenes, scenes.c.id == GRAPHS.c.scene)
        query = living.where(scenes.c.removed_at.is_(None)).order_by(GRAPHS.c.created_at)
        with self._catalog.read() as connection:
            wanted = [tuple(row) for row in connection.execute(query).all()]
            new = [row[0] for row in wanted if row not in self._listed]
            if new:
                some = GRAPHS.c.number.in_(new) if len(new) <= recipes.MAX_NAMED_KEYS else true()
                for row in connection.execute(GRAPHS.select().where(some)).all():
                    self._listed[row.number, row.key, row.group_id, row.created_at] = _stored(row)
        return [self._listed[one] for one in wanted]


def _stored(row: Row[Any]) -> StoredGraph:
    layers = row.about["layers"]
    return StoredGraph(
        key=row.key,
        scene=row.scene,
        layers={name: layer["count"] for name, layer in layers.items()},
        created_at=row.created_at,
        unit_m=float(row.about["unit_m"]),
        up=None if row.about["up"] is None else tuple(row.about["up"]),
        recipe=row.recipe,
        notes=tuple(row.about["notes"]),
        about_layers={name: layer["rest"] for name, layer in layers.items()},
    )
