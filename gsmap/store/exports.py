"""The record of exports and their tiles, by which only changed tiles are made again."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sqlalchemy import Row, func, insert, select, update

from gsmap.errors import NotFoundError
from gsmap.store import recipes
from gsmap.store.catalog import Catalog, now
from gsmap.store.matrices import from_array, from_pose, to_array, to_pose
from gsmap.store.schema import exports, tiles
from gsmap.store.schema import recipes as recipe_rows
from gsmap.types import Tile
from gsmap.types.plain import plain


@dataclass(frozen=True)
class Export:
    """One run of an export.

    Args:
        number: unique in the map, growing.
        target: absolute path of the folder or file.
        revision: number of the revision whose poses were used.
        settings: tile size, merger, format and the like, as given to `Exports.begin`.
        num_tiles: number of tiles made; unchanged tiles are not made again.
    """

    number: int
    target: str
    revision: int | None
    created_at: str
    num_tiles: int
    settings: dict[str, Any] = field(default_factory=dict)


class Exports:
    """The exports of a map. A tile belongs to a target (export folder); for each path, the newest tile is on disk."""

    def __init__(self, catalog: Catalog) -> None:
        self._catalog = catalog

    def begin(
        self, target: str | os.PathLike[str], *, revision: int | None, settings: Mapping[str, Any] | None = None
    ) -> int:
        """Record the start of an export and return its number."""
        row = {"target": _target(target), "revision": revision, "settings": plain(dict(settings or {}))}
        with self._catalog.write() as connection:
            query = insert(exports).returning(exports.c.number)
            return int(connection.execute(query, row | {"created_at": now()}).scalar_one())

    def add_tile(self, export: int, tile: Tile) -> None:
        """Record a tile that was just written, so that an interrupted export can continue.

        Raises:
            InputError: the recipe is neither empty nor a `RecipeKey.to_json`.
        """
        row = {
            "export": export,
            "key": tile.key,
            "component": int(tile.component),
            "bounds": from_array(tile.bounds),
            "poses": {scene: from_pose(pose) for scene, pose in tile.poses.items()},
            "num_gaussians": int(tile.num_gaussians),
            "truncated": int(tile.truncated),
            "path": tile.path,
            "sha256": tile.sha256,
            "notes": list(tile.notes),
            "created_at": now(),
        }
        with self._catalog.write() as connection:
            if connection.execute(select(exports.c.number).where(exports.c.number == export)).first() is None:
                raise NotFoundError(f"there is no export {export}: begin one first", code="export_not_found")
            connection.execute(insert(tiles), row | {"recipe": recipes.save_recipe(connection, tile.recipe)})

    def forget(self, target: str | os.PathLike[str], paths: Iterable[str]) -> None:
        """Mark tiles as removed from a target, by path; their rows stay as history."""
        ours = select(exports.c.number).where(exports.c.target == _target(target))
        gone = tiles.c.export.in_(ours) & tiles.c.path.in_(list(paths)) & tiles.c.removed_at.is_(None)
        with self._catalog.write() as connection:
            connection.execute(update(tiles).where(gone).values(removed_at=now()))

    def tiles(self, target: str | os.PathLike[str]) -> list[Tile]:
        """Return the current tiles of a target, by path."""
        query = (
            select(tiles, *(column for column in recipe_rows.c if column.name in recipes.PARTS))
            .join(exports, exports.c.number == tiles.c.export)
            .outerjoin(recipe_rows, recipe_rows.c.digest == tiles.c.recipe)
            .where(exports.c.target == _target(target), tiles.c.removed_at.is_(None))
            .order_by(tiles.c.number)
        )
        with self._catalog.read() as connection:
            newest = {row.path: row for row in connection.execute(query)}
        return [_tile(newest[path]) for path in sorted(newest)]

    def targets(self) -> list[str]:
        """Return every target with current tiles."""
        query = select(exports.c.target).join(tiles).where(tiles.c.removed_at.is_(None)).distinct()
        with self._catalog.read() as connection:
            return sorted(connection.execute(query).scalars())

    def list(self) -> list[Export]:
        """Return all exports, oldest first."""
        count = func.count(tiles.c.number).label("num_tiles")
        query = select(exports, count).outerjoin(tiles).group_by(exports.c.number).order_by(exports.c.number)
        with self._catalog.read() as connection:
            return [
                Export(r.number, r.target, r.revision, r.created_at, r.num_tiles, r.settings)
                for r in connection.execute(query)
            ]


def _target(path: str | os.PathLike[str]) -> str:
    return str(Path(path).resolve())


def _tile(row: Row[Any]) -> Tile:
    return Tile(
        key=row.key,
        component=row.component,
        bounds=to_array(row.bounds),
        poses={scene: to_pose(pose) for scene, pose in row.poses.items()},
        num_gaussians=row.num_gaussians,
        recipe={} if row.recipe is None else recipes.recipe_json(row),
        truncated=bool(row.truncated),
        path=row.path,
        sha256=row.sha256,
        notes=tuple(row.notes),
    )
