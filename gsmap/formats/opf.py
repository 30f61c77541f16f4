"""Read the calibrated cameras of projects in the Open Photogrammetry Format (OPF 1.0, github.com/Pix4D/opf-spec)."""

from __future__ import annotations

from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import unquote, urlsplit

import numpy as np

from gsmap.errors import InputError
from gsmap.formats.camera_files import load_json, unique
from gsmap.formats.lenses import pinhole_cameras
from gsmap.geometry.camera_models import EQUIRECTANGULAR, camera_model
from gsmap.types import Cameras
from gsmap.types.cameras import CameraModel

_PARTS = {
    "application/opf-calibrated-cameras+json": "calibrated cameras",
    "application/opf-input-cameras+json": "input cameras",
    "application/opf-camera-list+json": "a camera list",
}


def read(path: Path) -> Cameras:
    """Return the calibrated cameras of a project file in its processing coordinate system.

    Angles are omega, phi, kappa: R_x R_y R_z takes right-top-back camera axes to the frame. Image sizes come from the
    input cameras, names from the camera list.

    Raises:
        NotFoundError: the project or a file that it names is missing.
        NotPinholesError: gsmap knows none of the lenses.
        InputError: the project is not calibrated, or names files outside its folder.
    """
    project = load_json(path)
    parts = {
        resource["format"]: load_json(_inside(path, resource["uri"]))
        for item in project["items"]
        for resource in item["resources"]
        if resource["format"] in _PARTS
    }
    if lacking := [what for kind, what in _PARTS.items() if kind not in parts]:
        raise InputError(f"{path} holds no {' and no '.join(lacking)}: calibrate the project first", code="no_cameras")
    calibrated, given, listed = (parts[kind] for kind in _PARTS)
    sizes = {sensor["id"]: (int(w), int(h)) for sensor in given["sensors"] for w, h in [sensor["image_size_px"]]}
    photos = {camera["id"]: _photo(camera["uri"]) for camera in listed["cameras"]}
    lenses = {sensor["id"]: _model(sensor["internals"], sizes[sensor["id"]]) for sensor in calibrated["sensors"]}
    cameras = calibrated["cameras"]
    if not cameras:
        raise InputError(f"{path} holds no calibrated cameras", code="no_cameras")
    names = unique([photos.get(camera["id"], str(camera["id"])) for camera in cameras])
    return pinhole_cameras(
        np.stack([_pose(camera) for camera in cameras]), [lenses[one["sensor_id"]] for one in cameras], names, path
    )


def _inside(path: Path, uri: str) -> Path:
    """Return the file that a project names.

    Raises:
        InputError: it lies outside the folder of the project.
    """
    relative = PurePosixPath(unquote(uri))
    if urlsplit(uri).scheme or relative.is_absolute() or ".." in relative.parts:
        raise InputError(f"{path} names {uri!r}, which lies outside its folder", code="invalid_cameras")
    return path.parent / relative


def _photo(uri: str) -> str:
    parts = urlsplit(uri)
    return unquote(parts.path).rpartition("/")[2] + (f"#{parts.fragment}" if parts.fragment else "")


def _pose(camera: dict[str, Any]) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    out = np.eye(4)
    out[:3, :3] = Rotation.from_euler("XYZ", camera["orientation_deg"], degrees=True).as_matrix()
    out[:3, 1:3] *= -1  # right-top-back to right-down-front
    out[:3, 3] = camera["position"]
    return out


def _model(internals: dict[str, Any], size_px: tuple[int, int]) -> CameraModel | str:
    """Return a lens, or the name of one that COLMAP does not have: Pix4D's fisheye polynomial has even powers."""
    if internals["type"] == "spherical":
        return camera_model(EQUIRECTANGULAR, *size_px, size_px)
    if internals["type"] != "perspective":
        return f"OPF {internals['type']}"
    f, (cx, cy) = float(internals["focal_length_px"]), map(float, internals["principal_point_px"])
    k1, k2, k3 = map(float, internals["radial_distortion"])
    p1, p2 = map(float, internals["tangential_distortion"])
    return camera_model("FULL_OPENCV", *size_px, (f, f, cx, cy, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0))
