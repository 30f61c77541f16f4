"""Write and read the file of an array group: an uncompressed zip archive with the keys of a zarr v3 group.

`zarr.storage.ZipStore` and any unzip tool open it. gsmap writes it sequentially in an order that suits partial reads:
the chunks of all long arrays row block by row block, so that the data of a region of a scene is contiguous; then arrays
of a single chunk; then the metadata; then the table of contents, which locates everything.

The table is validated when it is read, since a map may come from an untrusted source: members must be stored
uncompressed, one after the other, within the file.
"""

from __future__ import annotations

import math
import struct
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

FILE = "arrays.zip"
TAIL_BYTES = 64 << 10
"""Number of bytes read first, from the end: enough for the table and metadata of a scene with two million Gaussians."""

_ZSTD_LEVEL, _FLOAT_LEVEL = 1, -1
"""Levels of zstd. Below 0 it copies what finds no match, such as mantissas, instead of coding it by its entropy: arrays
of float32 are a tenth larger, and read four times as fast."""
_FIXED_DATE = (1980, 1, 1, 0, 0, 0)  # equal arrays give equal bytes, whenever they are written
_END, _END_64, _LOCATOR = struct.Struct("<4s4H2LH"), struct.Struct("<4sQ2H2L4Q"), struct.Struct("<4sLQL")
_ENTRY, _LOCAL = struct.Struct("<4s6H3L5H2L"), struct.Struct("<4s5H3L2H")
_MAX_TABLE_BYTES = 64 << 20  # half a million chunks: 1.6 billion Gaussians
_UTF8 = 0x800

Read = Callable[[int, int], bytes]


@dataclass(frozen=True, slots=True)
class ByteRange:
    """A range of bytes of one file of a group; a whole member of an archive has a CRC-32."""

    file: str
    start: int
    size: int
    crc32: int | None = None


@dataclass(frozen=True)
class StreamedArray:
    """An array that is written block by block and never fully in memory.

    Args:
        shape, dtype: of the whole array.
        block: returns the block that begins at a row; called in order, with blocks as long as a chunk.
    """

    shape: tuple[int, ...]
    dtype: np.dtype
    block: Callable[[int], np.ndarray]

    def __len__(self) -> int:
        return self.shape[0]

    @property
    def size(self) -> int:
        return math.prod(self.shape)

    def __getitem__(self, rows: slice) -> np.ndarray:
        return self.block(rows.start)


def write(path: Path, arrays: Mapping[str, np.ndarray | StreamedArray], *, chunk_rows: int) -> None:
    """Write arrays in chunks of ``chunk_rows`` rows; only one block of rows of all streamed arrays is in memory at a
    time.
    """
    import zarr
    from numcodecs import zstd
    from zarr.codecs import ZstdCodec
    from zarr.storage import MemoryStore

    keys: dict[str, Any] = {}
    group = zarr.create_group(MemoryStore(keys), zarr_format=3)
    levels = {name: _FLOAT_LEVEL if array.dtype == np.float32 else _ZSTD_LEVEL for name, array in arrays.items()}
    for name, array in arrays.items():
        group.create_array(
            name,
            shape=array.shape,
            dtype=array.dtype,
            chunks=(min(chunk_rows, max(1, len(array))), *(max(1, n) for n in array.shape[1:])),
            compressors=[ZstdCodec(level=levels[name], checksum=True)],
            fill_value=0,
        )
    with zipfile.ZipFile(path, "x", zipfile.ZIP_STORED) as archive:
        for long in (True, False):
            chosen = {n: a for n, a in arrays.items() if a.size and (len(a) > chunk_rows) == long}
            for i in range(-(-max((len(array) for array in chosen.values()), default=0) // chunk_rows)):
                for name, array in chosen.items():
                    if i * chunk_rows < len(array):
                        chunk = _chunk(array, i, min(chunk_rows, len(array)))
                        key = "/".join([name, "c", str(i), *("0" for _ in array.shape[1:])])
                        archive.writestr(zipfile.ZipInfo(key, _FIXED_DATE), zstd.compress(chunk, levels[name], True))
        for key, described in keys.items():
            archive.writestr(zipfile.ZipInfo(key, _FIXED_DATE), described.to_bytes())


def _chunk(array: np.ndarray | StreamedArray, i: int, rows: int) -> np.ndarray:
    """Return the bytes of one chunk; the last chunk is padded with zeros, as in zarr."""
    part = np.ascontiguousarray(array[i * rows : (i + 1) * rows], array.dtype.newbyteorder("<"))
    if len(part) < rows:
        part = np.concatenate([part, np.zeros((rows - len(part), *part.shape[1:]), part.dtype)])
    return part.reshape(-1).view(np.uint8)


def read_members(size: int, read: Read) -> Mapping[str, ByteRange]:
    """Return the byte ranges of the members of an archive, by name.

    Args:
        size: of the file in bytes.
        read: ``read(start, stop)`` returns that range of the file.

    Raises:
        ValueError: gsmap did not write the archive.
    """
    end = size - _END.size
    if end < 0:
        raise ValueError("the archive is too short")
    mark, _, _, _, count, table_bytes, table, comment = _END.unpack(read(end, size))
    if mark != b"PK\5\6" or comment:
        raise ValueError("the archive has no end record")
    if 0xFFFF in (count,) or 0xFFFFFFFF in (table_bytes, table):
        end -= _LOCATOR.size
        mark, _, where, _ = _LOCATOR.unpack(read(end, end + _LOCATOR.size)) if end >= 0 else (b"", 0, 0, 0)
        end -= _END_64.size
        if mark != b"PK\6\7" or where != end or end < 0:
            raise ValueError("the archive has no valid zip64 end record")
        mark, *_, count, table_bytes, table = _END_64.unpack(read(end, end + _END_64.size))
        if mark != b"PK\6\6":
            raise ValueError("the archive has no valid zip64 end record")
    if table + table_bytes != end or table_bytes > _MAX_TABLE_BYTES:
        raise ValueError("the archive's central directory is not at its end")
    return _entries(read(table, end), count, table)


@lru_cache(maxsize=4)  # every tile reads the same scenes, and the table grows with the scene
def _entries(table: bytes, count: int, end: int) -> Mapping[str, ByteRange]:
    """Parse and validate a table of contents; the members must end where the table begins."""
    out: dict[str, ByteRange] = {}
    at = lies = 0
    for _ in range(count):
        if at + _ENTRY.size > len(table):
            raise ValueError("the archive's central directory is truncated")
        entry = _ENTRY.unpack_from(table, at)
        mark, _, _, flags, method, _, _, crc, packed, size, named, more, comment, disk, _, _, start = entry
        at += _ENTRY.size
        name = table[at : at + named].decode()
        extra = table[at + named : at + named + more]
        at += named + more + comment
        if size == 0xFFFFFFFF:
            raise ValueError("the archive has a member of over 4 GB")
        if start == 0xFFFFFFFF and len(extra) == 12 and extra[:4] == b"\1\0\x08\0":
            start, extra = int.from_bytes(extra[4:], "little"), b""
        if mark != b"PK\1\2" or flags & ~_UTF8 or method or packed != size or comment or disk or extra or name in out:
            raise ValueError("the archive's central directory has entries that gsmap does not write")
        if start != lies:
            raise ValueError("the archive's members are not contiguous")
        body = start + _LOCAL.size + named
        out[name] = ByteRange(FILE, body, size, crc)
        lies = body + size
    if at != len(table) or lies != end:
        raise ValueError("the archive's central directory does not list all members of the archive")
    return MappingProxyType(out)
