"""Find the surface point that a pixel of a scene's camera shows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsmap.errors import InputError, NotFoundError
from gsmap.geometry.camera_models import view_of_pixel
from gsmap.geometry.rays import surface_along
from gsmap.map.world.photo_names import rows_of_photo
from gsmap.store import Store
from gsmap.types import Cameras, Gaussians


def camera_of(cameras: Cameras, name: str, scene_name: str) -> Cameras:
    """Return the camera of a scene with a photo's name, with or without folders and suffix: several faces if the photo
    is a panorama. A face is named ``PHOTO#front`` and so on; its pixels are those of the face.

    Raises:
        NotFoundError: none, or several.
    """
    photos = cameras.photo_rows
    if name in cameras.names and name not in photos:
        return replace(cameras[cameras.names.index(name)], lenses=())
    names = list(photos)
    found = rows_of_photo(names, name)
    if len(found) != 1:
        what = f"{len(found)} cameras" if found else "no camera"
        some = ", ".join([names[row] for row in found[:3]] or names[:3])
        raise NotFoundError(
            f"scene {scene_name} has {what} called {name!r}: {'such as' if found else 'its first ones are'} {some}",
            code="camera_not_found",
        )
    return cameras[photos[names[found[0]]]]


def view_of(cameras: Cameras, pixel: np.ndarray) -> tuple[Cameras, np.ndarray]:
    """Return the pinhole camera that shows a pixel of a photo, and the pixel in that camera, without distortion.

    Args:
        cameras: the cameras of one photo.

    Raises:
        InputError: the pixel lies outside of the photo, or its lens has no ray there.
    """
    name = next(iter(cameras.photo_rows))
    width, height = photo_size(cameras)
    if not (0 <= pixel[0] <= width and 0 <= pixel[1] <= height):
        raise InputError(
            f"pixel {pixel[0]:g},{pixel[1]:g} lies outside of the image of camera {name} ({width}x{height})",
            code="pixel_outside",
        )
    found = view_of_pixel(cameras, pixel)
    if found is None:
        raise InputError(
            f"the lens of {name} shows nothing at pixel {pixel[0]:g},{pixel[1]:g}: pick one nearer to the middle",
            code="pixel_outside",
        )
    row, at = found
    return cameras[row], at


def photo_size(cameras: Cameras) -> tuple[int, int]:
    """Return the width and height of the photo that the cameras are of."""
    lens = cameras.lenses[0] if cameras.lenses else None
    width, height = cameras.sizes_px[0].tolist() if lens is None else lens.model.size_px
    return width, height


def surface_at(
    gaussians: Gaussians, camera: Cameras, pixel: np.ndarray, sigma_share: float
) -> tuple[float, float] | None:
    """Return the depth along z of the surface at a pixel, and its standard deviation; None without a surface.

    The standard deviation is that of splats around surfaces (a share of the depth), and how thick the surface is.
    """
    pose = camera.T_frame_camera[0]
    ray = pose[:3, :3] @ ray_of(camera.intrinsics_px[0], pixel)
    found = surface_along(gaussians, pose[:3, 3], ray)
    if found is None:
        return None
    depth, thickness = found
    return depth, float(np.hypot(sigma_share * depth, thickness))


def ray_of(intrinsics_px: np.ndarray, pixel: np.ndarray) -> np.ndarray:
    """Return the direction (3,) of a pixel in the camera frame, with z = 1."""
    fx, fy, cx, cy = intrinsics_px
    return np.array([(pixel[0] - cx) / fx, (pixel[1] - cy) / fy, 1.0])


def picked_point(
    store: Store, scene: str, camera_name: str, pixel: np.ndarray, sigma_share: float, sigma_px: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the scene point (3,) that a pixel of a camera shows, and its covariance (3, 3).

    Raises:
        NotFoundError: no such camera, or nothing is to be seen there.
        InputError: a pixel outside of the picture.
    """
    found = store.scenes.get(scene)
    picked = f"pixel {pixel[0]:g},{pixel[1]:g}"
    camera, pixel = view_of(camera_of(store.scenes.cameras(found.id), camera_name, found.name), pixel)
    seen = surface_at(store.scenes.gaussians(found.id), camera, pixel, sigma_share)
    if seen is None:
        raise NotFoundError(
            f"{picked} of camera {camera_name} of scene {found.name} shows no surface: pick one that does",
            code="pixel_without_surface",
        )
    depth, sigma = seen
    fx, fy = camera.intrinsics_px[0, :2]
    ray = ray_of(camera.intrinsics_px[0], pixel)
    J = np.stack([np.array([depth / fx, 0, 0]), np.array([0, depth / fy, 0]), ray], axis=1)
    covariance = J @ np.diag([sigma_px**2, sigma_px**2, sigma**2]) @ J.T
    turn = camera.T_frame_camera[0]
    return turn[:3, :3] @ (ray * depth) + turn[:3, 3], turn[:3, :3] @ covariance @ turn[:3, :3].T
