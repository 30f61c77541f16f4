"""Read photos, upright by their EXIF orientation, with their intrinsics and masks."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gsmap.errors import ConfigError, InputError, NotFoundError
from gsmap.formats.pictures import open_picture
from gsmap.geometry.camera_models import EQUIRECTANGULAR, camera_model, pinhole_views, undistort
from gsmap.types.localization import Photo

if TYPE_CHECKING:
    from numpy.typing import ArrayLike
    from PIL.Image import Image

_MIN_INTRINSIC_PX, _MAX_INTRINSIC_PX = 0.01, 1_000_000

_PANORAMA = re.compile(rb"ProjectionType\W{1,4}equirectangular", re.IGNORECASE)  # of GPano
_EXIF_IFD, _FOCAL_35MM = 0x8769, 0xA405
_FILM_DIAGONAL_MM = 43.267  # of a frame of 36 x 24 mm, to which equivalent focal lengths refer
_EXIF_SIGMA = 0.05  # relative: focal lengths are rounded to millimetres, and phones do not record crops
_DEFAULT_FOCAL, _UNKNOWN = 0.8, float("inf")  # per longer side: a view of 64 degrees, between phones and kit lenses


@dataclass(frozen=True)
class Lens:
    """Specified intrinsics of a photo.

    Args:
        intrinsics_px: ``fx fy cx cy``, in pixels of the upright photo; None if unknown.
        focal_px: focal length in pixels, with the principal point in the middle; None if unknown.
        model: name of a COLMAP camera model and its parameters, in pixels of the upright photo; None for a pinhole.
        use_exif: use the focal length in EXIF, if none is specified.
    """

    intrinsics_px: tuple[float, float, float, float] | None = None
    focal_px: float | None = None
    use_exif: bool = True
    model: tuple[str, tuple[float, ...]] | None = None

    def __post_init__(self) -> None:
        given = (*(self.intrinsics_px or ()), *((self.focal_px,) if self.focal_px is not None else ()))
        if not all(_MIN_INTRINSIC_PX <= value <= _MAX_INTRINSIC_PX for value in given):
            raise ConfigError(
                "intrinsics are fx,fy,cx,cy and a focal length is a number, all in pixels and between "
                f"{_MIN_INTRINSIC_PX} and {_MAX_INTRINSIC_PX:,}",
                code="invalid_intrinsics",
            )


def checked_model(name: str, params: tuple[float, ...]) -> str:
    """Return the name of a camera model, after a check of its parameters.

    Raises:
        ValueError, RuntimeError: an unknown model, or a wrong number of parameters.
    """
    if params or name != EQUIRECTANGULAR:
        camera_model(name, 1, 1, params)
    return name


def read_photo(
    path: str | os.PathLike[str], lens: Lens | None = None, masks: str | os.PathLike[str] | None = None
) -> Photo:
    """Read a photo, upright by its EXIF orientation.

    Args:
        masks: folder of the photo's mask (`read_mask`).

    Raises:
        NotFoundError: the file or its mask does not exist.
        InputError, MissingDependencyError: the photo or its mask cannot be read (`open_picture`).
    """
    path, lens = Path(path), lens or Lens()
    if not path.is_file():
        raise NotFoundError(f"there is no photo {path}", code="file_not_found")

    with open_picture(path) as picture:
        rgb, focal_35mm, is_panorama = _upright(picture, in_place=True)
    known = None if masks is None else read_mask(path, masks, (rgb.shape[1], rgb.shape[0]))
    return make_photo(rgb, focal_35mm, _panoramic(lens) if is_panorama else lens, path.name, known)


def photo_in_memory(picture: Image | ArrayLike, lens: Lens | None = None, name: str = "photo") -> Photo:
    """Return a photo of an image in memory.

    Args:
        picture: a PIL image, turned upright by its EXIF orientation; or pixels (H, W), (H, W, 3) or (H, W, 4), in uint8
            or as floats in [0, 1], RGB; alpha is ignored.
        name: for messages.

    Raises:
        InputError: pixels of another shape or type, or floats out of range.
    """
    from PIL.Image import Image

    lens = lens or Lens()
    if isinstance(picture, Image):
        rgb, focal_35mm, is_panorama = _upright(picture, in_place=False)
        return make_photo(rgb, focal_35mm, _panoramic(lens) if is_panorama else lens, name)
    pixels = np.asarray(picture)
    if pixels.ndim == 2:
        pixels = np.repeat(pixels[..., None], 3, axis=2)
    if pixels.ndim != 3 or pixels.shape[2] not in (3, 4) or 0 in pixels.shape:
        raise InputError(
            f"{name}: an image is an array (height, width, 3), got {np.shape(picture)}", code="shape_mismatch"
        )
    pixels = pixels[..., :3]
    if np.issubdtype(pixels.dtype, np.floating):
        if not (pixels.min() >= 0 and pixels.max() <= 1):  # NaN, too
            raise InputError(f"{name}: floats of an image lie in [0, 1]; or pass uint8", code="out_of_range")
        pixels = (pixels * 255 + 0.5).astype(np.uint8)
    if pixels.dtype != np.uint8:
        raise InputError(
            f"{name}: an image has uint8 values, or floats in [0, 1], got {pixels.dtype}", code="wrong_type"
        )
    return make_photo(np.ascontiguousarray(pixels), None, lens, name)


def _panoramic(lens: Lens) -> Lens:
    """Return the lens of a photo whose metadata say that it is a panorama, unless another one was specified."""
    is_given = lens.model or lens.intrinsics_px or lens.focal_px
    return lens if is_given else replace(lens, model=(EQUIRECTANGULAR, ()))


def _upright(picture: Image, *, in_place: bool) -> tuple[np.ndarray, object, bool]:
    """Return the pixels (H, W, 3) of a picture, turned by its EXIF orientation, the focal length that EXIF states, and
    whether its XMP says that it is an equirectangular panorama.

    Args:
        in_place: turn the picture itself, which takes less memory.
    """
    from PIL import ImageOps

    focal_35mm = picture.getexif().get_ifd(_EXIF_IFD).get(_FOCAL_35MM)
    xmp = picture.info.get("xmp") or picture.info.get("XML:com.adobe.xmp") or b""
    is_panorama = _PANORAMA.search(xmp if isinstance(xmp, bytes) else str(xmp).encode()) is not None
    if in_place:
        ImageOps.exif_transpose(picture, in_place=True)
    else:
        picture = ImageOps.exif_transpose(picture)
    return np.asarray(picture if picture.mode == "RGB" else picture.convert("RGB")), focal_35mm, is_panorama


def read_mask(path: str | os.PathLike[str], masks: str | os.PathLike[str], size_px: tuple[int, int]) -> np.ndarray:
    """Read a photo's mask (H, W) from a folder of masks; True at valid pixels.

    As in COLMAP, the mask of ``photo.jpg`` is ``photo.jpg.png``, of the size of the upright photo, and black at invalid
    pixels. ``photo.png`` is accepted as well.

    Raises:
        NotFoundError: the folder or the mask does not exist.
        InputError: the mask cannot be read, has another size, or is black everywhere.
    """
    folder, name = Path(masks), Path(path)
    if not folder.is_dir():
        raise NotFoundError(f"there is no folder of masks {folder}", code="folder_not_found")
    offered = [folder / f"{name.name}.png", folder / f"{name.stem}.png"]
    found = next((one for one in offered if one.is_file()), None)
    if found is None:
        raise NotFoundError(
            f"{name.name} has no mask in {folder}: add {offered[0].name}, all white if every pixel is valid",
            code="mask_missing",
        )
    with open_picture(found) as picture:
        known = np.asarray(picture.convert("L")) > 0
    if known.shape[::-1] != size_px:
        raise InputError(
            f"{found} has {known.shape[1]} x {known.shape[0]} pixels, but its photo has {size_px[0]} x {size_px[1]}: "
            "a mask has the size of the upright photo",
            code="size_mismatch",
        )
    if not known.any():
        raise InputError(f"{found} is black everywhere, so its photo has no valid pixel", code="black_mask")
    return known


def make_photo(
    rgb: np.ndarray, focal_35mm: object, lens: Lens, name: str = "photo", known: np.ndarray | None = None
) -> Photo:
    """Return a photo of pixels (H, W, 3), uint8, with intrinsics as specified, from EXIF, or by default.

    Args:
        focal_35mm: equivalent focal length in millimetres from EXIF; invalid values are ignored.
        known: (H, W) mask of valid pixels; None for all.
    """
    height, width = rgb.shape[:2]
    if lens.model is not None:
        return _undistorted(rgb, *lens.model, name, known)
    focal, sigma = _DEFAULT_FOCAL * max(width, height), _UNKNOWN
    if lens.intrinsics_px is not None:
        cx, cy = lens.intrinsics_px[2:]
        if not (cx < width and cy < height):
            raise InputError(
                f"{name} has {width} x {height} pixels: its principal point cannot lie at {cx:g}, {cy:g}",
                code="invalid_intrinsics",
            )
        return Photo(rgb, np.array(lens.intrinsics_px), 0.0, name, known)
    if lens.focal_px is not None:
        focal, sigma = lens.focal_px, 0.0
    elif lens.use_exif and (equivalent := _number(focal_35mm)) is not None:
        focal, sigma = equivalent / _FILM_DIAGONAL_MM * float(np.hypot(width, height)), _EXIF_SIGMA
    return Photo(rgb, np.array([focal, focal, width / 2, height / 2]), sigma, name, known)


def _undistorted(
    rgb: np.ndarray, model_name: str, params: tuple[float, ...], name: str, known: np.ndarray | None
) -> Photo:
    """Return a photo without distortion, or with the faces of a panorama; pixels that it does not have are unknown.

    Raises:
        InputError: an equirectangular photo that is not twice as wide as high.
    """
    height, width = rgb.shape[:2]
    if model_name == EQUIRECTANGULAR and width != 2 * height:
        raise InputError(
            f"{name} has {width} x {height} pixels, but a full equirectangular panorama is twice as wide as high",
            code="size_mismatch",
        )
    model = camera_model(model_name, width, height, params or (width, height))
    views, photos = pinhole_views(model, np.eye(4), name), []
    if not views.lenses:
        return Photo(rgb, views.intrinsics_px[0], 0.0, name, known)
    for row in range(len(views)):
        shown, has = undistort(rgb, views[row])
        if known is not None:
            has &= undistort(np.repeat(known[..., None], 3, axis=2).astype(np.float32), views[row])[0][..., 0] > 0.5
        photos.append(
            Photo(shown, views.intrinsics_px[row], 0.0, views.names[row], None if has.all() else has, model_name)
        )
    if views.names == (name,):
        return photos[0]
    faces = tuple((photo, lens.R_photo_camera) for photo, lens in zip(photos, views.lenses, strict=True) if lens)
    return Photo(rgb, views.intrinsics_px[0], 0.0, name, known, model_name, faces)


def _number(value: object) -> float | None:
    """Parse a plausible focal length in millimetres; return None if it is implausible."""
    try:
        found = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return found if 5 <= found <= 2000 else None
