"""Read and write ``settings.toml``, the settings of a map that differ from the defaults; keep its comments."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gsmap.durable import write_text_whole
from gsmap.errors import ConfigError
from gsmap.types.plain import plain

FILE_NAME = "settings.toml"
PRESET = "preset"
_HEADER = "Settings of this map that differ from the defaults; `gsmap settings MAP` lists all of them."


def load(path: Path) -> dict[str, Any]:
    """Load settings by dotted name, including ``preset``; empty if the file is missing.

    Raises:
        ConfigError: not TOML; the line is named.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        return {}
    except UnicodeDecodeError as error:
        raise ConfigError(
            f"{path} is not a text file in UTF-8: correct or remove it", code="invalid_settings_file"
        ) from error
    try:
        return dict(_flat(tomllib.loads(text)))
    except (ValueError, RecursionError) as error:  # not only what tomllib names: an integer of 5000 digits, too
        raise ConfigError(
            f"{path} is not TOML ({error}): correct or remove it", code="invalid_settings_file"
        ) from error


def save(path: Path, values: Mapping[str, Any], drop: tuple[str, ...] = ()) -> None:
    """Set and remove settings in a file; keep the rest of the file, including comments.

    Args:
        values: by dotted name.
        drop: dotted names to remove.
    """
    import tomlkit

    document = tomlkit.parse(path.read_text(encoding="utf-8")) if path.exists() else tomlkit.document()
    if not path.exists():
        document.add(tomlkit.comment(_HEADER))
    for name in drop:
        _drop(document, name.split("."))
    for name, value in values.items():
        table: Any = document
        *above, last = name.split(".")
        for part in above:
            if part not in table:
                table[part] = tomlkit.table(is_super_table=True)
            table = table[part]
        if value is None:
            table[last] = "none"
        else:
            table[last] = plain(value)
    text = tomlkit.dumps(document)
    write_text_whole(path, text)


def _flat(table: Mapping[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    out: list[tuple[str, Any]] = []
    for key, value in table.items():
        if isinstance(value, dict):
            out += _flat(value, f"{prefix}{key}.")
        else:
            out.append((f"{prefix}{key}", None if value == "none" else value))
    return out


def _drop(table: Any, path: list[str]) -> None:
    if path[0] not in table:
        return
    if len(path) == 1:
        del table[path[0]]
        return
    _drop(table[path[0]], path[1:])
    if not len(table[path[0]]):
        del table[path[0]]
