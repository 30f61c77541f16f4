"""Format values for people, with control characters escaped."""

from __future__ import annotations

import unicodedata
from collections.abc import Mapping, Sequence
from typing import Any

# Cc, Cs: escape sequences, line breaks, halves of characters. Zl, Zp: line breaks of another kind.
_CATEGORIES = ("Cc", "Cs", "Zl", "Zp")
# Bidirectional overrides, which disguise a text.
_TURNING = frozenset("\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069")


def control_characters(text: str, *, lines: bool = False) -> list[str]:
    """Return the characters of a text that control a terminal, in order.

    Args:
        lines: allow line feeds.
    """
    if text.isascii() and text.isprintable():
        return []
    return [c for c in text if _steers(c) and not (lines and c == "\n")]


def escaped(text: str, *, lines: bool = False) -> str:
    r"""Escape control characters as ``\x1b`` and the like; other characters are unchanged.

    Args:
        lines: keep line feeds.
    """
    if not control_characters(text, lines=lines):
        return text
    parts = (c.encode("unicode_escape").decode() if _steers(c) and not (lines and c == "\n") else c for c in text)
    return "".join(parts)


def shown(value: Any, *, lines: bool = False) -> str:
    """Format a value for a table, with control characters escaped.

    Args:
        lines: keep line breaks.
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
    """List the first names, and the number of the remaining names."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")
