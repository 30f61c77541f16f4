"""Read and write the ``transforms.json`` of nerfstudio and instant-ngp: camera-to-world poses in OpenGL axes."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from typing import Any

import numpy as np

from gsmap.durable import write_text_output
from gsmap.errors import InputError, NotFoundError
from gsmap.formats.camera_files import load_json, unique
from gsmap.formats.lenses import photo_cameras, pinhole_cameras
from gsmap.formats.pictures import open_picture
from gsmap.geometry.camera_models import EQUIRECTANGULAR, camera_model
from gsmap.types import Cameras, Sim3
from gsmap.types.cameras import CameraModel

_FISHEYE = ("OPENCV_FISHEYE", "FISHEYE")
_PERSPECTIVE = ("OPENCV", "FULL_OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "RADIAL", "SIMPLE_RADIAL", "PERSPECTIVE")
# Keys of the parameters of COLMAP's models, in COLMAP's order; further parameters must be zero.
_MIDDLE, _SIMPLE = ("fl_x", "fl_y", "cx", "cy"), ("fl_x", "cx", "cy")
_KEYS = {
    "SIMPLE_PINHOLE": _SIMPLE,
    "PINHOLE": _MIDDLE,
    "SIMPLE_RADIAL": (*_SIMPLE, "k1"),
    "RADIAL": (*_SIMPLE, "k1", "k2"),
    "OPENCV": (*_MIDDLE, "k1", "k2", "p1", "p2"),
    "FULL_OPENCV": (*_MIDDLE, "k1", "k2", "p1", "p2", "k3"),
    "OPENCV_FISHEYE": (*_MIDDLE, "k1", "k2", "k3", "k4"),
}
DATAPARSER = "dataparser_transforms.json"


def parse(content: dict[str, Any], path: Path) -> Cameras:
    """Return the cameras of a parsed file, transformed to the frame in which the splats were trained.

    Args:
        path: The file; image sizes and ``dataparser_transforms.json`` are looked up beside it.

    Nerfstudio trains in ``scale * (transform @ x)`` of the *original* coordinates, while the poses of
    ``transforms.json`` already had ``applied_transform`` and ``applied_scale`` done to them: both are taken back first.

    Photos of other lenses than pinholes are seen through pinholes, and those of lenses that COLMAP does not have are
    left out: ``notes`` say so (`gsmap.formats.lenses`).

    Raises:
        NotPinholesError: COLMAP has no model of any lens.
        InputError: Cameras, sizes or focal lengths are missing.
    """
    frames = content["frames"]
    if not frames:
        raise InputError(f"{path} holds no cameras: its list of frames is empty", code="no_cameras")
    pose = np.array([f["transform_matrix"] for f in frames], np.float64)
    if pose.shape[1:] == (3, 4):
        pose = np.concatenate([pose, np.tile([[[0.0, 0, 0, 1]]], (len(pose), 1, 1))], axis=1)
    pose[:, :3, 1:3] *= -1  # OpenGL (y up, z back) to OpenCV (y down, z forward)
    scales = np.cbrt(np.abs(np.linalg.det(pose[:, :3, :3])))  # without sign: Cameras refuses a mirrored pose
    pose[:, :3, :3] /= scales[:, None, None]

    beside = path.parent / DATAPARSER
    if beside.is_file():
        change = load_json(beside)
        S_train_saved = _rows_to_matrix(change["transform"])
        if "applied_transform" in content:
            S_train_saved = S_train_saved @ np.linalg.inv(_rows_to_matrix(content["applied_transform"]))
        scale = float(change["scale"]) / float(content.get("applied_scale", 1.0))
        S = Sim3.from_matrix(S_train_saved)
        pose[:, :3, 3] = scale * S.apply(pose[:, :3, 3])
        pose[:, :3, :3] = S.rotation @ pose[:, :3, :3]

    models = [_model(content | f, path) for f in frames]
    names = unique([str(f.get("file_path", i)) for i, f in enumerate(frames)])
    return pinhole_cameras(pose, models, names, path)


def write(path: str | os.PathLike[str], cameras: Cameras) -> None:
    """Write a ``transforms.json`` (OpenGL axes) with poses in the frame of ``cameras`` and intrinsics per image.

    Frames are the photos with their lenses: all perspective, all fisheye or all equirectangular, as nerfstudio needs. A
    photo's name is its ``file_path``, relative to the file. Nerfstudio centres and scales poses as it loads them;
    ``--orientation-method none --center-method none --auto-scale-poses False`` keeps the frame.

    Raises:
        NotFoundError: The parent folder is missing.
        InputError: Lenses that the format does not have, or of several kinds.
    """
    path = Path(path)
    if not path.parent.is_dir():
        raise NotFoundError(f"cannot write {path}: no such folder: {path.parent}", code="folder_not_found")
    names, pose, models = photo_cameras(cameras)
    pose[:, :3, 1:3] *= -1  # OpenCV (y down, z forward) to OpenGL (y up, z back)
    kinds, frames = set(), []
    for i, (name, model) in enumerate(zip(names, models, strict=True)):
        kinds.add(model.name if model.name in ("PINHOLE", "OPENCV_FISHEYE", EQUIRECTANGULAR) else "OPENCV")
        frame: dict[str, Any] = {"file_path": name}
        frame |= dict(zip(("w", "h"), model.size_px, strict=True))
        frames.append(frame | _frame_lens(model, path) | {"transform_matrix": pose[i].tolist()})
    if "OPENCV" in kinds:
        kinds.discard("PINHOLE")
    if len(kinds) > 1:
        raise InputError(
            f"{path} takes photos of one kind of lens, and these are of {', '.join(sorted(kinds))}: write a COLMAP "
            "model (--format colmap)",
            code="unsupported_output",
        )
    text = json.dumps({"camera_model": "".join(kinds) or "PINHOLE", "frames": frames}, indent=1)
    write_text_output(path, text)


def _frame_lens(model: CameraModel, path: Path) -> dict[str, float]:
    """Return the intrinsics and distortion of a lens by nerfstudio's keys."""
    if model.name == EQUIRECTANGULAR:
        width, height = model.size_px
        return dict(zip(_MIDDLE, (width / 2, float(height), width / 2, height / 2), strict=True))
    keys = _KEYS.get(model.name, ())
    if not keys or any(model.params[len(keys) :]):
        raise InputError(
            f"{path} cannot hold photos of the lens {model.name}: write a COLMAP model (--format colmap)",
            code="unsupported_output",
        )
    out = dict(zip(keys, model.params, strict=False))
    return {"fl_x": out["fl_x"], "fl_y": out["fl_x"]} | out


def _rows_to_matrix(rows: list[list[float]]) -> np.ndarray:
    out = np.eye(4)
    out[:3] = np.array(rows, np.float64)[:3]
    return out


def _model(both: dict[str, Any], path: Path) -> CameraModel | str:
    """Return the lens of one image, or the name of a model that COLMAP does not have; each parameter may be specified
    for the image or for the whole file."""
    name = "OPENCV_FISHEYE" if both.get("is_fisheye") else str(both.get("camera_model") or "OPENCV").upper()
    if name == EQUIRECTANGULAR:
        width, height = _size(both, path)
        return camera_model(name, width, height, (width, height))
    if name not in (*_PERSPECTIVE, *_FISHEYE, "FISHEYE624"):
        return name
    (fx, fy, cx, cy), (width, height) = _intrinsics(both, path)
    middle = (fx, fy, cx, cy)
    k1, k2, k3, k4, p1, p2 = (float(both.get(key) or 0.0) for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    if name == "FISHEYE624":
        params = tuple(float(value) for value in both.get("distortion_params") or ())
        return camera_model("RAD_TAN_THIN_PRISM_FISHEYE", width, height, middle + params) if len(params) == 12 else name
    if name in _FISHEYE:
        return camera_model("OPENCV_FISHEYE", width, height, (*middle, k1, k2, k3, k4))
    if k4:  # the fourth term of a polynomial here, and of a quotient in COLMAP's models
        return f"{name} with k4"
    if not any((k1, k2, k3, p1, p2)):
        return camera_model("PINHOLE", width, height, middle)
    return camera_model("FULL_OPENCV", width, height, (*middle, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0))


def _intrinsics(both: dict[str, Any], path: Path) -> tuple[tuple[float, float, float, float], tuple[int, int]]:
    width, height = _size(both, path)
    fx, fy = both.get("fl_x"), both.get("fl_y")
    if fx is None and "camera_angle_x" in both:
        fx = 0.5 * width / math.tan(0.5 * both["camera_angle_x"])
    if fy is None and "camera_angle_y" in both:
        fy = 0.5 * height / math.tan(0.5 * both["camera_angle_y"])
    fx = fy if fx is None else fx
    if fx is None:
        raise InputError(
            f"{path}: frame {both.get('file_path')} has no focal length (fl_x or camera_angle_x)",
            code="incomplete_camera",
        )
    fy = fx if fy is None else fy
    cx, cy = (size / 2 if both.get(key) is None else both[key] for key, size in (("cx", width), ("cy", height)))
    return (float(fx), float(fy), float(cx), float(cy)), (width, height)


def _size(both: dict[str, Any], path: Path) -> tuple[int, int]:
    if both.get("w") is None or both.get("h") is None:
        return _image_size(path.parent / both["file_path"], path)
    return int(both["w"]), int(both["h"])


def _image_size(image: Path, path: Path) -> tuple[int, int]:
    for candidate in (image, image.with_name(image.name + ".png")):
        if candidate.is_file():
            with open_picture(candidate) as opened:
                return opened.size
    raise InputError(f"{path} gives no image size (w, h) and {image} is not there to tell it", code="incomplete_camera")
