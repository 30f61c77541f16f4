"""Read scans (point clouds, meshes and depth pictures) for localization in a map.

Nothing that a file says of itself is believed: counts are held against its size, values against what they can be, and
what only a library can read is read by a process of its own, within limits (`gsmap.formats.scans.process`).
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from gsmap.errors import InputError, NotFoundError
from gsmap.formats.scans.depth import read_depth
from gsmap.formats.scans.limits import Params
from gsmap.types.scan import Scan

SUFFIXES = (".ply", ".pcd", ".xyz", ".las", ".laz", ".obj", ".stl", ".glb")
"""Suffixes of point clouds and meshes. A ``.ply`` or ``.glb`` may hold a splat instead (`holds_splat`)."""

__all__ = ["SUFFIXES", "Params", "holds_splat", "is_scan", "read", "read_depth"]


def is_scan(path: str | os.PathLike[str]) -> bool:
    """Return true if a path has the suffix of a point cloud, mesh or splat; the file need not exist."""
    from gsmap.formats import suffix_of

    return _suffix(Path(path)) in SUFFIXES or suffix_of(path) is not None


def holds_splat(path: str | os.PathLike[str]) -> bool:
    """Return true if a file holds Gaussians (read by `gsmap.formats.read`), false if it holds a scan.

    Raises:
        NotFoundError: no such file.
        InputError: a header that cannot be read, or neither by its suffix.
    """
    path = Path(path)
    suffix = _suffix(path)
    _require(path)
    if suffix == ".ply":
        from gsmap.formats import ply

        header = ply.read_header(path)
        vertex = header.elements.get("vertex")
        return ply.is_compressed(header) or (vertex is not None and "scale_0" in vertex.names)
    if suffix == ".glb":
        from gsmap.formats import glb

        return glb.holds_splats(path)
    if not is_scan(path):
        raise InputError(
            f"{path} has the suffix {suffix or '(none)'}: a scan is one of {', '.join(SUFFIXES)}, or a splat",
            code="unsupported_format",
        )
    return suffix not in SUFFIXES


def read(path: str | os.PathLike[str], params: Params | None = None) -> Scan:
    """Read the points of a cloud, or sample points evenly over the area of a mesh; `Scan` documents frames and units.

    Raises:
        NotFoundError: no such file.
        InputError: an unknown suffix, a file that is damaged or not what its suffix says, or no finite point.
        MissingDependencyError: ``.las`` and ``.laz`` need the extra ``las``, meshes and ``.pcd`` the extra ``mesh``.
    """
    path, params = Path(path), params or Params()
    suffix = _suffix(path)
    _require(path)
    if suffix not in SUFFIXES:
        raise InputError(
            f"{path} has the suffix {suffix or '(none)'}: a scan is one of {', '.join(SUFFIXES)}",
            code="unsupported_format",
        )
    try:
        with np.errstate(all="ignore"):
            found = _read(path, suffix, params)
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}", code="file_unreadable") from error
    return found.about_its_middle()


def _read(path: Path, suffix: str, params: Params) -> Scan:
    if suffix in (".las", ".laz"):
        from gsmap.formats.scans import las

        return las.read(path, params)
    if suffix == ".xyz":
        from gsmap.formats.scans import text

        return text.read(path)
    if suffix == ".ply":
        from gsmap.formats.scans import ply_points

        if not ply_points.is_mesh(path):
            return ply_points.read(path)
    from gsmap.formats.scans import meshes

    return meshes.read(path, params)


def _suffix(path: Path) -> str:
    return path.suffix.lower()


def _require(path: Path) -> None:
    if not path.exists():
        raise NotFoundError(f"cannot read {path}: no such file", code="file_not_found")
    if not path.is_file():
        raise InputError(f"cannot read {path}: it is a folder, a pipe or a device, not a file", code="not_a_plain_file")
