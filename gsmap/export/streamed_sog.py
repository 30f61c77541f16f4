"""Write the tiles of an export as streamed SOG, for PlayCanvas' engine and SuperSplat's viewer.

The tiles are stored beside it as bundled ``.sog``, and unbundled in the folders that the format requires.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from gsmap.durable import is_file, make_folder, open_file, sync_file, sync_folder, write_whole
from gsmap.errors import MALFORMED, CorruptError
from gsmap.export.levels import Params
from gsmap.export.pyramid import LEVELS_FOLDER, PyramidNode, StoredNode, boxes_of, build_pyramids, remove_unnamed
from gsmap.formats import sog, streamed_sog
from gsmap.formats.streamed_sog import LodNode, Run
from gsmap.types import Cameras, Gaussians, Tile

FILE_NAME = "lod-meta.json"


def write_streams(
    out: Path,
    tiles: Sequence[Tile],
    *,
    cameras: Callable[[int], Cameras | None] = lambda component: None,
    levels: Params | None = None,
) -> list[Path]:
    """Write ``lod-meta.json`` into each component's folder, with coarser levels of the tiles (`gsmap.export.levels`).

    See `gsmap.export.pyramid.build_pyramids` for reuse and memory. Positions and errors are in the map's frame and
    unit, as the format has no transform.

    Args:
        out: the export's folder with the tiles' ``.sog``.
        cameras: loads the cameras of the scenes of a component, in its frame.
        levels: settings of the levels.
    """
    written = []
    for _, folder, root in build_pyramids(out, tiles, StreamedSog(), cameras, levels or Params()):
        write_whole(folder / FILE_NAME, partial(streamed_sog.write_tree, root=_node(root, ())))
        remove_unnamed(folder, root)
        written.append(folder / FILE_NAME)
    return written


@dataclass(frozen=True)
class StreamedSog:
    """The files of a streamed SOG: for each tile and level, a folder with ``meta.json`` and images."""

    file_name: str = FILE_NAME
    key: str = f"sog {sog.VERSION}"

    def tile(
        self, folder: Path, tile: Tile, known: Mapping[str, StoredNode]
    ) -> tuple[str, int, np.ndarray, Gaussians | None]:
        bundle = folder / Path(tile.path).name
        uri = self.level_uri(tile.sha256[:24])
        if not is_file(folder / uri):
            make_folder((folder / uri).parent)
            sog.unbundled(bundle, (folder / uri).parent)
            _sync(folder / uri)
        found = sog.read(bundle)
        return uri, len(found), boxes_of(found, [len(found)])[0], found

    def level_uri(self, name: str) -> str:
        return f"{LEVELS_FOLDER}/{name}/meta.json"

    def read(self, path: Path) -> Gaussians:
        return sog.read(path)

    def write(
        self, path: Path, gaussians: Gaussians, tiles: Sequence[PyramidNode]
    ) -> tuple[tuple[int, ...], np.ndarray]:
        ordered, parts = streamed_sog.parted(gaussians, np.stack([tile.cell for tile in tiles]))
        make_folder(path.parent)
        write_whole(path, partial(sog.write, gaussians=ordered, ordered=True))
        _sync(path)
        return parts, boxes_of(ordered, parts)

    def known(self, folder: Path) -> dict[str, StoredNode]:
        try:
            with open(open_file(folder / FILE_NAME), "rb") as file:
                levels = streamed_sog.runs(json.loads(file.read()))
            return {
                uri: StoredNode(
                    max(float(run.extras["error_m"]) for run in runs),
                    {name: float(value) for name, value in runs[0].extras.items() if name != "error_m"},
                    tuple(run.count for run in runs),
                )
                for uri, runs in levels.items()
            }
        except (OSError, *MALFORMED, CorruptError):
            return {}  # missing or unknown: everything is made again


def _node(drawn: PyramidNode, above: tuple[tuple[PyramidNode, int], ...]) -> LodNode:
    """Return the tree's node of a pyramid node; ``above``: levels above it, each with the index of its first tile."""
    if not drawn.children:
        shown = {}
        boxes = []
        for level, at in (*above, (drawn, 0)):
            offset = sum(level.parts[:at])
            extras = {"error_m": level.error_m, **level.extras}
            shown[level.height] = Run(level.uri, offset, level.parts[at], extras)
            boxes.append(level.boxes[at])
        ends = np.stack(boxes)
        return LodNode(np.stack([np.nanmin(ends[:, 0], axis=0), np.nanmax(ends[:, 1], axis=0)]), shown)
    children, begun = [], 0
    for child in drawn.children:
        over = tuple((level, at + begun) for level, at in above)
        children.append(_node(child, (*over, (drawn, begun))))
        begun += len(child.tiles)
    return LodNode(drawn.box, {}, tuple(children))


def _sync(meta: Path) -> None:
    """Make the folder of a SOG durable on disk (fsync)."""
    for file in meta.parent.iterdir():
        sync_file(file)
    sync_folder(meta.parent)
