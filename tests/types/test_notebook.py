"""What a notebook shows: every row as a table, and nothing of what people wrote as HTML."""

from dataclasses import dataclass
from html.parser import HTMLParser
from typing import ClassVar

import numpy as np

from gsmap.types import Scene
from gsmap.types.notebook import html_facts
from gsmap.types.rows.base import Row, Table

HOSTILE = "<img src=x onerror=alert(1)>\x1b[31m & 'so' \"on\""


@dataclass(frozen=True, eq=False)
class Thing(Row):
    columns: ClassVar = {"id": "id", "name": "its name", "weight": "kg"}
    id: str
    name: str
    weight: float | None


class Cells(HTMLParser):
    """The text of every cell, line by line, and the tags that were met."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.lines: list[list[str]] = []
        self.tags: set[str] = set()
        self.open = False
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        if tag == "tr":
            self.lines.append([])
        self.open = tag in ("td", "th")
        if self.open:
            self.lines[-1].append("")

    def handle_endtag(self, tag):
        self.open = False

    def handle_data(self, data):
        if self.open:
            self.lines[-1][-1] += data


def test_a_table_shows_its_rows_and_counts_what_it_leaves_out() -> None:
    rows = Table(Thing(f"{k:064x}", f"n{k}", 0.123456) for k in range(70))
    seen = Cells(rows._repr_html_())
    assert seen.lines[0] == ["id", "its name", "kg"]
    assert seen.lines[1] == ["000000000000", "n0", "0.1235"]
    assert len(seen.lines) == 61
    assert "and 10 more" in rows._repr_html_()
    assert Table()._repr_html_() == "<p>none</p>"


def test_what_people_wrote_stays_text() -> None:
    for text in (
        Table([Thing("a", HOSTILE, None)])._repr_html_(),
        Thing("a", HOSTILE, None)._repr_html_(),
        html_facts(HOSTILE, [(HOSTILE, HOSTILE)]),
        Scene("0" * 64, HOSTILE, 1, 0, 0, np.zeros((2, 3)), tags=(HOSTILE,))._repr_html_(),
    ):
        seen = Cells(text)
        assert seen.tags <= {"table", "thead", "tbody", "tr", "th", "td", "p", "strong", "div"}
        assert "\x1b" not in text
        assert "onerror" in text


def test_a_row_shows_the_fields_of_its_table() -> None:
    assert Cells(Thing("a", "chair", 2.0)._repr_html_()).lines == [["id", "a"], ["its name", "chair"], ["kg", "2"]]
    assert Cells(Thing("a", "chair", None)._repr_html_()).lines == [["id", "a"], ["its name", "chair"]]


def test_a_table_is_a_list() -> None:
    row = Thing("a", "chair", 2.0)
    assert Table([row]) == [row]
    assert [*Table([row]), row] == [row, row]
