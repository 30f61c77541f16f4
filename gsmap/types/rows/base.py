"""The base class of rows and reports."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields
from typing import Any, ClassVar, TypeVar

import numpy as np

from gsmap.types.notebook import html_facts, html_table
from gsmap.types.plain import plain
from gsmap.types.sim3 import Sim3

SCHEMA = 2
"""The number under ``schema`` in all JSON output; it is raised whenever a key is removed or changes its meaning."""


class Row:
    """Base class of all rows and reports: frozen dataclasses; two are equal if their JSON is equal."""

    columns: ClassVar[Mapping[str, str]] = {}
    """Heading of each field or property that a table shows, in the order of the columns."""

    def to_json(self) -> dict[str, Any]:
        """Return all fields as JSON values: poses as 4x4 matrices, arrays as lists, NaN and infinity as null."""
        return {field.name: _json(getattr(self, field.name)) for field in fields(self)}  # type: ignore[arg-type]

    def cells(self) -> list[Any]:
        """Return the values of this row's line in a table, in the order of ``columns``."""
        return [getattr(self, name) for name in self.columns]

    def _repr_html_(self) -> str:
        names = self.columns or {field.name: field.name for field in fields(self)}  # type: ignore[arg-type]
        return html_facts(type(self).__name__, [(heading, getattr(self, name)) for name, heading in names.items()])

    def __eq__(self, other: object) -> bool:
        return type(self) is type(other) and isinstance(other, Row) and self.to_json() == other.to_json()

    __hash__ = None  # type: ignore[assignment]


R = TypeVar("R", bound=Row)


class Table(list[R]):
    """A list of rows that a notebook shows as a table."""

    def _repr_html_(self) -> str:
        return html_table(self[0].columns, self) if self else "<p>none</p>"


def coordinates(world: np.ndarray | None) -> str | None:
    """Format world coordinates with a precision of a tenth of a millimetre, however large they are."""
    if world is None:
        return None
    degrees = abs(world[0]) <= 360 and abs(world[1]) <= 90
    return " ".join(f"{value:.{9 if degrees and k < 2 else 4}f}" for k, value in enumerate(np.asarray(world).tolist()))


def _json(value: Any) -> Any:
    if isinstance(value, Row):
        return value.to_json()
    if isinstance(value, Sim3):
        return _json(value.matrix())
    if isinstance(value, Mapping):
        return {str(key): _json(item) for key, item in value.items()}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [_json(item) for item in value]
    value = plain(value)
    return None if isinstance(value, float) and not math.isfinite(value) else value
