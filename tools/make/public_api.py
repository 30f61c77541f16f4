"""Record the public Python API and the keys of JSON: tests/contracts/public_api.json, which a release must not break.

Additions are recorded at a release. A removal or a change of meaning raises the major version (before 1.0 the minor
one), one of JSON the number `SCHEMA`; without that, this command and tests/contracts/test_public_api.py refuse it::

    python -m tools.make.public_api
"""

from __future__ import annotations

import inspect
import json
import sys
import typing
from collections.abc import Iterator
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import Any

import gsmap
import gsmap.map
import gsmap.render
from gsmap.cli.app import outputs
from gsmap.cli.console import Output
from gsmap.types.rows.base import SCHEMA
from gsmap.version import __version__
from tools.harness import argument_parser, say
from tools.make.json_docs import json_type, row_types

RECORD = Path(__file__).resolve().parents[2] / "tests" / "contracts" / "public_api.json"
MODULES = {"gsmap.map": ("create", "open", "open_or_create"), "gsmap.render": tuple(gsmap.render.__all__)}
"""Documented names of docs/reference/python.md that are not in ``gsmap.__all__``."""


def surface() -> dict[str, Any]:
    """Return versions, the parameters of every public function, and the type of every key of every row."""
    python: dict[str, list[str]] = {}
    for name in sorted(gsmap.__all__):
        python |= dict(_members(f"gsmap.{name}", getattr(gsmap, name)))
    for module, names in MODULES.items():
        for name in names:
            python |= dict(_members(f"{module}.{name}", getattr(sys.modules[module], name)))
    python |= {f"gsmap.errors.{name}": [] for name, one in vars(gsmap.errors).items() if _is_error(one)}
    rows = {}
    for row in row_types():
        hints = typing.get_type_hints(row)
        rows[row.__name__] = {field.name: json_type(hints[field.name]) for field in fields(row)}  # type: ignore[arg-type]
    verbs = {verb: f"{_kind(output)} {output.row_type.__name__}" for verb, output in outputs().items()}
    return {"version": __version__, "python": python, "schema": SCHEMA, "rows": rows, "verbs": verbs}


def breaks(before: dict[str, Any], now: dict[str, Any]) -> list[str]:
    """Return what a user of the recorded version would miss, unless a version number announces it."""
    found = []
    if _major(now["version"]) <= _major(before["version"]):
        for name, parameters in before["python"].items():
            if name not in now["python"]:
                found.append(f"{name} is missing")
            else:
                found += [f"{name}: {problem}" for problem in _problems(parameters, now["python"][name])]
    if now["schema"] <= before["schema"]:
        verbs, rows = now["verbs"], now["rows"]
        found += [f"gsmap {verb}: other rows" for verb, shape in before["verbs"].items() if verbs.get(verb) != shape]
        for row, keys in before["rows"].items():
            found += [f"{row}.{key}: other JSON" for key, kind in keys.items() if rows.get(row, {}).get(key) != kind]
    return found


def _problems(before: list[str], now: list[str]) -> Iterator[str]:
    """Yield calls that stop working; parameters are ``name``, ``name=`` (optional) and ``*name`` (keyword)."""
    names = {name.strip("*="): name for name in now}
    for old in before:
        new = names.get(old.strip("*="))
        if new is None or (new.startswith("*") and not old.startswith("*")):
            yield f"no parameter {old}"
        elif old.endswith("=") and not new.endswith("="):
            yield f"parameter {new} has become required"
    added = set(names) - {old.strip("*=") for old in before}
    yield from (f"new parameter {name} is required" for name in sorted(added) if not names[name].endswith("="))
    order = [old.strip("=") for old in before if not old.startswith("*")]
    if [new.strip("=") for new in now if not new.startswith("*")][: len(order)] != order:
        yield "positional parameters are in another order"


def _members(name: str, value: Any) -> Iterator[tuple[str, list[str]]]:
    if inspect.isclass(value):
        made_of = fields(value) if is_dataclass(value) else ()
        yield name, [_parameter(f.name, f.kw_only, f.default is f.default_factory is MISSING) for f in made_of]
        for member in sorted(dir(value)):
            if not member.startswith("_") and member not in {f.name for f in made_of}:
                yield f"{name}.{member}", _parameters(inspect.getattr_static(value, member))
    else:
        yield name, _parameters(value)


def _parameters(value: Any) -> list[str]:
    function = getattr(value, "__func__", value)
    if not inspect.isfunction(function):
        return []
    out = []
    for one in inspect.signature(function).parameters.values():
        if one.kind is one.VAR_KEYWORD and "Unpack[" in str(one.annotation):
            keywords = getattr(sys.modules[function.__module__], one.annotation.removeprefix("Unpack[")[:-1])
            out += [_parameter(name, True, False) for name in keywords.__annotations__]
        elif one.kind not in (one.VAR_KEYWORD, one.VAR_POSITIONAL) and one.name not in ("self", "cls"):
            out.append(_parameter(one.name, one.kind is one.KEYWORD_ONLY, one.default is one.empty))
    return out


def _parameter(name: str, is_keyword: bool, is_required: bool) -> str:
    return f"{'*' if is_keyword else ''}{name}{'' if is_required else '='}"


def _kind(output: Output) -> str:
    return "one" if not output.key else "list of" if output.is_list else "optional"


def _is_error(value: object) -> bool:
    return isinstance(value, type) and issubclass(value, gsmap.errors.GsmapError)


def _major(version: str) -> tuple[int, int]:
    """Return the part of a version that announces incompatible changes."""
    major, minor, *_ = version.split(".")
    return (int(major), 0) if int(major) else (0, int(minor))


def main() -> int:
    argument_parser(__doc__).parse_args()
    now = surface()
    if RECORD.exists() and (broken := breaks(json.loads(RECORD.read_text()), now)):
        say("\n".join(broken))
        return 1
    RECORD.write_text(json.dumps(now, indent=1, sort_keys=True) + "\n")
    say(f"recorded {len(now['python'])} names and {len(now['rows'])} rows")
    return 0


if __name__ == "__main__":
    sys.exit(main())
