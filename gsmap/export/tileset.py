"""A 3D Tiles tileset over an export's tiles: coarser levels merged upwards, the finest level the tiles themselves."""

from __future__ import annotations

import hashlib
import json
from collections import defaultdict
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from gsmap.durable import is_file, make_folder, open_file, refuse_links, remove_file, write_whole
from gsmap.errors import MALFORMED, CorruptError
from gsmap.export.manifest import FILE_NAME as MANIFEST
from gsmap.formats import tiles3d
from gsmap.formats.tiles3d import TileNode
from gsmap.types import Gaussians, Sim3, Tile

FILE_NAME = "tileset.json"
LEVELS_FOLDER = "levels"
_MAX_PER_LEVEL = 100_000
_COARSENING = 4  # a level draws at most this fraction of what replaces it: half the detail on surfaces
_Cell = tuple[int, int, int]


@dataclass(frozen=True, eq=False)
class _Drawn:
    """A node, the file that holds what it draws, and the digest of what that was made from."""

    node: TileNode
    path: Path
    digest: str

    def gaussians(self) -> Gaussians:
        return tiles3d.read_content(self.path)


def is_stale(out: Path, tiles: Sequence[Tile]) -> bool:
    """Whether `write_tilesets` has work to do, also where an earlier one was killed."""
    changed_ns = (out / MANIFEST).stat().st_mtime_ns
    for folder in {(out / tile.path).parent for tile in tiles if tile.path}:
        try:
            if (folder / FILE_NAME).stat().st_mtime_ns <= changed_ns:
                return True
        except OSError:
            return True
        known = _known_boxes(folder)
        if any(f"{LEVELS_FOLDER}/{path.name}" not in known for path in (folder / LEVELS_FOLDER).glob("*")):
            return True
    return False


def write_tilesets(
    out: Path,
    tiles: Sequence[Tile],
    tile_size_m: float,
    metres_per_unit: Mapping[int, float] | None = None,
    *,
    S_ecef_map: Mapping[int, Sim3] | None = None,
    compressed: bool = True,
) -> list[Path]:
    """Write ``tileset.json`` into each component's folder, with coarser levels made by merging, never by dropping.

    Levels are named by what they were made from, so those whose tiles did not change are not made again. Memory is
    bounded by eight tiles. 3D Tiles are in metres: the root's transform makes the map's unit one, its geometric errors
    with it.

    Args:
        out: the export's folder; the tiles' ``.glb`` lie in it.
        tile_size_m: edge of the grid's tiles, > 0.
        metres_per_unit: of each component's frame; all 1 if None.
        S_ecef_map: of components that are tied to the world: takes their frames to Earth-centred metres (EPSG:4978),
            where globes draw them.
        compressed: whether the tiles are packed as SPZ, and levels are to be.
    """
    by_component: dict[int, list[Tile]] = defaultdict(list)
    for tile in tiles:
        if tile.path:
            by_component[tile.component].append(tile)
    written = []
    for component, members in by_component.items():
        metres = 1.0 if metres_per_unit is None else metres_per_unit[component]
        folder = (out / members[0].path).parent
        refuse_links(out, folder.name, LEVELS_FOLDER)
        known = _known_boxes(folder)
        cells = {_cell(tile, tile_size_m / metres): _leaf(folder, tile) for tile in members}
        while len(cells) > 1:
            cells = _one_level_up(folder, cells, known, compressed)
        (root,) = cells.values()
        # The map's z is up where gsmap could tell.
        transform = np.diag([metres, metres, metres, 1.0])
        if S_ecef_map is not None and component in S_ecef_map:
            transform = S_ecef_map[component].matrix()
        write = partial(tiles3d.write_tileset, root=root.node, transform=transform, compressed=compressed)
        write_whole(folder / FILE_NAME, write)
        _remove_unnamed(folder, root.node)
        written.append(folder / FILE_NAME)
    return written


def _cell(tile: Tile, edge: float) -> _Cell:
    x, y, z = np.floor(tile.bounds.mean(0) / edge).astype(int).tolist()
    return x, y, z


def _leaf(folder: Path, tile: Tile) -> _Drawn:
    path = folder / Path(tile.path).name
    return _Drawn(TileNode(tiles3d.box_of(tiles3d.read_content(path)), 0.0, path.name), path, tile.sha256)


def _one_level_up(
    folder: Path, cells: dict[_Cell, _Drawn], known: dict[str, tuple[np.ndarray, float]], compressed: bool
) -> dict[_Cell, _Drawn]:
    """Join every two by two by two cells, counted from the lowest one, so that each component ends in one root."""
    low = np.min(list(cells), axis=0)
    groups: dict[_Cell, list[_Drawn]] = defaultdict(list)
    for cell in sorted(cells):
        x, y, z = ((np.array(cell) - low) // 2).tolist()
        groups[x, y, z].append(cells[cell])
    return {
        cell: children[0] if len(children) == 1 else _parent(folder, children, known, compressed)
        for cell, children in groups.items()
    }


def _parent(
    folder: Path, children: list[_Drawn], known: dict[str, tuple[np.ndarray, float]], compressed: bool
) -> _Drawn:
    digest = hashlib.sha256("\n".join(child.digest for child in children).encode()).hexdigest()
    uri = f"{LEVELS_FOLDER}/{digest[:24]}.glb"
    path = folder / uri
    if uri in known and is_file(path):
        box, error_m = known[uri]
    else:
        finer = Gaussians.concatenate([c.gaussians() for c in children])
        level, voxel_m = tiles3d.coarser(finer, min(_MAX_PER_LEVEL, max(1, len(finer) // _COARSENING)))
        make_folder(path.parent)
        written: list[np.ndarray] = []
        write_whole(path, lambda staged: written.append(tiles3d.write_content(staged, level, compressed=compressed)))
        boxes = np.stack([*written, *(c.node.box for c in children)])
        box = np.stack([boxes[:, 0].min(0), boxes[:, 1].max(0)])
        # A level must never be finer than what replaces it, or viewers would stop at it too early.
        error_m = max(voxel_m, 1.5 * max(c.node.error_m for c in children), 1e-3)
    return _Drawn(TileNode(box, error_m, uri, tuple(c.node for c in children)), path, digest)


def _known_boxes(folder: Path) -> dict[str, tuple[np.ndarray, float]]:
    """Box and error of every level that the folder's present tileset names."""
    known: dict[str, tuple[np.ndarray, float]] = {}

    def walk(tile: dict) -> None:
        center, axes = (
            np.array(tile["boundingVolume"]["box"][:3]),
            np.reshape(tile["boundingVolume"]["box"][3:], (3, 3)),
        )
        half = np.diag(axes)
        known[tile["content"]["uri"]] = np.stack([center - half, center + half]), tile["geometricError"]
        for child in tile.get("children", ()):
            walk(child)

    try:
        with open(open_file(folder / FILE_NAME), "rb") as file:
            walk(json.loads(file.read())["root"])
    except (OSError, *MALFORMED, CorruptError):
        return {}  # none yet, or not ours: everything is read again
    return known


def _remove_unnamed(folder: Path, root: TileNode) -> None:
    """Delete levels that no node names any more."""
    named = set()
    todo = [root]
    while todo:
        node = todo.pop()
        named.add(node.uri)
        todo += node.children
    for path in (folder / LEVELS_FOLDER).glob("*"):
        if f"{LEVELS_FOLDER}/{path.name}" not in named:
            with suppress(IsADirectoryError):
                remove_file(folder, LEVELS_FOLDER, path.name)
