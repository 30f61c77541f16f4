"""Row classes define JSON keys, table columns and their meanings, from which the JSON reference is generated."""

from __future__ import annotations

import dataclasses
import importlib
import json
import pkgutil
import re
import subprocess
import sys
import time
import typing
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from rich.cells import cell_len

from gsmap.cli.console import begin_output, json_object, print_facts, print_rows, print_table
from gsmap.texts import shown
from gsmap.types import Sim3, rows
from gsmap.types.rows.base import Row
from gsmap.types.rows.maps import ViewReport
from gsmap.types.rows.scenes import SceneRef, SceneRow
from tools.make import json_docs as TOOL

ROOT = Path(__file__).resolve().parents[2]
MODULES = [importlib.import_module(f"{rows.__name__}.{m.name}") for m in pkgutil.iter_modules(rows.__path__)]
TYPES = [
    cls
    for module in MODULES
    for cls in vars(module).values()
    if isinstance(cls, type) and issubclass(cls, Row) and is_dataclass(cls) and cls.__module__ == module.__name__
]


def test_the_generated_page_has_a_section_for_every_row_that_a_verb_prints(tmp_path: Path) -> None:
    written = tmp_path / "json.md"
    subprocess.run([sys.executable, "-m", "tools.make.json_docs", "--out", written], cwd=ROOT, check=True)
    page = written.read_text(encoding="utf-8")
    assert page.endswith("|\n")
    for row in TOOL.row_types():
        assert f"\n### {row.__name__}\n" in page


@pytest.mark.parametrize("row", TYPES, ids=lambda row: row.__name__)
def test_every_field_has_a_meaning(row: type[Row]) -> None:
    entries = re.findall(r"^\| `(\w+)` \| (.+?) \| (.+) \|$", "\n".join(TOOL.section(row)), re.M)
    assert [name for name, _, _ in entries] == [field.name for field in fields(row)]
    assert all(len(meaning) > 2 for *_, meaning in entries)
    assert set(TOOL.docs_of(row)) == {field.name for field in fields(row)}


@pytest.mark.parametrize("row", TYPES, ids=lambda row: row.__name__)
def test_columns_are_fields_or_properties(row: type[Row]) -> None:
    assert all(hasattr(row, name) or name in row.__dataclass_fields__ for name in row.columns)


@pytest.mark.parametrize("row", TYPES, ids=lambda row: row.__name__)
def test_ids_and_names_go_together(row: type[Row]) -> None:
    names = {field.name for field in fields(row)}
    for key in ("scene", "target", "source"):
        assert (key in names) == (f"{key}_name" in names), key
    hints = typing.get_type_hints(row)
    # A point that was picked in no scene has neither.
    assert all(hints[key] in (str, str | None) for key in ("scene", "target", "source") if key in names)
    assert all(hints[key] == hints[f"{key}_name"] for key in ("scene", "target", "source") if key in names)


@dataclass(frozen=True, eq=False, kw_only=True)
class Sample(Row):
    pose: Sim3
    matrix: np.ndarray
    number: float
    inner: tuple[SceneRef, ...]
    more: dict[str, float]


def sample(number: float) -> Sample:
    return Sample(
        pose=Sim3(np.eye(3), np.array([1.0, 2, 3]), 2.0),
        matrix=np.array([1.0, np.nan, np.inf]),
        number=number,
        inner=(SceneRef(scene="a", scene_name="monday"),),
        more={"x": float("nan"), "y": 1},
    )


def test_json_is_strict_and_whole() -> None:
    data = json.loads(json.dumps(sample(float("inf")).to_json(), allow_nan=False))
    assert data == {
        "pose": [[2, 0, 0, 1], [0, 2, 0, 2], [0, 0, 2, 3], [0, 0, 0, 1]],
        "matrix": [1, None, None],
        "number": None,
        "inner": [{"scene": "a", "scene_name": "monday"}],
        "more": {"x": None, "y": 1},
    }


def test_floats_keep_their_bits() -> None:
    value = 0.1 + 0.2
    assert json.loads(json.dumps(sample(value).to_json()))["number"] == value


def test_equal_rows_say_the_same() -> None:
    assert sample(1.0) == sample(1.0) != sample(2.0)
    assert SceneRef(scene="a", scene_name="b") != ViewReport(url="a")


def test_a_verb_cannot_print_another_row_than_it_declares() -> None:
    with pytest.raises(TypeError, match="InitReport, not ViewReport"):
        json_object("init", ViewReport(url="x"))
    with pytest.raises(TypeError, match="one InitReport"):
        json_object("init", [])
    assert json_object("prior", None) == {"schema": 2, "prior": None}
    assert json_object("models list", []) == {"schema": 2, "models": []}


def test_tables_shorten_digests_and_escape_markup(capsys: pytest.CaptureFixture[str]) -> None:
    digest = "0123456789abcdef" * 2
    print_table("t", {"scene": "id", "scene_name": "name"}, [SceneRef(scene=digest, scene_name="[bold]x")])
    printed = capsys.readouterr().out
    assert digest[:12] in printed
    assert digest not in printed
    assert "[bold]x" in printed


def test_names_are_shown_as_they_are(capsys: pytest.CaptureFixture[str]) -> None:
    names = ["the:key:room", "a\\[/b]", "[red]", "50%"]
    print_table("[red]", {"scene_name": "name"}, [SceneRef(scene="", scene_name=name) for name in names])
    print_facts(":key:", {"[red]": "[/]"})
    printed = capsys.readouterr().out
    assert all(text in printed for text in [*names, ":key:", "[/]"])
    assert printed.count("[red]") == 2


def test_an_empty_table_has_its_headings(capsys: pytest.CaptureFixture[str]) -> None:
    print_rows("models list", [], json=False)
    assert "preset" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (None, "-"),
        (True, "yes"),
        (0.123456, "0.1235"),
        ((1, "a"), "1, a"),
        (np.array([1.0, 2.5]), "1 2.5"),
        ({"a": 1.0}, "a 1"),
    ],
)
def test_values_read_as_people_write_them(value: object, expected: str) -> None:
    assert shown(value) == expected


@pytest.mark.parametrize("row", TYPES, ids=lambda row: row.__name__)
def test_coordinates_name_their_frame_and_unit(row: type[Row]) -> None:
    """Components share no frame, so positions under each other say which component and unit they are in."""
    units = {"map units", "scene units", "m", "deg, map units"}
    lengths = ("position", "size", "sigma", "map", "at_m", "size_m", "box_m")
    shown = {name for name in row.columns if typing.get_type_hints(row).get(name) is not str}
    for name in shown:
        if name in lengths:
            heading = row.columns[name]
            unit = heading.partition("(")[2].removesuffix(")") or heading.partition(", ")[2]
            assert unit in units, heading
    of_map = {"position", "map", "at_m", "box_m"} & shown
    in_scene = any("scene units" in row.columns[name] for name in of_map)
    in_a_titled_table = row.__name__ == "PhotoChangeRow"  # of one photo, whose component is in the title
    assert not of_map or in_scene or in_a_titled_table or "component" in row.columns


@pytest.fixture(autouse=True)
def new_command() -> None:
    begin_output()


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], None]:
    """Makes stdout a terminal of a width."""

    def make(columns: int) -> None:
        monkeypatch.setattr("sys.stdout.isatty", lambda: True, raising=False)
        monkeypatch.setenv("COLUMNS", str(columns))

    return make


def edges(count: int) -> list[EdgeNote]:
    why = "chance explains the correspondences: 12 of 300 agree, which random places would give as well"
    return [
        EdgeNote(
            pair=f"部屋_{i:03}_north:hall_2026-05-31_{i:03}", status="no_match", inliers=i, overlap=0.25, reason=why
        )
        for i in range(count)
    ]


@dataclass(frozen=True, eq=False, kw_only=True)
class EdgeNote(Row):
    """A row of names, numbers and sentences."""

    columns: ClassVar[Mapping[str, str]] = {
        "pair": "pair",
        "status": "status",
        "overlap": "overlap",
        "inliers": "inliers",
        "reason": "reason",
    }

    pair: str
    status: str
    overlap: float
    inliers: int
    reason: str


@pytest.mark.parametrize("width", [60, 80, 100, 250])
def test_a_table_fits_its_terminal_without_breaking_words(
    width: int, terminal: Callable[[int], None], capsys: pytest.CaptureFixture[str]
) -> None:
    terminal(width)
    rows = edges(12)
    print_table("t", EdgeNote.columns, rows)
    printed = capsys.readouterr()
    lines = printed.out.splitlines()
    assert max(map(cell_len, lines)) <= width
    assert all(row.pair in printed.out for row in rows)
    assert set(rows[0].reason.split()) <= set(printed.out.split())
    left_out = printed.err.partition("no room for ")[2].partition(":")[0].split(", ")
    assert all((heading in left_out) != (heading in printed.out.split()) for heading in EdgeNote.columns)
    assert (left_out == [""]) == (width >= 100)
    if width == 250:
        assert len(lines) == 3 + len(rows)


def test_columns_that_have_no_room_are_named_and_never_the_first(
    terminal: Callable[[int], None], capsys: pytest.CaptureFixture[str]
) -> None:
    terminal(20)
    print_table("t", EdgeNote.columns, edges(1))
    printed = capsys.readouterr()
    assert "no room for status, overlap, inliers, reason: " in printed.err
    assert edges(1)[0].pair in printed.out


def test_a_pipe_gets_values_between_tabs(capsys: pytest.CaptureFixture[str]) -> None:
    rows = [*edges(2), dataclasses.replace(edges(1)[0], pair="a\tb\nc")]
    print_table("t", EdgeNote.columns, rows)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split("\t") == list(EdgeNote.columns.values())
    assert [line.split("\t")[0] for line in lines[1:3]] == [row.pair for row in rows[:2]]
    assert [len(line.split("\t")) for line in lines] == [5] * 4
    print_table("more", EdgeNote.columns, rows)
    assert capsys.readouterr().out.splitlines() == ["", "# more", *lines]


def test_wide_tables_have_all_columns_everywhere(cli: Callable[..., Any], site: Path) -> None:
    lines = cli("--wide", "list", site, "scenes").stdout.splitlines()
    assert lines[0] == "scenes"
    assert all(heading in lines[1] for heading in SceneRow.columns.values())
    assert "\t" in cli("list", site, "scenes").stdout


def test_a_long_table_is_printed_at_once(terminal: Callable[[int], None], capsys: pytest.CaptureFixture[str]) -> None:
    terminal(200)
    many = [SceneRef(scene=f"{i:032x}", scene_name=f"部屋 {i} [bold]") for i in range(5000)]
    began = time.process_time()
    print_table("t", {"scene": "id", "scene_name": "name"}, many)
    assert time.process_time() - began < 5  # rich takes some milliseconds a row
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 3 + len(many)
    assert len({line.index("部屋") for line in lines[3:]}) == 1


def test_a_row_with_an_array_is_one_line_in_python() -> None:
    @dataclass(frozen=True, eq=False, kw_only=True)
    class Place(Row):
        columns: ClassVar[Mapping[str, str]] = {"name": "name", "at": "at (m)"}

        name: str
        at: np.ndarray

    assert repr(Place(name="", at=np.array([1.0, 2, 3]))) == "Place(at=[1. 2. 3.])"
