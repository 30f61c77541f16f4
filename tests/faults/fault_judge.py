"""What is true of a map after a verb was killed or failed, and whether what it said is true."""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import sqlite3
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gsmap.export.lock import LOCK_FILE

# What two runs of the same verb may differ in, beside everything that ends in _at.
_PASSING = {
    "number",
    "adopts",
    "registration",
    "revision",
    "export",
    "s0",
    "s1",
    "seconds",
    "token",
    "since",
    "snapshot",
}
# A merge puts what was said in two maps in one order of time, under new numbers.
_RENUMBERED = {
    *(("scene_facts", "number"), ("reviews", "number"), ("reviews", "registration")),
    *(("registrations", "number"), ("registrations", "adopts")),
}
_RANDOM = {("about", "id"), ("revisions", "origin")}  # an origin names maps by their random ids
_LEFT_OUT = {"leases", "sqlite_sequence", "backups"}
ALARM = re.compile(r"damaged|restore\b|corrupt|malformed", re.IGNORECASE)
UNCHANGED = re.compile(r"nothing (was|has been) (changed|written|stored)", re.IGNORECASE)
_NOISE = re.compile(r"Traceback|Exception ignored|^\w+(\.\w+)*(Error|Exception)\b", re.MULTILINE)


@dataclass(frozen=True)
class State:
    """What maps (with their branches) and the folder of an export hold.

    Args:
        rows: every row of every catalog, as it stands, with where the catalog lies.
        alike: the same rows without what passes (times, running numbers): what two runs must agree on.
        files: digest by path, of what lies in the folder of the export and of the map's own small files.
    """

    rows: frozenset[str] = frozenset()
    alike: frozenset[str] = frozenset()
    files: dict[str, str] = field(default_factory=dict)
    exists: bool = False

    def same(self, other: State, *, history: bool = False) -> bool:
        """Whether two runs came to the same; with ``history``, rows of this one that were replaced by equal ones may be
        there too.
        """
        more = {row for row in self.alike - other.alike if not (history and _standing(row) in other.alike)}
        return self.exists == other.exists and self.files == other.files and not more and other.alike <= self.alike


def catalogs(folder: Path) -> list[Path]:
    """The folders below one that hold a catalog: maps, and their branches; not what is being made."""
    found = [
        path.parent for pattern in ("*.gsmap/", "*.gsmap/branches/*/") for path in folder.glob(f"{pattern}map.sqlite")
    ]
    return sorted(p for p in found if not any(part.startswith(".") for part in p.relative_to(folder).parts))


def state(folder: Path) -> State:
    """What lies in a folder of the harness; catalogs are read from copies, so that nothing is changed."""
    files = {}
    for place in (*folder.glob("*.gsmap/settings.toml"), *_files(folder / "out")):
        if place.is_file() and not place.name.startswith("."):
            files[str(place.relative_to(folder))] = hashlib.sha256(_content(place)).hexdigest()
    rows: dict[str, str] = {}
    for place in catalogs(folder):
        rows |= _rows(place / "map.sqlite", str(place.relative_to(folder)))
    return State(frozenset(rows), frozenset(rows.values()), files, (folder / "site.gsmap" / "map.sqlite").is_file())


def _content(path: Path) -> bytes:
    """Bytes; of JSON the numbers to 9 digits, since poses are read back to the last bit but one."""
    if path.suffix != ".json":
        return path.read_bytes()
    return json.dumps(json.loads(path.read_text(), parse_float=lambda text: f"{float(text):.9g}")).encode()


def _files(folder: Path) -> list[Path]:
    hidden = lambda p: any(part.startswith(".") for part in p.relative_to(folder).parts)  # noqa: E731
    return [p for p in sorted(folder.rglob("*")) if p.is_file() and not hidden(p)] if folder.is_dir() else []


def _rows(catalog: Path, place: str) -> dict[str, str]:
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
                exact = {
                    name: "*" if (table, name) in _RENUMBERED and value else value for name, value in values.items()
                }
                out[json.dumps([place, table, exact], sort_keys=True)] = json.dumps(
                    [place, table, like], sort_keys=True
                )
        connection.close()
    return out


def _plain(value: Any) -> Any:
    return hashlib.sha256(value).hexdigest() if isinstance(value, bytes) else value


def _likeness(table: str, name: str, value: Any) -> Any:
    if name in _PASSING or name.endswith("_at") or (table, name) in _RANDOM:
        return None if value is None else "*"
    if (table, name) == ("purges", "receipt"):  # a copy after a power cut has no other names on the disk
        value = json.dumps(json.loads(value) | {"linked_files": "*"})
    if (table, name) == ("scenes", "thinned") and value:
        value = json.dumps(json.loads(value) | {"at": "*"})
    if isinstance(value, float) or (isinstance(value, str) and value[:1] in ("[", "{")):
        return _rounded(value)
    return value


def _rounded(value: Any) -> Any:
    """Numbers to 6 digits after the point: an optimizer that begins at its own answer changes the last bits."""
    try:
        parsed = json.loads(value) if isinstance(value, str) else value
    except ValueError:
        return value
    return json.loads(json.dumps(parsed), parse_float=lambda text: round(float(text), 6) + 0.0)


def _standing(like: str) -> str:
    """A row as it was before it was replaced."""
    place, table, values = json.loads(like)
    if values.get("removed_at") is not None:
        values["removed_at"] = None
    return json.dumps([place, table, values], sort_keys=True)


def age(folder: Path) -> None:
    """Let what looks like somebody's passing file look like one that was left an hour ago."""
    for path in folder.rglob(".*"):
        os.utime(path, (time.time() - 3600,) * 2, follow_symlinks=False)


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


def leftovers(folder: Path, *, locks: bool = True) -> list[str]:
    """What is still there after ``gsmap prune`` and should not be; without ``locks`` those of exports, which the next
    export takes, may be.
    """
    site = folder / "site.gsmap"
    staging = site / "arrays" / "staging"
    found = [p for place in (folder, site, site / "models", folder / "out") for p in place.glob(".*")]
    found += [*staging.glob("*")] if staging.is_dir() else []
    return sorted(str(p.relative_to(folder)) for p in found if locks or p.name != LOCK_FILE)


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
        place, table, values = json.loads(gone)
        like = json.dumps([place, table, {n: _likeness(table, n, v) for n, v in values.items()}], sort_keys=True)
        if like in after.alike:  # the verb itself does not take it away
            out.append(f"lost: {gone[:300]}")
    if before.exists and not now.exists:
        out.append("lost: the whole catalog")
    invented = now.alike - before.alike - after.alike - {row for row in now.alike if _begun(row, after)}
    out += [f"invented: {row[:300]}" for row in sorted(invented)]
    for path in before.files:
        if path not in now.files and path in after.files:
            out.append(f"lost: {path}")
    for path, digest in now.files.items():
        if not path.endswith(("tiles.json", "tileset.json")) and digest not in (
            before.files.get(path),
            after.files.get(path),
        ):
            out.append(f"cut off or mixed up: {path}")
    return out


def _begun(like: str, after: State) -> bool:
    """Whether a row is a lookup, which later ones replace, or a purge that is not through yet, of a scene that the
    undisturbed run purged.
    """
    place, table, values = json.loads(like)
    if table == "lookups":
        return True
    if table != "purges" or "pending" not in values["receipt"]:
        return False
    return any(json.loads(row)[:2] == [place, table] and values["scene"] in row for row in after.alike)


def told(folder: Path, text: str) -> list[str]:
    """Which files have a text in their bytes, hidden ones too; and arrays of the map that no catalog of it names."""
    files = [path for path in sorted(folder.rglob("*")) if path.is_file()]
    found = [path for path in files if text.encode() in path.read_bytes()]
    site = folder / "site.gsmap"
    rows = [row for place in catalogs(folder) for row in _rows(place / "map.sqlite", "") if '"groups"' in row]
    unnamed = [path for path in site.glob("arrays/[gs]*/*") if not any(path.name in row for row in rows)]
    out = [f"{path.relative_to(folder)} still tells of {text}" for path in found]
    return out + [f"{path.relative_to(folder)} is still there" for path in unnamed]


def judge_words(code: int | None, stderr: str, before: State, after: State, now: State, *, whole: bool) -> list[str]:
    """Where what a verb said (or its exit code; None where it was killed) is not so."""
    out = []
    ours = "\n".join(line for line in stderr.splitlines() if line.startswith("gsmap: "))
    if whole and ALARM.search(ours):
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
    parts += [
        f"{p} differs" for p in sorted({*wanted.files, *found.files}) if wanted.files.get(p) != found.files.get(p)
    ]
    return "; ".join(parts[:4])


def _last(stderr: str) -> str:
    return (stderr.strip().splitlines() or [""])[-1][:300]
