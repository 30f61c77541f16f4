"""A 3D Tiles tileset over an export's tiles: coarser levels merged upwards, the finest level the tiles themselves."""

from __future__ import annotations

import hashlib
import json
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path

import numpy as np

from gsmap.durable import is_file, make_folder, open_file, refuse_links, remove_file, write_whole
from gsmap.errors import MALFORMED, CorruptError
from gsmap.export.levels import VERSION, Params, make_level
from gsmap.export.manifest import FILE_NAME as MANIFEST
from gsmap.formats import tiles3d
from gsmap.formats.tiles3d import TileNode
from gsmap.types import Cameras, Gaussians, Sim3, Tile

FILE_NAME = "tileset.json"
LEVELS_FOLDER = "levels"
_MAX_PER_LEVEL = 100_000
_COARSENING = 4  # a level draws at most this fraction of what replaces it: half the detail on surfaces
_MEASURED = "measured_error_m"  # of a level alone; its geometric error is not less than those of finer ones
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
        known = _known_levels(folder)
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
    cameras: Callable[[int], Cameras | None] = lambda component: None,
    levels: Params | None = None,
) -> list[Path]:
    """Write ``tileset.json`` into each component's folder, with coarser levels above the tiles (`gsmap.export.levels`).

    Levels are named by what they were made from and how, so those whose tiles did not change are not made again. Memory
    is bounded by eight tiles. 3D Tiles are in metres: the root's transform makes the map's unit one, its geometric
    errors with it.

    Args:
        out: the export's folder; the tiles' ``.glb`` lie in it.
        tile_size_m: edge of the grid's tiles, > 0.
        metres_per_unit: of each component's frame; all 1 if None.
        S_ecef_map: of components that are tied to the world: takes their frames to Earth-centred metres (EPSG:4978),
            where globes draw them.
        compressed: whether the tiles are packed as SPZ, and levels are to be.
        cameras: of the captures, in the frame of a component.
        levels: how they are made.
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
        known = _known_levels(folder)
        maker = _Maker(folder, known, compressed, cache(partial(cameras, component)), levels or Params())
        cells = {_cell(tile, tile_size_m / metres): _leaf(folder, tile) for tile in members}
        while len(cells) > 1:
            cells = _one_level_up(cells, maker)
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


@dataclass(frozen=True, eq=False)
class _Maker:
    """How the levels of one component are made.

    Args:
        folder: of the component.
        known: levels that the folder's present tileset names, by uri.
        compressed, cameras, levels: see `write_tilesets`.
    """

    folder: Path
    known: Mapping[str, TileNode]
    compressed: bool
    cameras: Callable[[], Cameras | None]
    levels: Params

    def parent(self, children: list[_Drawn]) -> _Drawn:
        """The tile that is drawn in place of its children; the one of earlier where it was made of the same."""
        made_of = [f"levels {VERSION} {self.levels} {self.compressed}", *(child.digest for child in children)]
        digest = hashlib.sha256("\n".join(made_of).encode()).hexdigest()
        uri = f"{LEVELS_FOLDER}/{digest[:24]}.glb"
        path = self.folder / uri
        if uri in self.known and is_file(path):
            known = self.known[uri]
            return _Drawn(replace(known, children=_needed(children, known.extras[_MEASURED])), path, digest)
        finer = Gaussians.concatenate([child.gaussians() for child in children])
        level = make_level(finer, min(_MAX_PER_LEVEL, max(1, len(finer) // _COARSENING)), self.cameras(), self.levels)
        make_folder(path.parent)
        written: list[np.ndarray] = []
        content = partial(tiles3d.write_content, gaussians=level.gaussians, compressed=self.compressed)
        write_whole(path, lambda staged: written.append(content(staged)))
        below = _needed(children, level.error_m)
        boxes = np.stack([*written, *(node.box for node in below)])
        box = np.stack([boxes[:, 0].min(0), boxes[:, 1].max(0)])
        # A level must never be finer than what replaces it, or viewers would stop at it too early.
        error_m = max(level.error_m, 1.5 * max(node.error_m for node in below), 1e-3)
        said = {} if level.psnr_db is None else dict(zip(("psnr_worst_db", "psnr_db"), level.psnr_db, strict=True))
        extras = {name: round(value, 2) for name, value in said.items()} | {_MEASURED: level.error_m}
        return _Drawn(TileNode(box, error_m, uri, below, extras), path, digest)


def _needed(children: list[_Drawn], error_m: float) -> tuple[TileNode, ...]:
    """What replaces a level of this measured error: finer ones, and of those that are no better what replaces them."""
    nodes: list[TileNode] = []
    for child in children:
        is_level = bool(child.node.children)  # the tiles themselves stay, whatever
        nodes += child.node.children if is_level and error_m <= child.node.error_m else [child.node]
    return tuple(nodes)


def _one_level_up(cells: dict[_Cell, _Drawn], maker: _Maker) -> dict[_Cell, _Drawn]:
    """Join every two by two by two cells, counted from the lowest one, so that each component ends in one root."""
    low = np.min(list(cells), axis=0)
    groups: dict[_Cell, list[_Drawn]] = defaultdict(list)
    for cell in sorted(cells):
        x, y, z = ((np.array(cell) - low) // 2).tolist()
        groups[x, y, z].append(cells[cell])
    return {cell: children[0] if len(children) == 1 else maker.parent(children) for cell, children in groups.items()}


def _known_levels(folder: Path) -> dict[str, TileNode]:
    """Every tile that the folder's present tileset names, by uri, without its children."""
    known: dict[str, TileNode] = {}

    def walk(tile: dict) -> None:
        center, axes = (
            np.array(tile["boundingVolume"]["box"][:3]),
            np.reshape(tile["boundingVolume"]["box"][3:], (3, 3)),
        )
        half = np.diag(axes)
        box, uri = np.stack([center - half, center + half]), tile["content"]["uri"]
        known[uri] = TileNode(box, tile["geometricError"], uri, extras=dict(tile.get("extras", {})))
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
