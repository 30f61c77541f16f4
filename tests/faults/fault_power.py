"""What a disk may hold after the power went: a model of names, bytes and what fsync makes of them.

A file's bytes are certain once it was fsynced, a folder's names once the folder was; what lies between may be there,
be missing, or be zeros. (SQLite's shared memory is left out: it means nothing after a cut.)
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from pathlib import Path

from fault_shim import Change

POLICIES = ("all", "data", "names", "zeros")
"""What is dropped: all that was not fsynced, only bytes, only names; or bytes that were not fsynced are zeros."""


class _File:
    def __init__(self, data: bytes = b"", *, synced: bool = False) -> None:
        self.data = bytearray(data)
        self.synced = data if synced else b""

    def kept(self, policy: str) -> bytes:
        if policy in ("all", "data"):
            return self.synced
        if policy == "zeros":
            now, sure = bytes(self.data), self.synced
            ends = (i for i, (a, b) in enumerate(zip(now, sure, strict=False)) if a != b)
            same = next(ends, min(len(now), len(sure)))
            return now[:same] + bytes(len(now) - same)
        return bytes(self.data)


class _Folder:
    def __init__(self) -> None:
        self.names: dict[str, _File | _Folder] = {}
        self.synced: dict[str, _File | _Folder] = {}


class Disk:
    """A folder as it lies now, taken for certain.

    Args:
        root: all changes that are played lie below it.
    """

    def __init__(self, root: Path) -> None:
        self._root = root
        self._content: list[tuple[str, bytes | None]] = []
        for path in sorted(root.rglob("*")):
            if not _passing(path.name):
                self._content.append((str(path.relative_to(root)), path.read_bytes() if path.is_file() else None))

    def materialise(self, changes: Sequence[Change], policy: str, target: Path) -> None:
        """Write what a disk might hold after these changes."""
        _write(self._played(changes), policy, target)

    def _played(self, changes: Sequence[Change]) -> _Folder:
        top = _Folder()
        for path, data in self._content:
            folder, name = self._place(top, path)
            folder.names[name] = _Folder() if data is None else _File(data, synced=True)
        _sync_all(top)
        for change in changes:
            self._play(top, change)
        return top

    def _place(self, top: _Folder, path: str) -> tuple[_Folder, str]:
        *parents, name = Path(path).parts
        for parent in parents:
            inner = top.names[parent]
            assert isinstance(inner, _Folder), path
            top = inner
        return top, name

    def _play(self, top: _Folder, change: Change) -> None:
        if change.kind in "#!?":
            return
        inside = os.path.relpath(change.path, self._root)
        if _passing(inside) or inside.endswith(" (deleted)"):
            return
        if inside == ".":
            if change.kind == "f":
                top.synced = dict(top.names)
            return
        folder, name = self._place(top, inside)
        found = folder.names.get(name)
        match change.kind:
            case "m":
                folder.names[name] = _Folder()
            case "c":
                if isinstance(found, _File):
                    found.data.clear()
                else:
                    folder.names[name] = _File()
            case "w":
                assert isinstance(found, _File), change
                end = change.offset + len(change.data)
                found.data.extend(bytes(max(0, end - len(found.data))))
                found.data[change.offset : end] = change.data
            case "t":
                assert isinstance(found, _File), change
                del found.data[change.offset :]
                found.data.extend(bytes(change.offset - len(found.data)))
            case "f":
                if isinstance(found, _File):
                    found.synced = bytes(found.data)
                elif found is not None:
                    found.synced = dict(found.names)
            case "u" | "d":
                folder.names.pop(name, None)
            case "r":
                other, new = self._place(top, os.path.relpath(change.other, self._root))
                other.names[new] = folder.names.pop(name)
            case "l":
                other, new = self._place(top, os.path.relpath(change.other, self._root))
                assert found is not None, change
                other.names[new] = found


def cuts(changes: Sequence[Change], count: int) -> Iterator[tuple[int, str]]:
    """Where to cut, and what is dropped: the end in every way, then just after what publishes, spread evenly."""
    for policy in POLICIES:
        yield len(changes), policy
    telling = [i for i, c in enumerate(changes, 1) if c.kind in "rfud" and i < len(changes)]
    count = max(0, count - len(POLICIES))
    for k in range(min(count, 4 * len(telling))):
        place = telling[k * len(telling) // count % len(telling)] if count < len(telling) else telling[k % len(telling)]
        yield place, POLICIES[(k + k // max(1, len(telling))) % len(POLICIES)]


def _passing(path: str) -> bool:
    return path.endswith("-shm")


def _sync_all(folder: _Folder) -> None:
    folder.synced = dict(folder.names)
    for inner in folder.names.values():
        if isinstance(inner, _Folder):
            _sync_all(inner)


def _write(folder: _Folder, policy: str, target: Path) -> None:
    target.mkdir(parents=True, exist_ok=True)
    for name, inner in (folder.synced if policy in ("all", "names") else folder.names).items():
        if isinstance(inner, _Folder):
            _write(inner, policy, target / name)
        else:
            (target / name).write_bytes(inner.kept(policy))
