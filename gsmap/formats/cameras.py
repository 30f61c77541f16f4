"""Camera files and folders of trainers, photogrammetry programs and phone scanners."""

from __future__ import annotations

import os
from pathlib import Path

from gsmap.errors import MALFORMED, GsmapError, InputError
from gsmap.formats import cameras_json, colmap, metashape, nerfstudio, opf, phone_scans
from gsmap.formats.camera_files import load_json
from gsmap.types import Cameras

_NAMES = ("cameras.json", "transforms.json", "cameras.xml", "metadata.json")


def find(folder: Path) -> Path | None:
    """Return the file or folder with the cameras of the captures in a folder; None without one that gsmap reads."""
    for name in _NAMES[:2]:
        if (folder / name).is_file():
            return folder / name
    if (model := colmap.find_model(folder)) is not None:
        return model
    for name in _NAMES[2:]:
        if (folder / name).is_file() and (name != "metadata.json" or _is_record3d(folder / name)):
            return folder / name
    projects = sorted(folder.glob("*.opf"))
    if len(projects) == 1:
        return projects[0]
    for name in phone_scans.POLYCAM:
        if any((folder / name).glob("*.json")):
            return folder / name
    return folder if all((folder / name).is_file() for name in phone_scans.STRAY) else None


def is_of_trainer(path: Path) -> bool:
    """Return true for camera files of trainers: ``cameras.json``, ``transforms.json`` and COLMAP models."""
    if path.is_dir():
        return colmap.find_model(path) is not None
    return path.suffix.lower() == ".json" and path.name != "metadata.json"


def read(path: str | os.PathLike[str]) -> Cameras:
    """Read the cameras of a file or a folder, in the frame of the Gaussians beside it.

    Files: ``cameras.json`` (INRIA), ``transforms.json`` (nerfstudio, instant-ngp; ``dataparser_transforms.json`` beside
    it is applied), ``.xml`` of Metashape, ``.opf`` projects, ``metadata.json`` of Record3D. Folders: a COLMAP model,
    ``corrected_cameras`` of Polycam, a scan of Stray Scanner, or one with any of these in it (`find`).

    Raises:
        NotFoundError: The file or folder is missing.
        NotPinholesError: Lenses that gsmap does not know.
        InputError: Another format, or damaged.
    """
    path = Path(path)
    try:
        return _read(path)
    except OSError as error:
        raise InputError(
            f"cannot read cameras from {path}: {error.strerror or error}", code="file_unreadable"
        ) from error
    except MALFORMED as error:
        if isinstance(error, GsmapError) and str(path) in str(error):
            raise
        what = f"lacks {error}" if isinstance(error, KeyError) else str(error)
        raise InputError(f"{path} is not a camera file: {what}", code="invalid_cameras") from error


def _read(path: Path) -> Cameras:
    if path.is_dir():
        if (model := colmap.find_model(path)) is not None:
            return colmap.read(model)
        found = find(path)
        if found is None and path.name in {name.rpartition("/")[2] for name in phone_scans.POLYCAM}:
            return phone_scans.read_polycam(path)
        if found is None:
            raise InputError(
                f"{path} holds no cameras: the folder has no COLMAP model (cameras.bin/.txt), no transforms.json, no "
                "cameras.xml of Metashape, no .opf project and no scan of Polycam, Record3D or Stray Scanner",
                code="no_cameras",
            )
        return phone_scans.read_stray(path) if found == path else _read(found)
    if path.suffix.lower() == ".xml":
        return metashape.read(path)
    if path.suffix.lower() == ".opf":
        return opf.read(path)
    content = load_json(path)
    if isinstance(content, list):
        return cameras_json.parse(content, path)
    if "poses" in content and "K" in content:
        return phone_scans.parse_record3d(content, path)
    return nerfstudio.parse(content, path)


def _is_record3d(path: Path) -> bool:
    try:
        content = load_json(path)
    except GsmapError:
        return False
    return isinstance(content, dict) and {"poses", "K", "w", "h"} <= content.keys()
