"""The documents: links lead somewhere, what they tell to type exists, and (slow) they build with their pictures."""

import re
import subprocess
import sys
from pathlib import Path

import make_docs
import pytest

from gsmap.cli.app import VERBS

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
_GENERATED = ("_pictures/",)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_to_files_that_are_there(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", page.read_text()):
        if "://" not in target and not target.startswith(("mailto:", *_GENERATED)):
            assert (page.parent / target).exists(), f"{page.name} links to {target}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_commands_that_are_told_exist(page: Path) -> None:
    for block in re.findall(r"^```(?:sh|bash|console|text)?\n(.*?)^```$", page.read_text(), re.M | re.S):
        for verb in re.findall(r"^(?:\$ )?gsmap ([a-z][a-z-]+)", block, re.M):
            assert verb in VERBS, f"{page.name} tells to type gsmap {verb}"


def test_every_page_is_in_the_table_of_contents() -> None:
    text = (ROOT / "docs" / "index.md").read_text()
    blocks = re.findall(r"```{toctree}\n(.*?)```", text, re.S)
    listed = {line.strip() for block in blocks for line in block.splitlines()}
    pages = {str(p.relative_to(ROOT / "docs").with_suffix("")) for p in PAGES[1:]}
    design = {name for name in pages if name.startswith("design/") and name != "design/README"}
    assert pages - design - {"index"} <= listed
    told = (ROOT / "docs" / "design" / "README.md").read_text()
    assert all(Path(name).name in told for name in design)


def test_the_blocks_of_the_newcomers_path_are_found() -> None:
    blocks = make_docs.commands_of("a\n```sh\nx\ny\n```\n```console\n$ z\n```\n```sh\nw\n```\n")
    assert blocks == ["x\ny\n", "w\n"]


def test_a_command_that_fails_ends_the_build(tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="no scene is called"):
        make_docs.run_commands(["gsmap init home.gsmap\n", "gsmap show home.gsmap nowhere\n"], tmp_path)


@pytest.mark.slow
def test_the_documents_build_and_every_command_works(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, ROOT / "tools" / "make_docs.py", "--out", tmp_path / "site", "--keep", tmp_path / "run"],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-4000:]
    start = (tmp_path / "site" / "start.html").read_text()
    for picture in re.findall(r'<img[^>]+src="([^"]+)"', start):
        assert (tmp_path / "site" / picture).stat().st_size > 5_000
