"""Build a pyramid of levels of detail over exported tiles, bottom-up in blocks of 2 x 2 x 2; reuse unchanged levels."""

from __future__ import annotations

import hashlib
import re
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Protocol

import numpy as np

from gsmap.durable import is_file, make_folder, refuse_links, remove_file, remove_tree
from gsmap.export.levels import VERSION, Params, make_level
from gsmap.export.manifest import FILE_NAME as MANIFEST
from gsmap.render import backend
from gsmap.types import Cameras, Gaussians, Tile

LEVELS_FOLDER = "levels"
_MAX_PER_LEVEL = 100_000
_COARSENING = 4  # least ratio of the Gaussians of a level's children to its own: half the detail on surfaces
_Cell = tuple[int, int, int]
_GRID_NAME = re.compile(r"tile_([+-]\d+)_([+-]\d+)_([+-]\d+)")


@dataclass(frozen=True, eq=False)
class PyramidNode:
    """A node of the pyramid: a tile, or a level that is shown from afar in place of its children.

    Args:
        uri: its file, relative to the component's folder.
        digest: digest of its inputs.
        cell: (2, 3) bounds of the tile; of a level, around those of its tiles.
        parts: number of Gaussians of each of its tiles, in the file's order.
        boxes: (tiles, 2, 3) boxes around these Gaussians; NaN without any.
        error_m: geometric error, in the frame's unit; 0 for a tile.
        extras: measurements by name.
        children: nodes that refine it.
        height: number of doublings of a tile's edge.
    """

    uri: str
    digest: str
    cell: np.ndarray
    parts: tuple[int, ...]
    boxes: np.ndarray
    error_m: float = 0.0
    extras: Mapping[str, float] = field(default_factory=dict)
    children: tuple[PyramidNode, ...] = ()
    height: int = 0

    @cached_property
    def tiles(self) -> tuple[PyramidNode, ...]:
        """All tiles below the node, in order; the node itself if it is a tile."""
        return tuple(tile for child in self.children for tile in child.tiles) or (self,)

    @cached_property
    def box(self) -> np.ndarray:
        """Box (2, 3) around the Gaussians of the node and of all nodes below it."""
        boxes = np.concatenate([self.boxes, *(child.box[None] for child in self.children)])
        return np.stack([np.nanmin(boxes[:, 0], axis=0), np.nanmax(boxes[:, 1], axis=0)])

    def walk(self) -> Iterator[PyramidNode]:
        """Yield the node and all nodes below it."""
        yield self
        for child in self.children:
            yield from child.walk()


@dataclass(frozen=True, eq=False)
class StoredNode:
    """Data of a level or tile in the tree of a folder; see `PyramidNode`. Missing boxes are read from its file."""

    error_m: float
    extras: Mapping[str, float]
    parts: tuple[int, ...]
    boxes: np.ndarray | None = None


class TreeLayout(Protocol):
    """The files of a pyramid in one format."""

    @property
    def file_name(self) -> str:
        """Name of the tree's file in the folder of a component."""
        ...

    @property
    def key(self) -> str:
        """Text that identifies the format of a level's file, as part of its recipe."""
        ...

    def tile(
        self, folder: Path, tile: Tile, known: Mapping[str, StoredNode]
    ) -> tuple[str, int, np.ndarray, Gaussians | None]:
        """Return a tile's uri, its number of Gaussians, their box (2, 3), and the Gaussians if they were read.

        Args:
            folder: folder of the component.
            tile: the tile.
            known: nodes of the folder's present tree, by uri, perhaps of an earlier content of the file.
        """
        ...

    def level_uri(self, name: str) -> str:
        """Return the uri of a level with some name."""
        ...

    def read(self, path: Path) -> Gaussians:
        """Read the Gaussians of a tile's or level's file."""
        ...

    def write(
        self, path: Path, gaussians: Gaussians, tiles: Sequence[PyramidNode]
    ) -> tuple[tuple[int, ...], np.ndarray]:
        """Write a level atomically; return its parts and their boxes, as in `PyramidNode`."""
        ...

    def known(self, folder: Path) -> dict[str, StoredNode]:
        """Return the nodes of the tree in a folder, by uri; empty if the tree's file is missing or unknown."""
        ...


def is_stale(out: Path, tiles: Sequence[Tile], layout: TreeLayout) -> bool:
    """Return true if the pyramids over exported tiles must be written, such as after an interruption."""
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


def build_pyramids(
    out: Path,
    tiles: Sequence[Tile],
    layout: TreeLayout,
    cameras: Callable[[int], Cameras | None],
    levels: Params,
) -> Iterator[tuple[int, Path, PyramidNode]]:
    """Build the pyramid of each component; yield the component, its folder and the root.

    A tile that is alone has a level above it if it holds more than a level does, so that viewers draw something early.
    Levels are named by the digest of their inputs, so those with unchanged tiles are reused, except for levels that
    were dropped because the level above is shown from as near. Memory is bounded by eight tiles.
    """
    by_component: dict[int, list[Tile]] = defaultdict(list)
    for tile in tiles:
        if tile.path:
            by_component[tile.component].append(tile)
    for component, members in by_component.items():
        folder = (out / members[0].path).parent
        refuse_links(out, folder.name, LEVELS_FOLDER)
        maker = _PyramidBuilder(folder, layout, layout.known(folder), _once(cameras, component), levels)
        cells = np.array([_cell(tile) for tile in members])
        cells -= cells.min(0)  # counted from the lowest one, so that each component ends in one root
        root, read = maker.place(
            dict(zip(map(tuple, cells.tolist()), members, strict=True)), int(cells.max()).bit_length()
        )
        if not root.children and sum(root.parts) > _MAX_PER_LEVEL:
            root = maker.parent([(root, read)], 1)
        yield component, folder, root


def remove_unnamed(folder: Path, root: PyramidNode) -> None:
    """Delete levels to which no node of the pyramid refers."""
    named = {node.uri.split("/")[1] for node in root.walk() if node.uri.startswith(f"{LEVELS_FOLDER}/")}
    for path in (folder / LEVELS_FOLDER).glob("*"):
        if path.name not in named:
            remove_tree(folder, LEVELS_FOLDER, path.name)


def remove_tree_files(out: Path, folder: str, layout_files: Sequence[str]) -> None:
    """Delete the trees of a component's folder, and their levels."""
    for name in layout_files:
        remove_file(out, folder, name)  # first: it names the levels
    remove_tree(out, folder, LEVELS_FOLDER)


def _once(cameras: Callable[[int], Cameras | None], component: int) -> Callable[[], Cameras | None]:
    """Return a function that loads the cameras of a component once, and only if needed."""
    found: list[Cameras | None] = []

    def get() -> Cameras | None:
        if not found:
            found.append(cameras(component))
        return found[0]

    return get


def _cell(tile: Tile) -> _Cell:
    """Return the cell of the grid that a tile's name states (`gsmap.export.plan_tiles`); a whole component is one."""
    named = _GRID_NAME.fullmatch(Path(tile.path).stem)
    return (0, 0, 0) if named is None else (int(named[1]), int(named[2]), int(named[3]))


@dataclass(frozen=True, eq=False)
class _PyramidBuilder:
    """Builder of the levels of one component.

    Args:
        folder: folder of the component.
        layout: its files.
        known: nodes of the folder's present tree, by uri.
        cameras, levels: see `gsmap.export.levels`.
    """

    folder: Path
    layout: TreeLayout
    known: Mapping[str, StoredNode]
    cameras: Callable[[], Cameras | None]
    levels: Params

    def place(self, tiles: Mapping[_Cell, Tile], height: int) -> tuple[PyramidNode, Gaussians | None]:
        """Return the node of a block, 2^height cells wide, and the Gaussians if it is a tile that was read."""
        if not height:
            (tile,) = tiles.values()
            uri, count, box, read = self.layout.tile(self.folder, tile, self.known)
            return PyramidNode(uri, tile.sha256, np.asarray(tile.bounds, np.float64), (count,), box[None]), read
        blocks: dict[_Cell, dict[_Cell, Tile]] = defaultdict(dict)
        for (x, y, z), tile in tiles.items():
            blocks[x >> height - 1, y >> height - 1, z >> height - 1][x, y, z] = tile
        below = [self.place(blocks[block], height - 1) for block in sorted(blocks)]
        return (below[0][0] if len(below) == 1 else self.parent(below, height)), None

    def parent(self, below: Sequence[tuple[PyramidNode, Gaussians | None]], height: int) -> PyramidNode:
        """Return the level above some children; reuse the stored level if its inputs are the same."""
        children = [child for child, _ in below]
        recipe = f"levels {VERSION} {self.levels} {self.layout.key} {backend()}"
        made_of = [recipe, *(child.digest for child in children)]
        digest = hashlib.sha256("\n".join(made_of).encode()).hexdigest()
        uri = self.layout.level_uri(digest[:24])
        path = self.folder / uri
        tiles = [tile for child in children for tile in child.tiles]
        cell = np.stack([np.min([c.cell[0] for c in children], axis=0), np.max([c.cell[1] for c in children], axis=0)])
        known = self.known.get(uri)
        if known is not None and is_file(path):
            boxes = known.boxes if known.boxes is not None else boxes_of(self.layout.read(path), known.parts)
            parts, error_m, extras = known.parts, known.error_m, dict(known.extras)
            children = _usable_children(children, error_m)
        else:
            finer = Gaussians.concatenate(
                [self.layout.read(self.folder / child.uri) if read is None else read for child, read in below]
            )
            most = min(_MAX_PER_LEVEL, max(1, len(finer) // _COARSENING))
            level = make_level(finer, most, self.cameras(), self.levels)
            make_folder(path.parent)
            parts, boxes = self.layout.write(path, level.gaussians, tiles)
            children = _usable_children(children, level.error_m)
            # A level's error must exceed its children's, or viewers would stop refining too early.
            error_m = max(level.error_m, 1.5 * max(child.error_m for child in children), 1e-3)
            measured = level.psnr_db or ()
            extras = {name: round(v, 2) for name, v in zip(("psnr_worst_db", "psnr_db"), measured, strict=False)}
        return PyramidNode(uri, digest, cell, parts, boxes, error_m, extras, tuple(children), height)


def _usable_children(children: Sequence[PyramidNode], error_m: float) -> list[PyramidNode]:
    """Return the children of a level; replace a child whose error is not below the level's by its own children."""
    kept: list[PyramidNode] = []
    for child in children:
        kept += [child] if not child.children or child.error_m < error_m else child.children
    return kept


def boxes_of(gaussians: Gaussians, parts: Sequence[int]) -> np.ndarray:
    """Return boxes (P, 2, 3) around runs of consecutive Gaussians; NaN for an empty run."""
    from gsmap.formats.tiles3d import box_of

    ends = np.cumsum([0, *parts])
    none = np.full((2, 3), np.nan)
    return np.stack([box_of(gaussians[a:b]) if b > a else none for a, b in pairwise(ends)])
