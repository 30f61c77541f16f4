"""Read and write the INRIA ``.ply`` of 3D Gaussian Splatting, whose columns are found by property name.

Any SH degree 0-3, any column order, any numeric type; positions that float32 cannot hold are written as doubles. The
header reader is our own: those of the libraries hang or abort the process on a malformed header, or allocate whatever
it claims.
"""

from __future__ import annotations

import math
import os
import re
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.lib import recfunctions as rfn

from gsmap.errors import InputError, NotGaussiansError
from gsmap.geometry.origins import centred, neighbour_distance, origin_of
from gsmap.geometry.sh import sh0_of_rgb
from gsmap.stream import load_all
from gsmap.types import FileInfo, Gaussians, GaussianSource
from gsmap.types.gaussians import CHUNK_ROWS, FIELDS
from gsmap.types.source import origin_of_source

VERSION = 3
HOLDS_ORIGIN = True

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
_SPLAT_NAME = re.compile(r"scalar_((f_dc|f_rest|scale|rot)_\d+|opacity|filter_3D|n[xyz])")
_ANTIALIASED = re.compile(r"(?<!\w)(not |non[- ]?)?antialiased\W*((0|false|no|off)(?!\S))?", re.IGNORECASE)
_FEW = 20  # Gaussians are too few for their values to show how opacities and scales are meant
_WIDE = 10.0  # distances between neighbours: a median Gaussian that wide would cover hundreds of others
_COVERED = (0.1, 0.9)  # opacities reach below and above
_PADDING = b"\0 \t\r\n"
_ENCODINGS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass(frozen=True)
class Element:
    """One element of a PLY header: ``count`` rows of ``dtype``, which is empty if a property is a list."""

    name: str
    count: int
    dtype: np.dtype
    has_list: bool = False

    @property
    def names(self) -> tuple[str, ...]:
        return self.dtype.names or ()


@dataclass(frozen=True)
class Header:
    """A parsed PLY header, with the number of bytes before the data (``data_offset``).

    ``renamed``: the properties of a splat had the prefix that CloudCompare gives to scalar fields, which was taken off.
    """

    encoding: str
    elements: dict[str, Element]
    comments: tuple[str, ...]
    data_offset: int
    renamed: bool = False


def read(path: str | os.PathLike[str]) -> Gaussians:
    """Read a 3DGS ``.ply``; see `stream`.

    Raises:
        InputError: not a PLY, truncated, or not a splat.
    """
    return stream(path).load()


def stream(path: str | os.PathLike[str]) -> PlySource:
    """Open a 3DGS ``.ply``, to be read in chunks.

    A file without ``f_dc`` but with ``red green blue`` takes its colours from those, one without ``scale_2`` (2DGS)
    gets flat Gaussians, and the 3D filter of Mip-Splatting (``filter_3D``) is folded into scales and opacities.
    Opacities in 0 to 1 and scales as lengths become logits and logarithms where both are without doubt so.

    Raises:
        InputError: not a PLY, truncated, longer than its header promises, not a splat, or one of opacities and scales
            is as trained and the other is not.
    """
    header = read_header(path)
    if is_compressed(header):
        raise InputError(
            f"{path} has the layout of a .compressed.ply: read it with gsmap.formats.read, which detects the layout",
            code="unsupported_format",
        )
    rows = _rows(path, header, "vertex")
    names = set(header.elements["vertex"].names)
    rest = _rest_names(path, names)
    columns = {
        "means": ["x", "y", "z"],
        "quats": ["rot_0", "rot_1", "rot_2", "rot_3"],
        "log_scales": ["scale_0", "scale_1", *(["scale_2"] if "scale_2" in names else [])],
        "logit_opacities": ["opacity"],
        "sh": ["f_dc_0", "f_dc_1", "f_dc_2"] if "f_dc_0" in names or "red" not in names else ["red", "green", "blue"],
    }
    missing = [n for field in ("means", "sh", "logit_opacities", "log_scales", "quats") for n in columns[field]]
    missing = [n for n in missing if n not in names]
    if missing:
        raise NotGaussiansError(
            f"{path} is not a 3DGS .ply: its vertices lack {', '.join(missing)} (a point cloud or mesh?)"
        )
    source = PlySource(rows, columns, tuple(rest), "filter_3D" in names, _origin(rows))
    return replace(source, activated=_is_activated(path, source))


@dataclass(frozen=True, eq=False)
class PlySource:
    """A source of the Gaussians of a ``.ply``, which reads the file on demand.

    Args:
        rows: Rows of the file.
        names: Properties of each field of `Gaussians`.
        rest: Properties of the spherical harmonics above degree 0, channel by channel.
        filtered: The file has a 3D filter, which is merged into scales and opacities.
        origin: (3,) offset subtracted from positions.
        activated: Opacities are in [0, 1] and scales are lengths, instead of logits and logarithms.
    """

    rows: Rows
    names: Mapping[str, list[str]]
    rest: tuple[str, ...]
    filtered: bool
    origin: np.ndarray
    activated: bool = False

    @property
    def num_gaussians(self) -> int:
        return self.rows.count

    @property
    def sh_degree(self) -> int:
        return math.isqrt(1 + len(self.rest) // 3) - 1

    def chunks(self) -> Iterator[Gaussians]:
        for part in self.rows.parts():
            yield Gaussians(**{name: self._field(name, part) for name in FIELDS}, origin=self.origin)

    def columns(self, name: str) -> Iterator[np.ndarray]:
        for part in self.rows.parts():
            yield self._field(name, part)

    def load(self) -> Gaussians:
        return load_all(self)

    def _field(self, name: str, part: np.ndarray) -> np.ndarray:
        """Return one field of `Gaussians` for some rows of the file."""
        if name == "sh":
            return self._sh(part)
        if name == "means" and self.origin.any():
            return centred(_positions(part), self.origin)[0]
        if not self.filtered or name not in ("log_scales", "logit_opacities"):
            return self._raw(name, part)
        logits, log_scales = self._raw("logit_opacities", part)[:, None], self._raw("log_scales", part)
        logits, log_scales = _fold_filter(logits, log_scales, np.asarray(part["filter_3D"], "f8"))
        return log_scales if name == "log_scales" else logits[:, 0]

    def _raw(self, name: str, part: np.ndarray) -> np.ndarray:
        names = self.names[name]
        out = np.empty((len(part), 3 if name == "log_scales" else len(names)), "f4")
        _take(part, names, out[:, : len(names)])
        if self.activated and name in ("log_scales", "logit_opacities"):
            with np.errstate(divide="ignore"):  # 0 and 1 become infinities, which every reader clamps
                out = np.log(out) if name == "log_scales" else np.log(out) - np.log1p(-out)
        if name == "log_scales" and len(names) == 2:
            out[:, 2] = out[:, :2].min(1) + np.log(1e-3)  # 2DGS
        return out[:, 0] if name == "logit_opacities" else out

    def _sh(self, part: np.ndarray) -> np.ndarray:
        k = 1 + len(self.rest) // 3
        out = np.empty((len(part), k, 3), "f4")
        _take(part, self.names["sh"], out[:, 0])
        if self.names["sh"][0] == "red":
            kind = part.dtype["red"]
            out[:, 0] = sh0_of_rgb(out[:, 0] / (np.iinfo(kind).max if kind.kind in "iu" else 1.0))
        if self.rest:
            channel_major = np.empty((len(part), len(self.rest)), "f4")
            _take(part, list(self.rest), channel_major)
            out[:, 1:] = channel_major.reshape(len(part), 3, k - 1).transpose(0, 2, 1)
        return out


def _is_activated(path: str | os.PathLike[str], source: PlySource) -> bool:
    """Return true if opacities are in [0, 1] and scales are lengths; false for logits and logarithms.

    Logits of a capture do not all lie in 0 to 1, which are opacities of 0.5 to 0.73, and its logarithms of scales are
    not all positive unless its unit is small beside its Gaussians.

    Raises:
        InputError: Only one of opacities and scales is activated.
    """
    opacity, scale = [np.inf, -np.inf], np.inf
    medians: list[float] = []
    if source.num_gaussians < _FEW:
        return False
    for part in source.rows.parts():
        opacities, scales = source._raw("logit_opacities", part), source._raw("log_scales", part)
        scales = scales[:, : len(source.names["log_scales"])]
        opacities, scales = opacities[~np.isnan(opacities)], scales[~np.isnan(scales)]
        if not len(opacities) or not len(scales):
            continue
        opacity = [min(opacity[0], float(opacities.min())), max(opacity[1], float(opacities.max()))]
        scale = min(scale, float(scales.min()))
        if scale < 0 and (opacity[0] < 0 or opacity[1] > 1):
            return False
        medians.append(float(np.median(scales)))
    if not medians:
        return False
    is_opacity = 0 <= opacity[0] < _COVERED[0] and _COVERED[1] < opacity[1] <= 1
    if scale < 0:
        if is_opacity:
            raise InputError(
                f"{path}: its opacities lie in {opacity[0]:.3g} to {opacity[1]:.3g} as opacities do, and its scales "
                "are logarithms: a .ply of splats has both as trained; write the opacities as logits, log(a / (1 - a))",
                code="activated_values",
            )
        return False
    if is_opacity:
        return True
    apart, median = neighbour_distance(source), float(np.median(medians))
    if not median < _WIDE * apart < math.exp(min(median, 700.0)):
        return False
    if opacity[0] >= 0 and opacity[1] <= 1:
        return True
    raise InputError(
        f"{path}: its scales are lengths ({median:.3g} where neighbours are {apart:.3g} apart), and its opacities are "
        f"logits ({opacity[0]:.3g} to {opacity[1]:.3g}): a .ply of splats has both as trained; write the scales as "
        "logarithms",
        code="activated_values",
    )


def _origin(rows: Rows) -> np.ndarray:
    """Return an origin to subtract from positions in double precision; zeros if float32 represents them exactly."""
    if all(rows.dtype[name] == np.float32 for name in "xyz"):
        return np.zeros(3)  # nothing is lost yet
    if not origin_of(_positions(next(rows.parts()))).any():  # the first rows lie near zero: so do all together
        return np.zeros(3)
    step = max(1, rows.count // CHUNK_ROWS)
    return origin_of(np.concatenate([_positions(part[::step]) for part in rows.parts()]))


def _positions(part: np.ndarray) -> np.ndarray:
    """Return the positions (n, 3) float64 of some rows."""
    return np.stack([part[name].astype(np.float64) for name in "xyz"], axis=1)


def info(path: str | os.PathLike[str]) -> FileInfo:
    """Return the metadata: whether training was antialiased, and notes on properties that reading changes."""
    header = read_header(path)
    names = header.elements["vertex"].names if "vertex" in header.elements else ()
    text = " ".join(header.comments).lower()
    notes = []
    if "splatrendermode: 2dgs" in text or (names and "scale_0" in names and "scale_2" not in names):
        notes.append("2D Gaussians (2DGS) are rendered as flat 3D Gaussians")
    if "filter_3D" in names:
        notes.append("the 3D filter of Mip-Splatting was folded into scales and opacities")
    if names and "f_dc_0" not in names and "red" in names:
        notes.append("colours come from red, green, blue and do not depend on the view")
    if header.renamed:
        notes.append("its columns have CloudCompare's names (scalar_f_dc_0) and were read as those of a splat")
    if {"x", "opacity", "scale_0", "rot_3"} <= set(names) and stream(path).activated:
        notes.append(
            "its opacities lie in 0 to 1 and its scales are lengths, so they were not read as logits and logarithms"
        )
    antialiased = "splatrendermode: mip" in text or "filter_3D" in names
    antialiased |= any(not m[1] and not m[2] for m in map(_ANTIALIASED.search, header.comments) if m)
    return FileInfo(antialiased, tuple(notes))


def write(
    path: str | os.PathLike[str],
    gaussians: GaussianSource,
    *,
    antialiased: bool = False,
    extra: Mapping[str, np.ndarray] | None = None,
) -> None:
    """Write the INRIA layout (float32, little endian, normals of zero, quaternions not normalized).

    Positions about an origin are written in full, in double precision.

    Args:
        antialiased: Mark the file, in a comment, as trained with the 2D Mip filter.
        extra: Further float properties (N,) by name, such as the index of the source capture.
    """
    extra = dict(extra or {})
    k = (gaussians.sh_degree + 1) ** 2
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{i}" for i in range(3 * (k - 1))]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    inria = len(names)
    names += list(extra)
    lines = ["ply", "format binary_little_endian 1.0"]
    lines += ["comment SplatRenderMode: mip"] if antialiased else []
    origin = origin_of_source(gaussians)
    doubles = "xyz" if origin.any() else ""
    dtype = np.dtype([(n, "<f8" if n in doubles else "<f4") for n in names])
    properties = (f"property {'double' if n in doubles else 'float'} {n}" for n in names)
    lines += [f"element vertex {gaussians.num_gaussians}", *properties, "end_header", ""]
    with open(path, "wb") as file:
        file.write("\n".join(lines).encode())
        start = 0
        for g in gaussians.chunks():
            table = np.zeros((len(g), len(names)), "<f4")
            table[:, 0:3] = g.means
            table[:, 6:9] = g.sh[:, 0]
            table[:, 9 : inria - 8] = g.sh[:, 1:].transpose(0, 2, 1).reshape(len(g), -1)
            table[:, inria - 8] = g.logit_opacities
            table[:, inria - 7 : inria - 4] = g.log_scales
            table[:, inria - 4 : inria] = g.quats
            for column, values in enumerate(extra.values(), start=inria):
                table[:, column] = values[start : start + len(g)]
            start += len(g)
            if not doubles:
                file.write(table.data)
                continue
            rows = rfn.unstructured_to_structured(table, dtype)
            for name, column in zip("xyz", (g.means + origin).T, strict=True):
                rows[name] = column
            file.write(rows.tobytes())


def read_header(path: str | os.PathLike[str]) -> Header:
    """Parse a PLY header of at most 64 KiB.

    Raises:
        InputError: Not a PLY, a header without end, or an invalid header line.
    """
    with open(path, "rb") as file:
        head = file.read(HEADER_LIMIT_BYTES)
    if not head.startswith((b"ply\n", b"ply\r")):
        what = "is empty" if not head else f"begins with {head[:4]!r}, not with 'ply'"
        raise InputError(f"{path} is not a PLY file: it {what}", code="wrong_file_type")
    lines: list[str] = []
    offset = 0
    while not lines or lines[-1] != "end_header":
        end = head.find(b"\n", offset)
        if end < 0:
            limit = "within 64 KiB" if len(head) == HEADER_LIMIT_BYTES else "before the file ends"
            raise InputError(
                f"{path}: the PLY header has no 'end_header' line {limit}; the file is damaged", code="ply_header"
            )
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
            raise InputError(
                f"{path}: line {number} of the PLY header is not a valid PLY statement: {line[:80]!r}",
                code="ply_header",
            )
    if not encoding:
        raise InputError(f"{path}: the PLY header has no 'format' line; the file is damaged", code="ply_header")
    elements: dict[str, Element] = {}
    renamed = False
    for name, count, columns in blocks:
        if name in elements or len({c for c, _ in columns}) < len(columns):
            raise InputError(
                f"{path}: the PLY header names element {name!r} or one of its properties twice", code="duplicate"
            )
        if name == "vertex":
            own = {c for c, _ in columns}
            given = [(m[1] if (m := _SPLAT_NAME.fullmatch(c)) and m[1] not in own else c, kind) for c, kind in columns]
            renamed, columns = given != columns, given
        byte_order = _ENCODINGS[encoding]
        fixed = [(c, byte_order + kind) for c, kind in columns if kind is not None]
        has_list = len(fixed) < len(columns)
        elements[name] = Element(name, count, np.dtype([] if has_list else fixed), has_list)
    return Header(encoding, elements, tuple(comments), offset, renamed)


def read_element(path: str | os.PathLike[str], header: Header, name: str) -> np.ndarray:
    """Return the rows of one element as a structured array, memory-mapped from a binary file.

    Raises:
        InputError: no such element, a list property in the way, or fewer or more bytes than the header promises.
    """
    element, offset, skip = _located(path, header, name)
    if header.encoding == "ascii":
        return _read_ascii(path, header, element, skip)
    return np.memmap(path, dtype=element.dtype, mode="r", offset=offset, shape=(element.count,))


@dataclass(frozen=True, eq=False)
class Rows:
    """The rows of one element, to be read in parts; rows of an ASCII file are kept in memory.

    Args:
        count: Number of rows.
        dtype: Type of a row.
        offset: Position of the first row in the file.
        version: Version of the file, to detect changes.
        held: All rows, if they are in memory.
    """

    path: Path
    count: int
    dtype: np.dtype
    offset: int
    version: tuple[int, ...]
    held: np.ndarray | None = None

    def parts(self) -> Iterator[np.ndarray]:
        """Yield the rows as structured arrays of at most `CHUNK_ROWS` rows."""
        if self.held is not None:
            for start in range(0, self.count, CHUNK_ROWS):
                yield self.held[start : start + CHUNK_ROWS]
            return
        with open(self.path, "rb") as file:  # not mapped: what was read of a map counts as memory in use
            file.seek(self.offset)
            for start in range(0, self.count, CHUNK_ROWS):
                wanted = min(CHUNK_ROWS, self.count - start)
                part = np.fromfile(file, self.dtype, wanted)
                if _version(os.fstat(file.fileno())) != self.version or len(part) < wanted:
                    raise InputError(
                        f"{self.path} changed during reading: let the program that writes it finish first",
                        code="file_changed",
                    )
                yield part


def _rows(path: str | os.PathLike[str], header: Header, name: str) -> Rows:
    """Return the rows of one element, to be read in parts; see `read_element`."""
    element, offset, skip = _located(path, header, name)
    held = _read_ascii(path, header, element, skip) if header.encoding == "ascii" else None
    return Rows(Path(path), element.count, element.dtype, offset, _version(os.stat(path)), held)


def _version(found: os.stat_result) -> tuple[int, ...]:
    return found.st_ino, found.st_size, found.st_mtime_ns


def _located(path: str | os.PathLike[str], header: Header, name: str) -> tuple[Element, int, int]:
    """Return an element, the byte at which its rows begin in a binary file, and the number of rows before it."""
    if name not in header.elements or not header.elements[name].count:
        raise InputError(f"{path} has no {name} rows: there is nothing to read", code="no_gaussians")
    offset, skip = header.data_offset, 0
    for element in header.elements.values():
        if element.has_list:
            raise InputError(
                f"{path}: element {element.name!r} has a list property: not a 3DGS .ply (a mesh?)",
                code="ply_properties",
            )
        if element.name == name:
            break
        offset += element.count * element.dtype.itemsize
        skip += element.count
    if not element.names:
        raise InputError(f"{path}: element {name!r} has no properties: not a 3DGS .ply", code="ply_properties")
    # The smallest an ASCII value can be is one digit and one separator.
    stride = 2 * len(element.names) if header.encoding == "ascii" else element.dtype.itemsize
    size = Path(path).stat().st_size
    present = size - offset
    if element.count * stride > present + (header.encoding == "ascii"):
        at_most = "at most " if header.encoding == "ascii" else ""
        raise InputError(
            f"{path} is truncated: its header promises {element.count} {name} rows of at least {stride} bytes, "
            f"but {max(0, present)} bytes follow, {at_most}{max(0, present) // stride} rows: copy or export it again",
            code="file_truncated",
        )
    if header.encoding != "ascii" and not any(e.has_list and e.count for e in header.elements.values()):
        end = header.data_offset + sum(e.count * e.dtype.itemsize for e in header.elements.values())
        if size - end >= stride or _tail(path, end).strip(_PADDING):
            raise _too_long(path, element, f"{size - end} more bytes, {(size - end) / stride:.6g} rows")
    return element, offset, skip


def _tail(path: str | os.PathLike[str], start: int) -> bytes:
    with open(path, "rb") as file:
        file.seek(start)
        return file.read()


def _too_long(path: str | os.PathLike[str], element: Element, more: str) -> InputError:
    return InputError(
        f"{path}: its header promises {element.count} {element.name} rows, but {more}, follow: export it again, or "
        "correct the counts in its header",
        code="file_damaged",
    )


def is_compressed(header: Header) -> bool:
    """Return true for PlayCanvas' ``.compressed.ply`` layout, whatever the name of the file."""
    return "vertex" in header.elements and "packed_position" in header.elements["vertex"].names


def _read_ascii(path: str | os.PathLike[str], header: Header, element: Element, skip: int) -> np.ndarray:
    with open(path, "rb") as file, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of lines without data, which are left out
        file.seek(header.data_offset)
        lines = iter(file)
        try:
            rows = np.loadtxt(lines, element.dtype, comments=None, skiprows=skip, max_rows=element.count, ndmin=1)
        except ValueError as error:
            raise InputError(f"{path}: its ASCII rows cannot be read: {error}", code="invalid_row") from error
        left = sum(1 for line in lines if line.strip())
    if len(rows) < element.count:
        raise InputError(
            f"{path} is truncated: {element.count} rows promised, {len(rows)} found", code="file_truncated"
        )
    later = sum(e.count for e in header.elements.values()) - skip - element.count
    if left > later:
        raise _too_long(path, element, f"{element.count + left - later} rows")
    return rows


def _rest_names(path: str | os.PathLike[str], names: set[str]) -> list[str]:
    count = sum(n.startswith("f_rest_") for n in names)
    rest = [f"f_rest_{i}" for i in range(count)]
    if count not in (0, 9, 24, 45) or not names.issuperset(rest):
        raise InputError(
            f"{path} has {count} f_rest properties; SH degrees 0 to 3 have 0, 9, 24 or 45, numbered from 0",
            code="unsupported_sh_degree",
        )
    return rest


def _take(rows: np.ndarray, names: list[str], out: np.ndarray) -> None:
    """Copy named columns into ``out`` (n, len(names)), in one operation if all columns are float32."""
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
    """Apply Mip-Splatting's 3D filter (Yu et al. 2024, eq. 9): widen Gaussians, dim them by the ratio of volumes."""
    variance = np.exp(2 * log_scales.astype(np.float64))
    widened = variance + size[:, None] ** 2
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        ratio = np.sqrt((variance / widened).prod(1, keepdims=True))
        opacity = np.clip(ratio / (1 + np.exp(-logits.astype(np.float64))), 1e-7, 1 - 1e-7)
    return np.log(opacity / (1 - opacity)), 0.5 * np.log(widened)
