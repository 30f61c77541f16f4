"""The contract of file formats of Gaussians."""

from __future__ import annotations

import os
from typing import Any, Protocol

from gsmap.types import FileInfo, Gaussians, GaussianSource


class Format(Protocol):
    """A file format, which the suffix of a file selects.

    Its name in the family is the suffix itself, in lower case (``.ply``, ``.compressed.ply``, ``tileset.json``); where
    several fit a path, the longest counts, and a built-in one goes before another package's of the same name::

        [project.entry-points."gsmap.formats"]
        ".xyz" = "my_package.xyz"

    A format has `VERSION` and ``read``, ``write`` or both (`ReadableFormat`, `WritableFormat`); one that is read may
    also say more of a file (`DescribedFormat`), and read it in chunks (`StreamedFormat`). It has no ``Params``: options
    are keyword arguments of ``write``.

    Frames: right-down-front, the axes of a trained ``.ply``, in the file's own unit; a format of other axes turns its
    Gaussians, spherical harmonics included (`gsmap.formats.axes`).

    Attributes:
        VERSION: an int, raised whenever what is read from, or written to, a file changes.

    A format whose files hold more than single precision returns Gaussians about an origin where they need one
    (`gsmap.geometry.origins.centred`); one that writes them has ``HOLDS_ORIGIN = True``. To others, Gaussians are given
    with their origin added, or are refused where single precision, or the steps that ``position_step`` of positions
    (N, 3) returns, do not hold the distances between neighbours.
    """

    VERSION: int


class ReadableFormat(Format, Protocol):
    """A format that can be read."""

    def read(self, path: str | os.PathLike[str], /) -> Gaussians:
        """Read the Gaussians of a file; their values are not checked and may be NaN.

        Raises:
            InputError: the file is not what its suffix says, is damaged, or promises more than its size can hold.
            OSError: as the system gives it.
        """
        ...


class DescribedFormat(ReadableFormat, Protocol):
    """A format with metadata."""

    def info(self, path: str | os.PathLike[str], /) -> FileInfo:
        """Read the metadata from the header alone.

        Raises:
            InputError, OSError: as ``read``.
        """
        ...


class StreamedFormat(ReadableFormat, Protocol):
    """A format that can be read in chunks; if it has a ``write``, this also accepts a `GaussianSource`."""

    def stream(self, path: str | os.PathLike[str], /) -> GaussianSource:
        """Open a file to read it in chunks; errors that concern the whole file are raised now.

        Raises:
            InputError, OSError: as ``read``.
        """
        ...


class WritableFormat(Format, Protocol):
    """A format that can be written."""

    def write(self, path: str | os.PathLike[str], gaussians: Gaussians, /, **options: Any) -> None:
        """Write a file under a temporary name in its final folder; the caller renames the file.

        Raises:
            InputError: Gaussians that the format cannot hold.
            ConfigError: an option that makes no sense.
            OSError: as the system gives it.
        """
        ...
