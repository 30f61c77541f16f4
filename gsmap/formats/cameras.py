"""Camera files and folders: ``cameras.json``, ``transforms.json`` and COLMAP models."""

from __future__ import annotations

import os
from pathlib import Path

from gsmap.errors import MALFORMED, GsmapError, InputError
from gsmap.formats import cameras_json, colmap, nerfstudio
from gsmap.formats.camera_files import load_json
from gsmap.types import Cameras


def read(path: str | os.PathLike[str]) -> Cameras:
    """Read a ``cameras.json`` (INRIA), a ``transforms.json`` (nerfstudio, instant-ngp), or a COLMAP model folder.

    A folder may be the model itself, or hold ``sparse/0``, ``sparse`` or ``transforms.json``. A file
    ``dataparser_transforms.json`` beside ``transforms.json`` is applied. Frames: the Gaussians' own.

    Raises:
        NotFoundError: The file or folder is missing.
        NotPinholesError: Lenses that gsmap does not know.
        InputError: Another format, or damaged.
    """
    path = Path(path)
    try:
        if path.is_dir():
            model = colmap.find_model(path)
            if model is not None:
                return colmap.read(model)
            if not (path / "transforms.json").is_file():
                raise InputError(
                    f"{path} holds no cameras: the folder has no COLMAP model (cameras.bin/.txt) and no "
                    "transforms.json",
                    code="no_cameras",
                )
            path = path / "transforms.json"
        content = load_json(path)
        return cameras_json.parse(content, path) if isinstance(content, list) else nerfstudio.parse(content, path)
    except OSError as error:
        raise InputError(
            f"cannot read cameras from {path}: {error.strerror or error}", code="file_unreadable"
        ) from error
    except MALFORMED as error:
        if isinstance(error, GsmapError) and str(path) in str(error):
            raise
        what = f"lacks {error}" if isinstance(error, KeyError) else str(error)
        raise InputError(f"{path} is not a camera file: {what}", code="invalid_cameras") from error
