"""The base class of rows and reports."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import numpy as np

from gsmap.errors import MissingDependencyError
from gsmap.texts import short
from gsmap.types.plain import plain
from gsmap.types.sim3 import Sim3

if TYPE_CHECKING:
    from pandas import DataFrame

SCHEMA = 2
"""The number under ``schema`` in all JSON output; it is raised whenever a key is removed or changes its meaning."""
_MAX_LINES = 20  # of a table's representation: the rest is counted
_MAX_TEXT = 60  # characters of a text in a row's representation
_FEW = 4  # items of a value that are shown


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

    def __init_subclass__(cls) -> None:
        # `dataclass` leaves one that the class has as it is.
        cls.__repr__ = cls.__dict__.get("__repr__", Row.__repr__)  # type: ignore[method-assign]

    def __repr__(self) -> str:
        """Return one line with what tables show of the row; long values are shortened."""
        names = self.columns or [field.name for field in fields(self)]  # type: ignore[arg-type]
        values = ((name, getattr(self, name)) for name in names)
        shown = ", ".join(
            f"{name}={_short(value)}"
            for name, value in values
            if not (value is None or (isinstance(value, str) and not value))
        )
        return f"{type(self).__name__}({shown})"

    def _repr_html_(self) -> str:
        from gsmap.types.notebook import html_facts

        names = self.columns or {field.name: field.name for field in fields(self)}  # type: ignore[arg-type]
        return html_facts(type(self).__name__, [(heading, getattr(self, name)) for name, heading in names.items()])

    def __eq__(self, other: object) -> bool:
        return type(self) is type(other) and isinstance(other, Row) and self.to_json() == other.to_json()

    __hash__ = None  # type: ignore[assignment]


def _short(value: Any) -> str:
    """Return a value for a one-line representation."""
    if isinstance(value, str):
        text = short(value)
        return repr(text if len(text) <= _MAX_TEXT else f"{text[:_MAX_TEXT]}...")
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, np.ndarray):
        return (
            np.array2string(value, precision=3, suppress_small=True)
            if value.ndim == 1 and value.size <= _FEW
            else (f"array{value.shape}")
        )
    if isinstance(value, (tuple, list)) and len(value) > _FEW:
        return f"<{len(value)} items>"
    return repr(value)


R = TypeVar("R", bound=Row)


class Table(list[R]):
    """A list of rows that a notebook shows as a table."""

    def to_pandas(self) -> DataFrame:
        """Return a `pandas.DataFrame` with a line per row: what tables show, then the other fields, values as they are.

        Arrays and poses are objects. Without rows, there are no columns.

        Raises:
            MissingDependencyError: pandas is not installed.
        """
        try:
            import pandas
        except ImportError as error:
            raise MissingDependencyError("a data frame needs pandas", extra="pandas") from error
        names = dict.fromkeys((*self[0].columns, *(field.name for field in fields(self[0])))) if self else ()  # type: ignore[arg-type]
        return pandas.DataFrame([{name: getattr(row, name) for name in names} for row in self])

    def __repr__(self) -> str:
        lines = [repr(row) for row in self[:_MAX_LINES]]
        more = [f"... {len(self) - _MAX_LINES} more"] if len(self) > _MAX_LINES else []
        return "[" + ",\n ".join([*lines, *more]) + "]"

    def _repr_html_(self) -> str:
        from gsmap.types.notebook import html_table

        return html_table(self)


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
