"""Read XGRIDS' ``.lcc``: JSON beside ``index.bin``, ``data.bin`` and, with SH, ``shcoef.bin``, with levels of detail.

Units of a grid in x and y, each with a run of rows for every level in ``data.bin``: positions in float32, the rest
within bounds that the JSON gives. Frame: x right, y front, z up, in metres. Data Organization Format originated from
XGRIDS: https://github.com/xgrids/LCCWhitepaper (version 5).
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gsmap.errors import MALFORMED, InputError
from gsmap.formats.axes import PLY, change_axes
from gsmap.formats.inside import file_inside
from gsmap.formats.quantise import from_smallest_three, logits_of_bytes
from gsmap.geometry.sh import sh0_of_rgb
from gsmap.stream import load_all
from gsmap.types import FileInfo, Gaussians
from gsmap.types.gaussians import CHUNK_ROWS

VERSION = 1

_AXES = "RFU"
_MAX_META_BYTES = 4 << 20
_MAX_LEVELS = 32
_MAX_INDEX_BYTES = 256 << 20
_ROW = np.dtype([("mean", "<f4", 3), ("rgba", "u1", 4), ("scale", "<u2", 3), ("quat", "<u2", 2), ("normal", "<u2", 3)])
_SH_ROW = np.dtype(("<u4", 16))  # fifteen colours and one unused
_TINY = np.finfo(np.float32).tiny
# Two bits name the largest of x, y, z, w; ours are w, x, y, z, and so are the other three in their order.
_LARGEST = np.array([1, 2, 3, 0])
_OTHERS = np.array([[2, 0, 1], [2, 0, 1], [2, 0, 1], [0, 1, 2]])


def read(path: str | os.PathLike[str]) -> Gaussians:
    """Read the finest level of an ``.lcc``; leave out the environment (``environment.bin``).

    Raises:
        InputError: Not the JSON of an ``.lcc``, missing files, or invalid row ranges.
    """
    return stream(path).load()


def stream(path: str | os.PathLike[str]) -> LccSource:
    """Open the finest level of an ``.lcc``, to be read in chunks; see `read`.

    Raises:
        InputError: as `read`.
    """
    path = Path(path)
    meta = _meta(path)
    try:
        levels = int(meta["totalLevel"])
        bounds = {str(one["name"]): _bounds(one) for one in meta["attributes"] if one["name"] in ("scale", "shcoef")}
        with_sh = meta.get("fileType") == "Quality" or (meta.get("fileType") is None and "shcoef" in bounds)
        if not 0 < levels <= _MAX_LEVELS or "scale" not in bounds or (with_sh and "shcoef" not in bounds):
            raise InputError(
                f"{path}: {levels} levels, bounds of {sorted(bounds)}: not what gsmap reads of an .lcc",
                code="unsupported_version",
            )
    except MALFORMED as error:
        if isinstance(error, InputError):
            raise
        raise InputError(
            f"{path} is not the JSON of an .lcc: {type(error).__name__} {error}", code="not_json"
        ) from error
    data = _beside(path, "data.bin")
    sh = _beside(path, "shcoef.bin") if with_sh else None
    return LccSource(path, data, sh, _runs(path, levels, data, sh), bounds)


def info(path: str | os.PathLike[str]) -> FileInfo:
    """Return the metadata, with a note if the file has an environment, which is left out.

    Raises:
        InputError: as `read`.
    """
    path = Path(path)
    _meta(path)
    notes = ["Data Organization Format originated from XGRIDS"]
    if any(one.name.lower() == "environment.bin" for one in path.parent.iterdir()):
        notes.append(f"{path.name}: the environment was left out")
    return FileInfo(notes=tuple(notes))


@dataclass(frozen=True, eq=False)
class LccSource:
    """A source of the finest level of an ``.lcc``, which reads the file on demand.

    Args:
        path: Path of the JSON.
        data, sh: Files of the rows; ``sh`` is None without SH.
        runs: (R, 2) int64 first row and number of rows of each unit.
        bounds: (2, 3) bounds of scales and of SH.
    """

    path: Path
    data: Path
    sh: Path | None
    runs: np.ndarray
    bounds: dict[str, np.ndarray]

    @property
    def num_gaussians(self) -> int:
        return int(self.runs[:, 1].sum())

    @property
    def sh_degree(self) -> int:
        return 0 if self.sh is None else 3

    def chunks(self) -> Iterator[Gaussians]:
        for first, count in self.runs.tolist():
            for begin in range(first, first + count, CHUNK_ROWS):
                wanted = min(CHUNK_ROWS, first + count - begin)
                rows = np.fromfile(self.data, _ROW, wanted, offset=begin * _ROW.itemsize)
                more = None
                if self.sh is not None:
                    more = np.fromfile(self.sh, "<u4", 16 * wanted, offset=begin * _SH_ROW.itemsize).reshape(-1, 16)
                if len(rows) != wanted or (more is not None and len(more) != wanted):
                    raise InputError(
                        f"{self.path}: {self.data.name} changed during reading: read it again", code="file_changed"
                    )
                yield self._decoded(rows, more)

    def columns(self, name: str) -> Iterator[np.ndarray]:
        for chunk in self.chunks():
            yield getattr(chunk, name)

    def load(self) -> Gaussians:
        return load_all(self)

    def _decoded(self, rows: np.ndarray, more: np.ndarray | None) -> Gaussians:
        low, high = self.bounds["scale"]
        scales = low + (high - low) * (rows["scale"].astype(np.float32) / 65535)
        log_scales = np.log(np.where(scales == 0, _TINY, scales))  # a negative one becomes NaN, which validation names
        packed = rows["quat"][:, 0].astype(np.uint32) | rows["quat"][:, 1].astype(np.uint32) << 16
        sh = np.zeros((len(rows), (self.sh_degree + 1) ** 2, 3), np.float32)
        sh[:, 0] = sh0_of_rgb(rows["rgba"][:, :3].astype(np.float32) / 255)
        if more is not None:
            low, high = self.bounds["shcoef"]
            word = more[:, :15]
            level = np.stack([(word & 2047) / 2047, (word >> 11 & 1023) / 1023, word >> 21], axis=2)
            level[:, :, 2] /= 2047
            sh[:, 1:] = low + (high - low) * level
        found = Gaussians(rows["mean"], _quats(packed), log_scales, logits_of_bytes(rows["rgba"][:, 3]), sh)
        return change_axes(found, PLY, _AXES)


def _quats(packed: np.ndarray) -> np.ndarray:
    """Unpack quaternions (N, 4) wxyz from three components of 10 bits and the index of the fourth (2 bits, xyzw)."""
    three: np.ndarray = np.stack([packed & 1023, packed >> 10 & 1023, packed >> 20 & 1023], axis=1).astype(np.float32)
    three = three / 1023 * np.float32(2**0.5) - np.float32(0.5**0.5)
    fourth = packed >> 30
    return from_smallest_three(_LARGEST[fourth], np.take_along_axis(three, _OTHERS[fourth], axis=1))


def _meta(path: Path) -> dict[str, Any]:
    if path.stat().st_size > _MAX_META_BYTES:
        raise InputError(
            f"{path} is larger than the {_MAX_META_BYTES >> 20} MiB of JSON that gsmap reads", code="file_too_large"
        )
    try:
        return dict(json.loads(path.read_bytes()))
    except MALFORMED as error:
        raise InputError(f"{path} is not the JSON of an .lcc: {error}", code="not_json") from error


def _bounds(one: dict[str, Any]) -> np.ndarray:
    bounds = np.array([one["min"], one["max"]], np.float32)
    return np.broadcast_to(bounds.reshape(2, -1), (2, 3)).copy()


def _beside(path: Path, name: str) -> Path:
    """Return the path of a file of the scene, in any letter case, as the white paper and the scanners differ."""
    found = next((one.name for one in sorted(path.parent.iterdir()) if one.name.lower() == name), name)
    return file_inside(path, found)


def _runs(path: Path, levels: int, data: Path, sh: Path | None) -> np.ndarray:
    """Return the first row and the number of rows (R, 2) of each unit's finest level."""
    index = _beside(path, "index.bin")
    unit = np.dtype([("cell", "<u4"), ("levels", [("rows", "<u4"), ("offset", "<u8"), ("size", "<u4")], levels)])
    size = index.stat().st_size
    if not size or size % unit.itemsize or size > _MAX_INDEX_BYTES:
        raise InputError(
            f"{index}: {size} bytes are not units of {unit.itemsize} ({levels} levels)", code="file_damaged"
        )
    finest = np.fromfile(index, unit)["levels"][:, 0]
    finest = finest[finest["rows"] > 0]
    first, odd = np.divmod(finest["offset"], np.uint64(_ROW.itemsize))
    there = data.stat().st_size // _ROW.itemsize
    if sh is not None:
        there = min(there, sh.stat().st_size // _SH_ROW.itemsize)
    if not len(finest) or odd.any() or (first > there).any():
        raise InputError(
            f"{index} refers to no rows of {data.name}, or to rows beyond its end", code="rows_outside_file"
        )
    runs = np.stack([first.astype(np.int64), finest["rows"].astype(np.int64)], axis=1)
    in_order = runs[np.argsort(runs[:, 0], kind="stable")]
    ends = in_order.sum(1)
    if ends[-1] > there or (in_order[1:, 0] < ends[:-1]).any():
        raise InputError(
            f"{index} refers to rows beyond the end of {data.name}, or to a row twice", code="rows_outside_file"
        )
    return runs
