"""Values as JSON can hold them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np


def plain(value: Any) -> Any:
    """Dicts, lists, text and numbers for any value: dataclasses and mappings become dicts, tuples and arrays lists.

    Floats keep their bits; NaN and infinity stay what they are. What is unknown becomes its text.
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


def canonical(value: Any) -> str:
    """One text for equal values, whatever the order of keys: what digests are taken of."""
    return of_plain(plain(value))


def of_plain(value: Any) -> str:
    """`canonical` of what is plain already: for long ones, most of whose time is in making sure of that."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"))
