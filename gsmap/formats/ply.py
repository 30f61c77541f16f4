"""The INRIA ``.ply`` of 3D Gaussian Splatting, by property name.

Any SH degree 0-3, any column order, any numeric type. The header reader is our own: those of the libraries hang or
abort the process on a malformed header, or allocate whatever it claims.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gsmap.errors import InputError
from gsmap.geometry.sh import sh0_of_rgb
from gsmap.types import FileInfo, Gaussians

VERSION = 1

HEADER_LIMIT_BYTES = 64 * 1024

_TYPES = {
    "char": "i1",
    "int8": "i1",
    "uchar": "u1",
    "uint8": "u1",
    "short": "i2",
    "int16": "i2",
    "ushort": "u2",
    "uint16": "u2",
    "int": "i4",
    "int32": "i4",
    "uint": "u4",
    "uint32": "u4",
    "float": "f4",
    "float32": "f4",
    "double": "f8",
    "float64": "f8",
}
_ENCODINGS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_BLOCK = 1 << 16


@dataclass(frozen=True)
class Element:
    """One element of a header: ``count`` rows of ``dtype``, which is empty where a property is a list."""

    name: str
    count: int
    dtype: np.dtype
    has_list: bool = False

    @property
    def names(self) -> tuple[str, ...]:
        return self.dtype.names or ()


@dataclass(frozen=True)
class Header:
    """A parsed PLY header; the data begins ``data_offset`` bytes into the file."""

    encoding: str
    elements: dict[str, Element]
    comments: tuple[str, ...]
    data_offset: int


def read(path: str | os.PathLike[str]) -> Gaussians:
    """Read a 3DGS ``.ply``.

    A file without ``f_dc`` but with ``red green blue`` takes its colours from those, one without ``scale_2`` (2DGS)
    gets flat Gaussians, and the 3D filter of Mip-Splatting (``filter_3D``) is folded into scales and opacities.

    Raises:
        InputError: not a PLY, truncated, or not a splat.
    """
    header = read_header(path)
    if is_compressed(header):
        raise InputError(f"{path} holds the layout of a .compressed.ply: read it with gsmap.formats.read, which looks")
    rows = read_element(path, header, "vertex")
    names = set(header.elements["vertex"].names)
    rest = _rest_names(path, names)
    has_dc, flat = "f_dc_0" in names, "scale_2" not in names
    position, quat, opacity = ["x", "y", "z"], ["rot_0", "rot_1", "rot_2", "rot_3"], ["opacity"]
    scale = ["scale_0", "scale_1"] if flat else ["scale_0", "scale_1", "scale_2"]
    colour = ["f_dc_0", "f_dc_1", "f_dc_2"] if has_dc or "red" not in names else ["red", "green", "blue"]
    missing = [n for n in (*position, *colour, *opacity, *scale, *quat) if n not in names]
    if missing:
        raise InputError(f"{path} is not a 3DGS .ply: its vertices lack {', '.join(missing)} (a point cloud or mesh?)")

    n, k = len(rows), 1 + len(rest) // 3
    means, quats, log_scales = np.empty((n, 3), "f4"), np.empty((n, 4), "f4"), np.empty((n, 3), "f4")
    logits, sh = np.empty((n, 1), "f4"), np.empty((n, k, 3), "f4")
    for start in range(0, n, _BLOCK):  # blocks keep the strided reads inside the cache
        block = slice(start, start + _BLOCK)
        part = rows[block]
        _take(part, position, means[block])
        _take(part, quat, quats[block])
        _take(part, scale, log_scales[block, : len(scale)])
        _take(part, opacity, logits[block])
        _take(part, colour, sh[block, 0])
        if rest:
            channel_major = np.empty((len(part), len(rest)), "f4")
            _take(part, rest, channel_major)
            sh[block, 1:] = channel_major.reshape(len(part), 3, k - 1).transpose(0, 2, 1)
    if not has_dc:
        top = np.iinfo(rows.dtype["red"]).max if rows.dtype["red"].kind in "iu" else 1.0
        sh[:, 0] = sh0_of_rgb(sh[:, 0] / top)
    if flat:
        log_scales[:, 2] = log_scales[:, :2].min(1) + np.log(1e-3)
    if "filter_3D" in names:
        logits, log_scales = _fold_filter(logits, log_scales, np.asarray(rows["filter_3D"], "f8"))
    return Gaussians(means, quats, log_scales, logits[:, 0], sh)


def info(path: str | os.PathLike[str]) -> FileInfo:
    """Whether it was trained antialiased, and what reading it changed."""
    header = read_header(path)
    names = header.elements["vertex"].names if "vertex" in header.elements else ()
    text = " ".join(header.comments).lower()
    notes = []
    if "splatrendermode: 2dgs" in text or (names and "scale_0" in names and "scale_2" not in names):
        notes.append("2D Gaussians (2DGS): rendered as flat 3D ones")
    if "filter_3D" in names:
        notes.append("the 3D filter of Mip-Splatting was folded into scales and opacities")
    if names and "f_dc_0" not in names and "red" in names:
        notes.append("colours from red green blue: no view dependence")
    antialiased = "splatrendermode: mip" in text or "antialiased" in text or "filter_3D" in names
    return FileInfo(antialiased, tuple(notes))


def write(
    path: str | os.PathLike[str],
    gaussians: Gaussians,
    *,
    antialiased: bool = False,
    extra: Mapping[str, np.ndarray] | None = None,
) -> None:
    """Write the INRIA layout (float32, little endian, normals of zero, quaternions as they are).

    Args:
        antialiased: note in a comment that it was trained with the 2D Mip filter.
        extra: further float properties by name, (N,) each, such as the index of the capture each came from.
    """
    extra = dict(extra or {})
    k = gaussians.sh.shape[1]
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{i}" for i in range(3 * (k - 1))]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    inria = len(names)
    names += list(extra)
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += ["comment SplatRenderMode: mip"] if antialiased else []
    lines += [f"element vertex {len(gaussians)}", *(f"property float {n}" for n in names), "end_header", ""]
    with open(path, "wb") as file:
        file.write("\n".join(lines).encode())
        for start in range(0, len(gaussians), _BLOCK):
            g = gaussians[start : start + _BLOCK]
            rows = np.zeros((len(g), len(names)), "<f4")
            rows[:, 0:3] = g.means
            rows[:, 6:9] = g.sh[:, 0]
            rows[:, 9 : inria - 8] = g.sh[:, 1:].transpose(0, 2, 1).reshape(len(g), -1)
            rows[:, inria - 8] = g.logit_opacities
            rows[:, inria - 7 : inria - 4] = g.log_scales
            rows[:, inria - 4 : inria] = g.quats
            for column, values in enumerate(extra.values(), start=inria):
                rows[:, column] = values[start : start + len(g)]
            file.write(rows.data)


def read_header(path: str | os.PathLike[str]) -> Header:
    """Parse a PLY header of at most 64 KiB.

    Raises:
        InputError: not a PLY, no end of header, or a line that means nothing.
    """
    with open(path, "rb") as file:
        head = file.read(HEADER_LIMIT_BYTES)
    if not head.startswith((b"ply\n", b"ply\r")):
        what = "is empty" if not head else f"begins with {head[:4]!r}, not with 'ply'"
        raise InputError(f"{path} is not a PLY file: it {what}")
    lines: list[str] = []
    offset = 0
    while not lines or lines[-1] != "end_header":
        end = head.find(b"\n", offset)
        if end < 0:
            limit = "within 64 KiB" if len(head) == HEADER_LIMIT_BYTES else "before the file ends"
            raise InputError(f"{path}: the PLY header has no 'end_header' line {limit}; the file is damaged")
        lines.append(head[offset:end].decode("utf-8", "replace").strip())
        offset = end + 1

    encoding, comments = "", []
    blocks: list[tuple[str, int, list[tuple[str, str | None]]]] = []
    for number, line in enumerate(lines[1:-1], start=2):
        keyword, _, value = line.partition(" ")
        words = value.split()
        if keyword == "format" and words and words[0] in _ENCODINGS:
            encoding = words[0]
        elif keyword in ("comment", "obj_info", ""):
            comments.append(value)
        elif keyword == "element" and len(words) == 2 and words[1].isdecimal() and len(words[1]) <= 18:
            blocks.append((words[0], int(words[1]), []))
        elif keyword == "property" and blocks and len(words) == 2 and words[0] in _TYPES:
            blocks[-1][2].append((words[1], _TYPES[words[0]]))
        elif keyword == "property" and blocks and len(words) == 4 and words[0] == "list":
            blocks[-1][2].append((words[3], None))
        else:
            raise InputError(f"{path}: line {number} of the PLY header means nothing: {line[:80]!r}")
    if not encoding:
        raise InputError(f"{path}: the PLY header has no 'format' line; the file is damaged")
    elements = {}
    for name, count, columns in blocks:
        if name in elements or len({c for c, _ in columns}) < len(columns):
            raise InputError(f"{path}: the PLY header names element {name!r} or one of its properties twice")
        byte_order = _ENCODINGS[encoding]
        fixed = [(c, byte_order + kind) for c, kind in columns if kind is not None]
        has_list = len(fixed) < len(columns)
        elements[name] = Element(name, count, np.dtype([] if has_list else fixed), has_list)
    return Header(encoding, elements, tuple(comments), offset)


def read_element(path: str | os.PathLike[str], header: Header, name: str) -> np.ndarray:
    """The rows of one element as a structured array, mapped from the file where it is binary.

    Raises:
        InputError: no such element, a list property in the way, or fewer bytes than the header promises.
    """
    if name not in header.elements or not header.elements[name].count:
        raise InputError(f"{path} has no {name} rows: there is nothing to read")
    offset, skip = header.data_offset, 0
    for element in header.elements.values():
        if element.has_list:
            raise InputError(f"{path}: element {element.name!r} has a list property: not a 3DGS .ply (a mesh?)")
        if element.name == name:
            break
        offset += element.count * element.dtype.itemsize
        skip += element.count
    if not element.names:
        raise InputError(f"{path}: element {name!r} has no properties: not a 3DGS .ply")
    # The smallest an ASCII value can be is one digit and one separator.
    stride = 2 * len(element.names) if header.encoding == "ascii" else element.dtype.itemsize
    present = Path(path).stat().st_size - offset
    if element.count * stride > present + (header.encoding == "ascii"):
        raise InputError(
            f"{path} is truncated: its header promises {element.count} {name} rows of at least {stride} bytes, "
            f"but {max(0, present)} bytes follow"
        )
    if header.encoding == "ascii":
        return _read_ascii(path, header, element, skip)
    return np.memmap(path, dtype=element.dtype, mode="r", offset=offset, shape=(element.count,))


def is_compressed(header: Header) -> bool:
    """Whether this is PlayCanvas' ``.compressed.ply`` layout, whatever the file is called."""
    return "vertex" in header.elements and "packed_position" in header.elements["vertex"].names


def _read_ascii(path: str | os.PathLike[str], header: Header, element: Element, skip: int) -> np.ndarray:
    with open(path, "rb") as file, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of lines without data, which are left out
        file.seek(header.data_offset)
        try:
            rows = np.loadtxt(file, element.dtype, comments=None, skiprows=skip, max_rows=element.count, ndmin=1)
        except ValueError as error:
            raise InputError(f"{path}: its ASCII rows cannot be read: {error}") from error
    if len(rows) < element.count:
        raise InputError(f"{path} is truncated: {element.count} rows promised, {len(rows)} found")
    return rows


def _rest_names(path: str | os.PathLike[str], names: set[str]) -> list[str]:
    count = sum(n.startswith("f_rest_") for n in names)
    rest = [f"f_rest_{i}" for i in range(count)]
    if count not in (0, 9, 24, 45) or not names.issuperset(rest):
        raise InputError(
            f"{path} has {count} f_rest properties; SH degrees 0 to 3 have 0, 9, 24 or 45, numbered from 0"
        )
    return rest


def _take(rows: np.ndarray, names: list[str], out: np.ndarray) -> None:
    """Copy named columns into ``out`` (n, len(names)), all at once where every column is a float32."""
    dtype = rows.dtype
    order = list(dtype.names or ())
    if all(dtype[n] == np.float32 for n in order):
        table = rows.view(np.float32).reshape(len(rows), -1)
        columns = [order.index(n) for n in names]
        run = slice(columns[0], columns[0] + len(names))
        out[:] = table[:, run] if columns == list(range(run.start, run.stop)) else table[:, columns]
    else:
        for i, n in enumerate(names):
            with np.errstate(over="ignore"):  # a double beyond float32 becomes inf, which validation names
                out[:, i] = rows[n]


def _fold_filter(logits: np.ndarray, log_scales: np.ndarray, size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mip-Splatting (Yu et al. 2024, eq. 9): widen by the filter, dim by the ratio of the volumes."""
    variance = np.exp(2 * log_scales.astype(np.float64))
    widened = variance + size[:, None] ** 2
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        ratio = np.sqrt((variance / widened).prod(1, keepdims=True))
        opacity = np.clip(ratio / (1 + np.exp(-logits.astype(np.float64))), 1e-7, 1 - 1e-7)
    return np.log(opacity / (1 - opacity)), 0.5 * np.log(widened)
