"""Read and write the ``gcp_list.txt`` of OpenDroneMap and WebODM: ground control points in photos.

The first line names the coordinate reference system: ``EPSG:25832``, a PROJ string (``+proj=utm +zone=32 ...``), or
``WGS84 UTM 32N``. Every other line is a control point in one photo, ``geo_x geo_y geo_z im_x im_y image_name
[gcp_name] [more]``, parted by spaces or tabs: easting or longitude first, height, then column and row in pixels from
the image's upper left corner. Lines that begin with ``#``, and empty ones, are skipped, and so is what follows a ``#``
on the first line. A point without a name is that of its place, however that is written. In a line parted by spaces an
image's name, which may have spaces, ends with its suffix; where that is not clear, tabs must part the line.
"""

from __future__ import annotations

import math
import os
import re
from dataclasses import dataclass, replace
from pathlib import Path

from gsmap.durable import write_text_output
from gsmap.errors import InputError, NotFoundError

_MOST_BYTES = 64 << 20
_UTM = re.compile(r"WGS ?84\s+UTM\s*(\d{1,2})\s*([NS])", re.IGNORECASE)
_IMAGE_END = re.compile(r"\.(?:jpe?g|png|tiff?|webp|bmp|jp2|hei[cf]|dng|arw|cr[23]|nef|raw|exr)(?=\s|$)", re.IGNORECASE)
_NUMBERS = ("geo_x", "geo_y", "geo_z", "im_x", "im_y")


@dataclass(frozen=True)
class GcpLine:
    """A control point in one photo.

    Args:
        line: Line number in the file, from 1.
        name: Name of the point; derived from its position if the file has none.
        position: x, y, z in the coordinate reference system of the file.
        pixel: Column and row in the photo.
        image: Name of the photo.
        is_named: The file names the point.
    """

    line: int
    name: str
    position: tuple[float, float, float]
    pixel: tuple[float, float]
    image: str
    is_named: bool = True


@dataclass(frozen=True)
class GcpList:
    """The content of a ``gcp_list.txt``.

    Args:
        crs: Coordinate reference system in a form that PROJ accepts.
        lines: Observations in the order of the file.
    """

    crs: str
    lines: tuple[GcpLine, ...]


def read(path: str | os.PathLike[str]) -> GcpList:
    """Read a ``gcp_list.txt``.

    Raises:
        NotFoundError: The file is missing.
        InputError: Invalid content; names the first invalid line.
    """
    path = Path(path)
    if not path.is_file():
        raise NotFoundError(f"no file of control points at {path}", code="file_not_found")
    if path.stat().st_size > _MOST_BYTES:
        raise InputError(f"{path} is too large for a list of control points", code="file_too_large")
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is not UTF-8 text: {error.reason}", code="invalid_text") from error
    return parse(text, str(path))


def parse(text: str, where: str = "gcp_list") -> GcpList:
    """Parse the text of a ``gcp_list.txt``; see `read`."""
    rows = [(number, line.strip()) for number, line in enumerate(text.splitlines(), 1)]
    rows = [(number, line) for number, line in rows if line and not line.startswith("#")]
    if not rows:
        raise InputError(
            f"{where} is empty: its first line must name the coordinate system, such as EPSG:25832", code="file_empty"
        )
    crs = _crs(re.sub(r"\s+#.*", "", rows[0][1]), f"{where}, line {rows[0][0]}")
    found = [_line(number, line, f"{where}, line {number}") for number, line in rows[1:]]
    found = _with_names(found, [line for _, line in rows[1:]])
    if not found:
        raise InputError(
            f"{where} has no control point: add lines such as geo_x geo_y geo_z im_x im_y image [name]",
            code="no_control_points",
        )
    places: dict[str, GcpLine] = {}
    seen: dict[tuple[str, str], GcpLine] = {}
    for one in found:
        first = places.setdefault(one.name, one)
        if first.position != one.position:
            raise InputError(
                f"{where}, line {one.line}: point {one.name} has other coordinates than on line {first.line}: use one "
                "name per point",
                code="duplicate",
            )
        before = seen.setdefault((one.name, one.image), one)
        if before is not one:
            raise InputError(
                f"{where}, line {one.line}: point {one.name} in photo {one.image} is already on line {before.line}: "
                "remove one of the lines",
                code="duplicate",
            )
    return GcpList(crs, tuple(found))


def write(path: str | os.PathLike[str], crs: str, lines: list[GcpLine]) -> None:
    """Write a file from which `read` returns the same numbers to the last digit."""
    parts = [crs]
    for one in lines:
        numbers = "\t".join(repr(float(v)) for v in (*one.position, *one.pixel))
        parts.append(f"{numbers}\t{one.image}\t{one.name}")
    write_text_output(Path(path), "\n".join(parts) + "\n")


def _crs(line: str, where: str) -> str:
    if (utm := _UTM.fullmatch(line)) is not None:
        zone, half = int(utm[1]), utm[2].upper()
        if not 1 <= zone <= 60:
            raise InputError(f"{where}: UTM zone {zone} does not exist", code="gcp_crs_missing")
        return f"EPSG:{(32600 if half == 'N' else 32700) + zone}"
    if line.startswith("+proj") or re.match(r"(?i)[a-z]+:\d+(\+\d+)?$", line) or line.endswith("]"):
        return line
    if all(_is_number(part) for part in line.split()[:3]):
        raise InputError(
            f"{where}: the first line must name the coordinate system, such as EPSG:25832, but it is a point",
            code="gcp_crs_missing",
        )
    raise InputError(
        f"{where}: {line[:60]!r} is not a coordinate system: write EPSG:25832, a PROJ string, or WGS84 UTM 32N",
        code="gcp_crs_missing",
    )


def _line(number: int, line: str, where: str) -> GcpLine:
    parts = line.split("\t") if line.count("\t") >= 5 else line.split(None, 5)
    parts = [part.strip() for part in parts]
    if not _is_number(parts[0]):
        raise InputError(
            f"{where} has {len(line.split())} fields and begins with {parts[0][:40]!r}, not a finite number: a "
            "line is geo_x geo_y geo_z im_x im_y image_name [gcp_name], with pixels and photo, and the point's "
            "name last",
            code="invalid_line",
        )
    if len(parts) < 6:
        raise InputError(
            f"{where} has {len(parts)} of the fields geo_x geo_y geo_z im_x im_y image_name [gcp_name]: "
            + ("the height is missing" if len(parts) == 5 and not _is_number(parts[4]) else "some are missing"),
            code="invalid_line",
        )
    if line.count("\t") < 5:
        parts[5:] = _image_and_name(parts[5], where)
    values = []
    for name, part in zip(_NUMBERS, parts, strict=False):
        if not _is_number(part):
            raise InputError(f"{where}: {name} is {part[:40]!r}, not a finite number", code="invalid_line")
        values.append(float(part))
    if not parts[5]:
        raise InputError(f"{where} has no name of a photo", code="invalid_line")
    name = parts[6] if len(parts) > 6 else ""
    x, y, z, u, v = values
    return GcpLine(number, name, (x, y, z), (u, v), parts[5])


def _image_and_name(text: str, where: str) -> list[str]:
    """Split the end of a line into the name of the image, which may have spaces, and the name of the point, if any."""
    ends = [found.end() for found in _IMAGE_END.finditer(text)]
    words = [text[: ends[0]], *text[ends[0] :].split()[:1]] if ends else text.split()
    # What looks like the number of a copy, "DJI_0001 (2)", is no point's name.
    if len(ends) > 1 or (not ends and len(words) > 2) or (len(words) == 2 and re.fullmatch(r"\(\d+\)", words[1])):
        raise InputError(
            f"{where}: it is not clear where the photo's name ends in {text[:60]!r}: separate the fields with tabs",
            code="invalid_line",
        )
    return words


def _with_names(found: list[GcpLine], lines: list[str]) -> list[GcpLine]:
    """Name unnamed points: by a named point with the same coordinates, or by the text of their coordinates."""
    named = {one.position: one.name for one in reversed(found) if one.name}
    for one, line in zip(found, lines, strict=True):
        named.setdefault(one.position, "_".join(line.split(None, 3)[:3]))
    return [one if one.name else replace(one, name=named[one.position], is_named=False) for one in found]


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False
