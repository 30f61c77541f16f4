"""The page of ``gsmap report``, read as a browser reads it and compared with the map."""

from __future__ import annotations

import re
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest
from cli_rooms import save_changes

import gsmap.map
from gsmap.register import recipe_key
from gsmap.report import owner_of
from gsmap.report.words import chi_square, length, number
from gsmap.types import Registration

Run = Callable[..., Any]


class Page(HTMLParser):
    """Elements with their attributes, all text, and the cells of every table by the heading before it."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.rows: list[list[str]] = []
        self._cell: str | None = None
        self.feed(path.read_text())
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self._cell = ""

    def handle_endtag(self, tag: str) -> None:
        if tag in ("td", "th") and self._cell is not None:
            self.rows[-1].append(self._cell)
            self._cell = None

    def handle_data(self, data: str) -> None:
        self.text += data
        if self._cell is not None:
            self._cell += data

    def row(self, first: str) -> list[str]:
        (found,) = (row for row in self.rows if row and row[0] == first)
        return found

    def attributes(self, name: str) -> list[str]:
        return [value or "" for _, told in self.tags for key, value in told.items() if key == name]


def report(cli: Run, site: Path, *more: object) -> tuple[Page, dict[str, Any]]:
    path = site.parent / "report.html"
    done = cli("report", site, path, "--json", *more)
    assert done.code == 0, done.stderr
    return Page(path), done.json


def test_every_scene_and_edge_is_on_the_page_with_its_numbers(site: Path, cli: Run) -> None:
    page, said = report(cli, site)
    with gsmap.map.open(site) as m:
        for row in m.scene_rows():
            cells = page.row(row.name)
            assert f"{row.num_gaussians:,}" in cells
            assert row.status in cells
        for edge in m.edge_rows():
            cells = page.row(edge.pair)
            told = m.show_pair(edge.pair)
            assert cells[2] == chi_square(told.residual_chi2)
            assert cells[5:7] == [f"{edge.num_inliers:,}", number(edge.overlap, 2)]
            assert cells[8] == edge.reason
        metre = next(iter(m.metres().values()))
        revision = m.pose_graph()
        assert revision is not None
    assert {"plan", "edges", "scenes", "history", "cost", "reading"} <= set(said["sections"])
    assert metre.known_by in page.text
    assert said["num_bytes"] == (site.parent / "report.html").stat().st_size
    assert said["standing"] == "look"  # one scene is alone, and nothing confirms the only edge
    assert said["verdict"] in page.text
    assert "odd:one" in said["verdict"]


def test_positions_are_as_sure_as_the_map_says(site: Path, cli: Run) -> None:
    page, _ = report(cli, site)
    with gsmap.map.open(site) as m:
        told = m.show_scene("right")
        assert told.translation_sigma_m
        sigma = page.row("right")[4]
    assert sigma != "–"
    assert sigma == length(float(sigma.split()[0]) * (1e-3 if sigma.endswith("mm") else 1.0))


def test_the_page_loads_and_runs_nothing(site: Path, cli: Run) -> None:
    page, _ = report(cli, site)
    names = {name for name, _ in page.tags}
    assert not names & {"script", "iframe", "object", "embed", "link", "form", "base", "style "}
    policy = next(told["content"] for name, told in page.tags if told.get("http-equiv") == "Content-Security-Policy")
    assert policy is not None
    assert policy.startswith("default-src 'none'; style-src 'sha256-")
    assert "unsafe" not in policy
    for where in page.attributes("src") + page.attributes("href"):
        assert where.startswith(("data:image/webp;base64,", "#"))
    assert not page.attributes("style")
    assert not [key for _, told in page.tags for key in told if key.startswith("on")]
    text = (site.parent / "report.html").read_text()
    assert not re.findall(r"@import|url\(", text)
    anchors = {value[1:] for value in page.attributes("href") if value.startswith("#")}
    assert anchors == set(page.attributes("id"))


def test_a_doubtful_pair_is_drawn_unless_nobody_asks(site: Path, cli: Run) -> None:
    page, said = report(cli, site)
    assert said["num_pictures"] == 1
    assert "left:right from the same cameras" in page.attributes("alt")
    page, said = report(cli, site, "--no-pictures")
    assert said["num_pictures"] == 0
    assert "gsmap show MAP A:B --picture FILE" in page.text


def test_hostile_texts_are_shown_and_do_nothing(site: Path, cli: Run) -> None:
    name, note = "<script>alert(1)</script>", "\"' onload='x' --></style><img src=x>\nsecond line"
    assert cli("edit", site, "left", "--name", name, "--note", note, "--tag", "<b>").code == 0
    with gsmap.map.open(site) as m:
        one, two = (scene.id for scene in m.scenes() if scene.name in (name, "odd:one"))
        reason = "</td><script src=//evil.example></script>\x1b[2J"
        key = recipe_key(m.settings.register).of("hostile")
        m.store.registrations.save(Registration(one, two, "no_match", reason=reason), key)
    page, _ = report(cli, site)
    text = (site.parent / "report.html").read_text()
    assert "<script" not in text
    assert "<img src=x" not in text
    assert "\x1b" not in text
    assert name in page.text
    assert page.row(name)[-1].endswith(note)
    assert any(r"</td><script src=//evil.example></script>\x1b[2J" in row for row in page.rows)


def test_paths_of_this_machine_stay_on_it(site: Path, cli: Run) -> None:
    assert cli("edit", site, "left", "--captured-at", "2024-05-31").code == 0
    assert cli("reject", site, "left:right").code == 0
    page, said = report(cli, site)
    assert "todo" in said["sections"]
    assert str(site.parent) not in (site.parent / "report.html").read_text()
    assert f"gsmap optimize {site.name}" in page.text


def test_changes_are_told_and_drawn(site: Path, cli: Run) -> None:
    save_changes(site)
    page, said = report(cli, site)
    assert "changes" in said["sections"]
    assert said["num_pictures"] == 2
    row = page.row("c1")
    with gsmap.map.open(site) as m:
        told = m.show_change("c1")
    assert row[1] == told.kind
    assert row[2] == told.pair
    assert "c1: " in page.text


def test_since_a_date_only_what_is_new_is_told(site: Path, cli: Run) -> None:
    page, _ = report(cli, site, "--since", "2020-01-01")
    assert "Since 2020-01-01: 3 new scenes" in page.text
    page, _ = report(cli, site, "--since", "2999-01-01")
    assert "Since 2999-01-01: 0 new scenes, 0 pairs registered" in page.text
    done = cli("report", site, site.parent / "new.html", "--since", "yesterday")
    assert done.code == 2
    assert "is not a date" in done.stderr
    assert not (site.parent / "new.html").exists()


def test_maps_without_content_have_a_report(tmp_path: Path, captures: Path, cli: Run) -> None:
    cli("init", tmp_path / "a.gsmap")
    page, said = report(cli, tmp_path / "a.gsmap")
    assert said["standing"] == "empty"
    assert "This map is empty" in page.text
    cli("ingest", tmp_path / "a.gsmap", captures / "left.ply")
    page, said = report(cli, tmp_path / "a.gsmap")
    assert said["standing"] == "act"
    assert "poses were never solved" in page.text
    assert page.row("left")[1] == "ingested"


def test_a_damaged_scene_is_named_and_the_page_is_made_all_the_same(site: Path, cli: Run) -> None:
    for file in (site / "arrays" / "scenes").rglob("*"):
        if file.is_file() and file.stat().st_size > 1000:
            content = bytearray(file.read_bytes())
            file.unlink()  # it is a link to that of another map
            content[len(content) // 2] ^= 255
            file.write_bytes(bytes(content))
    page, said = report(cli, site)
    assert any("is drawn as a box" in note for note in said["notes"])
    assert str(site) not in page.text
    assert page.row("left")


@pytest.mark.parametrize("name", ["report.ply", "report", "missing/report.html", "taken.html", "folder.html"])
def test_a_page_takes_the_place_of_nothing_else(name: str, site: Path, tmp_path: Path, cli: Run) -> None:
    (tmp_path / "taken.html").write_text("<p>mine")
    (tmp_path / "folder.html").mkdir()
    before = (site / "map.sqlite").read_bytes()
    done = cli("report", site, tmp_path / name)
    assert done.code in (1, 2)
    assert "gsmap: " in done.stderr
    assert "Traceback" not in done.stderr
    assert (tmp_path / "taken.html").read_text() == "<p>mine"
    assert (site / "map.sqlite").read_bytes() == before


def test_a_purge_deletes_the_reports_that_show_a_scene(site: Path, cli: Run) -> None:
    report(cli, site)
    path = site.parent / "report.html"
    with gsmap.map.open(site) as m:
        assert owner_of(path) == m.store.id
    done = cli("remove", site, "left", "--purge", "--json")
    assert done.code == 0, done.stderr
    assert not path.exists()


def test_pairs_and_changes_are_drawn_on_demand(site: Path, cli: Run, tmp_path: Path) -> None:
    from PIL import Image

    save_changes(site)
    for thing in ("left", "left:right", "c1"):
        done = cli("show", site, thing, "--picture", tmp_path / "one.png")
        assert done.code == 0, done.stderr
        assert min(Image.open(tmp_path / "one.png").size) > 100
        (tmp_path / "one.png").unlink()
    done = cli("show", site, "left:odd:one", "--picture", tmp_path / "none.png")
    assert done.code == 1
    assert "has no pose by which" in done.stderr
    assert cli("show", site, "left:right", "--picture", tmp_path / "one.xyz").code == 2


def test_the_settings_bound_what_is_shown(site: Path, cli: Run) -> None:
    bounds = ["report.edges=1", "report.scenes=1", "report.pair_pictures=0", "report.change_pictures=0"]
    bounds += ["report.islands=0"]
    for bound in bounds:
        assert cli("settings", site, "--set", bound).code == 0
    page, said = report(cli, site)
    assert said["num_pictures"] == 0
    assert "2 more scenes are not shown" in page.text
    assert "more edges are not shown" in page.text
    assert not [told for name, told in page.tags if name == "svg" and told["class"] == "plan"]
