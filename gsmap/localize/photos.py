"""Photographs in files: their pixels the right way up, and what they say of their lens."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from gsmap.errors import ConfigError, InputError, NotFoundError
from gsmap.formats.pictures import open_picture
from gsmap.types.localization import Photo

_EXIF_IFD, _FOCAL_35MM = 0x8769, 0xA405
_FILM_DIAGONAL_MM = 43.267  # of a frame of 36 x 24 mm, which equivalent focal lengths mean
_EXIF_SIGMA = 0.05  # whole millimetres, and a crop that phones do not tell of
_LIKELY, _ANY = 0.8, float("inf")  # of the longer side: 64 degrees across, between phones and kit lenses


@dataclass(frozen=True)
class Lens:
    """What a person says of the lens that took a photograph.

    Args:
        intrinsics_px: ``fx fy cx cy``, in pixels of the upright picture; None where only less is known.
        focal_px: the focal length in pixels, with the principal point in the middle; None where it is not known.
        ask_file: believe what the file says (EXIF), where nothing else is said.
    """

    intrinsics_px: tuple[float, float, float, float] | None = None
    focal_px: float | None = None
    ask_file: bool = True

    def __post_init__(self) -> None:
        given = (*(self.intrinsics_px or ()), *((self.focal_px,) if self.focal_px is not None else ()))
        if not np.isfinite(given).all() or any(value <= 0 for value in given):
            raise ConfigError(
                "intrinsics are fx,fy,cx,cy in pixels, and a focal length is in pixels: all above 0",
                code="invalid_intrinsics",
            )


def read_photo(
    path: str | os.PathLike[str], lens: Lens | None = None, masks: str | os.PathLike[str] | None = None
) -> Photo:
    """Read a picture, turned the way its EXIF says it was held.

    Args:
        masks: the folder that its mask is in (`read_mask`).

    Raises:
        NotFoundError: no such file, or no mask of it.
        InputError, MissingDependencyError: not a picture that gsmap reads (`open_picture`); or its mask is none.
    """
    from PIL import ImageOps

    path, lens = Path(path), lens or Lens()
    if not path.is_file():
        raise NotFoundError(f"no photo at {path}", code="file_not_found")

    with open_picture(path) as picture:
        focal_35mm = picture.getexif().get_ifd(_EXIF_IFD).get(_FOCAL_35MM)
        ImageOps.exif_transpose(picture, in_place=True)
        rgb = np.asarray(picture if picture.mode == "RGB" else picture.convert("RGB"))
    photo = taken_with(rgb, lens, focal_35mm, path.name)
    return photo if masks is None else replace(photo, known=read_mask(path, masks, photo.size_px))


def read_mask(path: str | os.PathLike[str], masks: str | os.PathLike[str], size_px: tuple[int, int]) -> np.ndarray:
    """(H, W) bool of a photo: what its mask in a folder of masks leaves.

    As COLMAP has them: of ``photo.jpg`` the mask is ``photo.jpg.png``, of the photo's size once that is upright, and
    black where the photo does not count. ``photo.png`` is taken as well.

    Raises:
        NotFoundError: no such folder or mask; a photo whose mask is missing is not taken as a whole.
        InputError: not a picture, of another size, or black everywhere.
    """
    folder, name = Path(masks), Path(path)
    if not folder.is_dir():
        raise NotFoundError(f"no folder of masks at {folder}", code="folder_not_found")
    offered = [folder / f"{name.name}.png", folder / f"{name.stem}.png"]
    found = next((one for one in offered if one.is_file()), None)
    if found is None:
        raise NotFoundError(
            f"{name.name} has no mask in {folder}: call it {offered[0].name}, white where all counts",
            code="mask_missing",
        )
    with open_picture(found) as picture:
        known = np.asarray(picture.convert("L")) > 0
    if known.shape[::-1] != size_px:
        raise InputError(
            f"{found} has {known.shape[1]} x {known.shape[0]} pixels, its photo {size_px[0]} x {size_px[1]}: "
            "masks are of the upright photo's size",
            code="size_mismatch",
        )
    if not known.any():
        raise InputError(f"{found} is black everywhere: it leaves nothing of its photo", code="black_mask")
    return known


def taken_with(rgb: np.ndarray, lens: Lens, focal_35mm: object = None, name: str = "photo") -> Photo:
    """A photo of pixels (H, W, 3) uint8 and what is known of its lens.

    Args:
        focal_35mm: equivalent focal length in millimetres, as its file says; whatever is no such number is ignored.
    """
    height, width = rgb.shape[:2]
    focal, sigma = _LIKELY * max(width, height), _ANY
    if lens.intrinsics_px is not None:
        cx, cy = lens.intrinsics_px[2:]
        if not (cx < width and cy < height):
            raise InputError(
                f"{name} has {width} x {height} pixels: its principal point cannot lie at {cx:g}, {cy:g}",
                code="invalid_intrinsics",
            )
        return Photo(rgb, np.array(lens.intrinsics_px), 0.0, name)
    if lens.focal_px is not None:
        focal, sigma = lens.focal_px, 0.0
    elif lens.ask_file and (equivalent := _number(focal_35mm)) is not None:
        focal, sigma = equivalent / _FILM_DIAGONAL_MM * float(np.hypot(width, height)), _EXIF_SIGMA
    return Photo(rgb, np.array([focal, focal, width / 2, height / 2]), sigma, name)


def _number(value: object) -> float | None:
    """A plausible focal length of a lens in millimetres, or None."""
    try:
        found = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return found if 5 <= found <= 2000 else None
