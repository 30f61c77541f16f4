"""``tiles.json``: what an export folder holds, written last and whole."""

from __future__ import annotations

import json
import os
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from gsmap.errors import ConfigError, InputError
from gsmap.types import Sim3, Tile

FILE_NAME = "tiles.json"
_VERSION = 1
_SAVE_EVERY_S = 2.0


@dataclass
class Manifest:
    """The tiles of a folder, by component and name.

    Args:
        map_id: which map the folder belongs to.
        tiles: those that are finished.
        num_bytes: size of each tile's file, by path.
    """

    map_id: str
    tiles: dict[tuple[int, str], Tile] = field(default_factory=dict)
    num_bytes: dict[str, int] = field(default_factory=dict)
    _saved_at: float = field(default_factory=time.monotonic, repr=False)

    @classmethod
    def load(cls, folder: Path, map_id: str) -> Manifest:
        """The folder's manifest; an empty one where the folder is empty or missing.

        Raises:
            ConfigError: the folder holds another map's export, or files that are no export at all.
            InputError: the manifest cannot be read.
        """
        path = folder / FILE_NAME
        if not path.exists():
            if folder.exists() and not folder.is_dir():
                raise ConfigError(f"{folder} is a file: give a folder to export to")
            if folder.exists() and any(p for p in folder.iterdir() if not p.name.startswith(".")):
                raise ConfigError(f"{folder} holds files but no {FILE_NAME}: export to an empty or a new folder")
            return cls(map_id)
        try:
            content = json.loads(path.read_text())
            version, owner = content["version"], content["map_id"]
            entries = [(e["name"], _tile(e), int(e["num_bytes"])) for e in content["tiles"]]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise InputError(f"{path} is not a manifest gsmap wrote ({error!r}): export to another folder") from error
        if version != _VERSION:
            raise ConfigError(f"{path} has version {version}, this gsmap writes {_VERSION}: export to another folder")
        if owner != map_id:
            raise ConfigError(f"{folder} holds the export of another map ({owner[:12]}): export to another folder")
        return cls(
            map_id,
            {(tile.component, name): tile for name, tile, _ in entries},
            {tile.path: size for _, tile, size in entries},
        )

    def has_file(self, folder: Path, tile: Tile) -> bool:
        """Whether the tile's file lies there with the size it was written with; a tile without Gaussians has none."""
        if not tile.path:
            return True
        try:
            return (folder / tile.path).stat().st_size == self.num_bytes[tile.path]
        except OSError:
            return False

    def save_sometimes(self, folder: Path) -> None:
        """Save, unless that was done a moment ago: an interrupted export loses seconds, a large one does not crawl."""
        if time.monotonic() - self._saved_at > _SAVE_EVERY_S:
            self.save(folder)

    def save(self, folder: Path) -> None:
        """Replace the folder's manifest in one step."""
        entries = [
            {
                "name": name,
                "component": tile.component,
                "path": tile.path,
                "bounds_m": tile.bounds.tolist(),
                "num_gaussians": tile.num_gaussians,
                "num_bytes": self.num_bytes.get(tile.path, 0),
                "sha256": tile.sha256,
                "method": tile.method,
                "truncated": tile.truncated,
                "key": tile.key,
                "S_map_scene": {scene: pose.matrix().tolist() for scene, pose in sorted(tile.poses.items())},
            }
            for (_, name), tile in sorted(self.tiles.items())
        ]
        content = {"version": _VERSION, "map_id": self.map_id, "tiles": entries}
        staged = folder / f".{FILE_NAME}.partial"
        with open(staged, "w") as file:
            json.dump(content, file, indent=1)
            file.flush()
            os.fsync(file.fileno())
        os.replace(staged, folder / FILE_NAME)
        sync_folder(folder)
        self._saved_at = time.monotonic()


def sync_folder(folder: Path) -> None:
    """Make the renames in a folder survive a power cut."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _tile(entry: dict) -> Tile:
    return Tile(
        key=str(entry["key"]),
        component=int(entry["component"]),
        bounds=np.array(entry["bounds_m"], dtype=np.float64),
        poses={scene: Sim3.from_matrix(np.array(matrix)) for scene, matrix in entry["S_map_scene"].items()},
        num_gaussians=int(entry["num_gaussians"]),
        method=str(entry["method"]),
        truncated=bool(entry["truncated"]),
        path=str(entry["path"]),
        sha256=str(entry["sha256"]),
    )
