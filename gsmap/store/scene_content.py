"""Scenes as the catalog's rows and as arrays on disk."""

from __future__ import annotations

from typing import Any

import numpy as np
from sqlalchemy import Row

from gsmap.errors import InputError
from gsmap.store import compact
from gsmap.store.arrays import digest
from gsmap.store.layout import Shape
from gsmap.types import Cameras, Gaussians, Scene, Thinning

GAUSSIANS = ("means", "quats", "log_scales", "logit_opacities", "sh")


def scene_id(gaussians: Gaussians, cameras: Cameras) -> str:
    """32 hex digits of content: the same Gaussians and cameras have the same id in every map."""
    arrays = [getattr(gaussians, name) for name in GAUSSIANS]
    views = [cameras.T_frame_camera, cameras.intrinsics_px, cameras.sizes_px]
    return digest(*arrays, *views, text="\n".join(cameras.names))


def scene_of(row: Row[Any], tags: tuple[str, ...]) -> Scene:
    """A scene from its row."""
    return Scene(
        id=row.id,
        name=row.name,
        num_gaussians=row.num_gaussians,
        sh_degree=row.sh_degree,
        num_cameras=row.num_cameras,
        bounds=np.array(row.bounds),
        scale_policy=row.scale_policy,
        captured_at=row.captured_at,
        ingested_at=row.ingested_at,
        source=row.source,
        cameras_synthesised=bool(row.cameras_synthesised),
        antialiased=bool(row.antialiased),
        tags=tags,
        thinning=_thinning(row),
    )


def _thinning(row: Row[Any]) -> Thinning | None:
    if row.thinned is None:
        return None
    up = row.thinned["up"]
    return Thinning(row.thinned["at"], row.thinned["num_gaussians"], None if up is None else tuple(up))


def shapes_of(row: Row[Any]) -> dict[str, Shape]:
    """What a scene's row says of its arrays."""
    n, c = row.num_gaussians, row.num_cameras
    shapes: dict[str, Shape] = {
        "means": (n, 3),
        "quats": (n, 4),
        "log_scales": (n, 3),
        "logit_opacities": (n,),
        "sh": (n, (row.sh_degree + 1) ** 2, 3),
    }
    if row.thinned is not None:
        shapes = compact.shapes(n, row.sh_degree)
    shapes |= {
        "cameras.T_frame_camera": (c, 4, 4),
        "cameras.intrinsics_px": (c, 4),
        "cameras.sizes_px": (c, 2),
        "cameras.names": (None,),
    }
    return shapes


def to_arrays(gaussians: Gaussians, cameras: Cameras) -> dict[str, np.ndarray]:
    """What is written of a scene, by the names of its arrays."""
    return {name: getattr(gaussians, name) for name in GAUSSIANS} | camera_arrays(cameras)


def camera_arrays(cameras: Cameras) -> dict[str, np.ndarray]:
    """As `to_arrays`, of its cameras alone."""
    for name in cameras.names:
        if "\n" in name:
            raise InputError(f"camera name {name!r} has a line break")
    return {
        "cameras.T_frame_camera": cameras.T_frame_camera,
        "cameras.intrinsics_px": cameras.intrinsics_px,
        "cameras.sizes_px": cameras.sizes_px,
        "cameras.names": np.frombuffer("\n".join(cameras.names).encode(), np.uint8),
    }
