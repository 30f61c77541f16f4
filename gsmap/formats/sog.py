"""Read and write PlayCanvas' SOG version 2 (``meta.json``, and lossless WebP images with one texel per Gaussian).

Positions are 16 bits of a signed logarithm, scales and colours go through a codebook of 256, quaternions are
smallest-three of 8 bits, SH comes from a palette. A bundled ``.sog`` is a ZIP of the same files.

https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog/
"""

from __future__ import annotations

import hashlib
import io
import json
import lzma
import math
import os
import uuid
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from gsmap.errors import MALFORMED, ConfigError, InputError
from gsmap.formats.inside import file_inside
from gsmap.formats.palettes import codebook, palette
from gsmap.formats.pictures import open_picture
from gsmap.formats.quantise import (
    check_size,
    from_smallest_three,
    logits_of_bytes,
    opacity_bytes,
    require_writable,
    smallest_three,
)
from gsmap.geometry.morton import morton_order
from gsmap.types import FileInfo, Gaussians

VERSION = 1

_MAX_META_BYTES = 4 << 20
_MAX_PIXELS = 1 << 26  # 64 million Gaussians, 256 MiB an image
_SPARE_PIXELS = 1 << 16  # of an image beyond those that are used: writers round its sides up
_LEAST_BYTES = 56  # of a Gaussian in memory, SH degree 0
_SH_COEFFICIENTS = (0, 3, 8, 15)
_PALETTE_COLUMNS = 64
_MAX_PALETTE = 1 << 16  # labels have 16 bits
_FIRST_TAG = 252  # quaternion tags 252 to 255: which component is largest


_MAX_SIDE = 16383  # pixels, of WebP
_MAX_LOG_SCALE = 80.0
_SQRT2 = np.float32(2**0.5)
_LEAST_PALETTE = 1 << 10
_PER_ENTRY = 2  # Gaussians for one entry of the palette, at least: it would cost more than it tells
Files = Callable[[str, int], bytes]  # one of the files by its name, refused beyond a size


def read(path: str | os.PathLike[str]) -> Gaussians:
    """Read SOG version 2, from a ``.sog`` or from the ``meta.json`` of a folder.

    Raises:
        InputError: not a ZIP, another version, files missing or outside the folder, images too small or far too large
            for the count.
    """
    return _opened(path, _decode)


def info(path: str | os.PathLike[str]) -> FileInfo:
    """Return the metadata of ``meta.json``: antialiased training.

    Raises:
        InputError: as `read`.
    """
    return _opened(path, lambda path, files, size: FileInfo(antialiased=_antialiased(_meta(path, files))))


def write(
    path: str | os.PathLike[str],
    gaussians: Gaussians,
    *,
    palette_size: int = _MAX_PALETTE,
    turns: int = 5,
    ordered: bool = False,
    antialiased: bool = False,
) -> None:
    """Write SOG version 2, as a ``.sog`` or (if ``path`` is a ``meta.json``) as a folder; name images by digests.

    Args:
        palette_size: Maximum number of entries of the SH palette; at most half the number of Gaussians.
        turns: Number of k-means iterations for the palette.
        ordered: Keep the order of the Gaussians, which costs bytes; default: Morton order.
        antialiased: Mark the file as trained with the 2D Mip filter.

    Raises:
        InputError: No Gaussians, values that are not finite, or more Gaussians than an image can hold.
        ConfigError: The palette size is out of range.
    """
    path = Path(path)
    if not 1 <= palette_size <= _MAX_PALETTE:
        raise ConfigError(f"palette_size must be 1 to {_MAX_PALETTE}, got {palette_size}", code="out_of_range")
    if turns < 1:
        raise ConfigError(f"turns must be at least 1, got {turns}", code="out_of_range")
    require_writable(path, gaussians)
    if gaussians.sh_degree > 3:
        raise InputError(
            f"{path}: SOG can store SH of degree 3 at most, but the Gaussians have degree {gaussians.sh_degree}",
            code="unsupported_output",
        )
    if len(gaussians) > _MAX_PIXELS:
        raise InputError(
            f"{path}: a SOG file stores at most {_MAX_PIXELS:,} Gaussians, not {len(gaussians):,}: name the output "
            "lod-meta.json, which consists of several files",
            code="unsupported_output",
        )
    g = gaussians if ordered else gaussians[morton_order(gaussians.means)]
    meta, images = _encode(g, palette_size, turns)
    if antialiased:
        meta |= {"antialias": True, "model": "antialiased"}
    if path.suffix.lower() == ".sog":
        with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
            for name, data in [("meta.json", json.dumps(meta).encode()), *images.items()]:
                archive.writestr(
                    zipfile.ZipInfo(name), data
                )  # of no date, so that the same Gaussians make the same file
        return
    for part in meta.values():
        if isinstance(part, dict) and "files" in part:
            part["files"] = [_placed(path.parent, name, images[name]) for name in part["files"]]
    path.write_text(json.dumps(meta))


def unbundled(path: str | os.PathLike[str], folder: Path) -> None:
    """Copy the files of a ``.sog`` that gsmap wrote into a folder unchanged, ``meta.json`` last."""

    def copy(path: str | os.PathLike[str], files: Files, size: int) -> None:
        meta = _meta(path, files)
        parts = [part["files"] for part in meta.values() if isinstance(part, dict) and "files" in part]
        for name in [name for names in parts for name in names]:
            if name != Path(name).name:
                raise InputError(f"{path}: {name!r} is not a valid file name", code="content_invalid")
            (folder / name).write_bytes(files(name, size))
        (folder / "meta.json").write_bytes(files("meta.json", _MAX_META_BYTES))

    _opened(path, copy)


def _opened(path: str | os.PathLike[str], work: Callable[[str | os.PathLike[str], Files, int], Any]) -> Any:
    """Call ``work`` with the files of a SOG and their size in bytes; convert its errors to typed errors."""
    path = Path(path)
    try:
        if path.suffix.lower() == ".json":
            return work(path, *_folder(path))
        with zipfile.ZipFile(path) as archive:
            return work(path, lambda name, limit: _member(path, archive, name, limit), os.path.getsize(path))
    except (zipfile.BadZipFile, zipfile.LargeZipFile, zlib.error, lzma.LZMAError, RuntimeError, EOFError) as error:
        raise InputError(f"{path} is not a readable .sog (a ZIP file): {error}", code="wrong_file_type") from error
    except MALFORMED as error:
        if isinstance(error, InputError):
            raise
        raise InputError(
            f"{path}: its meta.json does not describe it: {type(error).__name__} {error}", code="not_json"
        ) from error


def _folder(path: Path) -> tuple[Files, int]:
    """Return a reader of the files beside a ``meta.json``, and the total size of its images in bytes."""

    def file(name: str, limit: int) -> bytes:
        place = path if name == "meta.json" else file_inside(path, name)
        if place.stat().st_size > limit:
            raise InputError(
                f"{path}: {name} is {place.stat().st_size:,} bytes, more than the {limit:,} gsmap reads",
                code="file_too_large",
            )
        return place.read_bytes()

    return file, sum(one.stat().st_size for one in path.parent.glob("*.webp") if one.is_file())


def _encode(g: Gaussians, palette_size: int, turns: int) -> tuple[dict[str, Any], dict[str, bytes]]:
    """Return the ``meta.json`` and the images for Gaussians, which must have the order of storage."""
    n, k = g.sh.shape[:2]
    width = min(_MAX_SIDE // 4 * 4, 4 * math.ceil(math.sqrt(n) / 4))
    images: dict[str, bytes] = {}

    def put(name: str, texels: np.ndarray, width: int = width) -> str:
        """Store texels (N, 1 to 4) uint8 as an image, opaque if there is no fourth channel."""
        rows = -(-len(texels) // width)
        out = np.zeros((rows * width, 4), np.uint8)
        out[:, 3] = 255
        out[: len(texels), : texels.shape[1]] = texels
        images[f"{name}.webp"] = _webp(out.reshape(rows, width, 4))
        return f"{name}.webp"

    logarithm = np.sign(g.means) * np.log1p(np.abs(g.means.astype(np.float64)))
    low, high = logarithm.min(0), logarithm.max(0)
    level = np.round((logarithm - low) / np.where(high > low, high - low, 1) * 65535).astype(np.uint16)
    largest, three = smallest_three(g.quats)
    quats = np.concatenate([np.round((three * _SQRT2 + 1) / 2 * 255), largest[:, None] + _FIRST_TAG], axis=1)
    scale_book, scales = codebook(np.clip(g.log_scales, -_MAX_LOG_SCALE, _MAX_LOG_SCALE))
    colour_book, colours = codebook(g.sh[:, 0])
    meta: dict[str, Any] = {
        "version": 2,
        "asset": {"generator": "gsmap"},
        "count": n,
        "means": {
            "mins": low.tolist(),
            "maxs": high.tolist(),
            "files": [put("means_l", (level & 255).astype(np.uint8)), put("means_u", (level >> 8).astype(np.uint8))],
        },
        "scales": {"codebook": scale_book.tolist(), "files": [put("scales", scales)]},
        "quats": {"files": [put("quats", quats.astype(np.uint8))]},
        "sh0": {
            "codebook": colour_book.tolist(),
            "files": [put("sh0", np.concatenate([colours, opacity_bytes(g.logit_opacities)[:, None]], axis=1))],
        },
    }
    if k > 1:
        entries, labels = palette(
            g.sh[:, 1:].reshape(n, -1),
            min(palette_size, max(_LEAST_PALETTE, n // _PER_ENTRY)),
            turns,
            _palette_weights(g),
        )
        book, places = codebook(entries)
        places = places.reshape(-1, 3)
        bytes_of = np.stack([labels & 255, labels >> 8, np.zeros_like(labels)], axis=1).astype(np.uint8)
        names = [put("shN_centroids", places, _PALETTE_COLUMNS * (k - 1)), put("shN_labels", bytes_of)]
        bands = _SH_COEFFICIENTS.index(k - 1)
        meta["shN"] = {"count": len(entries), "bands": bands, "codebook": book.tolist(), "files": names}
    return meta, images


def _palette_weights(g: Gaussians) -> np.ndarray:
    """Return the weights (N,) of the Gaussians for the palette: opacity times projected area, with an upper limit."""
    scales = np.sort(np.clip(g.log_scales, -_MAX_LOG_SCALE, _MAX_LOG_SCALE), axis=1)[:, 1:]
    area = np.exp((scales - np.median(scales, axis=0)).clip(-5, 5).sum(1))
    weights = area / (1 + np.exp(-g.logit_opacities.clip(-20, 20)))
    return np.clip(weights / np.median(weights), 0.25, 4).astype(np.float32)


def _webp(texels: np.ndarray) -> bytes:
    from PIL import Image

    out = io.BytesIO()
    Image.fromarray(texels, "RGBA").save(out, "WEBP", lossless=True, exact=True, method=4, quality=75)
    return out.getvalue()


def _placed(folder: Path, name: str, data: bytes) -> str:
    """Write an image under a name with its digest, so that an older ``meta.json`` keeps its images; return the name."""
    stem, suffix = name.split(".")
    name = f"{stem}-{hashlib.sha256(data).hexdigest()[:12]}.{suffix}"
    staged = folder / f".{uuid.uuid4().hex[:8]}.{name}"
    try:
        staged.write_bytes(data)
        os.replace(staged, folder / name)
    finally:
        staged.unlink(missing_ok=True)
    return name


def _antialiased(meta: dict[str, Any]) -> bool:
    return meta.get("antialias") is True or meta.get("model") == "antialiased"


def _decode(path: str | os.PathLike[str], files: Files, size: int) -> Gaussians:
    meta = _meta(path, files)
    n = int(meta["count"])
    if not 0 < n <= _MAX_PIXELS:
        raise InputError(f"{path} promises {n} Gaussians; gsmap reads 1 to {_MAX_PIXELS}", code="count_mismatch")
    check_size(path, n * _LEAST_BYTES, size)

    def texels(part: str, file: int = 0) -> np.ndarray:
        image = _image(path, files, meta[part]["files"][file], 2 * n).reshape(-1, 4)
        if len(image) < n:
            raise InputError(
                f"{path}: the image of {part} holds {len(image)} texels for {n} Gaussians", code="count_mismatch"
            )
        return image[:n]

    low, high = (np.array(meta["means"][end], np.float64).reshape(3) for end in ("mins", "maxs"))
    level = texels("means", 0)[:, :3] | texels("means", 1)[:, :3].astype(np.uint16) << 8
    logarithm = low + (high - low) * (level / 65535)
    quats = texels("quats")
    colours = texels("sh0")
    sh = np.zeros((n, 1 + _SH_COEFFICIENTS[_bands(path, meta)], 3), np.float32)
    sh[:, 0] = _codebook(path, meta["sh0"])[colours[:, :3]]
    if sh.shape[1] > 1:
        sh[:, 1:] = _palette_sh(path, files, meta["shN"], texels("shN", 1), sh.shape[1] - 1)
    return Gaussians(
        np.sign(logarithm) * np.expm1(np.abs(logarithm)),
        _quats(path, quats),
        _codebook(path, meta["scales"])[texels("scales")[:, :3]],
        logits_of_bytes(colours[:, 3]),
        sh,
    )


def _meta(path: str | os.PathLike[str], files: Files) -> dict[str, Any]:
    try:
        meta = json.loads(files("meta.json", _MAX_META_BYTES))
    except (UnicodeDecodeError, json.JSONDecodeError, RecursionError) as error:
        raise InputError(f"{path}: its meta.json cannot be read: {error}", code="not_json") from error
    version = meta.get("version", 1)
    if version != 2:
        raise InputError(
            f"{path}: SOG version {version}; gsmap reads version 2, so export it anew", code="unsupported_version"
        )
    return meta


def _member(path: str | os.PathLike[str], archive: zipfile.ZipFile, name: str, limit: int) -> bytes:
    """Read one file of the archive to memory; its name is never used as a path on disk."""
    try:
        entry = archive.getinfo(name)
    except KeyError as error:
        raise InputError(f"{path} lacks {name!r}; it may be truncated", code="content_missing") from error
    if entry.file_size > limit:
        raise InputError(
            f"{path}: {name} is {entry.file_size:,} bytes, more than the {limit:,} gsmap reads", code="file_too_large"
        )
    with archive.open(entry) as file:
        data = file.read(limit + 1)
    if len(data) > limit:
        raise InputError(f"{path}: {name} is more than the {limit:,} bytes it promises", code="file_too_large")
    return data


def _image(path: str | os.PathLike[str], files: Files, name: str, most: int) -> np.ndarray:
    """Read a lossless WebP as (H, W, 4) uint8; reject an image with clearly more than ``most`` pixels."""
    most += _SPARE_PIXELS
    data = files(name, 4 * most)
    with open_picture(f"{path}: {name}", data=data, formats=["WEBP"], max_pixels=most) as image:
        return np.asarray(image.convert("RGBA"))


def _codebook(path: str | os.PathLike[str], part: dict[str, Any]) -> np.ndarray:
    book = np.array(part["codebook"], np.float32)
    if book.shape != (256,):
        raise InputError(f"{path}: a codebook of shape {book.shape}, expected 256 values", code="invalid_codebook")
    return book


def _bands(path: str | os.PathLike[str], meta: dict[str, Any]) -> int:
    bands = int(meta["shN"]["bands"]) if "shN" in meta else 0
    if not 0 <= bands <= 3:
        raise InputError(f"{path}: {bands} bands of SH; gsmap reads 0 to 3", code="unsupported_sh_degree")
    return bands


def _palette_sh(
    path: str | os.PathLike[str], files: Files, part: dict[str, Any], labels: np.ndarray, k: int
) -> np.ndarray:
    """Read the SH coefficients (N, k, 3) of each label; a row of the palette's image has 64 entries of k texels."""
    image = _image(path, files, part["files"][0], _MAX_PALETTE * k)
    if image.shape[1] != _PALETTE_COLUMNS * k:
        raise InputError(
            f"{path}: its SH palette is {image.shape[1]} texels wide, expected {_PALETTE_COLUMNS * k}",
            code="invalid_palette",
        )
    entries = image.reshape(-1, k, 4)[:, :, :3]
    label = labels[:, 0] | labels[:, 1].astype(np.uint16) << 8
    if label.max() >= min(int(part["count"]), len(entries)):
        raise InputError(
            f"{path}: the SH label {label.max()} is beyond the palette's {part['count']} entries",
            code="invalid_palette",
        )
    return _codebook(path, part)[entries][label]


def _quats(path: str | os.PathLike[str], texels: np.ndarray) -> np.ndarray:
    if (texels[:, 3] < _FIRST_TAG).any():
        row = int((texels[:, 3] < _FIRST_TAG).argmax())
        raise InputError(
            f"{path}: the quaternion of Gaussian {row} has the unknown tag {texels[row, 3]}", code="not_a_rotation"
        )
    three = (texels[:, :3] / np.float32(255) * 2 - 1) * np.float32(2**-0.5)
    return from_smallest_three(texels[:, 3] - _FIRST_TAG, three)
