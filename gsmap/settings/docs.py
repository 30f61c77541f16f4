"""Read the meaning and unit of settings from docstrings."""

from __future__ import annotations

import inspect
import re
from functools import lru_cache

# Endings of names that say a unit; the longest one counts.
_UNITS = {
    "_m": "m",
    "_m2": "m^2",
    "_cm": "cm",
    "_px": "px",
    "_s": "s",
    "_rad": "rad",
    "_deg": "deg",
    "_db": "dB",
    "_days": "days",
    "_mb": "MB",
}
_ENTRY = re.compile(r"^(?P<names>[A-Za-z_]\w*(?:, [A-Za-z_]\w*)*): (?P<text>.*)$")


@lru_cache(maxsize=512)
def field_docs(cls: type) -> dict[str, str]:
    """Return the meaning of each field of a dataclass, from the ``Args:`` of its docstring; fields may share an entry.

    A docstring may also begin with ``Args:``, followed by a remark in brackets on the units.
    """
    lines = inspect.cleandoc(cls.__doc__ or "").splitlines()
    start = next((i for i, line in enumerate(lines) if line.startswith("Args")), None)
    if start is None:
        return {}
    body = lines[start + 1 :]
    width = next((len(line) - len(line.lstrip()) for line in body if line.strip()), 0)
    out: dict[str, str] = {}
    names: list[str] = []
    for line in body:
        if line.strip() and line[:width].strip():  # the next section, such as Raises:
            break
        text = line[width:]
        entry = _ENTRY.match(text)
        if entry:
            names = entry["names"].split(", ")
            for name in names:
                out[name] = entry["text"]
        elif text.startswith(" ") and names:
            for name in names:
                out[name] += " " + text.strip()
        elif text.strip():
            break
    return out


def unit_of(name: str) -> str:
    """Return the unit from the suffix of a field's name, or an empty text."""
    parts = [ending for ending in _UNITS if name.endswith(ending)]
    return _UNITS[max(parts, key=len)] if parts else ""
