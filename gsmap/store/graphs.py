"""Scene graphs, kept under what they were made from: scene and method."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from sqlalchemy import Row, delete, insert, select

from gsmap.store.arrays import Arrays, digest
from gsmap.store.catalog import Catalog, explained, now
from gsmap.store.groups import has_group, manifest, publish
from gsmap.store.matrices import from_array, plain, to_array
from gsmap.store.scenes import resolve
from gsmap.store.schema import graphs, scenes
from gsmap.types import NodeLayer, SceneGraph

KIND = "graphs"


@dataclass(frozen=True)
class StoredGraph:
    """What the catalog knows of a graph without reading it.

    Args:
        key: digest of scene and method; registrations are keyed by it.
        scene: scene id.
        method: as given to `Graphs.save`.
        layers: number of nodes by layer.
        up: (3,) against gravity in the scene's frame, or None.
    """

    key: str
    scene: str
    method: str
    layers: dict[str, int]
    created_at: str
    up: tuple[float, ...] | None = None

    @property
    def num_nodes(self) -> int:
        return sum(self.layers.values())


def graph_key(scene_id: str, method: str) -> str:
    """The digest a graph is kept under."""
    return digest(text=f"{scene_id}\n{method}")


class Graphs:
    """The scene graphs of a map; ``method`` is any text that decides the result (a digest of segmenter, ...)."""

    def __init__(self, catalog: Catalog, arrays: Arrays) -> None:
        self._catalog = catalog
        self._arrays = arrays

    def save(self, graph: SceneGraph, method: str) -> StoredGraph:
        """Keep a graph; the same again changes nothing, another one under the same key takes its place."""
        key = graph_key(graph.scene_id, method)
        arrays: dict[str, np.ndarray] = {}
        layers: dict[str, dict] = {}
        for i, (name, nodes) in enumerate(graph.layers.items()):
            parts = {field.name: getattr(nodes, field.name) for field in fields(nodes)}
            arrays |= {f"{i}.{part}": value for part, value in parts.items() if isinstance(value, np.ndarray)}
            rest = {part: value for part, value in parts.items() if not isinstance(value, np.ndarray)}
            layers[name] = {"count": len(nodes), "rest": plain(rest)}
        about = {
            "up": from_array(graph.up),
            "unit_m": float(graph.unit_m),
            "notes": list(graph.notes),
            "layers": layers,
        }
        group_id = digest(*arrays.values(), text=f"{key}{about}")
        row = {"key": key, "scene": graph.scene_id, "method": method, "num_nodes": graph.num_nodes, "about": about}
        staging = self._arrays.stage(arrays)
        with explained(self._catalog.folder), staging as staged, self._catalog.write() as connection:
            old = connection.execute(select(graphs).where(graphs.c.key == key)).first()
            if old is not None and old.group_id == group_id:
                return _stored(old)
            resolve(connection, graph.scene_id)
            if not has_group(connection, group_id):
                publish(connection, self._arrays, staged, KIND, group_id)
            connection.execute(delete(graphs).where(graphs.c.key == key))
            connection.execute(insert(graphs), row | {"group_id": group_id, "created_at": now()})
            return _stored(connection.execute(select(graphs).where(graphs.c.key == key)).one())

    def find(self, ref: str, method: str) -> StoredGraph | None:
        """The graph of a scene by a method, if it was made."""
        with self._catalog.read() as connection:
            key = graph_key(resolve(connection, ref), method)
            row = connection.execute(select(graphs).where(graphs.c.key == key)).first()
        return None if row is None else _stored(row)

    def load(self, ref: str, method: str | None = None) -> SceneGraph | None:
        """Read the graph of a scene by a method, or the newest one; None where there is none.

        Raises:
            CorruptError: bytes on disk are missing or differ.
        """
        with self._catalog.read() as connection:
            query = (
                select(graphs).where(graphs.c.scene == resolve(connection, ref)).order_by(graphs.c.created_at.desc())
            )
            row = connection.execute(query if method is None else query.where(graphs.c.method == method)).first()
            if row is None:
                return None
            files = manifest(connection, row.group_id)
        arrays = self._arrays.read(KIND, row.group_id, files)
        layers = {}
        for i, (name, layer) in enumerate(row.about["layers"].items()):
            mine: dict[str, Any] = {
                key.split(".", 1)[1]: array for key, array in arrays.items() if key.startswith(f"{i}.")
            }
            rest = {"descriptor_id" if key == "method" else key: value for key, value in layer["rest"].items()}
            layers[name] = NodeLayer(**mine, **rest)
        return SceneGraph(row.scene, layers, to_array(row.about["up"]), row.about["unit_m"], tuple(row.about["notes"]))

    def list(self) -> list[StoredGraph]:
        """The graphs of all living scenes, oldest first."""
        query = select(graphs).join(scenes, scenes.c.id == graphs.c.scene).where(scenes.c.removed_at.is_(None))
        with self._catalog.read() as connection:
            return [_stored(row) for row in connection.execute(query.order_by(graphs.c.created_at))]


def _stored(row: Row) -> StoredGraph:
    counts = {name: layer["count"] for name, layer in row.about["layers"].items()}
    up = row.about["up"]
    return StoredGraph(row.key, row.scene, row.method, counts, row.created_at, None if up is None else tuple(up))
