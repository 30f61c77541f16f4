"""Cache trees and sketches of scenes in the user's cache folder, so that a page opens immediately the next time.

Entries are named by content and method (``KEY.tree``, a folder; ``KEY.N.sketch``, a file), so that maps share them. An
entry is created by one rename; a damaged entry counts as missing; the least recently used entries are evicted first.
Entries may be deleted at any time.
"""

from __future__ import annotations

import contextlib
import glob
import hashlib
import json
import os
import re
import shutil
import time
import uuid
from collections.abc import Callable
from pathlib import Path

import numpy as np

from gsmap.durable import files_below, is_folder, staged_folder
from gsmap.errors import MALFORMED
from gsmap.formats.tiles3d import CONTENT_FOLDER
from gsmap.types import Gaussians
from gsmap.view.trees import FILE_NAME, Sketch

_MANIFEST = "files.json"
_TILE = re.compile(rf"{CONTENT_FOLDER}/[0-9a-z]+-([0-9a-f]{{16}})\.glb")
_COLUMNS = {"means": 3, "quats": 4, "log_scales": 3, "logit_opacities": 1, "sh": 3}
_STALE_S = 3600.0  # age after which a staged entry counts as left over by a process that died
_OWNER = "cache"  # in names of staged folders: entries belong to no map
_NAMELESS = re.compile(r"\.[0-9a-f]{32}")  # entries that an older gsmap was making


class TreeCache:
    """A cache of levels of detail in one folder, which several processes may use at once.

    Args:
        root: Folder of the cache; created with the first entry.
        max_bytes: Maximum size of all entries. A larger single entry is kept until the next one.
    """

    def __init__(self, root: Path, max_bytes: int) -> None:
        self.root = root
        self.max_bytes = max_bytes

    # --- sketches ----------------------------------------------------------------------------------------------------

    def sketch(self, key: str, max_count: int) -> Sketch | None:
        """Return the sketch of a scene; None if it is missing or damaged."""
        path = self._sketch(key, max_count)
        try:
            with open(path, "rb") as file:
                table = np.load(file, allow_pickle=False)
            # Two rows of a box, then one for each Gaussian.
            if table.ndim != 2 or table.shape[1] != sum(_COLUMNS.values()) or not 3 <= len(table) <= 2 + max_count:
                raise ValueError
            if table.dtype != np.float32 or not np.isfinite(table).all():
                raise ValueError
            os.utime(path)
        except (OSError, EOFError, ValueError):
            return None
        parts = dict(zip(_COLUMNS, np.split(table[2:], np.cumsum(list(_COLUMNS.values()))[:-1], axis=1), strict=True))
        parts |= {"logit_opacities": parts["logit_opacities"][:, 0], "sh": parts["sh"][:, None]}
        return Sketch(Gaussians(**parts), table[:2, :3].astype(np.float64))

    def keep_sketch(self, key: str, max_count: int, made: Sketch) -> None:
        """Store a sketch."""
        table = np.zeros((2 + len(made.gaussians), sum(_COLUMNS.values())), np.float32)
        table[:2, :3] = made.box
        columns = [getattr(made.gaussians, name).reshape(len(table) - 2, -1) for name in _COLUMNS]
        table[2:] = np.concatenate(columns, axis=1)
        self._make_folder()
        with staged_folder(self._sketch(key, max_count), _OWNER) as staged:
            with open(staged / "sketch", "xb") as file:
                np.save(file, table)
            os.replace(staged / "sketch", self._sketch(key, max_count))

    # --- trees -------------------------------------------------------------------------------------------------------

    def tree(self, key: str) -> Path | None:
        """Return the folder of a scene's tree; None if it is missing or damaged."""
        folder = self._tree(key)
        try:
            listed = json.loads((folder / _MANIFEST).read_bytes())
            tileset = (folder / FILE_NAME).read_bytes()
            if hashlib.sha256(tileset).hexdigest() != listed[FILE_NAME]:
                raise ValueError
            if any((folder / uri).stat().st_size != size for uri, size in listed["tiles"].items()):
                raise ValueError
            os.utime(folder)
            return folder
        except FileNotFoundError:
            if folder.exists():
                self._drop(folder)
            return None
        except (OSError, *MALFORMED):
            self._drop(folder)
            return None

    def tile(self, key: str, uri: str) -> bytes | None:
        """Return the bytes of a tile; if the tile is missing or damaged, delete its tree and return None."""
        named = _TILE.fullmatch(uri)
        if named is None:
            return None
        try:
            data = (self._tree(key) / uri).read_bytes()
        except OSError:
            return None
        if not hashlib.sha256(data).hexdigest().startswith(named[1]):
            self._drop(self._tree(key))
            return None
        return data

    def make_tree(self, key: str, write: Callable[[Path], object]) -> Path:
        """Let ``write`` fill a folder, and store that folder as the tree of a scene.

        If another process was faster, its tree is kept.
        """
        self._make_folder()
        with staged_folder(self._tree(key), _OWNER) as folder:
            staged = folder / "tree"
            write(staged)
            tiles = {
                f"{CONTENT_FOLDER}/{path.name}": path.stat().st_size for path in (staged / CONTENT_FOLDER).iterdir()
            }
            digest = hashlib.sha256((staged / FILE_NAME).read_bytes()).hexdigest()
            (staged / _MANIFEST).write_text(json.dumps({FILE_NAME: digest, "tiles": tiles}))
            self._make_room(sum(tiles.values()))
            with contextlib.suppress(OSError):  # another process was faster
                os.rename(staged, self._tree(key))
        return self._tree(key)

    # --- all entries -------------------------------------------------------------------------------------------------

    def num_files(self, scene: str) -> int:
        """Count the cached files of a scene, which the prefix of their keys identifies."""
        return sum(len(files_below(path)) if is_folder(path) else 1 for path in self._of(scene))

    def forget(self, scene: str) -> None:
        """Delete all entries of a scene, which the prefix of their keys identifies, and their leftovers.

        Entries that an older gsmap left half-made do not name their scene, and are deleted, too.
        """
        for path in self._of(scene):
            self._drop(path)

    def _of(self, scene: str) -> list[Path]:
        escaped = glob.escape(scene)
        nameless = [path for path in self.root.glob(".*") if _NAMELESS.fullmatch(path.name)]
        return [*self.root.glob(f"{escaped}*"), *self.root.glob(f".{escaped}*"), *nameless]

    def _tree(self, key: str) -> Path:
        return self.root / f"{key}.tree"

    def _sketch(self, key: str, max_count: int) -> Path:
        return self.root / f"{key}.{max_count}.sketch"

    def _make_folder(self) -> None:
        self.root.mkdir(mode=0o700, parents=True, exist_ok=True)

    def _drop(self, path: Path) -> None:
        """Delete an entry such that other processes see it whole or not at all."""
        grave = path.with_name(f".{path.name.removeprefix('.')}.{uuid.uuid4().hex[:8]}")
        try:
            os.rename(path, grave)
        except OSError:
            return
        if grave.is_dir() and not grave.is_symlink():
            shutil.rmtree(grave, ignore_errors=True)
        else:
            grave.unlink(missing_ok=True)

    def _make_room(self, size_bytes: int) -> None:
        """Evict leftovers of dead processes, and the least recently used entries until ``size_bytes`` fit."""
        kept = []
        for entry in os.scandir(self.root):
            with contextlib.suppress(OSError):
                about = entry.stat(follow_symlinks=False)
                if entry.name.startswith("."):
                    if time.time() - about.st_mtime > _STALE_S:
                        self._drop(Path(entry))
                    continue
                kept.append((about.st_mtime, _num_bytes(Path(entry)), Path(entry)))
        over = sum(size for _, size, _ in kept) + size_bytes - self.max_bytes
        for _, size, path in sorted(kept):
            if over <= 0:
                break
            self._drop(path)
            over -= size


def _num_bytes(path: Path) -> int:
    """Return the size of an entry in bytes; read a tree's size from its manifest, which is faster than adding files."""
    if not path.is_dir():
        return path.stat().st_size
    try:
        return sum(json.loads((path / _MANIFEST).read_bytes())["tiles"].values())
    except (OSError, *MALFORMED):
        return 0
