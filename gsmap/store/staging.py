"""Make staging folders for new maps, and find leftovers of killed processes."""

from __future__ import annotations

import contextlib
import os
import re
import time
from collections.abc import Iterator
from pathlib import Path

from gsmap.durable import is_folder, lock_folder, make_locked_folder, remove_tree
from gsmap.store.error_translation import displayed_as

# Doubled for a map made in a folder that is staged itself.
_STAGED = r"\.{{1,2}}{name}(\.[0-9a-f]{{8}}){{1,2}}"
# Staged files of `gsmap.durable.write_whole`, and the age from which they are abandoned.
_STAGED_FILE = re.compile(r"\.(settings\.toml|catalog\.url|map\.sqlite[a-z0-9.]*)\.[0-9a-f]{8}|\.map\.sqlite\.sha256")
_ABANDONED_S = 60.0
_PART = re.compile(r"arrays|models|branches|lock|\.?(map\.sqlite|catalog\.url|settings\.toml).*")  # entries of a map


@contextlib.contextmanager
def beside(folder: Path) -> Iterator[Path]:
    """Yield a new locked folder beside ``folder``; remove it at the end unless the block renamed it to ``folder``.

    The lock lasts as long as this process, so that other processes can tell it from leftovers; leftovers of the same
    name are removed first.
    """
    _remove_leftovers(folder)
    staged, handle = make_locked_folder(folder.with_name(f".{folder.name}"))
    try:
        with displayed_as(staged, folder):
            yield staged
    finally:
        with contextlib.suppress(OSError):
            remove_tree(staged.parent, staged.name)  # missing once renamed
        os.close(handle)


def abandoned_files(folder: Path) -> dict[str, int]:
    """Return names and sizes of the files that killed processes left in a map while replacing others."""
    out = {}
    for entry in os.scandir(folder):
        if _STAGED_FILE.fullmatch(entry.name) and entry.is_file(follow_symlinks=False):
            found = entry.stat(follow_symlinks=False)
            if time.time() - found.st_mtime > _ABANDONED_S:
                out[entry.name] = found.st_size
    return out


def _remove_leftovers(folder: Path) -> None:
    staged = re.compile(_STAGED.format(name=re.escape(folder.name)))
    for name in sorted(os.listdir(folder.parent)):
        path = folder.parent / name
        if not (staged.fullmatch(name) and is_folder(path)):
            continue
        with contextlib.suppress(OSError):  # locked by another process, or not permitted
            handle = lock_folder(path, wait=False)
            try:
                if all(_PART.fullmatch(part) for part in os.listdir(handle)):
                    remove_tree(folder.parent, name)
            finally:
                os.close(handle)
