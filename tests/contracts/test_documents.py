"""Check the documents: links, commands, settings, length, and (slow) the build with its pictures."""

import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import typer.main
from test_families import _outside_package  # noqa: F401  # which docs/how-to/extending.md configures

from gsmap.cli.app import build
from gsmap.map.settings import settings_of
from gsmap.settings import parse
from tools.make import docs as make_docs

ROOT = Path(__file__).resolve().parents[2]
DOCS = sorted(page for page in (ROOT / "docs").rglob("*.md") if not page.name.startswith("_build_"))
PAGES = [*(ROOT / name for name in ("README.md", "ARCHITECTURE.md", "CONTRIBUTING.md", "CHANGELOG.md")), *DOCS]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_to_files_that_are_there(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", page.read_text()):
        if "://" not in target and not target.startswith("mailto:"):
            assert (page.parent / target).exists(), f"{page.name} links to {target}"


def commands_in(text: str) -> Iterator[tuple[str, bool]]:
    """Each command line of a page, and whether it is whole: one of a block, rather than named in a sentence."""
    blocks = re.findall(r"^```(?:sh|bash|console|text)?\n(.*?)^```$", text, re.M | re.S)
    for block in blocks:
        for line in block.replace("\\\n", " ").splitlines():
            if found := re.match(r"(?:\$ )?(gsmap [a-z-].*)", line):
                yield found[1], True
    for found in re.findall(r"`(gsmap [a-z-][^`]*)`", re.sub(r"^```.*?^```$", "", text, flags=re.M | re.S)):
        if found != "gsmap page digests 1":  # how a file begins (docs/reference/storage.md)
            yield " ".join(found.split()), False


@cache
def program() -> Any:
    return typer.main.get_command(build())


def refusal(line: str, *, whole: bool) -> str:
    """Why the command line takes no such command; empty where it does. Nothing is run.

    Args:
        whole: else it may lack arguments and values, ``A/B`` stands for one of several words, ``[A]`` may be left out,
            and words in capitals stand for others.
    """
    if not whole:
        line = re.sub(r"[\[\]]", "", line)
    words = shlex.split(line, comments=True)[1:]
    words = words[: next((i for i, word in enumerate(words) if word in ("|", ">", "&&", "&", ";", "2>")), len(words))]
    if not whole:
        words = [re.sub(r"^([a-z]+)/.*", r"\1", word) if not word.startswith("-") else word for word in words]
        words = ["1" if re.fullmatch(r"[A-Z][A-Z0-9]*(\.\.\.)?", word) else word for word in words]
    command = program()
    while words and hasattr(command, "commands") and not words[0].startswith("-"):
        if words[0] not in command.commands:
            return f"there is no {words[0]}"
        command, words = command.commands[words[0]], words[1:]
    if hasattr(command, "commands"):
        return ""  # options of the program, or all verbs of a group
    try:
        with command.make_context("gsmap", list(words)):
            return ""
    except Exception as error:  # of click, which typer holds a copy of
        open_ended = type(error).__name__ in ("MissingParameter", "BadParameter") or "requires an argument" in str(
            error
        )
        return "" if open_ended and not whole else f"{type(error).__name__}: {error}"
    except SystemExit:
        return ""  # --help


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_commands_are_taken_by_the_command_line(page: Path) -> None:
    refused = {line: why for line, whole in commands_in(page.read_text()) if (why := refusal(line, whole=whole))}
    assert refused == {}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_settings_that_are_told_are_taken(page: Path) -> None:
    for told in re.findall(r"--set[ =]([a-z_]+\.[\w.]+=[^\s`]+)", page.read_text()):
        settings_of(dict([parse(told.rstrip(").,;"))]))


@pytest.mark.parametrize(
    ("line", "whole", "taken"),
    [
        ("gsmap export MAP OUT --merge voxel", True, True),
        ("gsmap export MAP OUT --method voxel", True, False),
        ("gsmap export MAP OUT --method voxel", False, False),
        ("gsmap exprot MAP OUT", False, False),
        ("gsmap export MAP", True, False),
        ("gsmap export MAP", False, True),
        ("gsmap thin site.gsmap --keep-days many", True, False),
        ("gsmap list MAP scenes/edges", False, True),
        ("gsmap list site.gsmap everything", True, False),
    ],
)
def test_a_command_is_refused_where_the_command_line_would(line: str, whole: bool, taken: bool) -> None:
    assert (refusal(line, whole=whole) == "") == taken


def test_every_page_is_in_the_table_of_contents() -> None:
    text = (ROOT / "docs" / "index.md").read_text()
    blocks = re.findall(r"```{toctree}\n(.*?)```", text, re.S)
    listed = {line.strip() for block in blocks for line in block.splitlines()}
    pages = {str(p.relative_to(ROOT / "docs").with_suffix("")) for p in DOCS}
    design = {name for name in pages if name.startswith("design/") and name != "design/README"}
    assert pages - design - {"index"} <= listed
    told = (ROOT / "docs" / "design" / "README.md").read_text()
    assert all(Path(name).name in told for name in design)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_tools_that_are_named_exist(page: Path) -> None:
    text = page.read_text()
    modules = {name.replace(".", "/") + ".py" for name in re.findall(r"python -m (tools\.[a-z_.]+[a-z])", text)}
    files = set(re.findall(r"(tools/[a-z_/0-9]+\.(?:py|sh|js))", text))
    assert sorted(name for name in modules | files if not (ROOT / name).exists()) == []


def test_files_that_the_architecture_names_exist() -> None:
    named = re.findall(r"`?((?:[a-z_]+/)+[a-z_0-9]+\.(?:py|cpp))`?", (ROOT / "ARCHITECTURE.md").read_text())
    assert [name for name in named if not (ROOT / name).exists() and not (ROOT / "gsmap" / name).exists()] == []


def test_documents_stay_short() -> None:
    assert sum(len(page.read_text().split()) for page in PAGES) <= 50_000
    assert (ROOT / "README.md").stat().st_size <= 9_000
    assert (ROOT / "CHANGELOG.md").stat().st_size <= 12_000
    assert len((ROOT / "ARCHITECTURE.md").read_text().splitlines()) <= 200
    notes = [page for page in DOCS if page.parent.name == "design" and page.name != "README.md"]
    assert len(notes) <= 25
    assert all(len(note.read_text().split()) <= 450 for note in notes)


def test_news_fragments_have_a_type_and_one_line() -> None:
    for fragment in (ROOT / "changes").glob("*.md"):
        if fragment.name != "README.md":
            assert re.fullmatch(r"(\d+|\+[\w-]+)\.(added|changed|fixed|removed)\.md", fragment.name), fragment.name
            assert len(fragment.read_text().strip().splitlines()) == 1, fragment.name


def test_the_blocks_of_the_newcomers_path_are_found() -> None:
    blocks = make_docs.commands_of("a\n```sh\nx\ny\n```\n```console\n$ z\n```\n```sh\nw\n```\n")
    assert blocks == ["x\ny\n", "w\n"]


def test_a_command_that_fails_ends_the_build(tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="no scene is called"):
        make_docs.run_commands(["gsmap init home.gsmap\n", "gsmap show home.gsmap nowhere\n"], tmp_path)


@pytest.mark.slow
def test_the_documents_build_and_every_command_works(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "tools.make.docs", "--out", tmp_path / "site", "--keep", tmp_path / "run"],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-4000:]
    start = (tmp_path / "site" / "start.html").read_text()
    for picture in re.findall(r'<img[^>]+src="([^"]+)"', start):
        assert (tmp_path / "site" / picture).stat().st_size > 5_000
