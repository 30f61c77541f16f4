"""Read the cameras of phone scans: Polycam, Record3D and Stray Scanner."""

from __future__ import annotations

import csv
import struct
from pathlib import Path
from typing import Any

import numpy as np

from gsmap.errors import InputError
from gsmap.formats.camera_files import load_json
from gsmap.types import Cameras

_OPENGL = np.array([1.0, -1.0, -1.0])  # right-up-back camera axes in terms of right-down-front
POLYCAM = ("keyframes/corrected_cameras", "keyframes/cameras")
STRAY = ("odometry.csv", "camera_matrix.csv")
_MAX_MOVIE_BYTES = 1 << 26  # of the index of a video
_MAX_BOXES = 10_000  # before the index of a video; a crafted file could hold millions


def read_polycam(folder: Path) -> Cameras:
    """Return the cameras of a folder of Polycam's raw data (``keyframes/corrected_cameras``), in ARKit's frame (y up).

    Raises:
        InputError: the folder holds no cameras.
    """
    files = sorted(folder.glob("*.json"))
    if not files:
        raise InputError(f"{folder} holds no cameras of Polycam", code="no_cameras")
    found = [load_json(file) for file in files]
    poses = np.tile(np.eye(4), (len(found), 1, 1))
    poses[:, :3] = [[[one[f"t_{row}{column}"] for column in range(4)] for row in range(3)] for one in found]
    poses[:, :3, :3] *= _OPENGL
    return Cameras(
        poses,
        np.array([[one[key] for key in ("fx", "fy", "cx", "cy")] for one in found], np.float64),
        np.array([[one["width"], one["height"]] for one in found]),
        tuple(f"{file.stem}.jpg" for file in files),
    )


def parse_record3d(content: dict[str, Any], path: Path) -> Cameras:
    """Return the cameras of a parsed ``metadata.json`` of Record3D, in ARKit's frame (y up).

    Raises:
        InputError: it has no poses.
    """
    rows = np.array(content["poses"], np.float64).reshape(-1, 7)  # qx qy qz qw x y z
    if not len(rows):
        raise InputError(f"{path} holds no cameras: its list of poses is empty", code="no_cameras")
    K = np.array(content["K"], np.float64).reshape(3, 3).T  # stored by columns
    lens = np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]])
    lenses = np.array(content.get("perFrameIntrinsicCoeffs") or np.tile(lens, (len(rows), 1)), np.float64)
    size = (int(content["w"]), int(content["h"]))
    names = tuple(f"{row}.jpg" for row in range(len(rows)))
    return Cameras(_poses(rows[:, 4:], rows[:, :4], _OPENGL), lenses, np.tile(size, (len(rows), 1)), names)


def read_stray(folder: Path) -> Cameras:
    """Return the cameras of a folder of Stray Scanner, in ARKit's frame (y up); cameras are named by their frame.

    Raises:
        InputError: the folder has no poses or no ``rgb.mp4``, which has the size of the frames.
    """
    with open(folder / STRAY[0], newline="") as file:
        rows = [{key.strip(): value for key, value in row.items()} for row in csv.DictReader(file)]
    if not rows:
        raise InputError(f"{folder / STRAY[0]} holds no cameras", code="no_cameras")
    K = np.loadtxt(folder / STRAY[1], delimiter=",")
    one = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
    lenses = [[float(row.get(key) or one[key]) for key in one] for row in rows]
    places = np.array([[float(row[key]) for key in ("x", "y", "z")] for row in rows])
    turns = np.array([[float(row[key]) for key in ("qx", "qy", "qz", "qw")] for row in rows])
    names = tuple(row["frame"].strip() for row in rows)
    size = _video_size(folder / "rgb.mp4")
    return Cameras(_poses(places, turns, np.ones(3)), np.array(lenses), np.tile(size, (len(rows), 1)), names)


def _poses(places: np.ndarray, quats_xyzw: np.ndarray, axes: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    out = np.tile(np.eye(4), (len(places), 1, 1))
    out[:, :3, :3] = Rotation.from_quat(quats_xyzw).as_matrix() * axes
    out[:, :3, 3] = places
    return out


def _video_size(path: Path) -> tuple[int, int]:
    """Return width and height of an MP4, which are the last values of a track's header (ISO 14496-12, 8.3.2).

    Raises:
        InputError: the file is missing or damaged.
    """
    if path.is_file():
        content = _movie_box(path)
        at = content.find(b"tkhd")
        while at >= 4:
            end = at - 4 + int.from_bytes(content[at - 4 : at], "big")
            sides = content[end - 8 : end]
            if at + 4 <= end - 8 and len(sides) == 8:
                width, height = (value >> 16 for value in struct.unpack(">II", sides))
                if width and height:
                    return width, height
            at = content.find(b"tkhd", at + 4)
    raise InputError(
        f"cannot read the size of the frames of {path.parent}: {path} is missing or damaged", code="invalid_cameras"
    )


def _movie_box(path: Path) -> bytes:
    """Return the content of the box ``moov`` of an MP4; empty without one of a plausible size."""
    with open(path, "rb") as file:
        for _ in range(_MAX_BOXES):
            head = file.read(8)
            if len(head) < 8:
                break
            size, kind, skipped = int.from_bytes(head[:4], "big"), head[4:], 8
            if size == 1:
                size, skipped = int.from_bytes(file.read(8), "big"), 16
            if kind == b"moov":
                return file.read(min(max(size - skipped, 0), _MAX_MOVIE_BYTES))
            if size < skipped:  # to the end of the file, or damaged
                break
            file.seek(size - skipped, 1)
    return b""
