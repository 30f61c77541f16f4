"""PlayCanvas' ``.sog`` version 2 (read only): a ZIP of ``meta.json`` and lossless WebP images, one texel a Gaussian.

Positions are 16 bits of a signed logarithm, scales and colours go through a codebook of 256, quaternions are
smallest-three of 8 bits, SH comes from a palette.
"""

from __future__ import annotations

import io
import json
import lzma
import os
import zipfile
import zlib
from typing import Any

import numpy as np

from gsmap.errors import MALFORMED, InputError
from gsmap.formats.quantise import check_size, from_smallest_three, logits_of_bytes
from gsmap.types import Gaussians

VERSION = 1

_MAX_META_BYTES = 4 << 20
_MAX_PIXELS = 1 << 26  # 64 million Gaussians, 256 MiB an image
_SPARE_PIXELS = 1 << 16  # of an image beyond those that are used: writers round its sides up
_LEAST_BYTES = 56  # of a Gaussian in memory, SH degree 0
_SH_COEFFICIENTS = (0, 3, 8, 15)
_PALETTE_COLUMNS = 64
_MAX_PALETTE = 1 << 16  # labels have 16 bits
_FIRST_TAG = 252  # quaternion tags 252 to 255: which component is largest


def read(path: str | os.PathLike[str]) -> Gaussians:
    """Read a bundled ``.sog`` of version 2.

    Raises:
        InputError: not a ZIP, another version, members missing, images too small or far too large for the
            count.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            meta = _meta(path, archive)
            return _decode(path, archive, meta)
    except (zipfile.BadZipFile, zipfile.LargeZipFile, zlib.error, lzma.LZMAError, RuntimeError, EOFError) as error:
        raise InputError(f"{path} is not a readable .sog (a ZIP file): {error}") from error
    except MALFORMED as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: its meta.json does not describe it: {type(error).__name__} {error}") from error


def _decode(path: str | os.PathLike[str], archive: zipfile.ZipFile, meta: dict[str, Any]) -> Gaussians:
    n = int(meta["count"])
    if not 0 < n <= _MAX_PIXELS:
        raise InputError(f"{path}: a count of {n} Gaussians; gsmap reads 1 to {_MAX_PIXELS}")
    check_size(path, n * _LEAST_BYTES, os.path.getsize(path))

    def texels(part: str, file: int = 0) -> np.ndarray:
        image = _image(path, archive, meta[part]["files"][file], 2 * n).reshape(-1, 4)
        if len(image) < n:
            raise InputError(f"{path}: the image of {part} holds {len(image)} texels for {n} Gaussians")
        return image[:n]

    low, high = (np.array(meta["means"][end], np.float64).reshape(3) for end in ("mins", "maxs"))
    level = texels("means", 0)[:, :3] | texels("means", 1)[:, :3].astype(np.uint16) << 8
    logarithm = low + (high - low) * (level / 65535)
    quats = texels("quats")
    colours = texels("sh0")
    sh = np.zeros((n, 1 + _SH_COEFFICIENTS[_bands(path, meta)], 3), np.float32)
    sh[:, 0] = _codebook(path, meta["sh0"])[colours[:, :3]]
    if sh.shape[1] > 1:
        sh[:, 1:] = _palette_sh(path, archive, meta["shN"], texels("shN", 1), sh.shape[1] - 1)
    return Gaussians(
        np.sign(logarithm) * np.expm1(np.abs(logarithm)),
        _quats(path, quats),
        _codebook(path, meta["scales"])[texels("scales")[:, :3]],
        logits_of_bytes(colours[:, 3]),
        sh,
    )


def _meta(path: str | os.PathLike[str], archive: zipfile.ZipFile) -> dict[str, Any]:
    try:
        meta = json.loads(_member(path, archive, "meta.json", _MAX_META_BYTES))
    except (UnicodeDecodeError, json.JSONDecodeError, RecursionError) as error:
        raise InputError(f"{path}: its meta.json cannot be read: {error}") from error
    version = meta.get("version", 1)
    if version != 2:
        raise InputError(f"{path}: SOG version {version}; gsmap reads version 2, so export it anew")
    return meta


def _member(path: str | os.PathLike[str], archive: zipfile.ZipFile, name: str, limit: int) -> bytes:
    """One file of the archive, in memory only: its name is never a path on disk."""
    try:
        entry = archive.getinfo(name)
    except KeyError as error:
        raise InputError(f"{path} lacks {name!r}; is it a whole .sog?") from error
    if entry.file_size > limit:
        raise InputError(f"{path}: {name} is {entry.file_size:,} bytes, more than the {limit:,} gsmap reads")
    with archive.open(entry) as file:
        data = file.read(limit + 1)
    if len(data) > limit:
        raise InputError(f"{path}: {name} is more than the {limit:,} bytes it promises")
    return data


def _image(path: str | os.PathLike[str], archive: zipfile.ZipFile, name: str, most: int) -> np.ndarray:
    """(H, W, 4) uint8 of a lossless WebP of at most as many pixels, and some to spare."""
    from PIL import Image

    most += _SPARE_PIXELS
    data = _member(path, archive, name, 4 * most)
    try:
        with Image.open(io.BytesIO(data), formats=["WEBP"]) as image:
            if image.width * image.height > most:
                raise InputError(f"{path}: {name} has {image.width} x {image.height} pixels, more than {most:,}")
            return np.asarray(image.convert("RGBA"))
    except (OSError, SyntaxError, Image.DecompressionBombError) as error:
        raise InputError(f"{path}: {name} is not a WebP image: {error}") from error


def _codebook(path: str | os.PathLike[str], part: dict[str, Any]) -> np.ndarray:
    book = np.array(part["codebook"], np.float32)
    if book.shape != (256,):
        raise InputError(f"{path}: a codebook of shape {book.shape}, expected 256 values")
    return book


def _bands(path: str | os.PathLike[str], meta: dict[str, Any]) -> int:
    bands = int(meta["shN"]["bands"]) if "shN" in meta else 0
    if not 0 <= bands <= 3:
        raise InputError(f"{path}: {bands} bands of SH; gsmap reads 0 to 3")
    return bands


def _palette_sh(path, archive: zipfile.ZipFile, part: dict[str, Any], labels: np.ndarray, k: int) -> np.ndarray:
    """(N, k, 3): 64 palette entries a row of the image, each of k texels."""
    image = _image(path, archive, part["files"][0], _MAX_PALETTE * k)
    if image.shape[1] != _PALETTE_COLUMNS * k:
        raise InputError(f"{path}: an SH palette {image.shape[1]} wide, expected {_PALETTE_COLUMNS * k}")
    palette = image.reshape(-1, k, 4)[:, :, :3]
    label = labels[:, 0] | labels[:, 1].astype(np.uint16) << 8
    if label.max() >= min(int(part["count"]), len(palette)):
        raise InputError(f"{path}: an SH label of {label.max()} beyond the palette's {part['count']} entries")
    return _codebook(path, part)[palette][label]


def _quats(path: str | os.PathLike[str], texels: np.ndarray) -> np.ndarray:
    if (texels[:, 3] < _FIRST_TAG).any():
        row = int((texels[:, 3] < _FIRST_TAG).argmax())
        raise InputError(f"{path}: the quaternion of Gaussian {row} has the unknown tag {texels[row, 3]}")
    three = (texels[:, :3] / np.float32(255) * 2 - 1) * np.float32(2**-0.5)
    return from_smallest_three(texels[:, 3] - _FIRST_TAG, three)
