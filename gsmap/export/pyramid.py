"""Coarser levels above an export's tiles, whatever format they are in: made upwards, two by two by two, and kept."""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Protocol

import numpy as np

from gsmap.durable import is_file, make_folder, refuse_links, remove_tree
from gsmap.export.levels import VERSION, Params, make_level
from gsmap.export.manifest import FILE_NAME as MANIFEST
from gsmap.render import backend
from gsmap.types import Cameras, Gaussians, Tile

LEVELS_FOLDER = "levels"
_MAX_PER_LEVEL = 100_000
_COARSENING = 4  # a level draws at most this fraction of what replaces it: half the detail on surfaces
_Cell = tuple[int, int, int]


@dataclass(frozen=True, eq=False)
class Drawn:
    """What one place of a tree draws: a tile, or a level in place of its children.

    Args:
        uri: of its file, relative to the component's folder.
        digest: of what it was made from.
        cell: (2, 3) of the tile; of a level, around those of the tiles below.
        parts: how many Gaussians stand for each tile below it, in the file's order.
        boxes: (tiles, 2, 3) around what they draw; NaN where they are none.
        error_m: geometric error, in the frame's unit; 0 for a tile.
        extras: what was measured, by name.
        children: what replaces it.
        height: how often the edge of a tile was doubled.
    """

    uri: str
    digest: str
    cell: np.ndarray
    parts: tuple[int, ...]
    boxes: np.ndarray
    error_m: float = 0.0
    extras: Mapping[str, float] = field(default_factory=dict)
    children: tuple[Drawn, ...] = ()
    height: int = 0

    @cached_property
    def tiles(self) -> tuple[Drawn, ...]:
        """Those below it, in order; itself if it is one."""
        return tuple(tile for child in self.children for tile in child.tiles) or (self,)

    @cached_property
    def box(self) -> np.ndarray:
        """(2, 3) around what it and all below it draw."""
        boxes = np.concatenate([self.boxes, *(child.box[None] for child in self.children)])
        return np.stack([np.nanmin(boxes[:, 0], axis=0), np.nanmax(boxes[:, 1], axis=0)])

    def walk(self) -> Iterator[Drawn]:
        """It and all below it."""
        yield self
        for child in self.children:
            yield from child.walk()


@dataclass(frozen=True, eq=False)
class Known:
    """What a folder's present tree says of a level or a tile; see `Drawn`. Without boxes the file is read for them."""

    error_m: float
    extras: Mapping[str, float]
    parts: tuple[int, ...]
    boxes: np.ndarray | None = None


class Layout(Protocol):
    """The files of one kind of tree."""

    @property
    def file_name(self) -> str:
        """Of the tree, in the folder of a component."""
        ...

    @property
    def key(self) -> str:
        """What decides how a level's file is written."""
        ...

    def tile(
        self, folder: Path, tile: Tile, known: Mapping[str, Known]
    ) -> tuple[str, int, np.ndarray, Gaussians | None]:
        """The uri of a tile's file in a tree, how many Gaussians it holds, the box (2, 3) of what they draw, and
        themselves where it had to be read.

        Args:
            known: what the folder's present tree says, by uri, which may be of an earlier content of the file.
        """
        ...

    def level_uri(self, name: str) -> str:
        """Where the level of a name lies."""
        ...

    def read(self, path: Path) -> Gaussians:
        """What the file of a tile or a level holds."""
        ...

    def write(self, path: Path, gaussians: Gaussians, tiles: Sequence[Drawn]) -> tuple[tuple[int, ...], np.ndarray]:
        """Write a level in one step; its parts and their boxes, as in `Drawn`."""
        ...

    def known(self, folder: Path) -> dict[str, Known]:
        """The levels, and tiles, that the folder's present tree names, by uri; none where it is not ours."""
        ...


def is_stale(out: Path, tiles: Sequence[Tile], layout: Layout) -> bool:
    """Whether the trees over an export's tiles are to be written, also where an earlier one was killed."""
    changed_ns = (out / MANIFEST).stat().st_mtime_ns
    for folder in {(out / tile.path).parent for tile in tiles if tile.path}:
        try:
            if (folder / layout.file_name).stat().st_mtime_ns <= changed_ns:
                return True
        except OSError:
            return True
        named = {uri.split("/")[1] for uri in layout.known(folder) if uri.startswith(f"{LEVELS_FOLDER}/")}
        if any(path.name not in named for path in (folder / LEVELS_FOLDER).glob("*")):
            return True
    return False


def pyramids(
    out: Path,
    tiles: Sequence[Tile],
    tile_size_m: float,
    layout: Layout,
    metres_per_unit: Mapping[int, float] | None,
    cameras: Callable[[int], Cameras | None],
    levels: Params,
) -> Iterator[tuple[int, Path, Drawn]]:
    """Each component, its folder, and the root of the levels above its tiles.

    Levels are named by what they were made from and how, so those whose tiles did not change are not made again; but
    for one that was left out, since the level above it may be shown from as near. Memory is bounded by eight tiles.
    """
    by_component: dict[int, list[Tile]] = defaultdict(list)
    for tile in tiles:
        if tile.path:
            by_component[tile.component].append(tile)
    for component, members in by_component.items():
        edge = tile_size_m / (1.0 if metres_per_unit is None else metres_per_unit[component])
        folder = (out / members[0].path).parent
        refuse_links(out, folder.name, LEVELS_FOLDER)
        maker = _Maker(folder, layout, layout.known(folder), _once(cameras, component), levels)
        cells = np.array([_cell(tile, edge) for tile in members])
        cells -= cells.min(0)  # counted from the lowest one, so that each component ends in one root
        root, _ = maker.place(
            dict(zip(map(tuple, cells.tolist()), members, strict=True)), int(cells.max()).bit_length()
        )
        yield component, folder, root


def remove_unnamed(folder: Path, root: Drawn) -> None:
    """Delete levels that no place of the tree names any more."""
    named = {node.uri.split("/")[1] for node in root.walk() if node.uri.startswith(f"{LEVELS_FOLDER}/")}
    for path in (folder / LEVELS_FOLDER).glob("*"):
        if path.name not in named:
            remove_tree(folder, LEVELS_FOLDER, path.name)


def _once(cameras: Callable[[int], Cameras | None], component: int) -> Callable[[], Cameras | None]:
    """The cameras of a component, asked for once and only if they are needed."""
    found: list[Cameras | None] = []

    def get() -> Cameras | None:
        if not found:
            found.append(cameras(component))
        return found[0]

    return get


def _cell(tile: Tile, edge: float) -> _Cell:
    x, y, z = np.floor(tile.bounds.mean(0) / edge).astype(int).tolist()
    return x, y, z


@dataclass(frozen=True, eq=False)
class _Maker:
    """How the levels of one component are made.

    Args:
        folder: of the component.
        layout: of its files.
        known: levels and tiles that the folder's present tree names.
        cameras, levels: see `gsmap.export.levels`.
    """

    folder: Path
    layout: Layout
    known: Mapping[str, Known]
    cameras: Callable[[], Cameras | None]
    levels: Params

    def place(self, tiles: Mapping[_Cell, Tile], height: int) -> tuple[Drawn, Gaussians | None]:
        """What a block of 2^height cells along each axis draws, and its Gaussians if it is a tile that was read."""
        if not height:
            (tile,) = tiles.values()
            uri, count, box, read = self.layout.tile(self.folder, tile, self.known)
            return Drawn(uri, tile.sha256, np.asarray(tile.bounds, np.float64), (count,), box[None]), read
        blocks: dict[_Cell, dict[_Cell, Tile]] = defaultdict(dict)
        for (x, y, z), tile in tiles.items():
            blocks[x >> height - 1, y >> height - 1, z >> height - 1][x, y, z] = tile
        below = [self.place(blocks[block], height - 1) for block in sorted(blocks)]
        return (below[0][0] if len(below) == 1 else self.parent(below, height)), None

    def parent(self, below: Sequence[tuple[Drawn, Gaussians | None]], height: int) -> Drawn:
        """What is drawn in place of its children; the one of earlier where it was made of the same."""
        children = [child for child, _ in below]
        fitted_by = backend()
        recipe = f"levels {VERSION} {self.levels} {self.layout.key}"
        if fitted_by != "native":  # the CPU's levels keep the names that they had
            recipe += f" {fitted_by}"
        made_of = [recipe, *(child.digest for child in children)]
        digest = hashlib.sha256("\n".join(made_of).encode()).hexdigest()
        uri = self.layout.level_uri(digest[:24])
        path = self.folder / uri
        tiles = [tile for child in children for tile in child.tiles]
        cell = np.stack([np.min([c.cell[0] for c in children], axis=0), np.max([c.cell[1] for c in children], axis=0)])
        known = self.known.get(uri)
        if known is not None and is_file(path):
            boxes = known.boxes if known.boxes is not None else boxes_of(self.layout.read(path), known.parts)
            parts, error_m, said = known.parts, known.error_m, dict(known.extras)
            children = _better(children, error_m)
        else:
            finer = Gaussians.concatenate(
                [self.layout.read(self.folder / child.uri) if read is None else read for child, read in below]
            )
            most = min(_MAX_PER_LEVEL, max(1, len(finer) // _COARSENING))
            level = make_level(finer, most, self.cameras(), self.levels)
            make_folder(path.parent)
            parts, boxes = self.layout.write(path, level.gaussians, tiles)
            children = _better(children, level.error_m)
            # A level must never be finer than what replaces it, or viewers would stop at it too early.
            error_m = max(level.error_m, 1.5 * max(child.error_m for child in children), 1e-3)
            measured = level.psnr_db or ()
            said = {name: round(v, 2) for name, v in zip(("psnr_worst_db", "psnr_db"), measured, strict=False)}
        return Drawn(uri, digest, cell, parts, boxes, error_m, said, tuple(children), height)


def _better(children: Sequence[Drawn], error_m: float) -> list[Drawn]:
    """The children of a level, those left out that are not like enough from nearer than it is: what is below them
    replaces it instead."""
    kept: list[Drawn] = []
    for child in children:
        kept += [child] if not child.children or child.error_m < error_m else child.children
    return kept


def boxes_of(gaussians: Gaussians, parts: Sequence[int]) -> np.ndarray:
    """(P, 2, 3) the box around what each run of Gaussians draws; NaN where it is empty."""
    from gsmap.formats.tiles3d import box_of

    ends = np.cumsum([0, *parts])
    none = np.full((2, 3), np.nan)
    return np.stack([box_of(gaussians[a:b]) if b > a else none for a, b in pairwise(ends)])
