"""How stored results were made, each recipe once."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from sqlalchemy import ColumnElement, Connection, Row, Text, insert, select, true, type_coerce

from gsmap.errors import InputError, NotFoundError
from gsmap.methods import RecipeKey, text_digest
from gsmap.store.catalog import Catalog, now
from gsmap.store.schema import recipes
from gsmap.types.plain import canonical, plain

ASKED_AT_ONCE = 10_000  # values in one query; SQLite takes 32,766
MOST_ASKED = 5_000
"""Values that are named to a query; of more, all that there are are read instead, which is quicker."""
PARTS = ("stage", "method", "version", "settings", "backend")


class Recipes:
    """The recipes of a map, by digest (`RecipeKey.recipe`), as graphs, registrations, revisions and tiles name them."""

    def __init__(self, catalog: Catalog) -> None:
        self._catalog = catalog

    def get(self, digest: str) -> RecipeKey:
        """A recipe, without inputs.

        Raises:
            NotFoundError: no result was made so.
        """
        with self._catalog.read() as connection:
            row = connection.execute(select(recipes).where(recipes.c.digest == digest)).first()
        if row is None:
            raise NotFoundError(f"no result of this map was made by a recipe {digest}", code="recipe_not_found")
        return _recipe(row)

    def list(self) -> list[RecipeKey]:
        """All recipes, in the order of their first use."""
        with self._catalog.read() as connection:
            rows = connection.execute(select(recipes).order_by(recipes.c.created_at, recipes.c.digest)).all()
        return [_recipe(row) for row in rows]


def keep(connection: Connection, recipe: RecipeKey | Mapping[str, Any] | None) -> str | None:
    """The digest of a recipe (a key, or its `RecipeKey.to_json`), written down where it is new; None for none."""
    if not recipe:
        return None
    parts: Mapping[str, Any] = recipe.to_json() if isinstance(recipe, RecipeKey) else plain(recipe)
    if set(parts) != set(PARTS):
        raise InputError(
            f"a recipe has {', '.join(PARTS)} (RecipeKey.to_json), got {', '.join(parts)}", code="invalid_recipe"
        )
    digest = text_digest(canonical(parts))
    if connection.execute(select(recipes.c.digest).where(recipes.c.digest == digest)).first() is None:
        connection.execute(insert(recipes), {**parts, "digest": digest, "created_at": now()})
    return digest


def digest_of(key: RecipeKey | str) -> str:
    """What a result is kept under."""
    return key.digest if isinstance(key, RecipeKey) else key


def kept(
    connection: Connection,
    column: ColumnElement[str],
    keys: Iterable[RecipeKey | str],
    where: ColumnElement[bool] | None = None,
) -> set[str]:
    """Those of the keys (as digests) that a column holds, in rows that meet a condition."""
    some_of, found = {digest_of(key) for key in keys}, set()
    if len(some_of) > MOST_ASKED:  # what is only compared with needs no check (`gsmap.store.columns`)
        query = select(type_coerce(column, Text)).where(true() if where is None else where)
        return some_of.intersection(connection.execute(query).scalars().all())
    wanted = sorted(some_of)
    for start in range(0, len(wanted), ASKED_AT_ONCE):
        some = column.in_(wanted[start : start + ASKED_AT_ONCE])
        query = select(column).where(some, true() if where is None else where)
        found |= set(connection.execute(query).scalars())
    return found


def recipe_json(row: Row[Any]) -> dict[str, Any]:
    """`RecipeKey.to_json` of a row that has a recipe's columns."""
    return {part: getattr(row, part) for part in PARTS}


def _recipe(row: Row[Any]) -> RecipeKey:
    return RecipeKey(row.stage, row.method, row.version, row.settings, row.backend)
