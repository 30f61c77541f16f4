"""Read and write the ``cameras.json`` of INRIA's gaussian-splatting: a list of camera-to-scene poses in OpenCV axes."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from gsmap.durable import write_text_output
from gsmap.errors import InputError
from gsmap.formats.camera_files import unique
from gsmap.types import Cameras


def parse(entries: list[dict[str, Any]], path: Path) -> Cameras:
    """Return the cameras of a parsed file. Without ``cx cy``, the principal point is the image centre."""
    if not entries:
        raise InputError(f"{path} holds no cameras: the list is empty", code="no_cameras")
    pose = np.tile(np.eye(4), (len(entries), 1, 1))
    pose[:, :3, :3] = np.array([e["rotation"] for e in entries], np.float64)
    pose[:, :3, 3] = np.array([e["position"] for e in entries], np.float64)
    sizes = np.array([(e["width"], e["height"]) for e in entries])
    intrinsics = [(e["fx"], e["fy"], e.get("cx", e["width"] / 2), e.get("cy", e["height"] / 2)) for e in entries]
    names = unique([str(e.get("img_name", e.get("id", i))) for i, e in enumerate(entries)])
    return Cameras(pose, np.array(intrinsics, np.float64), sizes, names)


def write(path: str | os.PathLike[str], cameras: Cameras) -> None:
    """Write cameras in the INRIA layout; add ``cx cy`` where the principal point is not the image centre."""
    entries = []
    for i, name in enumerate(cameras.names):
        fx, fy, cx, cy = cameras.intrinsics_px[i].tolist()
        width, height = cameras.sizes_px[i].tolist()
        pose = cameras.T_frame_camera[i]
        entry = {"id": i, "img_name": name, "width": width, "height": height}
        entry |= {"position": pose[:3, 3].tolist(), "rotation": pose[:3, :3].tolist(), "fx": fx, "fy": fy}
        if (cx, cy) != (width / 2, height / 2):
            entry |= {"cx": cx, "cy": cy}
        entries.append(entry)
    write_text_output(Path(path), json.dumps(entries))
