"""Build the documents as a static site, with generated reference pages and new pictures.

    python -m tools.make.docs [--out docs/site] [--keep DIR]

Runs the commands of docs/start.md (blocks marked ``sh``) in a folder, in order; the notebook runs on the map that they
leave, and pictures show that map, those of the page in a headless Chromium. Writes the reference of settings, commands
and JSON keys, then calls Sphinx, where a warning is an error. Needs what `tools/setup.sh test` installs.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from tools.harness import argument_parser

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
PICTURES = DOCS / "_pictures"
SETTINGS = DOCS / "_build_settings.md"
COMMANDS = DOCS / "_build_commands.md"
JSON = DOCS / "_build_json.md"
_BLOCK = re.compile(r"^```sh\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def commands_of(page: str) -> list[str]:
    """Return the blocks of a page that a reader would type, in order."""
    return _BLOCK.findall(page)


def run_commands(blocks: list[str], folder: Path) -> None:
    """Run blocks of commands in a folder until one fails.

    Raises:
        SystemExit: a block failed; the message contains its output.
    """
    environment = os.environ | {"PATH": f"{_programs(folder)}:{os.environ['PATH']}", "COLUMNS": "160"}
    for block in blocks:
        print(block.strip(), file=sys.stderr)
        done = subprocess.run(
            ["bash", "-euo", "pipefail", "-c", block], cwd=folder, env=environment, capture_output=True, text=True
        )
        if done.returncode:
            raise SystemExit(f"{block}\nfailed with {done.returncode}:\n{done.stdout}{done.stderr}")


def _programs(folder: Path) -> Path:
    """Make a folder with a ``gsmap`` program that runs this checkout with this interpreter."""
    programs = folder / "bin"
    programs.mkdir(exist_ok=True)
    program = programs / "gsmap"
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m gsmap "$@"\n')
    program.chmod(0o755)
    return programs


def make_pictures(folder: Path) -> None:
    """Make the pictures of the documents from the map in a folder."""
    from PIL import Image

    shutil.rmtree(PICTURES, ignore_errors=True)
    PICTURES.mkdir()
    shutil.copy(folder / "trial" / "map.png", PICTURES / "demo.png")
    (pair,) = sorted((folder / "why").glob("*.png"))[:1]
    Image.open(pair).save(PICTURES / "pair.png")
    Image.open(folder / "seen" / "c1.png").save(PICTURES / "change.png")
    page_pictures(folder / "home.gsmap")


def page_pictures(path: Path) -> None:
    """Take screenshots of `gsmap view`: the map, an edge and a change under review, and a phone."""
    sys.path.insert(0, str(ROOT / "tests" / "view"))
    from hands import Hands
    from headless import Page

    import gsmap.map

    def settled(hands: Hands) -> None:
        hands.wait("globalThis.gsmap?.settled && findAll('img').every((e) => e.naturalWidth)", 180)

    with gsmap.map.open(path) as m, m.view().start() as server, tempfile.TemporaryDirectory() as profile:
        with Page(server.url, Path(profile) / "desk", 1280, 800) as page:
            hands = Hands(page)
            settled(hands)
            hands.press("h", "f")  # rooms from above
            settled(hands)
            _save(page, "page")
            hands.press("h")
            hands.press("2")
            hands.click("button", "All")
            hands.click("button.choose", "capture_b")
            hands.wait("findAll('img').length >= 2", 60)
            settled(hands)
            _save(page, "page_review")
            hands.press("Escape", "3")
            hands.click("button.choose", "isappeared")
            hands.wait("findAll('img').length >= 1", 60)
            settled(hands)
            _save(page, "page_time")
        with Page(server.url, Path(profile) / "phone", 390, 844) as page:
            hands = Hands(page)
            hands.resize(390, 844, mobile=True)
            settled(hands)
            _save(page, "page_phone")


def _save(page: Any, name: str) -> None:
    from PIL import Image

    Image.fromarray((page.picture() * 255).astype("uint8")).save(PICTURES / f"{name}.png", optimize=True)


def write_settings() -> None:
    """Write every setting with its default, unit and meaning, grouped by room."""
    from gsmap.map.reports import setting_rows
    from gsmap.map.settings import Settings

    lines: list[str] = []
    room = ""
    for row in setting_rows(Settings()):
        if row.name.split(".")[0] != room:
            room = row.name.split(".")[0]
            lines += ["", f"## {room}", "", "| name | default | unit | meaning |", "| --- | --- | --- | --- |"]
        doc = row.doc.replace("|", "\\|").replace("\n", " ")
        lines.append(f"| `{row.name}` | `{row.default}` | {row.unit} | {doc} |")
    SETTINGS.write_text("\n".join(lines) + "\n")


def write_commands() -> None:
    """Write every verb with its options, as typer documents them."""
    typer = [sys.executable, "-m", "typer", str(DOCS / "gsmap_commands.py"), "utils", "docs", "--name", "gsmap"]
    done = subprocess.run(typer, cwd=ROOT, check=True, capture_output=True, text=True)
    COMMANDS.write_text(done.stdout.split("\n", 1)[1].replace("\n# ", "\n## "))  # its title is the page's


def write_json() -> None:
    """Write the JSON keys of every verb."""
    subprocess.run([sys.executable, "-m", "tools.make.json_docs", "--out", JSON], cwd=ROOT, check=True)


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--out", type=Path, default=DOCS / "site", help="where the site goes")
    parser.add_argument("--keep", type=Path, help="run the commands in this folder, and keep what they leave")
    arguments = parser.parse_args()
    from sphinx.cmd.build import main as build

    with tempfile.TemporaryDirectory() as passing:
        folder = arguments.keep or Path(passing)
        folder.mkdir(parents=True, exist_ok=True)
        if not (folder / "home.gsmap").exists():
            run_commands(commands_of((DOCS / "start.md").read_text()), folder)
        make_pictures(folder)
        write_settings()
        write_commands()
        write_json()
        os.environ["GSMAP_DOCS_RUN"] = str(folder.resolve())
        sys.exit(build(["-W", "--keep-going", "-q", "-b", "html", str(DOCS), str(arguments.out)]))


if __name__ == "__main__":
    main()
