"""Render the scenes of the map from a candidate pose of a photo."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gsmap.geometry.projection import project
from gsmap.localize import displacement, features
from gsmap.localize.map_scene import MapScene

GREY = np.array([0.299, 0.587, 0.114], np.float32)
"""Weights of red, green and blue in a grey value (Rec. 601)."""

_STRIDE_PX = 12  # spacing of the rows and columns at which the motion of a render is measured
_MOTION_QUANTILE = 0.9


def downsample(image: np.ndarray, by: int) -> np.ndarray:
    """Return (H // by, W // by, ...) float32 means of blocks of an image (H, W, ...)."""
    height, width = (n // by for n in image.shape[:2])
    rows = image[: height * by, : width * by].reshape(height, by, -1).sum(1, dtype=np.float32)  # whole rows: faster
    out: np.ndarray = rows.reshape(height, width, by, *image.shape[2:]).sum(2) / np.float32(by * by)
    return out


def downsample_mask(mask: np.ndarray | None, by: int) -> np.ndarray | None:
    """Return the (H // by, W // by) mask of blocks in which a mask (H, W) is True everywhere; None if the mask is
    None."""
    return None if mask is None else downsample(mask, by) == 1


def sample_mask(mask: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Return the (K,) values of a mask (H, W) at pixels (K, 2); pixels outside get the value at the edge."""
    column, row = np.clip(pixels, 0, np.array(mask.shape[1::-1]) - 1).astype(np.int64).T
    out: np.ndarray = mask[row, column]
    return out


@dataclass(frozen=True, eq=False)
class SceneRender:
    """A render of one scene from a camera of the map.

    Args:
        scene: id of the scene.
        rgb: (H, W, 3) float32 in [0, 1].
        grey: (H, W) float32.
        alpha: (H, W) float32.
        depth_m: (H, W) float32 along the axis, 0 where nothing is rendered.
        smooth: (H, W) mask of pixels that are opaque and away from depth edges.
        T_metric_camera: (4, 4) camera-to-component, metres.
        intrinsics_px: (4,) intrinsics at this size.
        displacement: (R, C, 2) displacement map (`gsmap.localize.displacement`), or None.
    """

    scene: str
    rgb: np.ndarray
    grey: np.ndarray
    alpha: np.ndarray
    depth_m: np.ndarray
    smooth: np.ndarray
    T_metric_camera: np.ndarray
    intrinsics_px: np.ndarray
    displacement: np.ndarray | None = None

    @property
    def size_px(self) -> tuple[int, int]:
        return self.depth_m.shape[1], self.depth_m.shape[0]

    def downsampled(self, by: int) -> SceneRender:
        """Return the render at a smaller size; all pixels with content count as smooth."""
        alpha = downsample(self.alpha, by)
        rgb, grey, depth = (downsample(image, by) for image in (self.rgb, self.grey, self.depth_m))
        return SceneRender(
            self.scene, rgb, grey, alpha, depth, alpha > 0, self.T_metric_camera, self.intrinsics_px / by
        )

    def points(self, pixels: np.ndarray) -> np.ndarray:
        """Return the (K, 3) positions of pixels (K, 2) in the component's frame, in metres."""
        column, row = pixels.astype(np.int64).T
        z = self.depth_m[row, column].astype(np.float64)
        fx, fy, cx, cy = self.intrinsics_px
        local = np.stack([(pixels[:, 0] - cx) / fx * z, (pixels[:, 1] - cy) / fy * z, z], axis=1)
        out: np.ndarray = local @ self.T_metric_camera[:3, :3].T + self.T_metric_camera[:3, 3]
        return out

    def displaced_px(self, pixels: np.ndarray) -> np.ndarray:
        """Return the (K, 2) displacements of the content of pixels (K, 2); 0 without a displacement map."""
        if self.displacement is None:
            return np.zeros((len(pixels), 2))
        rows, columns = self.displacement.shape[:2]
        height, width = self.depth_m.shape
        column = np.minimum(pixels[:, 0] / width * columns, columns - 1).astype(np.int64)
        row = np.minimum(pixels[:, 1] / height * rows, rows - 1).astype(np.int64)
        out: np.ndarray = self.displacement[row, column]
        return out

    def corrected_points(self, pixels: np.ndarray) -> np.ndarray:
        """Return the (K, 3) positions of the content of pixels (K, 2), with the displacement undone."""
        limit = np.array(self.depth_m.shape[1::-1]) - 1e-3
        return self.points(np.clip(pixels + self.displaced_px(pixels), 0, limit))

    def motion_px(self, T_metric_camera: np.ndarray, intrinsics_px: np.ndarray) -> float:
        """Return the motion of the content in pixels if the camera moves to another pose (90th percentile); inf for an
        empty render."""
        row, column = np.nonzero(self.alpha[::_STRIDE_PX, ::_STRIDE_PX] > 0.5)
        if not len(row):
            return np.inf
        pixels = np.stack([column, row], axis=1) * float(_STRIDE_PX) + 0.5
        at, depth = project(self.points(pixels), np.linalg.inv(T_metric_camera), intrinsics_px)
        return float(np.quantile(np.where(depth > 0, np.linalg.norm(at - pixels, axis=1), 1e9), _MOTION_QUANTILE))


def render_scenes(
    scenes: Sequence[MapScene],
    T_metric_camera: np.ndarray,
    intrinsics_px: np.ndarray,
    size_px: tuple[int, int],
    previous: Sequence[SceneRender] = (),
    max_motion_px: float = 0.0,
    *,
    with_displacement: bool = False,
) -> list[SceneRender]:
    """Render every scene by itself from one camera, because two captures in one render blur each other.

    Args:
        previous: renders of any size; those of this size whose content moved by at most ``max_motion_px`` are reused.
        with_displacement: also compute the displacement map of each render.
    """
    reused = {
        one.scene: one
        for one in previous
        if one.size_px == size_px and one.motion_px(T_metric_camera, intrinsics_px) <= max_motion_px
    }
    out = []
    for one in scenes:
        if one.scene in reused:
            out.append(reused[one.scene])
            continue
        camera = one.camera(T_metric_camera, intrinsics_px, size_px)
        rendered = one.render(camera, with_centres=with_displacement)
        rgb = np.clip(np.nan_to_num(rendered.colour[0]), 0, 1)
        depth = rendered.depth[0] * np.float32(one.S_metric_scene.scale)
        smooth = features.smooth_depth(rendered) > 0
        moved = displacement.displacement_map(rendered) if with_displacement else None
        alpha = rendered.alpha[0]
        out.append(SceneRender(one.scene, rgb, rgb @ GREY, alpha, depth, smooth, T_metric_camera, intrinsics_px, moved))
    return out
