"""Pinhole cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gsmap.errors import InputError
from gsmap.types.tensors import to_tensor


@dataclass(frozen=True)
class CameraModel:
    """A camera model of COLMAP with its parameters; `gsmap.geometry.camera_models` projects with it.

    Args:
        name: one of COLMAP's 18 models, such as ``OPENCV_FISHEYE`` or ``EQUIRECTANGULAR``.
        size_px: width and height of the photo.
        params: parameters in COLMAP's order.
    """

    name: str
    size_px: tuple[int, int]
    params: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class PhotoLens:
    """The photo of which a pinhole camera shows the undistorted content, or a part of it.

    Args:
        photo: name of the photo.
        model: the lens that took it.
        R_photo_camera: (3, 3) rotation from the pinhole camera to the camera of the photo; both have one centre.
    """

    photo: str
    model: CameraModel
    R_photo_camera: np.ndarray


@dataclass(frozen=True, eq=False)
class Cameras:
    """A set of C undistorted pinhole cameras (OpenCV axes: x right, y down, z forward; pixel centres at +0.5).

    Args:
        T_frame_camera: (C, 4, 4) float64, camera-to-frame (the camera's centre is the last column).
        intrinsics_px: (C, 4) float64 ``fx fy cx cy``, in pixels of an image of ``sizes_px``.
        sizes_px: (C, 2) int64 ``width height``.
        names: C image names, unique; ids as text where the source has none.
        synthesised: true if gsmap synthesized the cameras because the source had none.
        notes: remarks on how they were read, such as lenses that are not pinholes; not copied to derived cameras.
        lenses: the photo of each camera and its lens, None where the camera is that of the photo; empty if all are.

    Raises:
        InputError: wrong shapes, NaN, a pose that is not rigid, a focal length or image size that is not positive.
    """

    T_frame_camera: np.ndarray
    intrinsics_px: np.ndarray
    sizes_px: np.ndarray
    names: tuple[str, ...] = ()
    synthesised: bool = False
    notes: tuple[str, ...] = ()
    lenses: tuple[PhotoLens | None, ...] = ()

    def __post_init__(self) -> None:
        pose = np.ascontiguousarray(self.T_frame_camera, dtype=np.float64)
        intrinsics = np.ascontiguousarray(self.intrinsics_px, dtype=np.float64)
        sizes = np.ascontiguousarray(self.sizes_px, dtype=np.int64)
        count = pose.shape[0] if pose.ndim == 3 else 0
        if pose.shape != (count, 4, 4) or intrinsics.shape != (count, 4) or sizes.shape != (count, 2):
            raise InputError(
                "Cameras need poses (C, 4, 4), intrinsics (C, 4) and sizes (C, 2), "
                f"got {pose.shape}, {intrinsics.shape}, {sizes.shape}",
                code="shape_mismatch",
            )
        names = tuple(str(n) for n in self.names) or tuple(str(i) for i in range(count))
        if len(names) != count:
            raise InputError(f"{count} cameras but {len(names)} names", code="shape_mismatch")
        if self.lenses and len(self.lenses) != count:
            raise InputError(f"{count} cameras but {len(self.lenses)} lenses", code="shape_mismatch")
        bad = ~(np.isfinite(pose).all((1, 2)) & np.isfinite(intrinsics).all(1))
        if bad.any():
            raise InputError(f"camera {names[int(np.argmax(bad))]} holds NaN or infinity", code="not_finite")
        rotation = pose[:, :3, :3]
        off = np.abs(rotation @ rotation.transpose(0, 2, 1) - np.eye(3)).max((1, 2), initial=0) > 1e-3
        off |= np.linalg.det(rotation) < 0
        off |= np.abs(pose[:, 3] - [0, 0, 0, 1]).max(1, initial=0) > 1e-6
        if off.any():
            raise InputError(
                f"camera {names[int(np.argmax(off))]} has a pose that is not a rigid transform", code="invalid_camera"
            )
        off = (intrinsics[:, :2] <= 0).any(1) | (sizes <= 0).any(1)
        if off.any():
            raise InputError(
                f"camera {names[int(np.argmax(off))]} has a focal length or image size that is not positive",
                code="invalid_camera",
            )
        object.__setattr__(self, "T_frame_camera", pose)
        object.__setattr__(self, "intrinsics_px", intrinsics)
        object.__setattr__(self, "sizes_px", sizes)
        object.__setattr__(self, "names", names)

    def __len__(self) -> int:
        return len(self.T_frame_camera)

    @property
    def centers(self) -> np.ndarray:
        """Camera centres (C, 3) in the frame."""
        return self.T_frame_camera[:, :3, 3]

    @property
    def T_camera_frame(self) -> np.ndarray:
        """View matrices (C, 4, 4), which map points from the frame to each camera."""
        rotation = self.T_frame_camera[:, :3, :3].transpose(0, 2, 1)
        out = np.tile(np.eye(4), (len(self), 1, 1))
        out[:, :3, :3] = rotation
        out[:, :3, 3] = -np.einsum("cij,cj->ci", rotation, self.centers)
        return out

    @property
    def photo_rows(self) -> dict[str, list[int]]:
        """Rows of the cameras of each photo by its name; a panorama has several."""
        out: dict[str, list[int]] = {}
        lenses = self.lenses or (None,) * len(self)
        for row, (name, lens) in enumerate(zip(self.names, lenses, strict=True)):
            out.setdefault(name if lens is None else lens.photo, []).append(row)
        return out

    @property
    def K(self) -> np.ndarray:
        """Calibration matrices (C, 3, 3)."""
        out = np.tile(np.eye(3), (len(self), 1, 1))
        out[:, 0, 0], out[:, 1, 1] = self.intrinsics_px[:, 0], self.intrinsics_px[:, 1]
        out[:, 0, 2], out[:, 1, 2] = self.intrinsics_px[:, 2], self.intrinsics_px[:, 3]
        return out

    def to_gsplat(self, device: str = "cpu") -> dict[str, Any]:
        """Return the cameras as arguments of `gsplat.rasterization`: ``viewmats`` (C, 4, 4), ``Ks`` (C, 3, 3),
        ``width`` and ``height``.

        Raises:
            InputError: no cameras, or images of several sizes: take one with ``cameras[i]``.
            MissingDependencyError: torch is not installed.
        """
        if len(np.unique(self.sizes_px, axis=0)) != 1:
            raise InputError(
                "gsplat renders images of one size at once: take cameras of one size, such as cameras[0]",
                code="shape_mismatch",
            )
        width, height = self.sizes_px[0].tolist()
        arrays = {"viewmats": self.T_camera_frame, "Ks": self.K}
        return {name: to_tensor(array, device) for name, array in arrays.items()} | {"width": width, "height": height}

    def __getitem__(self, index: int | slice | Sequence[int] | np.ndarray) -> Cameras:
        """Return the cameras at an index, slice, boolean mask or integer array as a `Cameras`, also for one index."""
        rows = np.atleast_1d(np.arange(len(self))[index])
        return replace(
            self,
            T_frame_camera=self.T_frame_camera[rows],
            intrinsics_px=self.intrinsics_px[rows],
            sizes_px=self.sizes_px[rows],
            names=tuple(self.names[i] for i in rows),
            notes=(),
            lenses=tuple(self.lenses[i] for i in rows) if self.lenses else (),
        )

    @classmethod
    def concatenate(cls, parts: Sequence[Cameras], notes: tuple[str, ...] = ()) -> Cameras:
        """Concatenate cameras in order; their names must differ."""
        if not parts:
            return cls(np.zeros((0, 4, 4)), np.zeros((0, 4)), np.zeros((0, 2)), notes=notes)
        lenses = [lens for part in parts for lens in part.lenses or (None,) * len(part)]
        return cls(
            np.concatenate([part.T_frame_camera for part in parts]),
            np.concatenate([part.intrinsics_px for part in parts]),
            np.concatenate([part.sizes_px for part in parts]),
            tuple(name for part in parts for name in part.names),
            any(part.synthesised for part in parts),
            notes,
            tuple(lenses) if any(lens is not None for lens in lenses) else (),
        )

    def evenly(self, count: int) -> Cameras:
        """Return at most ``count`` cameras, evenly spaced along the capture, in the order of the capture."""
        if len(self) <= count:
            return self
        return self[np.linspace(0, len(self) - 1, count).round().astype(int)]

    def resized(self, longest_side_px: int) -> Cameras:
        """Return the same cameras with images downscaled to at most ``longest_side_px`` pixels on the longer side."""
        factor = np.minimum(1.0, longest_side_px / self.sizes_px.max(1))
        sizes = np.maximum(1, np.round(self.sizes_px * factor[:, None])).astype(np.int64)
        # Scale by the rounded sizes, so that the principal point stays at the same place of the image.
        ratio = sizes / self.sizes_px
        intrinsics = self.intrinsics_px * np.concatenate([ratio, ratio], axis=1)
        return replace(self, intrinsics_px=intrinsics, sizes_px=sizes, notes=())

    def __repr__(self) -> str:
        return f"Cameras(n={len(self)}{', synthesised' if self.synthesised else ''})"
