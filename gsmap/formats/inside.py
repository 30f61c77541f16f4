"""Resolve the names of files in another file; only files within the folder of that file are allowed."""

from __future__ import annotations

from pathlib import Path, PurePosixPath
from urllib.parse import unquote

from gsmap.errors import InputError


def file_inside(path: Path, uri: object, suffix: str = "") -> Path:
    """Return the file that a relative uri in the file at ``path`` names, which must lie within the latter's folder.

    Args:
        suffix: Required suffix with the dot; any if empty.

    Raises:
        InputError: The file is outside the folder, has another suffix, or is missing.
    """
    name = PurePosixPath(unquote(str(uri)))
    folder = path.parent.resolve()
    try:
        file = (folder / name).resolve()
    except (ValueError, OSError, RuntimeError) as error:  # a NUL, half a surrogate, a name too long, links in a circle
        raise InputError(
            f"{path}: content {uri!r} is not a valid file name: {error}", code="content_invalid"
        ) from error
    if name.is_absolute() or ":" in str(name) or "\\" in str(name) or not file.is_relative_to(folder):
        raise InputError(
            f"{path}: content {uri!r} lies outside the folder of the file, so gsmap does not read it",
            code="content_outside_folder",
        )
    if suffix and file.suffix.lower() != suffix:
        raise InputError(
            f"{path}: content {uri!r} is not a {suffix} file; gsmap reads only {suffix} content there",
            code="content_invalid",
        )
    if not file.is_file():
        raise InputError(f"{path}: the file of content {uri!r} is missing", code="content_missing")
    return file
