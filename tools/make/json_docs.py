"""Generate the list of JSON keys that every verb prints, from the row classes in `gsmap.types.rows`.

    python -m tools.make.json_docs [--out FILE]     print the page, or write it

`tools.make.docs` calls it for the page docs/reference/json.md of the site.
"""

from __future__ import annotations

import re
import types
import typing
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path

import numpy as np
import typer.main

from gsmap.cli.app import build, outputs
from gsmap.cli.console import Output
from gsmap.reason_codes import REASONS
from gsmap.settings import field_docs
from gsmap.types.rows.base import SCHEMA, Row
from gsmap.types.sim3 import Sim3
from tools.harness import argument_parser
from tools.make.error_codes import ERRORS


def page() -> str:
    """Return the tables of verbs and rows in Markdown."""
    lines = [
        f"The number under `schema` is {SCHEMA}.",
        "",
        "## Verbs\n",
        "| verb | keys beside `schema` |",
        "| --- | --- |",
    ]
    lines += [f"| `gsmap {_usage(verb)}` | {_shape(shape)} |" for verb, shape in outputs().items()]
    lines += ["", "## Rows\n"]
    for row in row_types():
        lines += section(row)
    lines += ["## Codes of reasons\n", "| code | reason |", "| --- | --- |"]
    lines += [f"| `{code}` | {meaning} |" for code, (meaning, _) in sorted(REASONS.items())]
    lines += ["", "## Codes of errors\n", "| code | cause |", "| --- | --- |"]
    lines += [f"| `{code}` | {meaning} |" for code, meaning in sorted(ERRORS.items())]
    return "\n".join(lines).rstrip() + "\n"


def section(row: type[Row]) -> list[str]:
    """Return the section of one row class: its first sentence and a table of its keys."""
    docs, hints = docs_of(row), typing.get_type_hints(row)
    out = [f"### {row.__name__}\n", _first(row), "", "| key | value | meaning |", "| --- | --- | --- |"]
    for field in fields(row):  # type: ignore[arg-type]
        meaning = docs[field.name].replace("``", "`").replace("|", "\\|")
        out.append(f"| `{field.name}` | {json_type(hints[field.name])} | {meaning[:1].upper() + meaning[1:]} |")
    return [*out, ""]


def row_types() -> list[type[Row]]:
    """Return every row class that a verb can print, each before the classes nested in it."""
    found: list[type[Row]] = []
    todo = [output.row_type for output in outputs().values()]
    while todo:
        row = todo.pop(0)
        if row not in found:
            found.append(row)
            inner = [part for hint in typing.get_type_hints(row).values() for part in _parts(hint)]
            todo[:0] = [part for part in inner if part not in found]
    return found


def docs_of(row: type[Row]) -> dict[str, str]:
    """Return the meaning of each field, including inherited ones."""
    out: dict[str, str] = {}
    for cls in reversed(row.__mro__):
        if is_dataclass(cls):
            out |= {name: re.sub(r"\bNone\b", "null", meaning) for name, meaning in field_docs(cls).items()}
    return out


def json_type(hint: object) -> str:
    """Name the JSON type of a field."""
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


def _shape(output: Output) -> str:
    link = f"[{output.row_type.__name__}](#{output.row_type.__name__.lower()})"
    if not output.key:
        return f"the keys of {link}"
    return f'`"{output.key}"`: list of {link}' if output.is_list else f'`"{output.key}"`: {link}, or null'


def _usage(form: str) -> str:
    """Return a form of a verb with its required arguments; an argument in the form is the last of them."""
    command, words = typer.main.get_command(build()), form.split()
    verb = []
    while words and words[0] in getattr(command, "commands", {}):
        verb.append(words.pop(0))
        command = command.commands[verb[-1]]  # type: ignore[attr-defined]
    needed = [one for one in command.params if one.param_type_name == "argument" and one.required]
    arguments = [(one.metavar or str(one.name)).split("|")[0] for one in needed]
    return " ".join([*verb, *(arguments[:-1] if words and not words[0].startswith("-") else arguments), *words])


def _first(row: type[Row]) -> str:
    text = (row.__doc__ or "").split("\n\n")[0]
    return " ".join(text.split()).replace("``", "`")


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--out", type=Path, help="file to write; default: standard output")
    out = parser.parse_args().out
    if out:
        out.write_text(page(), encoding="utf-8")
    else:
        print(page(), end="")


if __name__ == "__main__":
    main()
