"""Read LAS and LAZ (integers with a scale and an offset) as float64, with laspy (extra ``las``)."""

from __future__ import annotations

import importlib.util
import struct
from pathlib import Path

import numpy as np

from gsmap.errors import InputError, MissingDependencyError
from gsmap.formats.scans import limits
from gsmap.formats.scans.points import scan_of
from gsmap.formats.scans.process import read_in_process
from gsmap.types.scan import Scan

_HEADER_BYTES, _LEAST_HEADER_BYTES = 375, 227
_RECORD_BYTES, _EXTENDED_BYTES = 54, 60  # of the header of a record of variable length
_SIXTEEN_BITS, _EIGHT_BITS = 65535.0, 255.0


def read(path: Path, params: limits.Params) -> Scan:
    """Read the points with their colours, relative to an origin near them.

    Raises:
        InputError: damaged, truncated, or a scale or offset that is no number.
        MissingDependencyError: laspy or lazrs is not installed.
    """
    if not all(importlib.util.find_spec(name) for name in ("laspy", "lazrs")):
        raise MissingDependencyError(f"{path}: .las and .laz are read by laspy, which is not installed", extra="las")
    _require_header(path)
    found = read_in_process(path, "las", params)
    counts, scales, offsets = found.get("counts", np.zeros((0, 3))), found["scales"], found["offsets"]
    total, seen = found["total"].tolist()
    if not (np.isfinite(scales).all() and np.isfinite(offsets).all() and (scales > 0).all()):
        raise InputError(
            f"{path} is damaged: its scales {scales.tolist()} or offsets {offsets.tolist()} are not usable",
            code="file_damaged",
        )
    if seen < total:
        raise InputError(
            f"{path} is truncated: its header promises {total:,} points, {seen:,} were found", code="file_truncated"
        )
    if not len(counts):
        raise InputError(f"{path} has no points: there is nothing to look for", code="empty_scan")
    # The integers are exact, and so is an origin that is one of them: nothing is lost to large coordinates.
    middle = np.round(np.median(counts, axis=0))
    points = (counts - middle) * scales
    colours = _colours(found["colours"]) if "colours" in found else None
    return scan_of(points, colours, path, total, origin=middle * scales + offsets)


def _require_header(path: Path) -> None:
    """Raise an error if the header promises more records than fit into the file, as laspy would search for all of them.

    The layout is that of the public header block (ASPRS LAS 1.4 R15, 2.4).
    """
    size = path.stat().st_size
    with open(path, "rb") as file:
        head = file.read(_HEADER_BYTES)
    if len(head) < _LEAST_HEADER_BYTES or head[:4] != b"LASF":
        raise InputError(f"{path} is not a LAS file: it has no LAS header", code="wrong_file_type")
    own, points, records = struct.unpack_from("<HII", head, 94)
    (length,) = struct.unpack_from("<H", head, 105)
    extended = struct.unpack_from("<I", head, 243)[0] if head[25] >= 4 and len(head) == _HEADER_BYTES else 0
    room = _LEAST_HEADER_BYTES <= own <= points <= size
    packed = bool(head[104] & 0x80)
    total = struct.unpack_from("<Q", head, 247)[0] if head[25] >= 4 and len(head) == _HEADER_BYTES else 0
    total = max(total, struct.unpack_from("<I", head, 107)[0])
    room &= total * (1 if packed else 8 * length) <= 8 * (size - points)  # a packed point has a bit at the least
    room &= own + records * _RECORD_BYTES <= points and extended * _EXTENDED_BYTES <= size
    if not room or not length:
        raise InputError(
            f"{path}: its LAS header does not fit the file of {size:,} bytes: it is truncated or damaged",
            code="file_truncated",
        )


def _colours(values: np.ndarray) -> np.ndarray | None:
    """Return colours (N, 3) in [0, 1]; None if all are zero. Some writers use only 8 of the 16 bits."""
    most = int(values.max(initial=0))
    return None if most == 0 else values / (_SIXTEEN_BITS if most > _EIGHT_BITS else _EIGHT_BITS)
