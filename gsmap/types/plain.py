"""Convert values to plain JSON types."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np


def plain(value: Any) -> Any:
    """Convert any value to dicts, lists, texts and numbers.

    Floats keep their bits; NaN and infinity are kept. A value of another type becomes its text.
    """
    if value is None or (isinstance(value, (bool, int, float, str)) and not isinstance(value, np.generic)):
        return value
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    if is_dataclass(value) and not isinstance(value, type):
        return {field.name: plain(getattr(value, field.name)) for field in fields(value)}
    return str(value)


def fields_of(value: Any, cls: type) -> dict[str, Any]:
    """Return the fields that an instance of a dataclass inherits from a class."""
    return {field.name: getattr(value, field.name) for field in fields(cls)}


def canonical(value: Any) -> str:
    """Return the canonical JSON text of a value, with sorted keys, for digests."""
    return of_plain(plain(value))


def of_plain(value: Any) -> str:
    """Return the canonical JSON text of a value that consists of plain types already."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"))
