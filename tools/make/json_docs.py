"""Write docs/json.md: what every verb prints with ``--json``, from the rows themselves (`gsmap.types.rows`).

python -m tools.make.json_docs            write the page
python -m tools.make.json_docs --check    exit 1 where the page is not what would be written
"""

# ruff: noqa: E402

from __future__ import annotations

import argparse
import sys
import types
import typing
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))  # the rows of this checkout, whichever one is installed

from gsmap.cli.objects import OBJECTS, Many, Maybe, Object
from gsmap.reason_codes import ERRORS
from gsmap.settings import field_docs
from gsmap.types.rows import SCHEMA, Row
from gsmap.types.sim3 import Sim3

PAGE = ROOT / "docs" / "json.md"

HEAD = f"""# What `--json` prints

<!-- Written by tools/make/json_docs.py from gsmap/types/rows/: change the rows, then run it. -->

Every verb takes `--json`: one JSON object on stdout, `"schema": {SCHEMA}` first; progress and remarks stay on stderr,
and the exit code is that of the verb without it. Keys are added as gsmap grows; where one goes or changes its meaning,
the number under `schema` is raised. In Python the verbs are methods of `gsmap.Map` that return the same rows, as frozen
dataclasses of `gsmap.types.rows` with the same names.

- Ids and names go together: `scene` and `scene_name`, `target` and `target_name`, `source` and `source_name`. An id is
  a digest of content; a scene, which is its own row, calls them `id` and `name`.
- A pose is a 4x4 matrix: `S_a_b` maps points from frame b to frame a. An array is a list of lists of the shape given.
- Units are in the names: `_m`, `_rad`, `_deg`, `_s`, `_px`, `_db`. Dates are ISO 8601 with their zone.
- A number that is not known or not finite is `null`.
- A verb that fails (exit code 1 or 2) prints `"error"` beside `"schema"`: an object of `"code"`, one of the
  [codes of errors](#codes-of-errors), and `"message"`, the line that stderr has, too. Wrong usage, such as an option
  that does not exist, prints nothing on stdout. Codes stay as they are; messages may change with any version. In Python
  the code is `GsmapError.code`; the server of `gsmap view` answers `{{"error": MESSAGE, "code": CODE}}`.
"""


def page() -> str:
    """The whole page."""
    lines = [HEAD, "## Verbs\n", "| verb | prints beside `schema` |", "| --- | --- |"]
    lines += [f"| `gsmap {_usage(verb)}` | {_shape(shape)} |" for verb, shape in OBJECTS.items()]
    lines += ["", "## Rows\n"]
    for row in row_types():
        lines += section(row)
    lines += ["## Codes of errors\n", "| code | cause |", "| --- | --- |"]
    lines += [f"| `{code}` | {meaning} |" for code, meaning in sorted(ERRORS.items())]
    return "\n".join(lines).rstrip() + "\n"


def section(row: type[Row]) -> list[str]:
    """What the page says of one type of row."""
    docs, hints = docs_of(row), typing.get_type_hints(row)
    out = [f"### {row.__name__}\n", _first(row), "", "| key | value | meaning |", "| --- | --- | --- |"]
    for field in fields(row):  # type: ignore[arg-type]
        meaning = docs[field.name].replace("``", "`").replace("|", "\\|")
        out.append(f"| `{field.name}` | {json_type(hints[field.name])} | {meaning[:1].upper() + meaning[1:]} |")
    return [*out, ""]


def row_types() -> list[type[Row]]:
    """Every type of row that a verb can print, nested ones after those that hold them."""
    found: list[type[Row]] = []
    todo = [shape.type for shape in OBJECTS.values()]
    while todo:
        row = todo.pop(0)
        if row not in found:
            found.append(row)
            inner = [part for hint in typing.get_type_hints(row).values() for part in _parts(hint)]
            todo[:0] = [part for part in inner if part not in found]
    return found


def docs_of(row: type[Row]) -> dict[str, str]:
    """The meaning of each field, those that it inherits included."""
    out: dict[str, str] = {}
    for cls in reversed(row.__mro__):
        if issubclass(cls, Row):
            out |= field_docs(cls)
    return out


def json_type(hint: object) -> str:
    """A field's type in JSON's words."""
    origin, inner = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return " or ".join(json_type(part) for part in inner)
    if origin is typing.Literal:
        return json_type(type(inner[0]))
    if origin is tuple:
        return f"list of {json_type(inner[0])}"
    if origin is not None and issubclass(origin, Mapping):
        return f"object of {json_type(inner[1])}"
    if isinstance(hint, type) and issubclass(hint, Row):
        return f"[{hint.__name__}](#{hint.__name__.lower()})"
    words = {
        str: "text",
        bool: "true or false",
        int: "whole number",
        float: "number",
        type(None): "null",
        Sim3: "4x4 matrix",
        np.ndarray: "array",
        typing.Any: "any value",
    }
    return words[hint]


def _parts(hint: object) -> list[type[Row]]:
    if isinstance(hint, type) and issubclass(hint, Row):
        return [hint]
    return [row for part in typing.get_args(hint) for row in _parts(part)]


def _shape(shape: Object) -> str:
    link = f"[{shape.type.__name__}](#{shape.type.__name__.lower()})"
    if isinstance(shape, Many):
        return f'`"{shape.key}"`: list of {link}'
    if isinstance(shape, Maybe):
        return f'`"{shape.key}"`: {link}, or null'
    return f"the keys of {link}"


def _usage(verb: str) -> str:
    known = {"show SCENE": "show MAP SCENE", "show A:B": "show MAP A:B", "convert": "convert IN OUT", "demo": "demo"}
    known |= {"backup": "backup MAP DEST", "backup --list": "backup MAP DEST --list"}
    known |= {"restore": "restore DEST MAP", "clone": "clone MAP NEW"}
    words = verb.split()
    if verb in known:
        return known[verb]
    return f"{verb} MAP" if words[0] != "list" else f"list MAP {words[1]}"


def _first(row: type[Row]) -> str:
    text = (row.__doc__ or "").split("\n\n")[0]
    return " ".join(text.split()).replace("``", "`")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true")
    if parser.parse_args().check:
        return int(not PAGE.exists() or PAGE.read_text(encoding="utf-8") != page())
    PAGE.write_text(page(), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
