"""The one way in which gsmap lays arrays out as zarr, checked before zarr reads any.

zarr would run whatever codec a file names, make an array of whatever shape it claims, and unpack whatever lies in a
chunk. A map may come from a stranger, so what differs from what `gsmap.store.arrays` writes is refused first: other
codecs, chunks that are missing or would not unpack to their size, shapes that the catalog contradicts, arrays far
larger than anything real packs to.
"""

from __future__ import annotations

import json
import math
import os
import struct
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from gsmap.durable import open_file
from gsmap.errors import CorruptError

CHUNK_ROWS = 16_384
SHARD_ROWS = 16 * CHUNK_ROWS
Shape = tuple[int | None, ...]

_ITEM_BYTES = {f"{kind}{bits}": bits // 8 for kind in ("int", "uint") for bits in (8, 16, 32, 64)}
_ITEM_BYTES |= {"bool": 1, "float16": 2, "float32": 4, "float64": 8}
_KEYS = {"shape", "data_type", "chunk_grid", "chunk_key_encoding", "fill_value", "codecs", "zarr_format", "node_type"}
_MAY_HAVE = _KEYS | {"attributes", "storage_transformers", "dimension_names"}
_CHUNK_KEYS = {"name": "default", "configuration": {"separator": "/"}}
_MAX_METADATA_BYTES = 1 << 16
_MAX_DIMENSIONS = 4
# Real Gaussians pack to a tenth; these say from where on it is an attack on memory, not a scene.
_MAX_PACKED = 1_000
_ALWAYS_ALLOWED_BYTES = 256 << 20
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_MAX_FRAME_HEADER = 18


def check(
    place: Path, sizes: Mapping[str, int], names: Collection[str], shapes: Mapping[str, Shape] | None = None
) -> None:
    """Refuse arrays that gsmap did not write so; almost nothing is read.

    Args:
        place: the group's folder.
        sizes: bytes of every file that the catalog names in it; each is a plain file of that size.
        names: of the arrays to be read.
        shapes: what is known of the shapes of some; None for a length that is not.

    Raises:
        CorruptError: with the array, and what is wrong.
    """
    at = place
    try:
        group = _metadata(place, "zarr.json", sizes)
        if group.get("node_type") != "group" or group.get("zarr_format") != 3 or group.get("consolidated_metadata"):
            raise ValueError("it is not a plain zarr v3 group")
        total = 0
        for name in names:
            at = place / name
            total += _check_array(place, name, sizes, (shapes or {}).get(name))
        if total > _ALWAYS_ALLOWED_BYTES + _MAX_PACKED * sum(sizes.values()):
            raise ValueError(f"its arrays would take {total:.3g} bytes, far more than such files can hold")
    except (ValueError, KeyError, TypeError, AttributeError, IndexError, RecursionError, struct.error) as error:
        said = str(error) if type(error) is ValueError else f"its zarr metadata makes no sense ({error!r})"
        raise CorruptError(f"{at}: {said}; gsmap did not write that: {mend(place.parent.name)}") from error


def mend(kind: str) -> str:
    """What to do about a damaged group of this kind."""
    again = {
        "graphs": "make the graph again (gsmap describe MAP SCENE)",
        "changes": "compare its two scenes again (gsmap changes MAP A:B)",
        "indexes": "add a capture: the index is made anew when the next one asks it",
    }
    return f"run gsmap check, and {again.get(kind, 'ingest the scene again')}"


def _check_array(place: Path, name: str, sizes: Mapping[str, int], known: Shape | None) -> int:
    """Check one array; returns its bytes in memory."""
    about = _metadata(place, f"{name}/zarr.json", sizes)
    if not _KEYS <= set(about) <= _MAY_HAVE or about["node_type"] != "array" or about["zarr_format"] != 3:
        raise ValueError("it is not a plain zarr v3 array")
    if about["chunk_key_encoding"] != _CHUNK_KEYS or about.get("storage_transformers"):
        raise ValueError("its chunks lie elsewhere than gsmap puts them")
    shape, kind = about["shape"], about["data_type"]
    if not isinstance(kind, str) or kind not in _ITEM_BYTES:
        raise ValueError(f"its values are {kind!r}, not plain numbers")
    if not _lengths(shape, least=0) or not 1 <= len(shape) <= _MAX_DIMENSIONS:
        raise ValueError(f"its shape is {shape!r}")
    if known is not None and not _same(shape, known):
        wanted = ", ".join("any" if length is None else str(length) for length in known)
        raise ValueError(f"its shape is {shape}, but the catalog says ({wanted})")
    grid = about["chunk_grid"]
    outer = grid["configuration"]["chunk_shape"]
    inner, sharded = _chunks_in(about["codecs"], outer)
    rows = [max(1, length) for length in shape[1:]]
    if grid["name"] != "regular" or not all(_lengths(c, least=1) and c[1:] == rows for c in (outer, inner)):
        raise ValueError(f"its chunks {outer!r} are not rows")
    if inner[0] > CHUNK_ROWS or outer[0] > SHARD_ROWS or outer[0] % inner[0]:
        raise ValueError(f"its chunks {inner} in {outer} are not of gsmap's sizes")
    item = _ITEM_BYTES[kind]
    num_bytes: int = math.prod(shape) * item
    if not num_bytes:
        return 0
    files = -(-shape[0] // outer[0])
    if files > len(sizes):
        raise ValueError(f"its shape is {shape}, but most of its chunks are missing")
    for i in range(files):
        key = "/".join([name, "c", str(i), *("0" for _ in rows)])
        if key not in sizes:
            raise ValueError(f"its chunk {i} is missing")
        used = -(-min(outer[0], shape[0] - i * outer[0]) // inner[0])
        _check_file(place / key, sizes[key], math.prod(inner) * item, used, outer[0] // inner[0] if sharded else 0)
    return num_bytes


def _chunks_in(codecs: Any, outer: list[int]) -> tuple[list[int], bool]:
    """The shape of what is packed by itself, and whether several such lie in one file; other codecs are refused."""
    names = _names_of(codecs)
    if names == ["bytes", "zstd"]:
        return outer, False
    if names == ["sharding_indexed"]:
        shard = codecs[0]["configuration"]
        index = _names_of(shard["index_codecs"])
        at_end = shard.get("index_location", "end") == "end"
        if _names_of(shard["codecs"]) == ["bytes", "zstd"] and index == ["bytes", "crc32c"] and at_end:
            return shard["chunk_shape"], True
        names += [*_names_of(shard["codecs"]), *index]
    raise ValueError(f"its codecs are {', '.join(names)[:100]}, which are not gsmap's")


def _names_of(codecs: Any) -> list[str]:
    return [str(codec["name"]) for codec in codecs]


def _check_file(path: Path, size: int, chunk_bytes: int, used: int, in_shard: int) -> None:
    """Look into a chunk's file: all that is used of it unpacks to exactly the bytes of a chunk."""
    handle = open_file(path)
    try:
        places: Sequence[tuple[int, int]] = [(0, size)]
        if in_shard:
            index = 16 * in_shard
            found = os.pread(handle, index, size - index - 4) if size > index + 4 else b""
            places = list(struct.iter_unpack("<QQ", found))[:used]
            if len(places) < used or any(start + length > size - index - 4 for start, length in places):
                raise ValueError(f"{path.name} of its shards lacks chunks")
        for start, _ in places:
            if _unpacked_bytes(os.pread(handle, _MAX_FRAME_HEADER, start)) != chunk_bytes:
                raise ValueError("a chunk of it would not unpack to its size")
    finally:
        os.close(handle)


def _unpacked_bytes(head: bytes) -> int:
    """What a zstd frame says it unpacks to (RFC 8878, 3.1.1.1); -1 where it does not say."""
    if head[:4] != _ZSTD_MAGIC:
        return -1
    flags = head[4]
    single, kind = flags >> 5 & 1, flags >> 6
    at = 5 + (not single) + (0, 1, 2, 4)[flags & 3]
    length = (1 if single else 0, 2, 4, 8)[kind]
    if not length or len(head) < at + length:
        return -1
    return int.from_bytes(head[at : at + length], "little") + (256 if kind == 1 else 0)


def _metadata(place: Path, path: str, sizes: Mapping[str, int]) -> dict[str, Any]:
    if sizes.get(path, _MAX_METADATA_BYTES + 1) > _MAX_METADATA_BYTES:
        raise ValueError("it has no zarr metadata")
    with open(open_file(place / path), "rb") as file:
        found = json.loads(file.read())
    if not isinstance(found, dict):
        raise ValueError("its zarr metadata is no object")
    return found


def _lengths(value: Any, least: int) -> bool:
    return isinstance(value, list) and all(type(length) is int and least <= length < 1 << 40 for length in value)


def _same(shape: list[int], known: Shape) -> bool:
    return len(shape) == len(known) and all(b is None or a == b for a, b in zip(shape, known, strict=True))
