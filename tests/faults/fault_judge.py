"""What is true of a map after a verb was killed or failed, and whether what it said is true."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
import sqlite3
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

# What two runs of the same verb may differ in, beside everything that ends in _at.
_PASSING = {"number", "adopts", "registration", "revision", "export", "s0", "s1", "seconds", "token", "since", "snapshot"}
_LEFT_OUT = {"leases", "sqlite_sequence", "backups"}
ALARM = re.compile(r"damaged|restore\b|corrupt|malformed", re.IGNORECASE)
UNCHANGED = re.compile(r"nothing (was|has been) (changed|written|stored)", re.IGNORECASE)
_NOISE = re.compile(r"Traceback|Exception ignored|^\w+(\.\w+)*(Error|Exception)\b", re.MULTILINE)


@dataclass(frozen=True)
class State:
    """What a map and the folder of its export hold.

    Args:
        rows: every row of the catalog, as it stands.
        alike: the same rows without what passes (times, running numbers): what two runs must agree on.
        files: digest by path, of what lies in the folder of the export and of the map's own small files.
    """

    rows: frozenset[str] = frozenset()
    alike: frozenset[str] = frozenset()
    files: dict[str, str] = field(default_factory=dict)
    exists: bool = False

    def same(self, other: State) -> bool:
        return self.exists == other.exists and self.alike == other.alike and self.files == other.files


def state(folder: Path, extra_maps: Iterable[str] = ()) -> State:
    """What lies in a folder of the harness; the catalog is read from a copy, so that nothing is changed."""
    site = folder / "site.gsmap"
    files = {}
    for place in (site / "settings.toml", *_files(folder / "out")):
        if place.is_file() and not place.name.startswith("."):
            files[str(place.relative_to(folder))] = hashlib.sha256(place.read_bytes()).hexdigest()
    if not (site / "map.sqlite").is_file():
        return State(files=files, exists=False)
    rows: dict[str, str] = {}
    for name in ("", *extra_maps):
        rows |= {name + row: name + like for row, like in _rows(site / name / "map.sqlite").items()}
    return State(frozenset(rows), frozenset(rows.values()), files, True)


def _files(folder: Path) -> list[Path]:
    hidden = lambda p: any(part.startswith(".") for part in p.relative_to(folder).parts)  # noqa: E731
    return [p for p in sorted(folder.rglob("*")) if p.is_file() and not hidden(p)] if folder.is_dir() else []


def _rows(catalog: Path) -> dict[str, str]:
    """Each row with its likeness."""
    out = {}
    with tempfile.TemporaryDirectory() as copy:
        for end in ("", "-wal"):
            if Path(f"{catalog}{end}").is_file():
                shutil.copyfile(f"{catalog}{end}", f"{copy}/map.sqlite{end}")
        connection = sqlite3.connect(f"{copy}/map.sqlite")
        connection.row_factory = sqlite3.Row
        names = "SELECT name FROM sqlite_master WHERE type = 'table' AND name NOT LIKE 'chunk_boxes\\__%' ESCAPE '\\'"
        for (table,) in connection.execute(names).fetchall():
            if table in _LEFT_OUT:
                continue
            for row in connection.execute(f'SELECT * FROM "{table}"'):
                values = {name: _plain(row[name]) for name in row.keys()}  # noqa: SIM118
                like = {name: _likeness(table, name, value) for name, value in values.items()}
                out[json.dumps([table, values], sort_keys=True)] = json.dumps([table, like], sort_keys=True)
        connection.close()
    return out


def _plain(value: Any) -> Any:
    return hashlib.sha256(value).hexdigest() if isinstance(value, bytes) else value


def _likeness(table: str, name: str, value: Any) -> Any:
    if name in _PASSING or name.endswith("_at") or (table, name) == ("about", "id"):
        return None if value is None else "*"
    return value


def tiles_problems(folder: Path) -> list[str]:
    """What the folder of an export has that a reader of ``tiles.json`` must not meet."""
    manifest = folder / "out" / "tiles.json"
    if not manifest.is_file():
        return []
    out = []
    for tile in json.loads(manifest.read_text())["tiles"]:
        path = folder / "out" / tile["path"]
        if tile["path"] and not path.is_file():
            out.append(f"tiles.json names {tile['path']}, which is missing")
    return out


def leftovers(folder: Path) -> list[str]:
    """What is still there after ``gsmap prune`` and should not be."""
    site = folder / "site.gsmap"
    staging = site / "arrays" / "staging"
    found = [p for place in (folder, site, site / "models", folder / "out") for p in place.glob(".*")]
    found += [*staging.glob("*")] if staging.is_dir() else []
    return sorted(str(p.relative_to(folder)) for p in found)


@dataclass
class Verdict:
    """What was wrong after one point; all empty where nothing was.

    Args:
        lost: rows that were committed before and are gone, problems that ``check`` finds, files cut off.
        tracebacks: of the disturbed run or of the repeated one.
        untrue: messages that the map's state belies, an exit code that does.
        repeat: why the repeated verb did not work, or where it did not end as an undisturbed run does.
        left: what nothing has removed in the end.
    """

    lost: list[str] = field(default_factory=list)
    tracebacks: list[str] = field(default_factory=list)
    untrue: list[str] = field(default_factory=list)
    repeat: list[str] = field(default_factory=list)
    left: list[str] = field(default_factory=list)

    @property
    def ok(self) -> bool:
        return not (self.lost or self.tracebacks or self.untrue or self.repeat or self.left)


def judge_rows(before: State, after: State, now: State) -> list[str]:
    """What is lost or invented, given what an undisturbed run would have made of the map."""
    out = []
    for gone in sorted(before.rows - now.rows):
        table, values = json.loads(gone)
        like = json.dumps([table, {n: _likeness(table, n, v) for n, v in values.items()}], sort_keys=True)
        if like in after.alike:  # the verb itself does not take it away
            out.append(f"lost: {gone[:300]}")
    if before.exists and not now.exists:
        out.append("lost: the whole catalog")
    out += [f"invented: {row[:300]}" for row in sorted(now.alike - before.alike - after.alike)]
    for path, digest in before.files.items():
        if path not in now.files and path in after.files:
            out.append(f"lost: {path}")
    for path, digest in now.files.items():
        if not path.endswith(("tiles.json", "tileset.json")) and digest not in (
            before.files.get(path),
            after.files.get(path),
        ):
            out.append(f"cut off or mixed up: {path}")
    return out


def judge_words(code: int | None, stderr: str, before: State, after: State, now: State, *, whole: bool) -> list[str]:
    """Where what a verb said (or its exit code; None where it was killed) is not so."""
    out = []
    if whole and ALARM.search(stderr):
        out.append(f"raises an alarm over a whole map: {_last(stderr)}")
    if code is None:
        return out
    if UNCHANGED.search(stderr) and not now.same(before):
        out.append(f"says that nothing was changed, and it was: {_last(stderr)}")
    if code == 0 and not now.same(after):
        out.append(f"ended well without its effect: {differences(after, now)}")
    if code != 0:
        said = [line for line in stderr.splitlines() if line.startswith("gsmap: ")]
        if len(said) != 1 or not stderr.rstrip().splitlines()[-1].startswith("gsmap: "):
            out.append(f"does not say in one line what went wrong: {stderr[-300:]!r}")
    return out


def tracebacks(stderr: str) -> list[str]:
    found = _NOISE.search(stderr)
    return [stderr[found.start() :][-600:]] if found else []


def differences(wanted: State, found: State) -> str:
    """In a few words."""
    if wanted.exists != found.exists:
        return "there is no map" if wanted.exists else "there is a map"
    parts = [f"lacks {row[:160]}" for row in sorted(wanted.alike - found.alike)[:2]]
    parts += [f"has {row[:160]}" for row in sorted(found.alike - wanted.alike)[:2]]
    parts += [f"{p} differs" for p in sorted({*wanted.files, *found.files}) if wanted.files.get(p) != found.files.get(p)]
    return "; ".join(parts[:4])


def _last(stderr: str) -> str:
    return (stderr.strip().splitlines() or [""])[-1][:300]
