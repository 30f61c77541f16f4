"""Format tables and facts as HTML for notebooks; user text is escaped."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Any

from gsmap.texts import shown

_MAX_LINES = 60  # of a table: the rest is counted
_DIGESTS = {"id", "scene", "target", "source", "sha256", "key", "descriptor_id"}
_DIGEST = re.compile(r"[0-9a-f]{32,64}")
_SHORT = 12  # digits of a digest that tell a map's things apart


def cell_text(name: str, value: Any) -> str:
    """Format a field for a table on a terminal or in a notebook, with digests shortened."""
    return short(value) if name in _DIGESTS else shown(value)


def short(value: Any) -> str:
    """Format a value like `shown`, with digests shortened."""
    return value[:_SHORT] if isinstance(value, str) and _DIGEST.fullmatch(value) else shown(value)


def html_table(columns: Mapping[str, str], rows: Sequence[Any]) -> str:
    """Format the named fields of rows (``columns``: field to heading) as an HTML table."""
    head = "".join(f"<th>{escape(heading)}</th>" for heading in columns.values())
    lines = (
        "".join(_cell(cell_text(name, getattr(row, name)), getattr(row, name)) for name in columns)
        for row in rows[:_MAX_LINES]
    )
    body = "".join(f"<tr>{line}</tr>" for line in lines)
    more = f"<p>and {len(rows) - _MAX_LINES} more</p>" if len(rows) > _MAX_LINES else ""
    table = f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
    return f'<div style="overflow-x:auto">{table}</div>{more}'


def html_facts(title: str, facts: Iterable[tuple[str, Any]]) -> str:
    """Format facts as an HTML table with a title, one fact per line; leave out facts that are None or empty."""
    lines = (
        f"<tr>{_cell(shown(name), name)}{_cell(short(value), '')}</tr>"
        for name, value in facts
        if value is not None and shown(value) != ""
    )
    return f"<p><strong>{escape(shown(title))}</strong></p><table><tbody>{''.join(lines)}</tbody></table>"


def _cell(text: str, value: Any) -> str:
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return f'<td style="text-align:{"right" if is_number else "left"}">{escape(text)}</td>'
