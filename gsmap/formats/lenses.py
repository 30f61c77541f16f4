"""View the photos of camera files through pinholes, whatever their lens, and say so in notes; and the reverse."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gsmap.errors import NotPinholesError
from gsmap.geometry.camera_models import pinhole_of, pinhole_views
from gsmap.types import Cameras
from gsmap.types.cameras import CameraModel


def photo_cameras(cameras: Cameras) -> tuple[list[str], np.ndarray, list[CameraModel]]:
    """Return the names of the P photos that cameras show, their camera-to-frame poses (P, 4, 4) and their lenses."""
    rows = [rows[0] for rows in cameras.photo_rows.values()]
    poses, models = cameras.T_frame_camera[rows], []
    for pose, row in zip(poses, rows, strict=True):
        lens = cameras.lenses[row] if cameras.lenses else None
        if lens is None:
            width, height = cameras.sizes_px[row].tolist()
            models.append(CameraModel("PINHOLE", (width, height), tuple(cameras.intrinsics_px[row].tolist())))
        else:
            pose[:3, :3] = pose[:3, :3] @ lens.R_photo_camera.T
            models.append(lens.model)
    return list(cameras.photo_rows), poses, models


def pinhole_cameras(
    poses: np.ndarray, models: Sequence[CameraModel | str], names: Sequence[str], where: object
) -> Cameras:
    """Return the pinhole cameras by which photos are seen, with notes on lenses that are no pinholes.

    Args:
        poses: (C, 4, 4) camera-to-frame poses of the photos.
        models: lens of each photo; the name of its model where gsmap cannot project with it, and the photo is left out.
        names: of the photos, unique.
        where: file or folder of the cameras, for messages.

    Raises:
        NotPinholesError: gsmap can project with no lens.
    """
    parts, notes = [], []
    for pose, model, name in zip(poses, models, names, strict=True):
        if isinstance(model, CameraModel):
            parts.append(pinhole_views(model, pose, name))
    for kind in sorted({model if isinstance(model, str) else model.name for model in models}):
        known = [model for model in models if isinstance(model, CameraModel) and model.name == kind]
        shown = [part for part in parts if part.lenses and part.lenses[0] and part.lenses[0].model.name == kind]
        bent = sum(list(part.photo_rows) == list(part.names) for part in shown)
        if bent:
            shift = max(shift for model in known if np.isfinite(shift := pinhole_of(model)[1]))
            notes.append(
                f"{bent} of {len(models)} cameras have distortion ({kind}) of up to {shift:.3g} px at the corners: "
                "they are shown undistorted, and pixels of their photos are undistorted"
            )
        if len(shown) > bent:
            notes.append(
                f"{len(shown) - bent} of {len(models)} cameras are too wide for one pinhole ({kind}): each is shown by "
                "up to six pinhole faces of 90 degrees"
            )
        if left_out := sum(model == kind for model in models):
            notes.append(
                f"{left_out} of {len(models)} cameras are left out, as gsmap does not know their lens ({kind}): "
                "undistort the images (colmap image_undistorter), or split panoramas into pinhole views, and give "
                "their cameras"
            )
    if models and not parts:
        raise NotPinholesError(f"{where}: {'; '.join(notes)}")
    return Cameras.concatenate(parts, notes=tuple(notes))
