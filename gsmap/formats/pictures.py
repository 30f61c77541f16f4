"""Open photographs, masks, depth pictures and textures; all image files that gsmap reads are opened here.

Pillow reads some fifty formats, one of them (PostScript) by starting another program, and decodes pictures of any size
that a few bytes claim. Here a picture has one of five formats, whatever its name, and its header is checked first.
"""

from __future__ import annotations

import contextlib
import io
import os
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from gsmap.errors import GsmapError, InputError, MissingDependencyError, NotFoundError

if TYPE_CHECKING:
    from PIL import Image

FORMATS = ("JPEG", "PNG", "WEBP", "TIFF", "HEIF")
"""Accepted formats, by Pillow's names. HEIF (HEIC) is read only if pillow-heif is installed."""

MAX_PIXELS = 1 << 27
"""Largest number of pixels of a picture; phones make up to 108 million, medium-format cameras 102 million."""

_HEIF_BRANDS = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1")


@contextlib.contextmanager
def open_picture(
    path: str | os.PathLike[str],
    *,
    data: bytes | None = None,
    formats: Sequence[str] = FORMATS,
    max_pixels: int = MAX_PIXELS,
) -> Iterator[Image.Image]:
    """Open a picture after checking its header; the code in the ``with`` block decodes the pixels.

    Any error that Pillow raises in the block becomes an `InputError`, so decode in the block and compute after it.

    Args:
        path: Path of the image.
        data: Bytes of the image, if it is not a file; ``path`` then names it in errors.
        formats: Allowed formats, of `FORMATS`.
        max_pixels: Maximum number of pixels in its header.

    Raises:
        NotFoundError: The file is missing.
        InputError: Another format, too many pixels, or damaged.
        MissingDependencyError: A HEIC image, and pillow-heif is not installed.
    """
    from PIL import Image, UnidentifiedImageError

    if data is None and not Path(path).is_file():
        raise NotFoundError(f"cannot read {os.fspath(path)}: no such file", code="file_not_found")
    name, readable = os.fspath(path), _readable(formats)
    try:
        with contextlib.ExitStack() as stack:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # the bar is ours
                picture = stack.enter_context(Image.open(path if data is None else io.BytesIO(data), formats=readable))
            width, height = picture.size
            if width * height > max_pixels:
                raise InputError(
                    f"{name} has {width} x {height} pixels, more than {max_pixels:,}: downscale the picture",
                    code="picture_too_large",
                )
            yield picture
    except GsmapError:
        raise
    except UnidentifiedImageError as error:
        if "HEIF" in formats and "HEIF" not in readable and _is_heif(path, data):
            raise MissingDependencyError(f"{name} is a HEIC picture, which pillow-heif reads", extra="heic") from error
        raise InputError(
            f"{name} cannot be read as a {_listed(readable)} picture: convert it to one of these formats",
            code="picture_unreadable",
        ) from error
    except Image.DecompressionBombError as error:
        raise InputError(
            f"{name} has more than {max_pixels:,} pixels: downscale the picture", code="picture_too_large"
        ) from error
    except MemoryError as error:
        raise InputError(
            f"{name} needs more memory for decoding than is available: downscale the picture", code="picture_too_large"
        ) from error
    except Exception as error:  # damage makes Pillow's readers raise nearly anything
        raise InputError(
            f"{name} cannot be read as a {_listed(readable)} picture ({error}): save it again",
            code="picture_unreadable",
        ) from error


def _readable(formats: Sequence[str]) -> list[str]:
    """Return those of the formats that this installation can read."""
    if "HEIF" in formats:
        try:
            import pillow_heif
        except ImportError:
            return [one for one in formats if one != "HEIF"]
        pillow_heif.register_heif_opener()
    return list(formats)


def _is_heif(path: str | os.PathLike[str], data: bytes | None) -> bool:
    if data is None:
        with open(path, "rb") as file:
            data = file.read(12)
    return data[4:8] == b"ftyp" and data[8:12] in _HEIF_BRANDS


def _listed(formats: Sequence[str]) -> str:
    return " or ".join({"WEBP": "WebP", "HEIF": "HEIC"}.get(one, one) for one in formats)
