"""Damage for `tools/check/fuzz_parsers.py` that goes beneath the layer a format is wrapped in.

Each takes an input, a random number generator and ``guided`` (bytes -> bytes, the fuzzer's own mutation, which knows
what compares with what), and returns another input; None where the input is too broken to be taken apart.
"""

from __future__ import annotations

import io
import json
import random
import struct
import zipfile
import zlib
from collections.abc import Callable
from typing import Any

Guided = Callable[[bytes], bytes]

NUMBERS = [0, 1, 2, 3, 4, 127, 128, 255, 256, 65535, 65536, 2**24, 2**31 - 1, 2**31, 2**32 - 1, 2**63, 2**64 - 1]
WORDS = [b"nan", b"inf", b"-1", b"0", b"1e999", b"9" * 20, b"9" * 5000, b"null", b"[]", b"{}", b'""', b"../../x"]
WORDS += [b"\x00", b"\xff\xfe", b"\x1b[2J", b"[" * 3000, b'{"a":' * 2000, b"\n" * 100, b"1_0", "٣".encode(), b"#"]
VALUES: list[Any] = [None, True, "", "x", "nan", [], {}, [[]], {"a": 1}, -1, 0, 1, 2**31, 2**63, 2**64, 10**400, 0.5]
VALUES += [
    -0.5,
    1e-320,
    1e38,
    1e300,
    float("nan"),
    float("inf"),
    "../../x",
    "/etc/passwd",
    "\x00",
    "\ud800",
    "a" * 2000,
]


def bruise(data: bytes, rng: random.Random, guided: Guided) -> bytes:
    """One to four wounds: bits, numbers, words, cuts and repeats, mostly near the beginning."""
    out = bytearray(data)
    for _ in range(rng.choice([1, 1, 1, 2, 4])):
        if not out:
            break
        at = rng.randrange(min(len(out), 400) if rng.random() < 0.5 else len(out))
        kind = rng.randrange(7)
        if kind == 0:
            out[at] ^= 1 << rng.randrange(8)
        elif kind == 1:
            width = rng.choice([1, 2, 4, 8])
            out[at : at + width] = (rng.choice(NUMBERS) % 256**width).to_bytes(width, "little")
        elif kind == 2:
            del out[at:]
        elif kind == 3:
            del out[at : at + rng.randint(1, 40)]
        elif kind == 4:
            out[at:at] = out[at : at + rng.randint(1, 200)] * rng.choice([1, 2, 50])
        elif kind == 5:
            out[at : at + rng.randint(0, 12)] = rng.choice(WORDS)
        else:  # a number in a text becomes another
            digits = [i for i, byte in enumerate(out[:20_000]) if 48 <= byte <= 57]
            if digits:
                i = rng.choice(digits)
                out[i : i + rng.randint(1, 4)] = rng.choice(WORDS + [str(n).encode() for n in NUMBERS])
    return bytes(out)


def either(data: bytes, rng: random.Random, guided: Guided) -> bytes:
    """The fuzzer's own mutation or a bruise."""
    return guided(data) if rng.random() < 0.5 else bruise(data, rng, guided)


def json_value(data: bytes, rng: random.Random, guided: Guided) -> bytes | None:
    """JSON that stays JSON: a value replaced, taken out, repeated, renamed or put elsewhere."""
    try:
        tree = json.loads(data)
        places = list(_places(tree))
        for _ in range(rng.choice([1, 1, 1, 2, 3])):
            _wound(tree, rng.choice(places), rng)
        return json.dumps(tree).encode("utf-8", "surrogatepass")
    except (ValueError, RecursionError, LookupError, TypeError, ArithmeticError):
        return None


def _places(tree: Any, depth: int = 0) -> Any:
    """(holder, key) of every value below a tree."""
    keys: Any = tree.keys() if isinstance(tree, dict) else range(len(tree)) if isinstance(tree, list) else ()
    for key in list(keys):
        yield tree, key
        if depth < 20:
            yield from _places(tree[key], depth + 1)


def _wound(tree: Any, place: tuple[Any, Any], rng: random.Random) -> None:
    holder, key = place
    kind = rng.randrange(8)
    if kind >= 6 and isinstance(holder[key], (int, float)):  # as good a number as it was
        holder[key] = type(holder[key])(holder[key] * rng.choice([-1, 0.5, 2, 1.0001, 1000]) + rng.choice([0, 0, 1]))
    elif kind <= 2 or kind >= 6:
        holder[key] = rng.choice(VALUES)
    elif kind == 3:
        del holder[key]
    elif isinstance(holder, list):
        holder.extend([holder[key]] * rng.choice([1, 2, 100])) if kind == 4 else holder.append(rng.choice(VALUES))
    elif kind == 4:
        other, there = rng.choice(list(_places(tree)))
        holder[key] = other[there]
    else:
        holder[rng.choice(["", "x", key + " ", key.upper()])] = holder.pop(key)


def json_or_bytes(data: bytes, rng: random.Random, guided: Guided) -> bytes:
    return (json_value(data, rng, guided) if rng.random() < 0.6 else None) or either(data, rng, guided)


def spz(data: bytes, rng: random.Random, guided: Guided) -> bytes | None:
    """Beneath gzip (versions 1 to 3), or in one stream of zstd with the table of contents made to fit (version 4)."""
    if data[:2] == b"\x1f\x8b":
        try:
            inner = zlib.decompressobj(31).decompress(data, 1 << 20)
        except zlib.error:
            return None
        squeeze = zlib.compressobj(1, wbits=31)
        return squeeze.compress(either(inner, rng, guided)) + squeeze.flush()
    from numcodecs import zstd

    try:
        streams, at = [], 32 + 16 * data[15]
        for i in range(data[15]):
            size, expanded = struct.unpack_from("<QQ", data, 32 + 16 * i)
            streams.append([bytes(zstd.decompress(data[at : at + size])), expanded])
            at += size
        head = bytearray(data[:32])
        if not streams or rng.random() < 0.3:
            head[4:32] = either(bytes(head[4:32]), rng, guided)[:28].ljust(28, b"\0")
        else:
            chosen = rng.choice(streams)
            chosen[0] = either(chosen[0], rng, guided)
            chosen[1] = rng.choice([len(chosen[0]), chosen[1]])
        packed = [bytes(zstd.compress(stream or b"\0", 1)) for stream, _ in streams]
        toc = b"".join(struct.pack("<QQ", len(p), e) for p, (_, e) in zip(packed, streams, strict=True))
        return bytes(head) + toc + b"".join(packed)
    except (RuntimeError, struct.error, IndexError, ValueError):
        return None


def sog(data: bytes, rng: random.Random, guided: Guided) -> bytes | None:
    """The same ZIP with one member damaged (the JSON as JSON, an image below its WebP), left out or renamed."""
    out = io.BytesIO()
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as source, zipfile.ZipFile(out, "w") as target:
            entries = source.infolist()
            names = [e.filename for e in entries if e.file_size < 1 << 20]
            victim = "meta.json" if rng.random() < 0.6 and "meta.json" in names else rng.choice(names)
            for name in names:
                member = source.read(name)
                if name == victim:
                    if rng.random() < 0.05:
                        continue
                    below = json_or_bytes if name == "meta.json" else _webp if rng.random() < 0.5 else either
                    member = below(member, rng, guided)
                target.writestr(name, member, rng.choice([zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED]))
    except Exception:  # whatever `zipfile` finds wrong with a file that is damaged already
        return None
    return out.getvalue()


def _webp(data: bytes, rng: random.Random, guided: Guided) -> bytes:
    """An image with other texels, another size or another mode."""
    from PIL import Image

    try:
        with Image.open(io.BytesIO(data), formats=["WEBP"]) as picture:
            if picture.width * picture.height > 1 << 16:
                return data
            texels, size = picture.convert("RGBA").tobytes(), picture.size
    except Exception:
        return either(data, rng, guided)
    if rng.random() < 0.3:
        size = (rng.choice([1, 4, 64, 192, 1000]), rng.choice([1, 4, 5]))
    texels = either(texels, rng, guided)[: 4 * size[0] * size[1]].ljust(4 * size[0] * size[1], b"\xff")
    image, out = Image.frombytes("RGBA", size, texels), io.BytesIO()
    if rng.random() < 0.2:
        image = image.convert("RGB")
    image.save(out, "WEBP", lossless=rng.random() < 0.8, exact=True)
    return out.getvalue()


def glb(data: bytes, rng: random.Random, guided: Guided) -> bytes | None:
    """The JSON chunk damaged, the lengths around it made to fit."""
    try:
        size = struct.unpack_from("<I", data, 12)[0]
        text, rest = data[20 : 20 + size], data[20 + size :]
        if len(text) < size:
            return None
        if rng.random() < 0.2:
            rest = either(rest, rng, guided)
        else:
            text = json_or_bytes(text, rng, guided)
        text += b" " * (-len(text) % 4)
        return data[:8] + struct.pack("<II", 20 + len(text) + len(rest), len(text)) + data[16:20] + text + rest
    except (struct.error, IndexError):
        return None


def protobuf(data: bytes, rng: random.Random, guided: Guided) -> bytes | None:
    """One field of a message, or of a message in it, damaged with the lengths around it made to fit."""
    fields = _fields(data)
    if not fields:
        return None
    number = rng.randrange(len(fields))
    tag, value = fields[number]
    if isinstance(value, bytes):
        inside = protobuf(value, rng, guided) if rng.random() < 0.7 else None
        value = inside if inside is not None else either(value, rng, guided)
    else:
        value = rng.choice(NUMBERS)
    fields[number : number + rng.choice([1, 1, 1, 0])] = [(tag if rng.random() < 0.9 else rng.randrange(256), value)]
    return b"".join(
        _varint(key) + (_varint(len(v)) + v if isinstance(v, bytes) else _varint(v) if key & 7 == 0 else b"\0" * 4)
        for key, v in fields
    )


def _fields(data: bytes) -> list[tuple[int, int | bytes]]:
    """(tag, value) of a message of varints and byte strings; empty where it is none."""
    out: list[tuple[int, int | bytes]] = []
    at = 0
    try:
        while at < len(data):
            tag, at = _read_varint(data, at)
            number, at = _read_varint(data, at)
            if tag & 7 == 2 and at + number <= len(data):
                out.append((tag, data[at : at + number]))
                at += number
            elif tag & 7 == 0:
                out.append((tag, number))
            else:
                return []
    except IndexError:
        return []
    return out


def _read_varint(data: bytes, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte = data[at]
        value |= (byte & 127) << shift
        at, shift = at + 1, shift + 7
        if byte < 128:
            return value, at


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    return bytes([*out, value])
