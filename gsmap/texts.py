"""Texts that people read: values as tables show them, and what must never reach a terminal as it is."""

from __future__ import annotations

import unicodedata
from collections.abc import Mapping, Sequence
from typing import Any

# Cc, Cs: escape sequences, line breaks, halves of characters. Zl, Zp: line breaks of another kind.
_CATEGORIES = ("Cc", "Cs", "Zl", "Zp")
_TURNING = frozenset("\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069")  # make a text read as another one


def control_characters(text: str, *, lines: bool = False) -> list[str]:
    """The characters of a text that steer a terminal instead of showing something, in order.

    Args:
        lines: a line feed is none of them.
    """
    if text.isascii() and text.isprintable():
        return []
    return [c for c in text if _steers(c) and not (lines and c == "\n")]


def escaped(text: str, *, lines: bool = False) -> str:
    r"""A text as a terminal may have it: control characters as ``\x1b`` and the like, everything else as it is.

    Args:
        lines: line feeds stay.
    """
    if not control_characters(text, lines=lines):
        return text
    parts = (c.encode("unicode_escape").decode() if _steers(c) and not (lines and c == "\n") else c for c in text)
    return "".join(parts)


def shown(value: Any, *, lines: bool = False) -> str:
    """A value as people read it in a table; control characters are escaped, whoever wrote them.

    Args:
        lines: line breaks stay.
    """
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, Mapping):
        return ", ".join(f"{escaped(str(name))} {shown(item, lines=lines)}" for name, item in value.items())
    if hasattr(value, "tolist"):  # numpy arrays
        return " ".join(shown(item) for item in value.tolist())
    if isinstance(value, (list, tuple)):
        return ", ".join(shown(item, lines=lines) for item in value)
    return escaped(str(value), lines=lines)


def _steers(c: str) -> bool:
    return c in _TURNING or unicodedata.category(c) in _CATEGORIES


def few(names: Sequence[str], most: int = 5) -> str:
    """The first of some names, and how many more there are."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")
