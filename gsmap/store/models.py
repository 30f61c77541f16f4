"""ONNX models that the user added, by name."""

from __future__ import annotations

import contextlib
import hashlib
import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from sqlalchemy import Row, insert, select, update

from gsmap.durable import open_file, refuse_links, write_whole
from gsmap.errors import NotFoundError
from gsmap.store.arrays import Arrays
from gsmap.store.catalog import Catalog, now
from gsmap.store.column_types import corrupt_value, is_relative
from gsmap.store.error_translation import NOT_KEPT, translate_errors
from gsmap.store.facts import validated_text
from gsmap.store.schema import models
from gsmap.types.plain import plain

FOLDER = "models"


@dataclass(frozen=True)
class Model:
    """A model file.

    Args:
        name: name in this map.
        kind: purpose (``sam_encoder``, ``clip``, ...).
        path: current path.
        copied: the map has its own copy.
        sha256: of the file when it was added.
        options: input size, normalization and other options of its use.
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
    """The models of a map.

    Args:
        arrays: of the same map; model copies are stored beside them, for all branches.
    """

    def __init__(self, catalog: Catalog, arrays: Arrays) -> None:
        self._catalog = catalog
        self._arrays = arrays
        self._home = arrays.root.parent

    def add(
        self,
        name: str,
        path: str | os.PathLike[str],
        *,
        kind: str,
        options: Mapping[str, Any] | None = None,
        copy: bool = True,
    ) -> Model:
        """Add a model in place of any model with the same name.

        Args:
            copy: keep a copy in the map, so that it can be moved; otherwise store the path.

        Raises:
            NotFoundError: no such file.
        """
        source = Path(path).absolute()
        if not source.is_file():
            raise NotFoundError(f"no model file at {path}", code="file_not_found")
        validated_text("the name of a model", name)
        with open(source, "rb") as file:
            sha256 = hashlib.file_digest(file, "sha256").hexdigest()
        relative = f"{FOLDER}/{sha256[:32]}{source.suffix}"
        row = {"name": name, "kind": kind, "path": relative if copy else str(source), "copied": int(copy)}
        row |= {"sha256": sha256, "size_bytes": source.stat().st_size, "options": plain(dict(options or {}))}
        with self._catalog.write() as connection:
            if copy:
                self._catalog.hold_until_commit(self._arrays.lock())
                _copy(source, self._home / relative)
                self._arrays.upload_model(relative)
            current = (models.c.name == name) & models.c.removed_at.is_(None)
            connection.execute(update(models).where(current).values(removed_at=now()))
            connection.execute(insert(models), row | {"created_at": now()})
        return self.get(name)

    def get(self, name: str) -> Model:
        """Return a model by name.

        Raises:
            NotFoundError: no model has this name.
        """
        for model in self.list():
            if model.name == name:
                return model
        raise NotFoundError(
            f"this map has no model {name!r}: gsmap models list MAP shows the models", code="model_not_found"
        )

    def list(self) -> list[Model]:
        """Return all models, oldest first."""
        query = select(models).where(models.c.removed_at.is_(None)).order_by(models.c.number)
        with self._catalog.read() as connection:
            return [self._model(row) for row in connection.execute(query)]

    def remove(self, name: str) -> None:
        """Remove a model; `prune` reclaims its copy."""
        self.get(name)
        current = (models.c.name == name) & models.c.removed_at.is_(None)
        with self._catalog.write() as connection:
            connection.execute(update(models).where(current).values(removed_at=now()))

    def _model(self, row: Row[Any]) -> Model:
        path = model_path(self._home, row)
        if row.copied:
            with contextlib.suppress(NotFoundError):  # raised again when the model is used
                self._arrays.fetch_model(row.path)
        return Model(
            row.name, row.kind, path, bool(row.copied), row.sha256, row.size_bytes, row.created_at, row.options
        )


def model_path(folder: Path, row: Row[Any]) -> Path:
    """Return the path of a row's model: its copy in the map, or the path where it was added.

    A file outside the map is only read, and only if its digest matches (`gsmap.describe.onnx`): a map can learn nothing
    else about it.

    Raises:
        CorruptError: the copy would lie outside the map's folder of models.
    """
    if not row.copied:
        return Path(row.path)
    path: str = row.path
    above, _, name = path.partition("/")
    if above != FOLDER or "/" in name or not is_relative(path):
        raise corrupt_value("models.path", path, "a file inside the map")
    refuse_links(folder, FOLDER, name)
    return folder / path


def open_model(folder: Path, row: Row[Any]) -> int:
    """Open a row's model for reading; follow a link if the model lies outside the map, where the user may use links."""
    path = model_path(folder, row)
    return open_file(path if row.copied else path.resolve())


def _copy(source: Path, target: Path) -> None:
    """Copy a file durably; after an error, no partial copy remains."""
    refuse_links(target.parent.parent, FOLDER)
    target.parent.mkdir(exist_ok=True)
    with translate_errors(target.parent, NOT_KEPT):
        write_whole(target, partial(_fill, source))


def _fill(source: Path, target: Path) -> None:
    shutil.copyfile(source, target)
