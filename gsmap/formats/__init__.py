"""Read and write files of Gaussians. Each format is one module, selected by the suffix of the file.

The contract of a format is in `gsmap.methods.format`; another package adds one by an entry point in the group
``gsmap.formats``, named by its suffix. Modules are imported on first use.
"""

from __future__ import annotations

import contextlib
import inspect
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from gsmap.durable import is_stream, write_output, write_whole
from gsmap.errors import ConfigError, InputError, NotFoundError
from gsmap.formats.precision import about_origin, about_zero
from gsmap.methods import family
from gsmap.stream import clamp_column, clamp_infinities
from gsmap.types import Cameras, FileInfo, Gaussians, GaussianSource
from gsmap.types.source import origin_of_source

_Part = TypeVar("_Part")


def suffix_of(path: str | os.PathLike[str]) -> str | None:
    """Return the longest known suffix of a path, so ``.compressed.ply`` before ``.ply``; None without one.

    One without a dot (``tileset.json``) is a whole name: that of a file whose folder is the scene.
    """
    name = Path(path).name.lower()
    found = (s for s in _suffixes(tuple(sys.path)) if name == s or (s.startswith(".") and name.endswith(s)))
    return max(found, key=len, default=None)


def read(path: str | os.PathLike[str]) -> Gaussians:
    """Read the Gaussians of a file of any known format; clamp infinite values that have a meaning (`gsmap.stream`).

    Positions that float32 cannot hold, such as map coordinates, are about an origin (`Gaussians.origin`).

    Raises:
        NotFoundError: The file is missing.
        InputError: Unknown suffix, content that does not match the suffix, or positions that its single precision has
            rounded together; values are checked by `gsmap.ingest`.
    """
    path = Path(path)
    suffix = _suffix(path, "read")
    # NaN and overflow in a damaged file are for `gsmap.ingest` to name, not for numpy to warn of.
    with _explained(path, "read"), np.errstate(all="ignore"):
        return about_origin(path, clamp_infinities(_load(_layout(path, suffix)).read(path))).load()


def stream(path: str | os.PathLike[str]) -> GaussianSource:
    """Open a file of Gaussians of any known format; read it in chunks if the format permits.

    Raises:
        NotFoundError, InputError: As `read`; reading chunks may raise them, too.
    """
    path = Path(path)
    module = _load(_layout(path, _suffix(path, "read")))
    if not hasattr(module, "stream"):
        return read(path)
    with _explained(path, "read"), np.errstate(all="ignore"):
        return about_origin(path, _FileSource(path, module.stream(path)))


@dataclass(frozen=True, eq=False)
class _FileSource:
    """A source of Gaussians in an open file; its errors from the operating system name the file."""

    path: Path
    source: GaussianSource

    @property
    def num_gaussians(self) -> int:
        return self.source.num_gaussians

    @property
    def sh_degree(self) -> int:
        return self.source.sh_degree

    def chunks(self) -> Iterator[Gaussians]:
        for chunk in self._quietly(self.source.chunks()):
            yield clamp_infinities(chunk)

    def columns(self, name: str) -> Iterator[np.ndarray]:
        for column in self._quietly(self.source.columns(name)):
            yield clamp_column(name, column)

    def load(self) -> Gaussians:
        with _explained(self.path, "read"), np.errstate(all="ignore"):
            return clamp_infinities(self.source.load())

    def _quietly(self, parts: Iterator[_Part]) -> Iterator[_Part]:
        while True:
            with _explained(self.path, "read"), np.errstate(all="ignore"):
                part = next(parts, None)
            if part is None:
                return
            yield part


def info(path: str | os.PathLike[str]) -> FileInfo:
    """Return the metadata of a file; an empty `FileInfo` if the format has no metadata."""
    path = Path(path)
    module = _load(_suffix(path, "read"))
    with _explained(path, "read"):
        return module.info(path) if hasattr(module, "info") else FileInfo()


def write(path: str | os.PathLike[str], gaussians: GaussianSource, **options: object) -> None:
    """Write Gaussians in the format of the path's suffix; after an error, no partial file remains.

    Links, pipes and devices: see `gsmap.durable.write_output`; only a format of one file is written to a pipe.

    What is still to be read is written a chunk at a time by formats that can (``.ply``), and is loaded for others.

    Args:
        options: Options of the format; see ``write`` of its module.

    Raises:
        NotFoundError: The folder does not exist; that of a ``tileset.json`` or the like is created.
        InputError: Unknown suffix, a format that is only read, a path that cannot be written, or positions about an
            origin in a format that holds no distances between neighbours there.
    """
    path = Path(path)
    suffix = _suffix(path, "write")
    module = _load(suffix)
    if not suffix.startswith("."):  # a folder by what lies in it, such as ``tileset.json``
        with _explained(path.parent, "write"):
            path.parent.mkdir(parents=True, exist_ok=True)
        if is_stream(path):
            raise InputError(
                f"cannot write {path}: it is a pipe or a device, but {suffix} consists of several files",
                code="not_writable",
            )
    with _explained(path, "write"):
        content = gaussians if hasattr(module, "stream") else gaussians.load()
        if not getattr(module, "HOLDS_ORIGIN", False) and origin_of_source(content).any():
            content = about_zero(path, content.load(), getattr(module, "position_step", None))
        if suffix.startswith("."):
            write_output(path, lambda staged: module.write(staged, content, **options))
        else:  # staged beside its other files
            write_whole(Path(os.path.realpath(path)), lambda staged: module.write(staged, content, **options))


def rewrite(path: str | os.PathLike[str], gaussians: GaussianSource, about: FileInfo) -> tuple[str, ...]:
    """Write Gaussians that were read from a file, with its metadata as far as the format can store them.

    Args:
        about: Metadata of the file that was read (`info`).

    Returns:
        The notes of ``about``, and one on metadata that the format cannot store.

    Raises:
        NotFoundError, InputError: As `write`.
    """
    can_mark = "antialiased" in inspect.signature(_load(_suffix(Path(path), "write")).write).parameters
    write(path, gaussians, **({"antialiased": True} if about.antialiased and can_mark else {}))
    if about.antialiased and not can_mark:
        return (*about.notes, f"{path} does not state that training was antialiased: its format cannot store that")
    return about.notes


def read_cameras(path: str | os.PathLike[str]) -> Cameras:
    """Read a ``cameras.json``, a ``transforms.json`` or a COLMAP folder; see `gsmap.formats.cameras.read`."""
    from gsmap.formats import cameras

    with _explained(Path(path), "read"), np.errstate(all="ignore"):
        return cameras.read(path)


def known(verb: str) -> list[str]:
    """Return the suffixes that can be read (``verb="read"``) or written (``"write"``)."""
    return [suffix for suffix in _suffixes(tuple(sys.path)) if _can(suffix, verb)]


def can_write(suffix: str) -> bool:
    """Return true if files of this suffix can be written; import only this format, where `known` imports all."""
    return _can(suffix, "write")


@lru_cache(maxsize=4)
def _suffixes(places: tuple[str, ...]) -> tuple[str, ...]:
    """Return all suffixes; cache them by ``places`` (`sys.path`), as searching for plug-ins takes milliseconds."""
    return family("format").names()


def _load(suffix: str) -> Any:
    return family("format").get(suffix)


def _can(suffix: str, verb: str) -> bool:
    """Return true if the format of a suffix can read or write (``verb``); false if its plug-in cannot be loaded."""
    try:
        return hasattr(_load(suffix), verb)
    except ConfigError:
        return False


def _suffix(path: Path, verb: str) -> str:
    """Return the suffix of a path; raise an error if no format can read or write that suffix."""
    suffix = suffix_of(path)
    if suffix is None:
        what = f"has the unknown suffix {path.suffix!r}" if path.suffix else "has no suffix"
        raise InputError(f"{path} {what}: gsmap can {verb} {', '.join(known(verb))}", code="unsupported_format")
    if not hasattr(_load(suffix), verb):
        raise InputError(
            f"{path}: gsmap cannot {verb} {suffix} files; it can {verb} {', '.join(known(verb))}",
            code="unsupported_format",
        )
    return suffix


def _layout(path: Path, suffix: str) -> str:
    """Return the suffix that fits the content of the file: some programs name a ``.compressed.ply`` file ``.ply``."""
    if suffix != ".ply":
        return suffix
    from gsmap.formats import ply

    return ".compressed.ply" if ply.is_compressed(ply.read_header(path)) else suffix


@contextlib.contextmanager
def _explained(path: Path, verb: str) -> Iterator[None]:
    """Convert errors of the operating system into typed errors."""
    if verb == "read" and path.exists() and not (path.is_file() or path.is_dir()):
        raise InputError(f"cannot read {path}: it is a pipe or a device, not a file", code="not_a_plain_file")
    try:
        yield
    except FileNotFoundError as error:
        what = "no such file" if verb == "read" else f"no such folder: {path.parent}"
        code = "file_not_found" if verb == "read" else "folder_not_found"
        raise NotFoundError(f"cannot {verb} {path}: {what}", code=code) from error
    except OSError as error:
        code = "file_unreadable" if verb == "read" else "not_writable"
        raise InputError(f"cannot {verb} {path}: {error.strerror or error}", code=code) from error
