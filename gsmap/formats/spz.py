"""Read and write Niantic's ``.spz``: quantized attributes in one gzip stream (versions 1 to 3) or in zstd streams (4).

Positions are 24-bit fixed point, scales 8-bit logarithms, quaternions smallest-three (versions 1 and 2: xyz),
opacities, colours and SH 8 bits. The axes are right-up-back; we turn them, which Open3D and gsply do not.
Layout after the format's README and reference library (nianticlabs/spz, MIT).
"""

from __future__ import annotations

import io
import os
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from gsmap.errors import ConfigError, InputError
from gsmap.formats.axes import PLY, SPZ, change_axes
from gsmap.formats.quantise import (
    check_size,
    from_smallest_three,
    logits_of_bytes,
    opacity_bytes,
    require_writable,
    smallest_three,
)
from gsmap.geometry.origins import neighbour_distance
from gsmap.types import FileInfo, Gaussians

VERSION = 1

_MAGIC = b"NGSP"
_GZIP = b"\x1f\x8b"
_COLOUR_SCALE = 0.15  # of f_dc: wider than [0, 1], so that colours may lie a bit outside
_SH_COEFFICIENTS = (0, 3, 8, 15, 24)
_ANTIALIASED, _EXTENSIONS = 1, 2
_AXES_EXTENSION = 0xADBE0003
# LDB, RDB, LUB, RUB, LDF, RDF, LUF, RUF, then LFD, RFD, LFU, RFU, LBD, RBD, LBU, RBU.
_AXES = [x + y + z for z in "BF" for y in "DU" for x in "LR"] + [x + y + z for y in "FB" for z in "DU" for x in "LR"]
_MAX_EXTENSION_BYTES = 1 << 20
_MAX_FIXED = 2**23 - 1
_USUAL_BITS = 12  # fractional, of a position


@dataclass(frozen=True)
class _Header:
    version: int
    count: int
    degree: int
    fractional_bits: int
    flags: int

    @property
    def strides(self) -> dict[str, int]:
        """Return the bytes per Gaussian of each attribute, in the order of the file."""
        return {
            "positions": 6 if self.version == 1 else 9,
            "alphas": 1,
            "colours": 3,
            "scales": 3,
            "rotations": 4 if self.version >= 3 else 3,
            "sh": 3 * _SH_COEFFICIENTS[self.degree],
        }

    @property
    def payload_bytes(self) -> int:
        return self.count * sum(self.strides.values())


def read(path: str | os.PathLike[str]) -> Gaussians:
    """Read an ``.spz`` of version 1 to 4 in the axes of a ``.ply``; drop SH beyond degree 3.

    Raises:
        InputError: not an SPZ, an unknown version, truncated, or a decompression bomb.
    """
    with open(path, "rb") as file:
        header, streams, axes = _load(path, file, Path(path).stat().st_size)
    return change_axes(_decode(header, streams), PLY, axes)


def info(path: str | os.PathLike[str]) -> FileInfo:
    """Return the metadata: whether training was antialiased, and notes on data that reading drops."""
    with open(path, "rb") as file:
        head = file.read(32)
        if head.startswith(_GZIP):
            head = _Inflater(path, file).take(16)
    header = _parse_header(path, head)
    notes = ("SH of degree 4 was cut to degree 3",) if header.degree == 4 else ()
    return FileInfo(bool(header.flags & _ANTIALIASED), notes)


def write(
    path: str | os.PathLike[str],
    gaussians: Gaussians,
    *,
    version: int = 3,
    sh_bits: tuple[int, int] = (5, 4),
    antialiased: bool = False,
) -> None:
    """Write an ``.spz`` in the order of the Gaussians.

    Args:
        version: 3 (gzip, read everywhere) or 4 (zstd, faster; not every viewer reads it).
        sh_bits: Bits of SH degree 1 and of the higher degrees, 1 to 8; fewer make a smaller file.
        antialiased: Mark the file as trained with the 2D Mip filter.

    Raises:
        ConfigError: Unsupported version or number of bits.
        InputError: No Gaussians, values that are not finite, or positions beyond 8388 km, or so far out that
            neighbours fall together.
    """
    require_writable(path, gaussians)
    _require_distances(path, gaussians)
    packed = pack(path, change_axes(gaussians, SPZ, PLY), version=version, sh_bits=sh_bits, antialiased=antialiased)
    Path(path).write_bytes(packed)


def pack(
    path: str | os.PathLike[str],
    gaussians: Gaussians,
    *,
    version: int = 3,
    sh_bits: tuple[int, int] = (5, 4),
    antialiased: bool = False,
) -> bytes:
    """Pack Gaussians as the bytes of an SPZ without changing axes; see `write`.

    Args:
        path: Path of the containing file, for messages.
    """
    if version not in (3, 4):
        raise ConfigError(f"cannot write SPZ version {version!r}: choose 3 or 4", code="unsupported_output")
    if len(sh_bits) != 2 or not all(1 <= bits <= 8 for bits in sh_bits):
        raise ConfigError(f"sh_bits must be two numbers from 1 to 8, got {sh_bits!r}", code="out_of_range")
    g = gaussians
    header = _Header(version, len(g), g.sh_degree, _fractional_bits(path, g.means), int(antialiased))
    streams = _encode(header, g, sh_bits)
    fields = (_MAGIC, version, len(g), header.degree, header.fractional_bits, header.flags)
    if version == 3:
        # Runs only: of quantised numbers longer matches are chance, and looking for them costs three times as much.
        squeeze = zlib.compressobj(wbits=31, strategy=zlib.Z_RLE)
        parts = [squeeze.compress(struct.pack("<4sIIBBBB", *fields, 0))]
        parts += [squeeze.compress(stream.data) for stream in streams]
        return b"".join([*parts, squeeze.flush()])
    from numcodecs import zstd

    packed = [bytes(zstd.compress(stream, 3)) for stream in streams]
    sizes = [struct.pack("<QQ", len(one), stream.nbytes) for stream, one in zip(streams, packed, strict=True)]
    return b"".join([struct.pack("<4sIIBBBBI12x", *fields, len(packed), 32), *sizes, *packed])


def unpack(path: str | os.PathLike[str], data: bytes) -> Gaussians:
    """Unpack an SPZ inside another file without changing axes; see `read`.

    Args:
        path: Path of the containing file, for messages.
    """
    header, streams, _ = _load(path, io.BytesIO(data), len(data))
    return _decode(header, streams)


def _load(path: str | os.PathLike[str], file: BinaryIO, size: int) -> tuple[_Header, dict[str, np.ndarray], str]:
    """Return the header, the raw uint8 stream of each attribute, and the axes of a file of ``size`` bytes."""
    head = file.read(4)
    file.seek(0)
    if head.startswith(_GZIP):
        return _load_gzip(path, file, size)
    if head == _MAGIC:
        return _load_zstd(path, file, size)
    what = "is empty" if not head else f"begins with {head!r}, not with gzip's mark or NGSP"
    raise InputError(f"{path} is not an SPZ file: it {what}", code="wrong_file_type")


def _load_gzip(path, file, size) -> tuple[_Header, dict[str, np.ndarray], str]:
    inflater = _Inflater(path, file)
    header = _parse_header(path, inflater.take(16))
    if header.version > 3:
        raise InputError(
            f"{path}: SPZ version {header.version} cannot be gzip compressed; the file is damaged",
            code="compression_mismatch",
        )
    check_size(path, header.payload_bytes, size)
    data = np.frombuffer(inflater.take(header.payload_bytes), np.uint8)
    streams, at = {}, 0
    for name, stride in header.strides.items():
        streams[name] = data[at : at + header.count * stride]
        at += header.count * stride
    extensions = inflater.rest(_MAX_EXTENSION_BYTES) if header.flags & _EXTENSIONS else b""
    return header, streams, _axes(path, extensions)


def _load_zstd(path, file, size) -> tuple[_Header, dict[str, np.ndarray], str]:
    from numcodecs import zstd

    head = file.read(32)
    header = _parse_header(path, head)
    if header.version != 4 or len(head) < 32:
        raise InputError(
            f"{path}: SPZ version {header.version} must be gzip compressed, or the file is truncated",
            code="compression_mismatch",
        )
    num_streams, toc_at = struct.unpack_from("<BI", head, 15)
    strides = {name: stride for name, stride in header.strides.items() if stride}
    if num_streams != len(strides) or not 32 <= toc_at <= min(size, 32 + _MAX_EXTENSION_BYTES):
        raise InputError(
            f"{path}: {num_streams} streams at byte {toc_at}, expected {len(strides)}; it is damaged",
            code="invalid_streams",
        )
    extensions = file.read(toc_at - 32) if header.flags & _EXTENSIONS else b""
    file.seek(toc_at)
    toc = file.read(16 * num_streams)
    if len(toc) < 16 * num_streams:
        raise InputError(f"{path} is truncated within its table of contents", code="file_truncated")
    sizes = np.frombuffer(toc, "<u8").reshape(-1, 2).tolist()
    if toc_at + len(toc) + sum(s for s, _ in sizes) != size:
        raise InputError(
            f"{path}: its streams do not add up to the {size} bytes of the file: truncated or damaged",
            code="file_truncated",
        )
    if [u for _, u in sizes] != [header.count * s for s in strides.values()]:
        raise InputError(
            f"{path}: its streams do not have the size that {header.count} Gaussians need; it is damaged",
            code="count_mismatch",
        )
    check_size(path, header.payload_bytes, size)
    streams = {"sh": np.empty(0, np.uint8)}
    for name, (squeezed, expanded) in zip(strides, sizes, strict=True):
        source, out = file.read(squeezed), np.empty(expanded, np.uint8)
        if _zstd_content_size(source) not in (None, expanded):
            raise InputError(
                f"{path}: the {name} are not the size that its table of contents promises; it is damaged",
                code="count_mismatch",
            )
        try:
            zstd.decompress(source, out)
        except (RuntimeError, ValueError) as error:
            raise InputError(
                f"{path}: its {name} cannot be decompressed: {error}", code="decompression_failed"
            ) from error
        streams[name] = out
    return header, streams, _axes(path, extensions)


def _parse_header(path: str | os.PathLike[str], head: bytes) -> _Header:
    if len(head) < 16 or head[:4] != _MAGIC:
        raise InputError(f"{path} is not an SPZ file: no NGSP header", code="wrong_file_type")
    header = _Header(*struct.unpack_from("<IIBBB", head, 4))
    if not 1 <= header.version <= 4:
        raise InputError(
            f"{path}: SPZ version {header.version} is unknown; gsmap reads 1 to 4", code="unsupported_version"
        )
    if header.count == 0:
        raise InputError(f"{path} holds no Gaussians", code="no_gaussians")
    if header.degree >= len(_SH_COEFFICIENTS) or header.fractional_bits > 23:
        raise InputError(
            f"{path}: SH degree {header.degree} and {header.fractional_bits} fractional bits: it is damaged",
            code="invalid_fractional_bits",
        )
    return header


def _axes(path: str | os.PathLike[str], extensions: bytes) -> str:
    """Return the axes from the extension records ``[type u32, length u32, payload]``, or the default axes of SPZ."""
    at, axes = 0, SPZ
    while at + 8 <= len(extensions):
        kind, length = struct.unpack_from("<II", extensions, at)
        if kind == _AXES_EXTENSION and length == 4 and at + 12 <= len(extensions):
            value = struct.unpack_from("<I", extensions, at + 8)[0]
            if value > len(_AXES):
                raise InputError(f"{path}: its axes are of the unknown kind {value}", code="unsupported_axes")
            axes = _AXES[value - 1] if value else SPZ
        at += 8 + length
    return axes


def _zstd_content_size(frame: bytes) -> int | None:
    """Return the decompressed size from a zstd frame's header (RFC 8878, 3.1.1.1); None if the header has no size.

    numcodecs leaves the rest of a buffer as it was when a frame holds less than the buffer.
    """
    if len(frame) < 6 or frame[:4] != b"\x28\xb5\x2f\xfd":
        return None
    flags = frame[4]
    single = flags >> 5 & 1
    at = 5 + (1 - single) + (0, 1, 2, 4)[flags & 3]
    width = (single, 2, 4, 8)[flags >> 6]
    value = int.from_bytes(frame[at : at + width], "little")
    return (value + (256 if width == 2 else 0)) if width else None


class _Inflater:
    """Bounded reader of a gzip file."""

    def __init__(self, path: str | os.PathLike[str], file) -> None:
        self._path, self._file, self._stream = path, file, zlib.decompressobj(wbits=31)
        self._file.seek(0)

    def take(self, size: int) -> bytes:
        """Read exactly ``size`` bytes, or raise InputError."""
        data = self.rest(size)
        if len(data) < size:
            raise InputError(
                f"{self._path} is truncated: {size:,} bytes promised, {len(data):,} found", code="file_truncated"
            )
        return data

    def rest(self, limit: int) -> bytes:
        """Return the remaining bytes, at most ``limit``."""
        parts, missing = [], limit
        while missing and not self._stream.eof:
            source = self._stream.unconsumed_tail or self._file.read(1 << 20)
            try:
                parts.append(self._stream.decompress(source, missing))
            except zlib.error as error:
                raise InputError(
                    f"{self._path} cannot be decompressed: {error}", code="decompression_failed"
                ) from error
            if not source and not parts[-1]:
                break
            missing -= len(parts[-1])
        return b"".join(parts)


def position_step(positions: np.ndarray) -> float:
    """Return the step in which an SPZ would store positions (N, 3)."""
    return float(2.0 ** -_fractional_bits("SPZ", positions))


def _require_distances(path: str | os.PathLike[str], gaussians: Gaussians) -> None:
    """Reject Gaussians that lie so far from the origin that the stored positions of neighbours would coincide."""
    bits = _fractional_bits(path, gaussians.means)
    apart = np.inf if bits >= _USUAL_BITS else neighbour_distance(gaussians)
    if apart < 2 * 2.0**-bits:
        raise InputError(
            f"{path}: positions reach {np.abs(gaussians.means).max():.6g}, where SPZ has steps of {2.0**-bits:g}, but "
            f"neighbours are {apart:.2g} apart: move the origin closer, or remove what lies far out",
            code="precision_loss",
        )


def _fractional_bits(path: str | os.PathLike[str], means: np.ndarray) -> int:
    """Choose the number of fractional bits: 12 (0.24 mm) by default, more for small scenes, fewer for a large range."""
    extent = float(np.abs(means).max())
    if extent > _MAX_FIXED:
        raise InputError(
            f"{path}: positions reach {extent:.3g}, SPZ can hold {_MAX_FIXED}: move the origin closer",
            code="precision_loss",
        )
    octaves = int(np.ceil(np.log2(max(extent, 1e-6) * (1 + 1e-6))))
    return max(0, min(23 - octaves, max(_USUAL_BITS, 18 - octaves), 23))


def _encode(header: _Header, g: Gaussians, sh_bits: tuple[int, int]) -> list[np.ndarray]:
    fixed = np.round(g.means.astype(np.float64) * 2.0**header.fractional_bits)
    fixed = np.clip(fixed, -_MAX_FIXED - 1, _MAX_FIXED).astype("<i4")
    scales = np.clip(np.round((g.log_scales + 10) * 16), 0, 255)
    colours = np.clip(np.round((g.sh[:, 0] * _COLOUR_SCALE + 0.5) * 255), 0, 255)
    sh = np.empty((len(g), g.sh.shape[1] - 1, 3), np.uint8)
    for band, bits in ((slice(0, 3), sh_bits[0]), (slice(3, None), sh_bits[1])):
        sh[:, band] = _quantise_sh(g.sh[:, 1:][:, band], 1 << 8 - bits)
    streams = [
        np.ascontiguousarray(fixed.view(np.uint8).reshape(-1, 4)[:, :3]),
        opacity_bytes(g.logit_opacities),
        colours.astype(np.uint8),
        scales.astype(np.uint8),
        _pack_quats(g.quats),
        sh,
    ]
    return [stream for stream in streams if stream.size]


def _quantise_sh(values: np.ndarray, step: int) -> np.ndarray:
    """Quantize SH to multiples of ``step`` / 128: zero stays zero, and the last bits compress well."""
    level = values * np.float32(128 / step)
    np.rint(level, out=level)
    level *= step
    level += 128
    return np.clip(level, 0, 255, out=level).astype(np.uint8)


def _decode(header: _Header, streams: dict[str, np.ndarray]) -> Gaussians:
    n = header.count
    if header.version == 1:
        means = streams["positions"].view("<f2").reshape(n, 3).astype(np.float32)
    else:
        fixed = np.zeros((n, 3, 4), np.uint8)
        fixed[..., 1:] = streams["positions"].reshape(n, 3, 3)
        means = (fixed.view("<i4")[..., 0] >> 8) * np.float32(2.0**-header.fractional_bits)
    k = min(_SH_COEFFICIENTS[header.degree], _SH_COEFFICIENTS[3])
    sh = np.empty((n, 1 + k, 3), np.float32)
    sh[:, 0] = (streams["colours"].reshape(n, 3) / np.float32(255) - np.float32(0.5)) / np.float32(_COLOUR_SCALE)
    if k:
        sh[:, 1:] = streams["sh"].reshape(n, -1, 3)[:, :k]
        sh[:, 1:] -= 128
        sh[:, 1:] /= 128
    return Gaussians(
        means,
        _unpack_quats(streams["rotations"].reshape(n, -1)),
        streams["scales"].reshape(n, 3) / np.float32(16) - 10,
        logits_of_bytes(streams["alphas"]),
        sh,
    )


def _pack_quats(quats: np.ndarray) -> np.ndarray:
    """Pack quaternions in 32 bits: 2 bits for the largest component (of xyzw), a sign and 9 bits for each other."""
    largest, three = smallest_three(quats[:, [1, 2, 3, 0]])
    level = np.round(np.abs(three) * (511 * 2**0.5)).clip(0, 511).astype(np.uint32)
    packed = (level | (three < 0).astype(np.uint32) << 9) @ np.array([1 << 20, 1 << 10, 1], np.uint32)
    return (largest.astype(np.uint32) << 30 | packed).astype("<u4").view(np.uint8)


def _unpack_quats(raw: np.ndarray) -> np.ndarray:
    if raw.shape[1] == 3:  # versions 1 and 2: xyz, w positive
        xyz = raw / np.float32(127.5) - 1
        w = np.sqrt(np.maximum(0, 1 - (xyz * xyz).sum(1, keepdims=True)))
        wxyz = np.concatenate([w, xyz], axis=1)
        return wxyz / np.linalg.norm(wxyz, axis=1, keepdims=True)
    packed = np.ascontiguousarray(raw).view("<u4")[:, 0]
    three = np.stack([packed >> 20, packed >> 10, packed], axis=1)
    value = (three & 511) * np.float32(2**-0.5 / 511) * np.where(three & 512, -1, 1).astype(np.float32)
    return from_smallest_three(packed >> 30, value)[:, [3, 0, 1, 2]]
