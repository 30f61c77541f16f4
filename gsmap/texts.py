"""Format values for people, with control characters escaped."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Mapping, Sequence
from typing import Any

# Cc, Cs: escape sequences, line breaks, halves of characters. Zl, Zp: line breaks of another kind.
_CATEGORIES = ("Cc", "Cs", "Zl", "Zp")
# Invisible format characters (bidirectional overrides, zero-width characters, tags), which disguise a text, but for the
# two joiners that scripts and emoji need.
_INVISIBLE = "Cf"
_JOINERS = frozenset("\u200c\u200d")
_DIGESTS = {"id", "scene", "target", "source", "sha256", "key", "descriptor_id"}
_DIGEST = re.compile(r"[0-9a-f]{32,64}")
_SHORT = 12  # digits of a digest that tell a map's things apart


def control_characters(text: str, *, lines: bool = False) -> list[str]:
    """Return the characters of a text that control a terminal or cannot be seen, in order.

    Args:
        lines: allow line feeds.
    """
    if text.isascii() and text.isprintable():
        return []
    around = zip(" " + text[:-1], text, text[1:] + " ", strict=True)
    return [
        c
        for before, c, after in around
        if (_steers(c) and not (lines and c == "\n")) or (c in _JOINERS and (before.isascii() or after.isascii()))
    ]


def escaped(text: str, *, lines: bool = False) -> str:
    r"""Escape control and invisible characters as ``\x1b`` and the like; other characters are unchanged.

    Args:
        lines: keep line feeds.
    """
    if text.isascii() and text.isprintable():
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


def cell_text(name: str, value: Any) -> str:
    """Format a field for a table on a terminal or in a notebook, with digests shortened."""
    return short(value) if name in _DIGESTS else shown(value)


def short(value: Any) -> str:
    """Format a value like `shown`, with digests shortened."""
    return value[:_SHORT] if isinstance(value, str) and _DIGEST.fullmatch(value) else shown(value)


def _steers(c: str) -> bool:
    category = unicodedata.category(c)
    return category in _CATEGORIES or (category == _INVISIBLE and c not in _JOINERS)


def counted(count: int, noun: str) -> str:
    """Return a count with its noun, such as ``1 photo`` and ``2 photos``."""
    return f"{count} {noun}{'s' * (count != 1)}"


def few(names: Sequence[str], most: int = 5) -> str:
    """List the first names, and the number of the remaining names."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")
