"""Format tables and facts as HTML for notebooks; user text is escaped."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from gsmap.markup import Markup, joined, tag
from gsmap.texts import cell_text, short, shown

_MAX_LINES = 60  # of a table: the rest is counted


def html_table(rows: Sequence[Any]) -> str:
    """Format the columns of rows as an HTML table."""
    if not rows:
        return tag("p", "none").html
    columns, more = rows[0].columns, len(rows) - _MAX_LINES
    head = tag("thead", tag("tr", [tag("th", heading) for heading in columns.values()]))
    lines = [
        tag("tr", [_cell(cell_text(name, getattr(row, name)), getattr(row, name)) for name in columns])
        for row in rows[:_MAX_LINES]
    ]
    table = tag("div", tag("table", head, tag("tbody", lines)), style="overflow-x:auto")
    return joined(table, tag("p", f"and {more} more") if more > 0 else None).html


def html_facts(title: str, facts: Iterable[tuple[str, Any]]) -> str:
    """Format facts as an HTML table with a title, one fact per line; leave out facts that are None or empty."""
    lines = [
        tag("tr", _cell(shown(name), name), _cell(short(value), ""))
        for name, value in facts
        if value is not None and shown(value) != ""
    ]
    return joined(tag("p", tag("strong", shown(title))), tag("table", tag("tbody", lines))).html


def _cell(text: str, value: Any) -> Markup:
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return tag("td", text, style=f"text-align:{'right' if is_number else 'left'}")
