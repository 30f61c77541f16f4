"""The manifest of an export folder, ``tiles.json``, which is replaced atomically after its tiles are written."""

from __future__ import annotations

import json
import math
import os
import re
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from gsmap.durable import is_file, open_file, write_text_whole
from gsmap.errors import MALFORMED, ConfigError, InputError
from gsmap.texts import control_characters
from gsmap.types import Sim3, Tile
from gsmap.types.metric_scale import MetricScale, as_known_by
from gsmap.types.plain import plain

FILE_NAME = "tiles.json"
_VERSION = 2
_NAMELESS = 1  # version whose tiles have no recipe
_SAVE_EVERY_S = 2.0
_SAVE_SHARE = 50  # least interval of saves, relative to the duration of the last one
_MAX_BYTES = 1 << 30  # a tile's entry has some kilobytes
_PATH = re.compile(r"component_\d+/[^/\\]+")


@dataclass
class Manifest:
    """The tiles of an export folder, by component and name.

    Args:
        map_id: id of the map that the folder belongs to.
        tiles: the finished tiles.
        num_bytes: size of each tile's file, by path.
        notes: notes on the state of the folder.
        doomed: paths of obsolete files that are to be deleted.
        metres: metric scale of each component as the tiles were made.
        world: georeference of components, as in their JSON (docs/how-to/world.md).
        offsets: coordinate offsets of the files of scenes in map coordinates, by scene.
    """

    map_id: str
    tiles: dict[tuple[int, str], Tile] = field(default_factory=dict)
    num_bytes: dict[str, int] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    doomed: set[str] = field(default_factory=set)
    metres: dict[int, MetricScale] = field(default_factory=dict)
    world: dict[int, dict[str, Any]] = field(default_factory=dict)
    offsets: dict[str, list[float]] = field(default_factory=dict)
    _saved_at: float = field(default_factory=time.monotonic, repr=False)
    _save_took_s: float = field(default=0.0, repr=False)

    @classmethod
    def load(cls, folder: Path, map_id: str) -> Manifest:
        """Load the manifest of a folder; return an empty manifest if the folder is empty or missing.

        Tiles of version 1 have an empty key, which makes them all dirty.

        Raises:
            ConfigError: the folder holds the export of another map, or unrelated files.
            InputError: the manifest cannot be read.
        """
        path = folder / FILE_NAME
        if not path.exists():
            if folder.exists() and not folder.is_dir():
                raise ConfigError(f"{folder} is a file: name a folder to export to", code="not_a_folder")
            if folder.exists() and any(p for p in folder.iterdir() if not p.name.startswith(".")):
                raise ConfigError(
                    f"{folder} holds files but no {FILE_NAME}: export to an empty or a new folder",
                    code="folder_not_empty",
                )
            return cls(map_id)
        try:
            content = json.loads(_text(path))
            version, owner = content["version"], str(content["map_id"])
            if version not in (_NAMELESS, _VERSION):
                raise ConfigError(
                    f"{path} has version {version}, but this gsmap writes version {_VERSION}: export to another folder",
                    code="export_version",
                )
            entries = [(str(e["name"]), _tile(e, version), int(e["num_bytes"])) for e in content["tiles"]]
            doomed = {_checked_path(p) for p in content.get("doomed", ())}
            metres = {int(c["component"]): _metre(c) for c in content.get("components", ())}
            world = {int(c["component"]): dict(c["world"]) for c in content.get("components", ()) if c.get("world")}
            offsets = {str(scene): [float(v) for v in at] for scene, at in content.get("offsets", {}).items()}
        except (OSError, *MALFORMED) as error:
            if isinstance(error, ConfigError):
                raise
            raise InputError(
                f"{path} is not a manifest gsmap wrote ({error!r}): export to another folder",
                code="foreign_export",
            ) from error
        if owner != map_id:
            raise ConfigError(
                f"{folder} holds the export of another map ({owner[:12]}): export to another folder",
                code="foreign_export",
            )
        notes: tuple[str, ...] = ()
        if version == _NAMELESS and entries:
            notes = (f"{path} has version {version}, which has no recipes of tiles: all tiles are made again",)
        return cls(
            map_id,
            {(tile.component, name): tile for name, tile, _ in entries},
            {tile.path: size for _, tile, size in entries},
            notes,
            doomed,
            metres,
            world,
            offsets,
        )

    def metres_per_unit(self, component: int) -> float:
        """Return the metres per unit of a component; 1 if unknown."""
        return self.metres[component].metres_per_unit if component in self.metres else 1.0

    def has_file(self, folder: Path, tile: Tile) -> bool:
        """Return true if the tile's file exists in its original size; also for a tile without Gaussians or file."""
        if not tile.path:
            return True
        path = folder / tile.path
        try:
            return is_file(path) and path.lstat().st_size == self.num_bytes[tile.path]
        except (OSError, ValueError):
            return False

    def save_sometimes(self, folder: Path) -> None:
        """Save the manifest unless it was saved seconds ago, so that an interrupted export loses seconds at most."""
        if time.monotonic() - self._saved_at > max(_SAVE_EVERY_S, _SAVE_SHARE * self._save_took_s):
            self.save(folder)

    def save(self, folder: Path) -> None:
        """Replace the manifest of a folder atomically."""
        entries = [
            _entry(name, tile, self.num_bytes.get(tile.path, 0), self.metres_per_unit(tile.component))
            for (_, name), tile in sorted(self.tiles.items())
        ]
        content = {"version": _VERSION, "map_id": self.map_id, "tiles": entries}
        if self.metres:
            content["components"] = [_component(c, self.metres[c], self.world.get(c)) for c in sorted(self.metres)]
        if self.offsets:
            content["offsets"] = dict(sorted(self.offsets.items()))
        if self.doomed:
            content["doomed"] = sorted(self.doomed)
        began = time.process_time()
        write_text_whole(folder / FILE_NAME, _as_json(content))
        self._saved_at, self._save_took_s = time.monotonic(), time.process_time() - began


def _as_json(content: Mapping[str, object]) -> str:
    """Serialize to JSON with one line per tile, which is eight times as fast as `json` with indents."""
    lines = []
    for name, value in content.items():
        if isinstance(value, list):
            text = "[\n" + ",\n".join(f"  {json.dumps(one)}" for one in value) + "\n ]"
        else:
            text = json.dumps(value)
        lines.append(f" {json.dumps(name)}: {text}")
    return "{\n" + ",\n".join(lines) + "\n}\n"


def _component(component: int, metre: MetricScale, world: dict[str, Any] | None) -> dict[str, object]:
    georeference: dict[str, object] = {} if world is None else {"world": world}
    return {
        "component": component,
        "metres_per_unit": metre.metres_per_unit,
        "metre_sigma": metre.sigma if math.isfinite(metre.sigma) else None,
        "metre_known_by": metre.known_by,
        "metre_note": metre.note,
    } | georeference


def _metre(entry: Mapping[str, Any]) -> MetricScale:
    sigma = entry["metre_sigma"]
    return MetricScale(
        float(entry["metres_per_unit"]),
        math.inf if sigma is None else float(sigma),
        as_known_by(str(entry["metre_known_by"])),
        str(entry["metre_note"]),
    )


def _entry(name: str, tile: Tile, num_bytes: int, metres_per_unit: float) -> dict[str, object]:
    """Return the entry of a tile in ``tiles.json``; docs/reference/storage.md explains every field."""
    turned = {} if tile.up == "z" else {"up": tile.up}
    return {
        "name": name,
        "component": tile.component,
        "path": tile.path,
        "bounds": tile.bounds.tolist(),
        "bounds_m": (tile.bounds * metres_per_unit).tolist(),
        "num_gaussians": tile.num_gaussians,
        "num_bytes": num_bytes,
        "sha256": tile.sha256,
        "key": tile.key,
        "recipe": plain(tile.recipe),
        "truncated": tile.truncated,
        "notes": list(tile.notes),
        "S_map_scene": {scene: pose.matrix().tolist() for scene, pose in sorted(tile.poses.items())},
    } | turned


def _text(path: Path) -> str:
    with open(open_file(path), "rb") as file:
        if os.fstat(file.fileno()).st_size > _MAX_BYTES:
            raise ValueError(f"it has more than {_MAX_BYTES} bytes")
        return file.read().decode()


def _checked_path(path: Any) -> str:
    """Validate the path of a tile's file, which must lie in a component's folder, or be empty without Gaussians."""
    if not isinstance(path, str) or control_characters(path) or (path and _PATH.fullmatch(path) is None):
        raise ValueError(f"the path {path!r} of a tile is not of the form component_N/NAME")
    if path.rpartition("/")[2] in (".", ".."):
        raise ValueError(f"the path {path!r} of a tile leads out of its folder")
    return path


def _tile(entry: Mapping[str, Any], version: int) -> Tile:
    known = version == _VERSION
    return Tile(
        key=str(entry["key"]) if known else "",
        component=int(entry["component"]),
        bounds=np.array(entry.get("bounds", entry["bounds_m"]), dtype=np.float64),
        poses={scene: Sim3.from_matrix(np.array(matrix)) for scene, matrix in entry["S_map_scene"].items()},
        num_gaussians=int(entry["num_gaussians"]),
        recipe=dict(entry["recipe"]) if known else {},
        truncated=bool(entry["truncated"]),
        path=_checked_path(entry["path"]),
        sha256=str(entry["sha256"]),
        notes=tuple(str(note) for note in entry["notes"]) if known else (),
        up="y" if entry.get("up") == "y" else "z",
    )
