"""Read the cameras that Metashape exports as XML (``File > Export > Export Cameras``)."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gsmap.errors import InputError, NotFoundError
from gsmap.formats.camera_files import unique
from gsmap.formats.lenses import pinhole_cameras
from gsmap.geometry.camera_models import EQUIRECTANGULAR, camera_model
from gsmap.types import Cameras
from gsmap.types.cameras import CameraModel

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

_MAX_BYTES = 1 << 28
_LOCAL = ("", "LOCAL_CS", "ENGCRS")  # coordinate systems whose metres are those of the exports


def read(path: Path) -> Cameras:
    """Return the cameras of an XML file in the frame of the point clouds and meshes that Metashape exports with it.

    Poses are those of the chunk, with the transform of each camera's component where it has one. Camera axes are
    right-down-front, pixel centres lie at +0.5, and ``cx`` and ``cy`` count from the middle of the photo (Metashape's
    manual, appendix on camera models, which also numbers the tangential coefficients the other way round than OpenCV).
    Photos without a pose are left out.

    Raises:
        NotFoundError: the file is missing.
        NotPinholesError: gsmap knows none of the lenses.
        InputError: no XML, no cameras with poses, or poses in Earth-centred coordinates.
    """
    chunk = _root(path).find("chunk")
    if chunk is None:
        raise InputError(f"{path} holds no cameras of Metashape: it has no chunk", code="no_cameras")
    system = (chunk.findtext("reference") or "").partition("[")[0].strip()
    if system not in _LOCAL and chunk.find("components/component/transform") is not None:
        raise InputError(
            f"{path}: the chunk is georeferenced, so its poses are Earth-centred and not in the frame of its exports: "
            "export the cameras in local coordinates",
            code="invalid_cameras",
        )
    models = {sensor.get("id"): _model(sensor) for sensor in chunk.findall("sensors/sensor")}
    components = {one.get("id"): _component(one) for one in chunk.findall("components/component")}
    poses: list[np.ndarray] = []
    lenses: list[CameraModel | str] = []
    names: list[str] = []
    for camera in chunk.iterfind("cameras//camera"):
        numbers = _numbers(camera.findtext("transform"))
        if len(numbers) != 16 or camera.get("sensor_id") not in models:
            continue
        pose = components.get(camera.get("component_id"), np.eye(4)) @ np.array(numbers).reshape(4, 4)
        pose[:3, :3] /= np.cbrt(np.abs(np.linalg.det(pose[:3, :3])))  # Cameras refuses a mirrored pose
        poses.append(pose)
        lenses.append(models[camera.get("sensor_id")])
        names.append(camera.get("label") or str(len(names)))
    if not poses:
        raise InputError(f"{path} holds no cameras with a pose: align the photos first", code="no_cameras")
    return pinhole_cameras(np.stack(poses), lenses, unique(names), path)


def _root(path: Path) -> Element:
    from xml.etree import ElementTree

    if not path.exists():
        raise NotFoundError(f"cannot read cameras from {path}: no such file", code="file_not_found")
    if path.stat().st_size > _MAX_BYTES:
        raise InputError(f"{path} is too large for a file of cameras", code="invalid_cameras")
    text = path.read_bytes()
    # Entities could expand without bound; in UTF-16 they would not be found.
    if b"\0" in text or re.search(rb"<!(DOCTYPE|ENTITY)", text):
        raise InputError(f"{path} is not the XML that Metashape writes (UTF-8, no DOCTYPE)", code="invalid_cameras")
    try:
        return ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise InputError(f"{path} is not XML: {error}", code="invalid_cameras") from error


def _component(component: Element) -> np.ndarray:
    """Return the similarity (4, 4) that takes the chunk's inner coordinates to those of its exports."""
    out = np.eye(4)
    transform = component.find("transform")
    if transform is not None:
        rotation, translation = (_numbers(transform.findtext(part)) for part in ("rotation", "translation"))
        scale = _numbers(transform.findtext("scale"))
        out[:3, :3] = np.array(rotation or np.eye(3)).reshape(3, 3) * (scale[0] if scale else 1.0)
        out[:3, 3] = translation or 0.0
    return out


def _model(sensor: Element) -> CameraModel | str:
    """Return the adjusted lens of a sensor, or the name of one that COLMAP does not have."""
    found = sensor.findall("calibration")
    calibration = next((one for one in found if one.get("class") == "adjusted"), found[-1] if found else None)
    resolution = sensor.find("resolution") if calibration is None else calibration.find("resolution")
    if resolution is None:
        raise InputError(f"sensor {sensor.get('label') or sensor.get('id')} has no resolution", code="invalid_cameras")
    width, height = int(resolution.get("width", 0)), int(resolution.get("height", 0))
    kind = sensor.get("type") or "frame"
    if kind == "spherical":
        return camera_model(EQUIRECTANGULAR, width, height, (width, height))
    if calibration is None:
        return f"{kind} without calibration"
    values = {part.tag: _numbers(part.text)[0] for part in calibration if part.tag != "resolution" and part.text}
    f, b1 = values["f"], values.get("b1", 0.0)
    middle = (f + b1, f, width / 2 + values.get("cx", 0.0), height / 2 + values.get("cy", 0.0))
    k1, k2, k3, k4 = (values.get(name, 0.0) for name in ("k1", "k2", "k3", "k4"))
    p1, p2 = values.get("p2", 0.0), values.get("p1", 0.0)  # in OpenCV's order
    odd = [name for name in ("b2", "p3", "p4") if values.get(name)]
    if kind == "fisheye" and not (odd or p1 or p2):
        return camera_model("OPENCV_FISHEYE", width, height, (*middle, k1, k2, k3, k4))
    if kind == "frame" and not (odd or k4):
        return camera_model("FULL_OPENCV", width, height, (*middle, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0))
    more = odd or [name for name, value in zip(("k4", "p1", "p2"), (k4, p1, p2), strict=True) if value]
    return f"{kind} with {', '.join(more)}" if kind in ("frame", "fisheye") else kind


def _numbers(text: str | None) -> list[float]:
    return [float(part) for part in (text or "").split()]
