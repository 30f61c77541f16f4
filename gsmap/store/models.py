"""ONNX models that the user gave, by name."""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from sqlalchemy import Row, insert, select, update

from gsmap.durable import write_whole
from gsmap.errors import InputError, NotFoundError
from gsmap.store.catalog import Catalog, now
from gsmap.store.explained import NOT_KEPT, explained
from gsmap.store.schema import models
from gsmap.types.plain import plain

FOLDER = "models"


@dataclass(frozen=True)
class Model:
    """A model file.

    Args:
        name: how it is called in this map.
        kind: what it is for (``sam_encoder``, ``clip``, ...).
        path: where it lies now.
        copied: whether the map has its own copy.
        sha256: of the file when it was added.
        options: input size, normalisation and what else its user needs.
    """

    name: str
    kind: str
    path: Path
    copied: bool
    sha256: str
    size_bytes: int
    created_at: str
    options: dict[str, Any] = field(default_factory=dict)


class Models:
    """The models of a map."""

    def __init__(self, catalog: Catalog) -> None:
        self._catalog = catalog

    def add(
        self,
        name: str,
        path: str | os.PathLike[str],
        *,
        kind: str,
        options: Mapping[str, Any] | None = None,
        copy: bool = True,
    ) -> Model:
        """Add a model, in place of the one of that name.

        Args:
            copy: keep a copy in the map, so that it can move; else remember the path.

        Raises:
            NotFoundError: no such file.
        """
        source = Path(path).absolute()
        if not source.is_file():
            raise NotFoundError(f"no model file at {path}")
        if not name:
            raise InputError("a model needs a name")
        with open(source, "rb") as file:
            sha256 = hashlib.file_digest(file, "sha256").hexdigest()
        relative = f"{FOLDER}/{sha256[:32]}{source.suffix}"
        row = {"name": name, "kind": kind, "path": relative if copy else str(source), "copied": int(copy)}
        row |= {"sha256": sha256, "size_bytes": source.stat().st_size, "options": plain(dict(options or {}))}
        with self._catalog.write() as connection:
            if copy:
                _copy(source, self._catalog.folder / relative)
            standing = (models.c.name == name) & models.c.removed_at.is_(None)
            connection.execute(update(models).where(standing).values(removed_at=now()))
            connection.execute(insert(models), row | {"created_at": now()})
        return self.get(name)

    def get(self, name: str) -> Model:
        """One model by name.

        Raises:
            NotFoundError: none is called so.
        """
        for model in self.list():
            if model.name == name:
                return model
        raise NotFoundError(f"no model is called {name!r}: gsmap models list MAP shows what there is")

    def list(self) -> list[Model]:
        """All models, oldest first."""
        query = select(models).where(models.c.removed_at.is_(None)).order_by(models.c.number)
        with self._catalog.read() as connection:
            return [self._model(row) for row in connection.execute(query)]

    def remove(self, name: str) -> None:
        """Forget a model; its copy is reclaimed by `prune`."""
        self.get(name)
        standing = (models.c.name == name) & models.c.removed_at.is_(None)
        with self._catalog.write() as connection:
            connection.execute(update(models).where(standing).values(removed_at=now()))

    def _model(self, row: Row[Any]) -> Model:
        path = self._catalog.folder / row.path if row.copied else Path(row.path)
        return Model(
            row.name, row.kind, path, bool(row.copied), row.sha256, row.size_bytes, row.created_at, row.options
        )


def _copy(source: Path, target: Path) -> None:
    """Copy a file durably; it appears whole or not at all."""
    target.parent.mkdir(exist_ok=True)
    with explained(target.parent, NOT_KEPT):
        write_whole(target, partial(_fill, source))


def _fill(source: Path, target: Path) -> None:
    shutil.copyfile(source, target)
