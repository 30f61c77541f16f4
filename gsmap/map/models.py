"""The ONNX models of a map, which are checked when they are added."""

from __future__ import annotations

import os
from typing import Any

from gsmap.errors import CorruptError
from gsmap.store import Store
from gsmap.types.model import ModelLimits, ModelSpec, Tensor


def add(
    store: Store, kind: str, path: str | os.PathLike[str], preset: str, copy: bool, limits: ModelLimits
) -> ModelSpec:
    """Check a model and store it in place of the previous model of its kind; see `check_model` for the errors."""
    from gsmap.describe.onnx.check import check_model  # loads the networks, which no other verb of a map needs

    spec = check_model(kind, path, preset, limits)
    store.models.add(kind, path, kind=kind, options=spec.to_json(), copy=copy)
    return spec


def specs(store: Store) -> dict[str, ModelSpec]:
    """Return the models of a map by kind."""
    return {model.kind: _spec(model.options, str(model.path)) for model in store.models.list()}


def _spec(options: dict[str, Any], path: str) -> ModelSpec:
    def tensors(rows: list[dict[str, Any]]) -> tuple[Tensor, ...]:
        return tuple(Tensor(row["name"], tuple(row["shape"]), row["dtype"]) for row in rows)

    try:
        return ModelSpec(
            kind=options["kind"],
            path=path,
            sha256=options["sha256"],
            preset=options["preset"],
            mean=tuple(options["mean"]),
            std=tuple(options["std"]),
            inputs=tensors(options["inputs"]),
            outputs=tensors(options["outputs"]),
        )
    except (KeyError, TypeError) as error:
        raise CorruptError(
            f"the catalog entry of the model {path} is invalid ({error!r}): add it again",
            code="catalog_invalid",
        ) from error
