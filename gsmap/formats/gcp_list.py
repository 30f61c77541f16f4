"""``gcp_list.txt`` of OpenDroneMap and WebODM: ground control points in photos.

The first line names the coordinate reference system: ``EPSG:25832``, a PROJ string (``+proj=utm +zone=32 ...``), or
``WGS84 UTM 32N``. Every other line is a control point in one photo, ``geo_x geo_y geo_z im_x im_y image_name
[gcp_name] [more]``, parted by spaces or tabs: easting or longitude first, height, then column and row in pixels from
the image's upper left corner. Lines that begin with ``#``, and empty ones, say nothing. Points without a name are
those of one place; images may have spaces in their names where tabs part the line.
"""

from __future__ import annotations

import math
import os
import re
from dataclasses import dataclass
from pathlib import Path

from gsmap.durable import write_text_output
from gsmap.errors import InputError, NotFoundError

_MOST_BYTES = 64 << 20
_UTM = re.compile(r"WGS ?84\s+UTM\s+(\d{1,2})\s*([NS])", re.IGNORECASE)
_NUMBERS = ("geo_x", "geo_y", "geo_z", "im_x", "im_y")


@dataclass(frozen=True)
class GcpLine:
    """A control point in one photo.

    Args:
        line: number in the file, from 1.
        name: of the point; one made of its place where the file names none.
        position: x, y, z in the file's system.
        pixel: column, row.
        image: name of the photo.
    """

    line: int
    name: str
    position: tuple[float, float, float]
    pixel: tuple[float, float]
    image: str


@dataclass(frozen=True)
class GcpList:
    """What a file holds.

    Args:
        crs: as PROJ takes it. lines: in the file's order.
    """

    crs: str
    lines: tuple[GcpLine, ...]


def read(path: str | os.PathLike[str]) -> GcpList:
    """Read a file.

    Raises:
        NotFoundError: no such file.
        InputError: the number of the first line that is wrong, and why; nothing is taken from such a file.
    """
    path = Path(path)
    if not path.is_file():
        raise NotFoundError(f"no file of control points at {path}")
    if path.stat().st_size > _MOST_BYTES:
        raise InputError(f"{path} is too large for a list of control points")
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is no text in UTF-8: {error.reason}") from error
    return parse(text, str(path))


def parse(text: str, where: str = "gcp_list") -> GcpList:
    """The content of a file; see `read`."""
    rows = [(number, line.strip()) for number, line in enumerate(text.splitlines(), 1)]
    rows = [(number, line) for number, line in rows if line and not line.startswith("#")]
    if not rows:
        raise InputError(f"{where} is empty: its first line names the coordinate system, such as EPSG:25832")
    crs = _crs(rows[0][1], f"{where}, line {rows[0][0]}")
    found = [_line(number, line, f"{where}, line {number}") for number, line in rows[1:]]
    if not found:
        raise InputError(f"{where} names no control point: each line is geo_x geo_y geo_z im_x im_y image [name]")
    places: dict[str, GcpLine] = {}
    seen: dict[tuple[str, str], GcpLine] = {}
    for one in found:
        first = places.setdefault(one.name, one)
        if first.position != one.position:
            raise InputError(
                f"{where}, line {one.line}: point {one.name} has other coordinates than on line {first.line}: one name "
                "is one point"
            )
        before = seen.setdefault((one.name, one.image), one)
        if before is not one:
            raise InputError(
                f"{where}, line {one.line}: point {one.name} in {one.image} again, as on line {before.line}"
            )
    return GcpList(crs, tuple(found))


def write(path: str | os.PathLike[str], crs: str, lines: list[GcpLine]) -> None:
    """Write a file that `read` gives back to the last digit."""
    parts = [crs]
    for one in lines:
        numbers = "\t".join(repr(float(v)) for v in (*one.position, *one.pixel))
        parts.append(f"{numbers}\t{one.image}\t{one.name}")
    write_text_output(Path(path), "\n".join(parts) + "\n")


def _crs(line: str, where: str) -> str:
    if (utm := _UTM.fullmatch(line)) is not None:
        zone, half = int(utm[1]), utm[2].upper()
        if not 1 <= zone <= 60:
            raise InputError(f"{where}: there is no UTM zone {zone}")
        return f"EPSG:{(32600 if half == 'N' else 32700) + zone}"
    if line.startswith("+proj") or re.match(r"(?i)[a-z]+:\d+(\+\d+)?$", line) or line.endswith("]"):
        return line
    if all(_is_number(part) for part in line.split()[:3]):
        raise InputError(f"{where}: the first line names the coordinate system, such as EPSG:25832; this is a point")
    raise InputError(
        f"{where}: {line[:60]!r} is no coordinate system: write EPSG:25832, a PROJ string, or WGS84 UTM 32N"
    )


def _line(number: int, line: str, where: str) -> GcpLine:
    parts = line.split("\t") if line.count("\t") >= 5 else line.split()
    parts = [part.strip() for part in parts]
    if len(parts) < 6:
        raise InputError(
            f"{where} has {len(parts)} of the fields geo_x geo_y geo_z im_x im_y image_name [gcp_name]: "
            + ("the height is missing" if len(parts) == 5 and not _is_number(parts[4]) else "some are missing")
        )
    values = []
    for name, part in zip(_NUMBERS, parts, strict=False):
        if not _is_number(part):
            raise InputError(f"{where}: {name} is {part[:40]!r}, which is no finite number")
        values.append(float(part))
    if not parts[5]:
        raise InputError(f"{where} names no photo")
    name = parts[6] if len(parts) > 6 and parts[6] else "_".join(parts[:3])
    x, y, z, u, v = values
    return GcpLine(number, name, (x, y, z), (u, v), parts[5])


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False
