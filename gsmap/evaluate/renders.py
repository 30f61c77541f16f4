"""Compare renders of Gaussians with reference images: photographs, or renders of the capture itself."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from gsmap.errors import InputError, NotFoundError
from gsmap.evaluate.images import psnr, ssim
from gsmap.formats.pictures import open_picture
from gsmap.geometry.camera_models import undistort
from gsmap.types import Cameras, Gaussians

_SUFFIXES = {".jpg", ".jpeg", ".png", ".webp", ".bmp", ".tif", ".tiff"}


@dataclass(frozen=True, eq=False)
class ImageScores:
    """Scores of each image, in the order of ``names``."""

    names: tuple[str, ...]
    psnr_db: np.ndarray
    ssim: np.ndarray
    lpips: np.ndarray = field(default_factory=lambda: np.zeros(0))

    def means(self) -> dict[str, float]:
        """Return the means ``{"psnr_db", "ssim", "lpips", "num_images"}``; ``lpips`` is present only if it was
        measured."""
        out: dict[str, float] = {"num_images": len(self.names)}
        if self.names:
            out |= {"psnr_db": float(self.psnr_db.mean()), "ssim": float(self.ssim.mean())}
        if len(self.lpips):
            out["lpips"] = float(self.lpips.mean())
        return out


def find_images(cameras: Cameras, folder: str | os.PathLike[str]) -> dict[int, Path]:
    """Find the images of cameras by name in a folder and its subfolders; return paths by camera index. Suffixes may
    differ. The faces of a panorama have the same image.

    Raises:
        NotFoundError: the folder does not exist, or no image in it has the name of a camera.
        InputError: two images match one camera.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise NotFoundError(f"there is no folder of images {folder}", code="folder_not_found")
    index = {_stem(name): rows for name, rows in cameras.photo_rows.items()}
    found: dict[int, Path] = {}
    for path in sorted(p for p in folder.rglob("*") if p.suffix.lower() in _SUFFIXES and p.is_file()):
        rows = index.get(_stem(path.relative_to(folder)), index.get(path.stem, []))
        if rows and rows[0] in found:
            raise InputError(
                f"camera {cameras.names[rows[0]]} has two images: {found[rows[0]]} and {path}", code="ambiguous_image"
            )
        found |= dict.fromkeys(rows, path)
    if not found:
        raise NotFoundError(
            f"no image in {folder} has the name of a camera (such as {', '.join(cameras.names[:3])})",
            code="image_not_found",
        )
    return found


def read_image(path: str | os.PathLike[str]) -> np.ndarray:
    """Read an image as (H, W, 3) float32 in [0, 1]."""
    with open_picture(path) as image:
        return np.asarray(image.convert("RGB"), dtype=np.float32) / 255


def compare_renders(
    gaussians: Gaussians,
    cameras: Cameras,
    images: Mapping[int, np.ndarray | Path],
    *,
    lpips: Callable[[np.ndarray, np.ndarray], float] | None = None,
) -> ImageScores:
    """Render Gaussians from cameras and compare the renders with images.

    Args:
        gaussians, cameras: Gaussians and cameras in one frame.
        images: images by camera index, as arrays (H, W, 3) in [0, 1] or as paths. An image of another size than its
            camera is compared at its own size if the aspect ratios agree. The image of a camera with a lens is the
            photo, which is undistorted; PSNR and SSIM leave out pixels that the photo does not show.
        lpips: function that measures LPIPS, such as `gsmap.evaluate.images.Lpips`.

    Raises:
        InputError: the aspect ratio of an image differs from that of its camera.
    """
    from gsmap.render import ChunkIndex, render

    index = ChunkIndex.build(gaussians)
    figures = []
    for at, image in sorted(images.items()):
        if isinstance(image, str | os.PathLike):
            image = read_image(image)
        camera, known = cameras[at], None
        if camera.lenses and camera.lenses[0] is not None:
            image, known = undistort(image, camera)
        camera = _at_size(camera, image.shape[1], image.shape[0])
        rendered = render(gaussians, camera, depth=False, dominant_id=False, index=index).colour[0]
        if known is not None:  # LPIPS takes no mask
            image = np.where(known[..., None], image, rendered)
        scores = psnr(rendered, image, known), ssim(rendered, image, known)
        figures.append((*scores, lpips(rendered, image) if lpips else 0.0))
    table = np.array(figures).reshape(-1, 3)
    names = tuple(cameras.names[at] for at in sorted(images))
    return ImageScores(names, table[:, 0], table[:, 1], table[:, 2] if lpips else np.zeros(0))


def _at_size(camera: Cameras, width: int, height: int) -> Cameras:
    """Return the camera of an image that was resampled to a size."""
    old = camera.sizes_px[0]
    ratio = np.array([width, height]) / old
    if abs(old[0] * ratio[1] - width) > 2:
        raise InputError(
            f"image of camera {camera.names[0]} has {width} x {height} pixels, its camera {old[0]} x {old[1]}: the "
            "aspect ratios differ",
            code="size_mismatch",
        )
    return Cameras(
        camera.T_frame_camera,
        camera.intrinsics_px * np.concatenate([ratio, ratio]),
        np.array([[width, height]]),
        camera.names,
    )


def _stem(name: str | os.PathLike[str]) -> str:
    path = Path(name)
    return str(path.with_suffix("")) if path.suffix.lower() in _SUFFIXES else str(path)
