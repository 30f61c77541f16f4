"""Read the positions of photos from EXIF."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsmap.errors import GsmapError, InputError, MissingDependencyError
from gsmap.formats.pictures import open_picture
from gsmap.world.params import Params

_GPS = 0x8825
_LATITUDE, _LONGITUDE, _ALTITUDE, _ERROR, _DATUM = 2, 4, 6, 31, 18
_HEIGHT_FACTOR = 2.0  # satellite heights are less accurate than horizontal positions by this factor
_SEA_LEVEL_SIGMA_M = 40.0  # of the geoid's height above the ellipsoid, an error that a whole map shares
_CORRECTED_SIGMA_M = 0.5  # receivers with corrections report less, including their common error
_RTK = re.compile(rb"drone-dji:Rtk(Flag|StdLat|StdLon|StdHgt)(?:=[\"']|>)\s*([-+0-9.eE]+)")
SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".webp", ".heic", ".heif")


@dataclass(frozen=True)
class PhotoPosition:
    """The position of a photo from EXIF.

    Args:
        image: path of the photo.
        longitude_deg, latitude_deg: position on WGS 84.
        height_m: height above sea level, or None. EXIF 3 has codes for heights above the ellipsoid (0 and 1), which
            meant sea level before and which writers still use for it.
        sigma_m: horizontal positioning error of the receiver, or None.
        height_sigma_m: vertical positioning error of the receiver, or None.
    """

    image: str
    longitude_deg: float
    latitude_deg: float
    height_m: float | None
    sigma_m: float | None
    height_sigma_m: float | None = None

    def sigmas(self, params: Params) -> tuple[tuple[float, float], tuple[float, float], float]:
        """Return three standard deviations: (horizontal, vertical) of this photo alone, (horizontal, vertical) of the
        error that the capture's photos share, and that of the sea level."""
        own = self.sigma_m or params.gnss_sigma_m
        common = max(params.gnss_common_sigma_m, self.sigma_m or 0.0)
        if self.sigma_m is not None and self.sigma_m < _CORRECTED_SIGMA_M:
            common = self.sigma_m
        ratio = _HEIGHT_FACTOR if self.height_sigma_m is None else self.height_sigma_m / own
        return (own, own * ratio), (common, common * ratio), _SEA_LEVEL_SIGMA_M


def read_folder(folder: str | os.PathLike[str]) -> dict[str, PhotoPosition | None]:
    """Read the positions of all photos below a folder, sorted by path; None for photos without a position.

    Raises:
        InputError: the folder does not exist, or no photo in it has a position.
        MissingDependencyError: a HEIC photo, and pillow-heif is not installed.
    """
    folder = Path(os.path.abspath(folder))  # absolute, because the name of a folder may name a scene
    if not folder.is_dir():
        raise InputError(f"there is no folder of photos {folder}", code="folder_not_found")
    photos = sorted(path for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES and path.is_file())
    found = {path.as_posix(): read(path) for path in photos}
    if not any(found.values()):
        raise InputError(f"none of the {len(photos)} photos in {folder} has a position (EXIF GPS)", code="no_gnss")
    return found


def read(path: str | os.PathLike[str]) -> PhotoPosition | None:
    """Read the position of a photo; return None if EXIF has no position or an invalid one.

    Raises:
        MissingDependencyError: a HEIC photo, and pillow-heif is not installed.
    """
    try:
        with open_picture(path) as picture:
            gps = picture.getexif().get_ifd(_GPS)
            rtk = _rtk_sigmas(picture.info.get("xmp") or picture.info.get("XML:com.adobe.xmp") or b"")
    except MissingDependencyError:
        raise
    except GsmapError:
        return None
    datum = str(gps.get(_DATUM, "WGS-84")).strip("\0 ").upper().replace(" ", "").replace("-", "")
    latitude = _degrees(gps.get(_LATITUDE), gps.get(_LATITUDE - 1), "NS")
    longitude = _degrees(gps.get(_LONGITUDE), gps.get(_LONGITUDE - 1), "EW")
    if latitude is None or longitude is None or abs(latitude) > 90 or abs(longitude) > 180:
        return None
    if (latitude == 0 and longitude == 0) or datum not in ("", "WGS84"):
        return None
    height, reference = _number(gps.get(_ALTITUDE)), gps.get(_ALTITUDE - 1, b"\0")
    code = reference[0] if isinstance(reference, bytes) and reference else int(reference or 0)
    if height is not None and code in (1, 3):
        height = -height
    error = _number(gps.get(_ERROR))
    horizontal, vertical = rtk or (error if error and error > 0 else None, None)
    return PhotoPosition(Path(path).as_posix(), longitude, latitude, height, horizontal, vertical)


def _rtk_sigmas(xmp: bytes | str) -> tuple[float, float] | None:
    """Return the horizontal and vertical standard deviations in metres that DJI's XMP states for a position with
    corrections (``drone-dji:RtkFlag`` is not 0); None without them."""
    text = xmp if isinstance(xmp, bytes) else xmp.encode()
    found = {name: _number(value) for name, value in _RTK.findall(text)}
    flag, *values = (found.get(name) for name in (b"Flag", b"StdLat", b"StdLon", b"StdHgt"))
    sigmas = [value for value in values if value is not None and value > 0]
    return (max(sigmas[:2]), sigmas[2]) if flag and len(sigmas) == len(values) else None


def _degrees(value: Any, reference: Any, letters: str) -> float | None:
    """Convert degrees, minutes and seconds with their hemisphere to degrees; return None if they are invalid."""
    try:
        parts = [float(part) for part in value]
        letter = str(reference).strip("\0 ").upper()[:1]
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    if len(parts) != 3 or letter not in letters or letter == "" or any(part != part for part in parts):
        return None
    size = parts[0] + parts[1] / 60 + parts[2] / 3600
    return -size if letter == letters[1] else size


def _number(value: Any) -> float | None:
    try:
        found = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return found if abs(found) < 1e6 else None
