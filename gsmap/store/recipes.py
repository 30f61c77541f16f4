"""Recipes of stored results, each stored once."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from sqlalchemy import ColumnElement, Connection, Row, Text, insert, select, true, type_coerce

from gsmap.errors import InputError, NotFoundError
from gsmap.methods import RecipeKey, text_digest
from gsmap.store.catalog import Catalog, now
from gsmap.store.schema import recipes
from gsmap.types.plain import canonical, plain

KEYS_PER_QUERY = 10_000  # values in one query; SQLite takes 32,766
MAX_NAMED_KEYS = 5_000
"""Maximum number of keys named in a query; for more, reading all rows is quicker."""
PARTS = ("stage", "method", "version", "settings", "backend")


class Recipes:
    """The recipes of a map by digest (`RecipeKey.recipe`), referenced by graphs, registrations, revisions and tiles."""

    def __init__(self, catalog: Catalog) -> None:
        self._catalog = catalog

    def get(self, digest: str) -> RecipeKey:
        """Return a recipe, without inputs.

        Raises:
            NotFoundError: no result has this recipe.
        """
        with self._catalog.read() as connection:
            row = connection.execute(select(recipes).where(recipes.c.digest == digest)).first()
        if row is None:
            raise NotFoundError(f"this map has no result of the recipe {digest}", code="recipe_not_found")
        return _recipe(row)

    def list(self) -> list[RecipeKey]:
        """Return all recipes, in the order of their first use."""
        with self._catalog.read() as connection:
            rows = connection.execute(select(recipes).order_by(recipes.c.created_at, recipes.c.digest)).all()
        return [_recipe(row) for row in rows]


def save_recipe(connection: Connection, recipe: RecipeKey | Mapping[str, Any] | None) -> str | None:
    """Store a recipe (a key, or its `RecipeKey.to_json`) if it is new, and return its digest; None for None."""
    if not recipe:
        return None
    parts: Mapping[str, Any] = recipe.to_json() if isinstance(recipe, RecipeKey) else plain(recipe)
    if set(parts) != set(PARTS):
        raise InputError(
            f"a recipe must have {', '.join(PARTS)} (RecipeKey.to_json), got {', '.join(parts)}", code="invalid_recipe"
        )
    digest = text_digest(canonical(parts))
    if connection.execute(select(recipes.c.digest).where(recipes.c.digest == digest)).first() is None:
        connection.execute(insert(recipes), {**parts, "digest": digest, "created_at": now()})
    return digest


def digest_of(key: RecipeKey | str) -> str:
    """Return the digest of a key, which may be a digest already."""
    return key.digest if isinstance(key, RecipeKey) else key


def stored_keys(
    connection: Connection,
    column: ColumnElement[str],
    keys: Iterable[RecipeKey | str],
    where: ColumnElement[bool] | None = None,
) -> set[str]:
    """Return, as digests, the keys that a column contains in rows that meet a condition."""
    some_of, found = {digest_of(key) for key in keys}, set()
    if len(some_of) > MAX_NAMED_KEYS:  # compared values need no validation (`gsmap.store.column_types`)
        query = select(type_coerce(column, Text)).where(true() if where is None else where)
        return some_of.intersection(connection.execute(query).scalars().all())
    wanted = sorted(some_of)
    for start in range(0, len(wanted), KEYS_PER_QUERY):
        some = column.in_(wanted[start : start + KEYS_PER_QUERY])
        query = select(column).where(some, true() if where is None else where)
        found |= set(connection.execute(query).scalars())
    return found


def recipe_json(row: Row[Any]) -> dict[str, Any]:
    """Return `RecipeKey.to_json` of a row with the columns of a recipe."""
    return {part: getattr(row, part) for part in PARTS}


def _recipe(row: Row[Any]) -> RecipeKey:
    return RecipeKey(row.stage, row.method, row.version, row.settings, row.backend)
