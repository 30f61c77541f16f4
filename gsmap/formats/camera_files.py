"""Helpers for all camera files: read JSON, and make camera names unique."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from gsmap.errors import InputError, NotFoundError


def load_json(path: Path) -> Any:
    if not path.exists():
        raise NotFoundError(f"cannot read cameras from {path}: no such file", code="file_not_found")
    try:
        return json.loads(path.read_bytes())
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} is not JSON: {error}", code="not_json") from error


def unique(names: list[str]) -> tuple[str, ...]:
    """Return the names, with ``#2``, ``#3`` and so on appended to repeated names."""
    seen: dict[str, int] = {}
    out = []
    for name in names:
        seen[name] = seen.get(name, 0) + 1
        out.append(name if seen[name] == 1 else f"{name}#{seen[name]}")
    return tuple(out)
