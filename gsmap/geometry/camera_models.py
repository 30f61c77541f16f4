"""Project and cast rays with the camera models of COLMAP, and view photos through pinholes.

Splats are rendered by pinholes. A photo with distortion is seen by the pinhole of the same focal lengths. A panorama,
and a fisheye that is too wide for one pinhole, is seen by those of six pinholes of 90 degrees, its faces, that look
along the axes of its camera.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np

from gsmap.errors import MissingDependencyError
from gsmap.types.cameras import CameraModel, Cameras, PhotoLens

EQUIRECTANGULAR = "EQUIRECTANGULAR"
FACES = ("front", "right", "back", "left", "up", "down")

# Of half the diagonal. Beyond it a third of what the photo shows lies outside the pinhole's view, or the reverse.
_MAX_SHIFT = 0.25
_ROUND_TRIP_PX = 0.5
_SMALL_ANGLE = 1e-4
_EXACT_PX = 1e-6  # shift at the corners up to which a lens is a pinhole
_SAME_RAY = 1 - 1e-9  # cosine
_MIN_COVERED = 0.25  # fraction of a face that the photo must show
_GRID = 9  # samples along the side of a face


def require_pycolmap() -> Any:
    """Return the module pycolmap.

    Raises:
        MissingDependencyError: pycolmap is not installed, as on Linux on ARM, for which it has no wheel.
    """
    try:
        import pycolmap
    except ImportError as error:
        raise MissingDependencyError(
            "camera models and resection need pycolmap, which has no wheel for this system: build it from source"
        ) from error
    return pycolmap


@lru_cache(maxsize=64)
def _camera(model: CameraModel) -> Any:
    pycolmap = require_pycolmap()
    width, height = model.size_px
    camera = pycolmap.Camera(model=model.name, width=width, height=height, params=list(model.params))
    if not camera.verify_params():
        raise ValueError(f"{len(model.params)} parameters do not fit the camera model {model.name}")
    return camera


def camera_model(name: object, width: int, height: int, params: tuple[float, ...]) -> CameraModel:
    """Return a checked camera model.

    Args:
        name: name of the model, or its `pycolmap.CameraModelId`.

    Raises:
        ValueError, RuntimeError: unknown model, or a wrong number of parameters.
    """
    pycolmap = require_pycolmap()
    camera = pycolmap.Camera(model=name, width=width, height=height, params=list(params))
    model = CameraModel(str(camera.model_name), (width, height), tuple(float(value) for value in params))
    _camera(model)
    return model


def project_with(model: CameraModel, points: np.ndarray) -> np.ndarray:
    """Project points (N, 3) of the camera frame to pixels (N, 2); NaN where the model shows no such point."""
    with np.errstate(all="ignore"):
        pixels: np.ndarray = np.array(_camera(model).img_from_cam(np.asarray(points, np.float64)), np.float64)
    return pixels.reshape(-1, 2)


def rays_of(model: CameraModel, pixels: np.ndarray) -> np.ndarray:
    """Return the unit rays (N, 3) of pixels (N, 2) in the camera frame; NaN where the model has no ray.

    Beyond the angles that a model holds, pycolmap returns rays of other pixels; these are NaN as well.
    """
    pixels = np.asarray(pixels, np.float64).reshape(-1, 2)
    with np.errstate(all="ignore"):
        rays = np.array(_camera(model).cam_ray_from_img(pixels), np.float64).reshape(-1, 3)
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        back = project_with(model, rays)
        if model.name == EQUIRECTANGULAR:  # the seam is at both sides
            width = model.size_px[0]
            back[:, 0] += width * np.round((pixels[:, 0] - back[:, 0]) / width)
        rays[~(np.linalg.norm(back - pixels, axis=1) < _ROUND_TRIP_PX)] = np.nan
    return rays


@lru_cache(maxsize=4096)
def pinhole_of(model: CameraModel) -> tuple[tuple[float, ...], float]:
    """Return ``fx fy cx cy`` of the pinhole with the focal lengths and principal point of a model, and the largest
    distance in pixels at a corner of the photo between a pixel and the pinhole's projection of its ray; infinite where
    no pinhole shows a corner."""
    camera, (width, height) = _camera(model), model.size_px
    if not camera.focal_length_idxs():  # asking such a camera for its focal length ends the process
        return (0.0, 0.0, 0.0, 0.0), math.inf
    fx, fy = camera.focal_length_x, camera.focal_length_y
    intrinsics = (fx, fy, camera.principal_point_x, camera.principal_point_y)
    if model.name in ("PINHOLE", "SIMPLE_PINHOLE"):
        return intrinsics, 0.0
    corners = np.array([[0, 0], [width, 0], [0, height], [width, height]], np.float64)
    rays = rays_of(model, corners)
    if not (rays[:, 2] > 0).all():
        return intrinsics, math.inf
    shift = rays[:, :2] / rays[:, 2:] * intrinsics[:2] + intrinsics[2:] - corners
    return intrinsics, float(np.linalg.norm(shift, axis=1).max())


def pinhole_views(model: CameraModel, pose: np.ndarray, photo: str) -> Cameras:
    """Return the pinhole cameras by which a photo is seen: one, or the faces of a panorama or a wide fisheye.

    Args:
        pose: (4, 4) camera-to-frame pose of the photo.
        photo: name of the photo; faces are called ``PHOTO#front`` and so on.
    """
    rotations, intrinsics, size_px, names = _views(model)
    poses = np.tile(pose, (len(rotations), 1, 1))
    poses[:, :3, :3] = pose[:3, :3] @ rotations
    is_pinhole = not names and pinhole_of(model)[1] <= _EXACT_PX
    return Cameras(
        poses,
        np.tile(intrinsics, (len(rotations), 1)),
        np.tile(size_px, (len(rotations), 1)),
        tuple(f"{photo}#{name}" for name in names) or (photo,),
        lenses=() if is_pinhole else tuple(PhotoLens(photo, model, rotation) for rotation in rotations),
    )


@lru_cache(maxsize=4096)
def _views(model: CameraModel) -> tuple[np.ndarray, tuple[float, ...], tuple[int, int], tuple[str, ...]]:
    """Return rotations (V, 3, 3) to the camera of a photo, intrinsics, size, and names of the faces (empty for a single
    pinhole) of the pinholes by which it is seen."""
    intrinsics, shift = pinhole_of(model)
    if shift <= _MAX_SHIFT * math.hypot(*model.size_px) / 2:
        return np.eye(3)[None], intrinsics, model.size_px, ()
    ahead = project_with(model, np.array([[-_SMALL_ANGLE, 0, 1], [_SMALL_ANGLE, 0, 1]]))
    side = max(2, round(float(np.linalg.norm(ahead[1] - ahead[0])) / _SMALL_ANGLE))  # as fine as the photo's middle
    at = (np.arange(_GRID) + 0.5) * 2 / _GRID - 1
    x, y = (axis.ravel() for axis in np.meshgrid(at, at))
    rotations = _face_rotations()
    covered = []
    for rotation in rotations:
        rays = np.stack([x, y, np.ones_like(x)], axis=1) @ rotation.T
        covered.append(_is_inside(model, _exact_pixels(model, rays)).mean() >= _MIN_COVERED)
    names = tuple(name for name, is_shown in zip(FACES, covered, strict=True) if is_shown)
    return rotations[np.array(covered)], (side / 2,) * 4, (side, side), names


def _face_rotations() -> np.ndarray:
    """Return the rotations (6, 3, 3) from each face to the camera of its photo."""
    turns = []
    for yaw in (0, 90, 180, 270):
        c, s = np.round([np.cos(np.radians(yaw)), np.sin(np.radians(yaw))])
        turns.append(np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]))
    for pitch in (90, -90):
        s = np.sign(pitch)
        turns.append(np.array([[1.0, 0, 0], [0, 0, -s], [0, s, 0]]))
    return np.stack(turns)


def _is_inside(model: CameraModel, pixels: np.ndarray) -> np.ndarray:
    """Return an (N,) mask of pixels (N, 2) inside the photo."""
    width, height = model.size_px
    column, row = pixels.T
    result: np.ndarray = (column >= 0) & (column <= width) & (row >= 0) & (row <= height)
    return result


def photo_pixels(camera: Cameras, pixels: np.ndarray) -> np.ndarray:
    """Return the pixels (N, 2) of the photo that show what pixels (N, 2) of its pinhole camera show; NaN without one.

    Args:
        camera: one camera.
    """
    lens = camera.lenses[0] if camera.lenses else None
    pixels = np.asarray(pixels, np.float64)
    if lens is None:
        return pixels
    fx, fy, cx, cy = camera.intrinsics_px[0]
    rays = np.stack([(pixels[:, 0] - cx) / fx, (pixels[:, 1] - cy) / fy, np.ones(len(pixels))], axis=1)
    return _exact_pixels(lens.model, rays @ lens.R_photo_camera.T)


def _exact_pixels(model: CameraModel, rays: np.ndarray) -> np.ndarray:
    """Project rays (N, 3); NaN beyond the angles that a model holds, where its polynomials turn back."""
    found = project_with(model, rays)
    with np.errstate(all="ignore"):
        same = (rays_of(model, found) * rays).sum(1) > _SAME_RAY * np.linalg.norm(rays, axis=1)
    found[~same] = np.nan
    return found


def view_of_pixel(cameras: Cameras, pixel: np.ndarray) -> tuple[int, np.ndarray] | None:
    """Return the row of the camera that shows a pixel (2,) of a photo, and the undistorted pixel in that camera, which
    may lie outside its image; None if the lens has no ray there.

    Args:
        cameras: the cameras of one photo.
    """
    lenses = cameras.lenses
    if not lenses or lenses[0] is None:
        return 0, np.asarray(pixel, np.float64)
    ray = rays_of(lenses[0].model, pixel)[0]
    if not np.isfinite(ray).all():
        return None
    local = np.array([ray @ lens.R_photo_camera for lens in lenses if lens is not None])
    row = int(np.argmax(local[:, 2]))
    if local[row, 2] <= 0:
        return None
    fx, fy, cx, cy = cameras.intrinsics_px[row]
    x, y, z = local[row]
    return row, np.array([fx * x / z + cx, fy * y / z + cy])


def undistort(image: np.ndarray, camera: Cameras) -> tuple[np.ndarray, np.ndarray]:
    """Return the image (h, w, 3) that a pinhole camera of a photo shows, and the mask (h, w) of pixels that the photo
    has.

    Args:
        image: (H, W, 3) photo in any size with the aspect ratio of its lens.
        camera: one camera with a lens.
    """
    lens = camera.lenses[0]
    assert lens is not None
    width, height = camera.sizes_px[0].tolist()
    grid = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), -1).reshape(-1, 2)
    at = photo_pixels(camera, grid)
    known = _is_inside(lens.model, at)
    at = np.where(known[:, None], at, 0) * (np.array(image.shape[1::-1]) / np.array(lens.model.size_px)) - 0.5
    wraps = lens.model.name == EQUIRECTANGULAR
    shown = _bilinear(image, at, wraps)
    shown[~known] = 0
    return shown.reshape(height, width, 3), known.reshape(height, width)


def _bilinear(image: np.ndarray, at: np.ndarray, wraps: bool) -> np.ndarray:
    """Return the values (N, 3) of an image at positions (N, 2) relative to the centre of its first pixel."""
    high, wide = image.shape[0] - 1, image.shape[1] - 1
    first = np.floor(at).astype(np.int64)
    share = (at - first).astype(np.float32)
    out = np.zeros((len(at), 3), np.float32)
    for right in (0, 1):
        column = (first[:, 0] + right) % (wide + 1) if wraps else np.clip(first[:, 0] + right, 0, wide)
        across = share[:, 0] if right else 1 - share[:, 0]
        for below in (0, 1):
            row = np.clip(first[:, 1] + below, 0, high)
            down = share[:, 1] if below else 1 - share[:, 1]
            out += image[row, column] * (across * down)[:, None]
    return out if image.dtype.kind == "f" else np.round(out).astype(image.dtype)
