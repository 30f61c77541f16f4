"""Read meshes (``.obj .stl .glb``, ``.ply`` with faces) and ``.pcd`` clouds with open3d, in a separate process.

A mesh becomes points spread evenly over its area, coloured by its textures, else by its vertices.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import numpy as np

from gsmap.errors import InputError, MissingDependencyError
from gsmap.formats.scans import limits
from gsmap.formats.scans.points import scan_of
from gsmap.formats.scans.process import read_in_process
from gsmap.types.scan import Scan

_SEED = 0


def read(path: Path, params: limits.Params) -> Scan:
    """Read the points of a cloud, or sample points on a mesh.

    Raises:
        InputError: not what its suffix says, damaged, or beyond the limits of time and memory.
        MissingDependencyError: open3d is not installed.
    """
    if importlib.util.find_spec("open3d") is None:
        raise MissingDependencyError(
            f"{path}: meshes and .pcd clouds are read by open3d, which is not installed", extra="mesh"
        )
    kind = "cloud" if path.suffix.lower() == ".pcd" else "mesh"
    if path.suffix.lower() == ".ply":
        _require_vertices(path)
    found = read_in_process(path, kind, params)
    vertices, colours = _checked(found, "vertices", 3, path), found.get("colours")
    if colours is not None:
        colours = _checked(found, "colours", 3, path) if len(colours) == len(vertices) else None
    if colours is not None and not colours.any():
        colours = None  # what a library fills in where a file has none
    triangles = found.get("triangles", np.zeros((0, 3), np.int64))
    if not len(vertices):
        raise InputError(
            f"{path} holds no {'points' if kind == 'cloud' else 'mesh'} that open3d can read", code="wrong_file_type"
        )
    if not len(triangles):
        total = len(vertices)
        rows = slice(None, None, -(-total // limits.MAX_POINTS))
        return scan_of(vertices[rows], None if colours is None else np.clip(colours[rows], 0, 1), path, total)
    return _sampled(path, found, vertices, colours, limits.MAX_POINTS)


def _sampled(path: Path, found: dict[str, Any], vertices: np.ndarray, colours: np.ndarray | None, count: int) -> Scan:
    """Sample points evenly over a mesh's area (Osada et al. 2002, eq. 1), always the same points for the same file."""
    triangles = _checked(found, "triangles", 3, path).astype(np.int64)
    if triangles.min() < 0 or triangles.max() >= len(vertices):
        raise InputError(
            f"{path} is damaged: its triangles refer to vertices that it does not have", code="file_damaged"
        )
    corners = vertices[triangles]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    areas = np.where(np.isfinite(areas), areas, 0.0)
    if not areas.sum() > 0:
        raise InputError(f"{path}: its triangles have no area, so there is no surface to localize", code="empty_scan")
    rng = np.random.default_rng(_SEED)
    # Strata of equal area: each point from its own, so that no patch is missed by chance.
    at = (np.arange(count) + rng.uniform(size=count)) / count
    total = np.cumsum(areas)
    rows = np.minimum(np.searchsorted(total, at * total[-1]), len(areas) - 1)
    r1, r2 = np.sqrt(rng.uniform(size=count)), rng.uniform(size=count)
    shares = np.stack([1 - r1, r1 * (1 - r2), r1 * r2], axis=1)
    points = np.einsum("nk,nkj->nj", shares, corners[rows])
    seen = _textured(found, rows, shares)
    if seen is None and colours is not None:
        seen = np.einsum("nk,nkj->nj", shares, colours[triangles[rows]])
    note = f"{count:,} points spread over the {areas.sum():,.0f} square units of its {len(triangles):,} triangles"
    return scan_of(points, None if seen is None else np.clip(seen, 0, 1), path, count, kind="mesh", notes=(note,))


def _textured(found: dict[str, Any], rows: np.ndarray, shares: np.ndarray) -> np.ndarray | None:
    """Return the colours (N, 3) of the samples from the mesh's textures; None if it has none, or if they do not fit."""
    pictures = [found[name] for name in sorted(n for n in found if n.startswith("texture"))]
    pictures = [found[f"texture{number}"] for number in range(len(pictures))]
    uvs, materials = found.get("uvs"), found.get("materials")
    count = len(found["triangles"])
    if not any(picture.size for picture in pictures) or uvs is None or uvs.shape != (3 * count, 2):
        return None
    which = np.zeros(count, np.int64) if materials is None or materials.shape != (count,) else materials
    at = np.einsum("nk,nkj->nj", shares, uvs.reshape(count, 3, 2)[rows])
    at = at - np.floor(at)  # textures repeat
    out = np.full((len(rows), 3), 0.5)
    for number, picture in enumerate(pictures):
        mine = which[rows] == number
        if picture.dtype != np.uint8 or picture.ndim not in (2, 3) or not picture.size or not mine.any():
            continue
        picture = picture.reshape(*picture.shape[:2], -1)
        tall, wide, channels = picture.shape
        column = np.minimum((at[mine, 0] * wide).astype(np.int64), wide - 1)
        row = np.minimum((at[mine, 1] * tall).astype(np.int64), tall - 1)
        pixels = picture[row, column].astype(np.float64) / 255
        out[mine] = pixels[:, :3] if channels >= 3 else pixels[:, :1]
    return out


def _checked(found: dict[str, np.ndarray], name: str, width: int, path: Path) -> np.ndarray:
    array = found.get(name, np.zeros((0, width)))
    if array.ndim != 2 or array.shape[1] != width or array.dtype.kind not in "fiu":
        raise InputError(f"{path} is damaged: its {name} cannot be read", code="file_damaged")
    return array


def _require_vertices(path: Path) -> None:
    """Raise an error if a PLY header promises more rows than the file holds, before a library allocates them."""
    from gsmap.formats import ply

    header = ply.read_header(path)
    size = path.stat().st_size - header.data_offset
    for element in header.elements.values():
        least = 2 if header.encoding == "ascii" or element.has_list else element.dtype.itemsize
        if element.count * least > size + 1:
            raise InputError(
                f"{path} is truncated: its header promises {element.count:,} rows of {element.name}, "
                f"but {size:,} bytes follow",
                code="file_truncated",
            )
