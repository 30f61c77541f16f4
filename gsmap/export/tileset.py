"""Write the tiles of an export as a 3D Tiles tileset, with levels of detail above the tiles."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from gsmap.durable import is_file, open_file, write_text_whole, write_whole
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
        metres_per_unit: metric scale of each component; all 1 if None.
        S_ecef_map: poses of georeferenced components in Earth-centred metres (EPSG:4978), for globes.
        compressed: whether tiles and levels are packed as SPZ.
        cameras: loads the cameras of the scenes of a component, in its frame.
        levels: settings of the levels.
    """
    written = []
    layout = Tiles3D(compressed)
    for component, folder, root in build_pyramids(out, tiles, layout, cameras, levels or Params()):
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


def write_whole_map(out: Path, components: Collection[int], georeferenced: Collection[int] = ()) -> str:
    """Write the ``tileset.json`` of the export's folder, which refers to those of the components.

    Components have unrelated frames, so they stand side by side along x, a tenth of the widest apart. If some are
    georeferenced, these stay in their places on the globe, and the others are left out.

    Returns:
        A remark on what is moved or left out; empty if nothing is.
    """
    shown = sorted(set(components) & set(georeferenced)) or sorted(components)
    uris = [f"component_{component}/{FILE_NAME}" for component in shown]
    linked = [tiles3d.LinkedTileset.of(uri, json.loads((out / uri).read_bytes())) for uri in uris]
    if len(linked) > 1 and not set(shown) <= set(georeferenced):
        gap, at = 0.1 * max(np.ptp(one.box[:, 0]) for one in linked), linked[0].box[0, 0]
        for k, one in enumerate(linked):
            linked[k] = replace(one, shift=np.array([at - one.box[0, 0], 0, 0]))
            at += np.ptp(one.box[:, 0]) + gap
    text = tiles3d.linking_tileset(linked)
    path = out / FILE_NAME
    if not is_file(path) or path.read_text() != text:
        write_text_whole(path, text)
    if len(shown) < len(components):
        return f"{FILE_NAME} shows the georeferenced components only; the others have their own in component_N"
    moved = any(one.shift.any() for one in linked)
    return f"{FILE_NAME} shows {len(shown)} components side by side, as nothing relates their frames" * moved


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
