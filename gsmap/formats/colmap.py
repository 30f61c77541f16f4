"""Read COLMAP models (the files ``cameras`` and ``images``, text or binary), and write them as text.

``points3D``, ``rigs`` and ``frames`` are not needed.
pycolmap knows the camera models; the two files are walked here, because its readers hang on a truncated one.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from gsmap.durable import write_text_output
from gsmap.errors import InputError, NotFoundError
from gsmap.formats.camera_files import unique
from gsmap.formats.lenses import photo_cameras, pinhole_cameras
from gsmap.geometry.camera_models import camera_model, require_pycolmap
from gsmap.geometry.rotations import matrices_to_quats, quats_to_matrices
from gsmap.types import Cameras
from gsmap.types.cameras import CameraModel

_PLACES = ("", "sparse/0", "sparse", "0", "colmap/sparse/0")


def find_model(folder: Path) -> Path | None:
    """Return the folder with a model's files (``folder``, its ``sparse/0`` or ``sparse``); None without a model."""
    for place in _PLACES:
        for suffix in ("bin", "txt"):
            if all((folder / place / f"{name}.{suffix}").is_file() for name in ("cameras", "images")):
                return folder / place
    return None


def read(folder: str | os.PathLike[str]) -> Cameras:
    """Read the cameras of a model, sorted by image name, with poses in COLMAP's world frame.

    Photos of other lenses than pinholes are seen through pinholes: ``notes`` say so (`gsmap.formats.lenses`).

    Raises:
        InputError: Damaged, or without images.
    """
    from scipy.spatial.transform import Rotation

    folder = Path(folder)
    binary = (folder / "images.bin").is_file() and (folder / "cameras.bin").is_file()
    try:
        if binary:
            calibrations: dict[int, CameraModel] = dict(_binary_cameras((folder / "cameras.bin").read_bytes()))
            images = sorted(_binary_images((folder / "images.bin").read_bytes()))
        else:
            calibrations = dict(_text_cameras((folder / "cameras.txt").read_text(errors="replace")))
            images = sorted(_text_images((folder / "images.txt").read_text(errors="replace")))
        if not images:
            raise InputError(f"{folder} holds no cameras: its list of images is empty", code="no_cameras")
        names = unique([name for name, _, _ in images])
        quats, translations = np.split(np.array([pose for _, pose, _ in images]), [4], axis=1)
        R_frame_camera = Rotation.from_quat(quats[:, [1, 2, 3, 0]]).inv().as_matrix()
        chosen = [calibrations[camera] for _, _, camera in images]
    except KeyError as error:
        raise InputError(
            f"{folder}: an image refers to camera {error}, which the model does not have", code="file_damaged"
        ) from error
    except (ValueError, RuntimeError, struct.error) as error:  # RuntimeError: pycolmap does not know the model
        if isinstance(error, InputError):
            raise
        raise InputError(
            f"{folder} is not a readable COLMAP model (truncated?): {error}", code="file_truncated"
        ) from error
    pose = np.tile(np.eye(4), (len(images), 1, 1))
    pose[:, :3, :3] = R_frame_camera
    pose[:, :3, 3] = -np.einsum("cij,cj->ci", R_frame_camera, translations)
    return pinhole_cameras(pose, chosen, names, folder)


def write(folder: str | os.PathLike[str], cameras: Cameras) -> None:
    """Write cameras as a COLMAP model in text, without points: ``cameras.txt``, ``images.txt``, ``points3D.txt``.

    Poses are in the cameras' own frame; images are the photos with their lenses, numbered from 1 in their order, and
    those of equal lenses share a camera. White space in a name becomes ``_``: COLMAP's text format ends a name there.

    Raises:
        InputError: The folder holds a binary model, which programs would read instead.
        NotFoundError: The parent folder is missing.
    """
    folder = Path(folder)
    if (folder / "cameras.bin").exists() or (folder / "images.bin").exists():
        raise InputError(
            f"{folder} holds a binary COLMAP model, which readers would prefer to the text model: write to another "
            "folder",
            code="binary_model_in_the_way",
        )
    if not folder.parent.is_dir():
        raise NotFoundError(f"cannot write {folder}: no such folder: {folder.parent}", code="folder_not_found")
    calibrations: dict[CameraModel, int] = {}
    photos, poses, models = photo_cameras(cameras)
    images = ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME", "# POINTS2D[] as X Y POINT3D_ID"]
    quats = matrices_to_quats(poses[:, :3, :3].transpose(0, 2, 1))
    # With the rotation that the quaternion says, so that the centre stays where it is.
    translations = -np.einsum("cij,cj->ci", quats_to_matrices(quats), poses[:, :3, 3])
    names = unique(["_".join(name.split()) or "_" for name in photos])
    for i, name in enumerate(names):
        camera = calibrations.setdefault(models[i], len(calibrations) + 1)
        pose = " ".join(repr(value) for value in (*quats[i].tolist(), *translations[i].tolist()))
        images += [f"{i + 1} {pose} {camera} {name}", ""]
    lines = ["# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]"]
    for model, camera in calibrations.items():
        lines.append(f"{camera} {model.name} {' '.join(map(repr, (*model.size_px, *model.params)))}")
    folder.mkdir(exist_ok=True)
    _write_lines(folder / "cameras.txt", lines)
    _write_lines(folder / "points3D.txt", ["# POINT3D_ID X Y Z R G B ERROR TRACK[] as IMAGE_ID POINT2D_IDX"])
    _write_lines(folder / "images.txt", images)


def _write_lines(path: Path, lines: list[str]) -> None:
    text = "\n".join(lines) + "\n"
    write_text_output(path, text)


def _binary_cameras(data: bytes) -> Iterator[tuple[int, CameraModel]]:
    pycolmap = require_pycolmap()
    (count,) = struct.unpack_from("<Q", data)
    offset = 8
    for _ in range(count):
        camera_id, model_id, width, height = struct.unpack_from("<IiQQ", data, offset)
        model = pycolmap.CameraModelId(model_id)
        num_params = len(pycolmap.Camera.create_from_model_id(1, model, 1.0, 1, 1).params)
        params = struct.unpack_from(f"<{num_params}d", data, offset + 24)
        offset += 24 + 8 * num_params
        yield camera_id, camera_model(model, width, height, params)


def _binary_images(data: bytes) -> Iterator[tuple[str, tuple[float, ...], int]]:
    (count,) = struct.unpack_from("<Q", data)
    offset = 8
    for _ in range(count):
        _, *pose, camera_id = struct.unpack_from("<I7dI", data, offset)
        end = data.index(b"\0", offset + 64)
        (num_points,) = struct.unpack_from("<Q", data, end + 1)
        yield data[offset + 64 : end].decode("utf-8", "replace"), tuple(pose), camera_id
        offset = end + 9 + 24 * num_points
        if offset > len(data):
            raise ValueError(f"images.bin ends before the last of its {count} images")


def _text_cameras(text: str) -> Iterator[tuple[int, CameraModel]]:
    for line in text.splitlines():
        if line.strip() and not line.startswith("#"):
            camera_id, model, width, height, *params = line.split()
            yield int(camera_id), camera_model(model, int(width), int(height), tuple(float(p) for p in params))


def _text_images(text: str) -> Iterator[tuple[str, tuple[float, ...], int]]:
    lines = [line for line in text.splitlines() if not line.startswith("#")]
    while lines and not lines[0].strip():
        lines.pop(0)
    for line in lines[::2]:  # every second line lists 2D points, and may be empty
        if line.strip():
            _, *pose, camera_id, name = line.split(maxsplit=9)
            yield name, tuple(float(v) for v in pose), int(camera_id)
