"""The zarr layout of gsmap's arrays, validated before anything is decompressed.

zarr would run any codec that a file names, allocate any shape it claims, and decompress any chunk. A map may come from
an untrusted source, so everything that differs from what `gsmap.store.arrays` writes is rejected first: other codecs,
missing chunks, chunks of other sizes, shapes that contradict the catalog, and arrays far larger than real data compress
to. What is left is decompressing zstd frames, which needs no zarr (zarr would take a millisecond per array).

A group is one archive (`gsmap.store.array_archive`).
"""

from __future__ import annotations

import json
import math
import struct
import zlib
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from gsmap.errors import CorruptError
from gsmap.store import array_archive
from gsmap.store.array_archive import ByteRange

CHUNK_ROWS = 16_384
Shape = tuple[int | None, ...]
Range = tuple[int, int]

_ITEM_BYTES = {f"{kind}{bits}": bits // 8 for kind in ("int", "uint") for bits in (8, 16, 32, 64)}
_ITEM_BYTES |= {"bool": 1, "float16": 2, "float32": 4, "float64": 8}
_KEYS = {"shape", "data_type", "chunk_grid", "chunk_key_encoding", "fill_value", "codecs", "zarr_format", "node_type"}
_MAY_HAVE = _KEYS | {"attributes", "storage_transformers", "dimension_names"}
_CHUNK_KEYS = {"name": "default", "configuration": {"separator": "/"}}
_MAX_METADATA_BYTES = 1 << 16
_MAX_DIMENSIONS = 4
# Real Gaussians compress to a tenth; beyond these limits a file is taken for a decompression bomb.
_MAX_PACKED = 1_000
_ALWAYS_ALLOWED_BYTES = 256 << 20
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_MAX_FRAME_HEADER = 18


class FileReader(Protocol):
    """Access to the bytes of the files of one group, on disk or in an object store."""

    def read(self, file: str, start: int, stop: int) -> bytes:
        """Read the bytes ``[start, stop)`` of a file; return fewer bytes if the file is shorter."""

    def expect(self, file: str, ranges: Sequence[Range]) -> None:
        """Announce the ranges that will be read next, so that few requests can fetch them."""


class GroupReader:
    """The keys of a group and the ranges of their bytes.

    Args:
        at: name of the group for messages.
        kind: of the group, for advice.
        sizes: size of every file of the group; each is a plain file of that size.

    Raises:
        CorruptError: the group is an archive that gsmap did not write.
    """

    def __init__(self, at: str, kind: str, sizes: Mapping[str, int], reader: FileReader) -> None:
        self.at = at
        self.kind = kind
        self.num_bytes = sum(sizes.values())
        self._reader = reader
        with self._translate_errors(at):
            if set(sizes) != {array_archive.FILE}:
                raise ValueError("it is not one archive")
            size = sizes[array_archive.FILE]
            reader.expect(array_archive.FILE, [(max(0, size - array_archive.TAIL_BYTES), size)])
            self.keys: Mapping[str, ByteRange] = array_archive.read_members(
                size, lambda start, stop: self._bytes(ByteRange(array_archive.FILE, start, stop - start))
            )

    def _bytes(self, span: ByteRange) -> bytes:
        found = self._reader.read(span.file, span.start, span.start + span.size)
        if len(found) != span.size:
            raise ValueError(f"{span.file} is shorter than when it was opened")
        return found

    def metadata(self, key: str) -> dict[str, Any]:
        span = self.keys.get(key)
        if span is None or span.size > _MAX_METADATA_BYTES:
            raise ValueError("it has no zarr metadata")
        text = self._bytes(span)
        if span.crc32 not in (None, zlib.crc32(text)):
            raise ValueError("its zarr metadata differs from what gsmap wrote")
        found = json.loads(text)
        if not isinstance(found, dict):
            raise ValueError("its zarr metadata is not a JSON object")
        return found

    def array_names(self) -> list[str]:
        found = (key.rpartition("/") for key in self.keys)
        return sorted(above for above, _, name in found if name == "zarr.json" and above)

    def selected(self, only: Sequence[str] | None, optional: Sequence[str]) -> list[str]:
        """Return the names of arrays to read: ``only`` (default: all), and those of ``optional`` that exist."""
        present = self.array_names() if only is None or optional else []
        return present if only is None else [*only, *(name for name in optional if name in present)]

    @contextmanager
    def _translate_errors(self, at: str) -> Iterator[None]:
        try:
            yield
        except (ValueError, KeyError, TypeError, AttributeError, IndexError, RecursionError, struct.error) as error:
            problem = str(error) if type(error) is ValueError else f"its zarr metadata is invalid ({error!r})"
            raise CorruptError(
                f"{at}: {problem}, which gsmap did not write: {repair_advice(self.kind)}", code="arrays_corrupt"
            ) from error

    def check_arrays(
        self, names: Collection[str], shapes: Mapping[str, Shape] | None = None, *, heads: bool = False
    ) -> dict[str, ArrayLayout]:
        """Validate and return the layout of arrays, reading hardly any data.

        Args:
            names: of the arrays.
            shapes: known shapes of some arrays; None for an unknown length.
            heads: also validate the decompressed size in the header of each chunk, as `ArrayLayout.read` does.

        Raises:
            CorruptError: an array has a layout that gsmap does not write.
        """
        out = {}
        with self._translate_errors(self.at):
            group = self.metadata("zarr.json")
            if group.get("node_type") != "group" or group.get("zarr_format") != 3 or group.get("consolidated_metadata"):
                raise ValueError("it is not a plain zarr v3 group")
        for name in names:
            with self._translate_errors(f"{self.at}/{name}"):
                array = out[name] = self._array(name, (shapes or {}).get(name))
                if heads:
                    for frame in array.frames:
                        array.check_head(self._bytes(replace(frame, size=min(frame.size, _MAX_FRAME_HEADER))))
        total = sum(array.num_bytes for array in out.values())
        with self._translate_errors(self.at):
            if total > _ALWAYS_ALLOWED_BYTES + _MAX_PACKED * self.num_bytes:
                raise ValueError(f"its arrays would take {total:.3g} bytes, far more than the file can hold")
        return out

    def _array(self, name: str, known: Shape | None) -> ArrayLayout:
        about = self.metadata(f"{name}/zarr.json")
        if not _KEYS <= set(about) <= _MAY_HAVE or about["node_type"] != "array" or about["zarr_format"] != 3:
            raise ValueError("it is not a plain zarr v3 array")
        if about["chunk_key_encoding"] != _CHUNK_KEYS or about.get("storage_transformers"):
            raise ValueError("its chunks are not stored at the paths that gsmap uses")
        shape, kind = about["shape"], about["data_type"]
        if not isinstance(kind, str) or kind not in _ITEM_BYTES:
            raise ValueError(f"its values are {kind!r}, not plain numbers")
        if not _are_lengths(shape, least=0) or not 1 <= len(shape) <= _MAX_DIMENSIONS:
            raise ValueError(f"its shape is {shape!r}")
        if known is not None and not _matches(shape, known):
            wanted = ", ".join("any" if length is None else str(length) for length in known)
            raise ValueError(f"its shape is {shape}, but the catalog records ({wanted})")
        grid = about["chunk_grid"]
        chunks = grid["configuration"]["chunk_shape"]
        _require_codecs(about["codecs"])
        rows = [max(1, length) for length in shape[1:]]
        if grid["name"] != "regular" or not _are_lengths(chunks, least=1) or chunks[1:] != rows:
            raise ValueError(f"its chunks {chunks!r} are not rows")
        if chunks[0] > CHUNK_ROWS:
            raise ValueError(f"its chunks {chunks} do not have the sizes that gsmap writes")
        out = ArrayLayout(tuple(shape), np.dtype(kind), chunks[0], [])
        if not out.num_bytes:
            return out
        files = -(-shape[0] // chunks[0])
        if files > len(self.keys):
            raise ValueError(f"its shape is {shape}, but most of its chunks are missing")
        others = "/0" * len(rows)
        spans = [span for i in range(files) if (span := self.keys.get(f"{name}/c/{i}{others}"))]
        if len(spans) < files:
            missing = next(i for i in range(files) if f"{name}/c/{i}{others}" not in self.keys)
            raise ValueError(f"its chunk {missing} is missing")
        out.frames.extend(spans)
        return out

    def read(
        self,
        arrays: Mapping[str, ArrayLayout],
        rows: Sequence[Range] | None = None,
        out: Mapping[str, np.ndarray] | None = None,
    ) -> dict[str, np.ndarray]:
        """Read rows of arrays that `check_arrays` validated: ranges ``[start, stop)`` in order, default: all.

        Args:
            out: by name, arrays to read into, of the shape and type of the rows.

        Raises:
            CorruptError: a chunk fails its checksum, or has another decompressed size.
        """
        wanted: dict[str, list[Range]] = {}
        for array in arrays.values():
            for frame in (array.frames[i] for i in array.chunks_of(rows)):
                wanted.setdefault(frame.file, []).append((frame.start, frame.start + frame.size))
        for file, ranges in wanted.items():
            self._reader.expect(file, ranges)
        found = {}
        for name, array in arrays.items():
            with self._translate_errors(f"{self.at}/{name}"):
                found[name] = array.read(self._bytes, rows, (out or {}).get(name))
        return found


@dataclass(frozen=True)
class ArrayLayout:
    """The validated layout of an array: a zstd frame for every ``chunk_rows`` rows."""

    shape: tuple[int, ...]
    dtype: np.dtype
    chunk_rows: int
    frames: list[ByteRange]

    @property
    def num_bytes(self) -> int:
        """Return the size in memory."""
        return math.prod(self.shape) * self.dtype.itemsize

    @property
    def chunk_bytes(self) -> int:
        return self.chunk_rows * math.prod(self.shape[1:]) * self.dtype.itemsize

    def chunks_of(self, rows: Sequence[Range] | None) -> list[int]:
        """Return the numbers of the chunks that contain some rows."""
        if rows is None or not self.frames:
            return list(range(len(self.frames)))
        last = self.shape[0] - 1
        spans = (range(a // self.chunk_rows, min(b - 1, last) // self.chunk_rows + 1) for a, b in rows if a < b)
        return sorted({i for span in spans for i in span})

    def check_head(self, frame: bytes) -> None:
        if _unpacked_bytes(frame) != self.chunk_bytes:
            raise ValueError("one of its chunks does not decompress to its recorded size")

    def read(
        self, bytes_of: Callable[[ByteRange], bytes], rows: Sequence[Range] | None, out: np.ndarray | None = None
    ) -> np.ndarray:
        """Read ranges ``[start, stop)`` of rows, in order, default: all; into ``out`` if it is given."""
        count = self.shape[0]
        ranges = [(0, count)] if rows is None else [(start, min(stop, count)) for start, stop in rows]
        shape = (sum(max(0, stop - start) for start, stop in ranges), *self.shape[1:])
        if out is None:
            out = np.zeros(shape, self.dtype)
        if out.shape != shape or out.dtype != self.dtype:
            raise ValueError(f"its rows are {shape} {self.dtype}, not {out.shape} {out.dtype}")
        if not self.frames:
            out[:] = 0
            return out
        at, held, scratch = 0, -1, np.empty(0, self.dtype)
        for start, stop in ranges:
            for i in range(start // self.chunk_rows, -(-stop // self.chunk_rows)):
                first = i * self.chunk_rows
                skipped, count = max(start - first, 0), min(stop - first, self.chunk_rows) - max(start - first, 0)
                part = out[at : at + count]
                at += count
                if count == self.chunk_rows and part.flags.c_contiguous:
                    self._unpack(bytes_of(self.frames[i]), part)
                    continue
                if i != held:
                    scratch = scratch if len(scratch) else np.empty((self.chunk_rows, *self.shape[1:]), self.dtype)
                    held = i
                    self._unpack(bytes_of(self.frames[i]), scratch)
                part[:] = scratch[skipped : skipped + count]
        return out

    def _unpack(self, frame: bytes, out: np.ndarray) -> None:
        """Decompress a chunk into a contiguous array of its size."""
        from numcodecs import zstd

        self.check_head(frame)
        try:
            zstd.decompress(frame, out)
        except RuntimeError as error:
            raise ValueError(f"one of its chunks differs from what gsmap wrote ({error})") from error


_REPAIRS = {
    "scenes": "ingest the scene again",
    "graphs": "compute the graph again (gsmap describe MAP SCENE)",
    "changes": "compare its two scenes again (gsmap changes MAP A:B)",
    "views": "localize a photo: gsmap computes lost features again",
    "prepared": "describe the scene again (gsmap describe MAP SCENE)",
    "photos": "remove the photo and add it again (gsmap localize MAP PHOTO --add)",
    "indexes": "add a capture: gsmap builds the index again",
}


def repair_of(kind: str) -> str:
    """Return how a damaged group of this kind is repaired."""
    return _REPAIRS.get(kind, "gsmap computes it again when it is needed")


def repair_advice(kind: str) -> str:
    """Return advice for a damaged group of this kind."""
    return f"run gsmap check, and {repair_of(kind)}"


def _require_codecs(codecs: Any) -> None:
    """Raise an error for codecs other than little-endian bytes in zstd."""
    names = [str(codec["name"]) for codec in codecs]
    if names != ["bytes", "zstd"] or codecs[0].get("configuration", {}).get("endian", "little") != "little":
        raise ValueError(f"its codecs are {', '.join(names)[:100]}, which gsmap does not use")


def _unpacked_bytes(head: bytes) -> int:
    """Return the decompressed size in the header of a zstd frame (RFC 8878, 3.1.1.1); -1 if it has none."""
    if head[:4] != _ZSTD_MAGIC or len(head) < 5:
        return -1
    flags = head[4]
    single, kind = flags >> 5 & 1, flags >> 6
    at = 5 + (not single) + (0, 1, 2, 4)[flags & 3]
    length = (1 if single else 0, 2, 4, 8)[kind]
    if not length or len(head) < at + length:
        return -1
    return int.from_bytes(head[at : at + length], "little") + (256 if kind == 1 else 0)


def _are_lengths(value: Any, least: int) -> bool:
    return isinstance(value, list) and all(type(length) is int and least <= length < 1 << 40 for length in value)


def _matches(shape: list[int], known: Shape) -> bool:
    return len(shape) == len(known) and all(b is None or a == b for a, b in zip(shape, known, strict=True))
