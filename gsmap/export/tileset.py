"""Write the tiles of an export as a 3D Tiles tileset, with levels of detail above the tiles."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from gsmap.durable import open_file, write_whole
from gsmap.errors import MALFORMED, CorruptError
from gsmap.export.levels import Params
from gsmap.export.pyramid import LEVELS_FOLDER, PyramidNode, StoredNode, build_pyramids, remove_unnamed
from gsmap.formats import tiles3d
from gsmap.formats.tiles3d import TileNode
from gsmap.types import Cameras, Gaussians, Sim3, Tile

FILE_NAME = "tileset.json"


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

    See `gsmap.export.pyramid.build_pyramids` for reuse and memory. 3D Tiles are in metres: the root's transform scales
    the map's unit, including geometric errors.

    Args:
        out: the export's folder with the tiles' ``.glb``.
        tile_size_m: edge of the grid's tiles, > 0.
        metres_per_unit: metric scale of each component; all 1 if None.
        S_ecef_map: poses of georeferenced components in Earth-centred metres (EPSG:4978), for globes.
        compressed: whether tiles and levels are packed as SPZ.
        cameras: loads the cameras of the scenes of a component, in its frame.
        levels: settings of the levels.
    """
    written = []
    layout = Tiles3D(compressed)
    for component, folder, root in build_pyramids(
        out, tiles, tile_size_m, layout, metres_per_unit, cameras, levels or Params()
    ):
        metres = 1.0 if metres_per_unit is None else metres_per_unit[component]
        # The map's z is up where gravity is known.
        transform = np.diag([metres, metres, metres, 1.0])
        if S_ecef_map is not None and component in S_ecef_map:
            transform = S_ecef_map[component].matrix()
        write = partial(tiles3d.write_tileset, root=_node(root), transform=transform, compressed=compressed)
        write_whole(folder / FILE_NAME, write)
        remove_unnamed(folder, root)
        written.append(folder / FILE_NAME)
    return written


@dataclass(frozen=True)
class Tiles3D:
    """The files of 3D Tiles: a ``.glb`` for each tile and level.

    Args:
        compressed: whether they are packed as SPZ.
    """

    compressed: bool = True
    file_name: str = FILE_NAME

    @property
    def key(self) -> str:
        return str(self.compressed)

    def tile(
        self, folder: Path, tile: Tile, known: Mapping[str, StoredNode]
    ) -> tuple[str, int, np.ndarray, Gaussians | None]:
        uri = Path(tile.path).name
        there = known.get(uri)
        # A file older than the tree is the one that the tree describes.
        if (
            there is not None
            and there.boxes is not None
            and _written_ns(folder / uri) < _written_ns(folder / FILE_NAME)
        ):
            return uri, tile.num_gaussians, there.boxes[0], None
        found = self.read(folder / uri)
        return uri, len(found), tiles3d.box_of(found), found

    def level_uri(self, name: str) -> str:
        return f"{LEVELS_FOLDER}/{name}.glb"

    def read(self, path: Path) -> Gaussians:
        return tiles3d.read_content(path)

    def write(
        self, path: Path, gaussians: Gaussians, tiles: Sequence[PyramidNode]
    ) -> tuple[tuple[int, ...], np.ndarray]:
        write_whole(path, partial(tiles3d.write_content, gaussians=gaussians, compressed=self.compressed))
        return (len(gaussians),), tiles3d.box_of(gaussians)[None]

    def known(self, folder: Path) -> dict[str, StoredNode]:
        found: dict[str, StoredNode] = {}

        def walk(tile: dict) -> None:
            center, axes = (
                np.array(tile["boundingVolume"]["box"][:3]),
                np.reshape(tile["boundingVolume"]["box"][3:], (3, 3)),
            )
            half = np.diag(axes)
            box, uri = np.stack([center - half, center + half]), tile["content"]["uri"]
            found[uri] = StoredNode(float(tile["geometricError"]), dict(tile.get("extras", {})), (0,), box[None])
            for child in tile.get("children", ()):
                walk(child)

        try:
            with open(open_file(folder / FILE_NAME), "rb") as file:
                walk(json.loads(file.read())["root"])
        except (OSError, *MALFORMED, CorruptError):
            return {}  # missing or unknown: everything is made again
        return found


def _written_ns(path: Path) -> int:
    return path.stat().st_mtime_ns


def _node(drawn: PyramidNode) -> TileNode:
    children = tuple(_node(child) for child in drawn.children)
    return TileNode(drawn.box, drawn.error_m, drawn.uri, children, drawn.extras)
