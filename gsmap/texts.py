"""Texts that people read on a terminal: what must never reach it as it is."""

from __future__ import annotations

import unicodedata

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
    shown = (c.encode("unicode_escape").decode() if _steers(c) and not (lines and c == "\n") else c for c in text)
    return "".join(shown)


def _steers(c: str) -> bool:
    return c in _TURNING or unicodedata.category(c) in _CATEGORIES
