"""Read and write 3D Tiles 1.1: ``tileset.json`` beside a folder of GLB files, where finer tiles replace coarser tiles.

The root tile's frame is the frame of the Gaussians. 3D Tiles turns glTF from y up to z up, so every GLB carries the
inverse of that turn on its node: what is stored is in the root's frame as it is, and viewers agree whether or not they
turn SH with a node. The root's ``transform`` alone places the map in a viewer's world, by default so that
right-down-front, the axes of a trained ``.ply``, stands upright.

For a map too large for memory, `write_content` each tile as it is made and `write_tileset` at the end; `write` does
both for one set of Gaussians, with an octree and levels of detail.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from gsmap.errors import MALFORMED, ConfigError, InputError
from gsmap.formats import glb
from gsmap.formats.inside import file_inside
from gsmap.formats.quantise import require_writable
from gsmap.geometry.boxes import cube_around, octants
from gsmap.geometry.decimate import decimate
from gsmap.geometry.voxels import reached_box
from gsmap.types import Gaussians

VERSION = 2
HOLDS_ORIGIN = True

CONTENT_FOLDER = "tiles"
_MAX_JSON_BYTES = 64 << 20
_MAX_DEPTH = 64
_MAX_TILES = 100_000
_SIGMAS = 3.0
_Y_UP_TO_Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
_UPRIGHT = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])  # right-down-front to z up


@dataclass(frozen=True, eq=False)
class TileNode:
    """One tile of a tileset.

    Args:
        box: (2, 3) bounding box of the tile and its children, root frame.
        error_m: Geometric error in the unit of the frame; 0 for the original Gaussians.
        uri: Path of its GLB, relative to ``tileset.json``, with ``/``; None without content.
        children: Finer tiles that replace it.
        extras: Additional numbers by name, which viewers ignore.
    """

    box: np.ndarray
    error_m: float
    uri: str | None = None
    children: tuple[TileNode, ...] = ()
    extras: Mapping[str, float] = field(default_factory=dict)


def read(path: str | os.PathLike[str]) -> Gaussians:
    """Read the finest level of a tileset in the frame of its root tile, without applying the root's own transform.

    Raises:
        InputError: not a tileset, implicit tiling, content that is not splats in GLB, or that lies outside the
            tileset's folder.
    """
    path = Path(path)
    if path.stat().st_size > _MAX_JSON_BYTES:
        raise InputError(
            f"{path} is larger than the {_MAX_JSON_BYTES >> 20} MiB of JSON that gsmap reads", code="file_too_large"
        )
    try:
        tileset = json.loads(path.read_bytes())
        contents = list(_finest(path, tileset["root"]))
    except MALFORMED as error:
        if isinstance(error, InputError):
            raise
        raise InputError(
            f"{path} is not a 3D Tiles tileset: {type(error).__name__} {error}", code="wrong_file_type"
        ) from error
    if not contents:
        raise InputError(f"{path} has no tiles with content", code="file_damaged")
    return Gaussians.concatenate(
        [glb.read_world(file_inside(path, uri, ".glb"), matrix @ _Y_UP_TO_Z_UP) for uri, matrix in contents]
    )


def write(
    path: str | os.PathLike[str],
    gaussians: Gaussians,
    *,
    max_per_tile: int = 100_000,
    transform: np.ndarray | None = None,
    compressed: bool = True,
) -> None:
    """Write a tileset of an octree: leaves have all Gaussians, each tile above them at most ``max_per_tile / 4``.

    What is coarse is merged pair by pair with its moments kept, never dropped. Content files are named by their
    digest, so an older ``tileset.json`` in the same folder stays whole until it is replaced.

    Args:
        max_per_tile: Gaussians in one leaf; what is above costs about a third more bytes in all.
        transform: (4, 4) from the Gaussians' frame to the viewer's world; upright for right-down-front if None.
        compressed: Pack the content as SPZ, which CesiumJS requires; otherwise float32, five times the bytes.
    """
    path = Path(path)
    if max_per_tile < 1:
        raise ConfigError(f"max_per_tile must be at least 1, got {max_per_tile}", code="out_of_range")
    require_writable(path, gaussians)
    local = replace(gaussians, origin=np.zeros(3))
    root, _ = _octree(path, local, *cube_around(local.means), max_per_tile, "0", compressed)
    write_tileset(path, root, transform=transform, compressed=compressed, origin=gaussians.origin)


def write_content(path: str | os.PathLike[str], gaussians: Gaussians, *, compressed: bool = True) -> None:
    """Write the GLB file of one tile."""
    require_writable(path, gaussians)
    writer = glb.write_packed if compressed else glb.write_world
    writer(path, gaussians, np.linalg.inv(_Y_UP_TO_Z_UP))


def read_content(path: str | os.PathLike[str]) -> Gaussians:
    """Read the GLB file of one tile, in the frame in which it was written."""
    return glb.read_world(Path(path), _Y_UP_TO_Z_UP).about(np.zeros(3))


def write_tileset(
    path: str | os.PathLike[str],
    root: TileNode,
    *,
    transform: np.ndarray | None = None,
    compressed: bool = True,
    origin: np.ndarray | None = None,
) -> None:
    """Write ``tileset.json``; call this last, when the content that it refers to exists.

    Args:
        compressed: The content is packed as SPZ.
        transform: (4, 4) from the root's frame to the viewer's world; upright for right-down-front if None.
        origin: (3,) in the root's frame that the nodes' boxes and content are about: a tile between the root and them
            has it as its transform, in double precision.
    """
    tile = _tile_json(root) | {"refine": "REPLACE"}
    if origin is not None and origin.any():
        shift = np.eye(4)
        shift[:3, 3] = origin
        outer = TileNode(root.box + origin, float(np.linalg.norm(root.box[1] - root.box[0])))  # of drawing nothing
        tile = _tile_json(outer) | {"refine": "REPLACE", "children": [tile | {"transform": shift.T.ravel().tolist()}]}
    matrix = _UPRIGHT if transform is None else np.asarray(transform, float)
    tile["transform"] = matrix.T.ravel().tolist()
    diagonal = float(np.linalg.norm(root.box[1] - root.box[0]))
    scale = float(np.linalg.norm(matrix[:3, :3], axis=0).max())  # a tile's own transform scales its error, not this one
    used: dict[str, Any] = {"extensionsUsed": [glb.EXTENSION]}
    if compressed:  # CesiumJS looks for them here before it loads any content
        used = {key: [glb.EXTENSION, glb.SPZ_EXTENSION] for key in ("extensionsUsed", "extensionsRequired")}
    tileset = {
        "asset": {"version": "1.1", "generator": "gsmap"},
        "geometricError": scale * max(diagonal, root.error_m),  # of drawing nothing at all
        "extensionsUsed": ["3DTILES_content_gltf"],
        "extensions": {"3DTILES_content_gltf": used},
        "root": tile,
    }
    Path(path).write_text(json.dumps(tileset, indent=1))


@dataclass(frozen=True, eq=False)
class LinkedTileset:
    """A tileset that another one refers to.

    Args:
        uri: path of its ``tileset.json``, relative to the other.
        box: (2, 3) box around its root tile in its own world.
        error_m: error of drawing nothing of it.
        used, required: extensions of its content.
        shift: (3,) where its world's origin lies in the other's.
    """

    uri: str
    box: np.ndarray
    error_m: float
    used: tuple[str, ...]
    required: tuple[str, ...]
    shift: np.ndarray = field(default_factory=lambda: np.zeros(3))

    @classmethod
    def of(cls, uri: str, tileset: Mapping[str, Any]) -> LinkedTileset:
        """Describe a tileset that `write_tileset` wrote."""
        root, content = tileset["root"], tileset["extensions"]["3DTILES_content_gltf"]
        box = np.asarray(root["boundingVolume"]["box"], np.float64).reshape(4, 3)
        matrix = np.asarray(root["transform"], np.float64).reshape(4, 4).T
        center = matrix[:3, :3] @ box[0] + matrix[:3, 3]
        half = np.abs(box[1:] @ matrix[:3, :3].T).sum(0)
        used, required = (tuple(content.get(key, ())) for key in ("extensionsUsed", "extensionsRequired"))
        return cls(uri, np.stack([center - half, center + half]), float(tileset["geometricError"]), used, required)


def linking_tileset(linked: Sequence[LinkedTileset]) -> str:
    """Return the JSON of a tileset that shows other tilesets together."""
    corners = np.stack([one.box + one.shift for one in linked])
    around = np.stack([corners[:, 0].min(0), corners[:, 1].max(0)])
    error_m = max(one.error_m for one in linked)
    root = _tile_json(TileNode(around, error_m)) | {"refine": "ADD", "children": []}
    for one in linked:
        shift = np.eye(4)
        shift[:3, 3] = one.shift
        tile = _tile_json(TileNode(one.box, one.error_m, one.uri))
        root["children"].append(tile | ({"transform": shift.T.ravel().tolist()} if one.shift.any() else {}))
    content = {
        key: sorted({name for one in linked for name in names(one)})
        for key, names in (
            ("extensionsUsed", lambda one: one.used),
            ("extensionsRequired", lambda one: one.required),
        )
    }
    tileset = {
        "asset": {"version": "1.1", "generator": "gsmap"},
        "geometricError": error_m,
        "extensionsUsed": ["3DTILES_content_gltf"],
        "extensions": {"3DTILES_content_gltf": {key: names for key, names in content.items() if names}},
        "root": root,
    }
    return json.dumps(tileset, indent=1)


def coarser(gaussians: Gaussians, max_count: int) -> tuple[Gaussians, float]:
    """Reduce Gaussians to at most ``max_count`` that look alike from afar; return them and how far content moved.

    Moments and transmittance are kept; see `gsmap.geometry.decimate`. The distance is the 95th percentile of the
    distances from each Gaussian to the Gaussian that replaces it, in the frame's unit; 0 if none was merged.
    """
    level, into = decimate(gaussians, max_count)
    if len(level) == len(gaussians):
        return level, 0.0
    apart = gaussians.means.astype(np.float64) - level.means.take(into, axis=0)
    return level, float(np.quantile(np.sqrt(np.einsum("nk,nk->n", apart, apart)), 0.95))


def box_of(gaussians: Gaussians) -> np.ndarray:
    """Return the box (2, 3) float64 around the Gaussians, each extended by three standard deviations along the axes."""
    return reached_box(gaussians, _SIGMAS)


def _octree(
    path: Path, gaussians: Gaussians, center: np.ndarray, side: float, max_per_tile: int, name: str, compressed: bool
) -> tuple[TileNode, Gaussians]:
    """Write the tile of a cube and all tiles below it; return it and its Gaussians, which the parent reduces."""
    children, levels = [], []
    if len(gaussians) > max_per_tile and len(name) < _MAX_DEPTH // 2:
        for i, inside, middle in octants(gaussians.means, center, side):
            part, below = gaussians[inside], f"{name}{i}"
            node, level = _octree(path, part, middle, side / 2, max_per_tile, below, compressed)
            children.append(node)
            levels.append(level)
    if not children:
        return TileNode(box_of(gaussians), 0.0, _place(path, gaussians, name, compressed)), gaussians
    level, error_m = coarser(Gaussians.concatenate(levels), max(1, max_per_tile // 4))
    coarsest = max(child.error_m for child in children)
    boxes = np.stack([box_of(level), *(child.box for child in children)])
    box = np.stack([boxes[:, 0].min(0), boxes[:, 1].max(0)])
    return TileNode(box, max(error_m, 1.5 * coarsest), _place(path, level, name, compressed), tuple(children)), level


def _place(path: Path, gaussians: Gaussians, name: str, compressed: bool) -> str:
    """Write one GLB into the content folder under a name with its digest; return its uri."""
    folder = path.parent / CONTENT_FOLDER
    folder.mkdir(exist_ok=True)
    staged = folder / f".{os.getpid()}.{name}.glb"
    try:
        write_content(staged, gaussians, compressed=compressed)
        with open(staged, "rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        uri = f"{CONTENT_FOLDER}/{name}-{digest[:12]}.glb"
        os.replace(staged, path.parent / uri)
    finally:
        staged.unlink(missing_ok=True)
    return uri


def _tile_json(node: TileNode) -> dict[str, Any]:
    center, half = (node.box[0] + node.box[1]) / 2, (node.box[1] - node.box[0]) / 2
    box = [*center.tolist(), half[0], 0, 0, 0, half[1], 0, 0, 0, half[2]]
    tile: dict[str, Any] = {"boundingVolume": {"box": [float(v) for v in box]}, "geometricError": float(node.error_m)}
    if node.uri is not None:
        tile["content"] = {"uri": node.uri}
    if node.extras:
        tile["extras"] = dict(node.extras)
    if node.children:
        tile["children"] = [_tile_json(child) for child in node.children]
    return tile


def _finest(path: Path, root: dict[str, Any]) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the uri and matrix of each content that is drawn when every tile is refined."""
    todo = [(root, np.eye(4), "REPLACE", 0)]
    seen = 0
    while todo:
        tile, matrix, refine, depth = todo.pop()
        seen += 1
        if depth > _MAX_DEPTH or seen > _MAX_TILES:
            raise InputError(
                f"{path}: more than {_MAX_TILES} tiles, or nested deeper than {_MAX_DEPTH}", code="nested_too_deeply"
            )
        if "implicitTiling" in tile:
            raise InputError(f"{path} uses implicit tiling, which gsmap does not read", code="unsupported_feature")
        if tile is not root and "transform" in tile:
            matrix = matrix @ np.array(tile["transform"], np.float64).reshape(4, 4).T
        refine = str(tile.get("refine", refine)).upper()
        children = tile.get("children", [])
        if not children or refine == "ADD":
            for content in tile.get("contents", [tile["content"]] if "content" in tile else []):
                yield _file_of(path, content), matrix
        todo += [(child, matrix, refine, depth + 1) for child in reversed(children)]


def _file_of(path: Path, content: dict[str, Any]) -> str:
    """Return the uri of a tile's content (``url`` before 3D Tiles 1.0), without query and fragment."""
    uri = content.get("uri", content.get("url"))
    if not isinstance(uri, str) or not uri:
        raise InputError(f"{path} is not a 3D Tiles tileset: the content of a tile has no uri", code="wrong_file_type")
    return uri.split("#", 1)[0].split("?", 1)[0]
