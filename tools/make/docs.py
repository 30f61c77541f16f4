"""Build the documents as a static site, with generated reference pages.

    python -m tools.make.docs [--out docs/site] [--keep DIR]

Runs the commands of docs/start.md (blocks marked ``sh``) in a folder, in order; the notebook runs on the map that they
leave. Writes the reference of settings, commands and JSON keys, then calls Sphinx, where a warning is an error. The
pictures of the documents are in the repository; `tools.make.doc_pictures` makes them anew. Needs what
`tools/setup.sh test` installs.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

from tools.harness import argument_parser

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
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
        write_settings()
        write_commands()
        write_json()
        os.environ["GSMAP_DOCS_RUN"] = str(folder.resolve())
        sys.exit(build(["-W", "--keep-going", "-q", "-b", "html", str(DOCS), str(arguments.out)]))


if __name__ == "__main__":
    main()
