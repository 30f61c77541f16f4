"""Draw top views of a component with a transparent background, for floor plans."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence

import numpy as np

from gsmap.geometry.transforms import transform_gaussians
from gsmap.report.plan import Plan
from gsmap.types import Cameras, Gaussians, Sim3

_FAR = 60.0  # height of the camera in sizes of the plan: rays are parallel to within a degree
_ABOVE_EYES = 0.3  # height shown above the cameras, as a fraction of their height above the floor
_FINER = 1.6  # supersampling factor of renders
_INK = 128


def top_picture(parts: Sequence[tuple[Gaussians, Sim3]], plan: Plan, eyes: np.ndarray, longest_px: int) -> bytes:
    """Render Gaussians from above without ceilings, as WebP that fills the bounds of the plan.

    Args:
        parts: Gaussians of each scene in its own frame, and its pose ``S_map_scene``.
        plan: The floor plan.
        eyes: (T, 3) camera centres in the component frame; Gaussians well above them are left out.
        longest_px: Longer side of the picture in pixels.
    """
    from PIL import Image

    from gsmap.render import render

    S_plan_map = Sim3(plan.R_plan_map, np.zeros(3), plan.metres_per_unit)
    placed = Gaussians.concatenate([transform_gaussians(part.degree_0(), S_plan_map @ S) for part, S in parts])
    (low, high), means = plan.bounds, placed.means
    with np.errstate(invalid="ignore"):
        shown = np.isfinite(means).all(1) & (means[:, :2] > low).all(1) & (means[:, :2] < high).all(1)
        shown &= placed.scales.max(1, initial=0) < 0.25 * float((high - low).max())  # fog
        if len(eyes) and shown.any():
            heights = plan.place(eyes)[:, 2]
            floor = float(np.quantile(means[shown, 2], 0.02))
            eye = float(np.median(heights))
            shown &= means[:, 2] < eye + _ABOVE_EYES * max(eye - floor, 0.0)
    if not shown.any():
        return b""
    placed = placed[shown]
    image = render(placed, _camera(plan, placed.means[:, 2], longest_px), depth=False, dominant_id=False)
    alpha = np.clip(np.nan_to_num(image.alpha[0]), 0, 1)
    colour = np.nan_to_num(image.colour[0]) / np.maximum(alpha, 1e-3)[..., None]
    rgba = np.concatenate([np.clip(colour, 0, 1), alpha[..., None]], axis=-1)
    picture = Image.fromarray((rgba * 255 + 0.5).astype(np.uint8), "RGBA")
    return _webp(picture.resize(_size_px(plan, longest_px), Image.Resampling.LANCZOS))


def density_picture(points: np.ndarray, plan: Plan, longest_px: int) -> bytes:
    """Draw points (K, 3) from above, darker where they are denser; return a WebP as `top_picture` does."""
    from PIL import Image

    width, height = _size_px(plan, longest_px // 3)
    flat = plan.place(points)[:, :2]
    edges = [np.linspace(plan.bounds[0, k], plan.bounds[1, k], size + 1) for k, size in enumerate((width, height))]
    counts = np.histogram2d(flat[:, 0], flat[:, 1], bins=edges)[0].T[::-1]
    if not counts.any():
        return b""
    shade = np.clip(np.log1p(counts) / np.log1p(np.quantile(counts[counts > 0], 0.98) + 1), 0, 1)
    rgba = np.full((*counts.shape, 4), _INK, np.uint8)
    rgba[..., 3] = (200 * shade + 0.5).astype(np.uint8)
    return _webp(Image.fromarray(rgba, "RGBA"))


def picture_webp(picture: np.ndarray) -> bytes:
    """Encode a picture (H, W, 3) uint8 as WebP."""
    from PIL import Image

    return _webp(Image.fromarray(picture))


def data_address(webp: bytes) -> str:
    """Return the address that embeds a WebP in a page."""
    return f"data:image/webp;base64,{base64.b64encode(webp).decode()}"


def _camera(plan: Plan, heights: np.ndarray, longest_px: int) -> Cameras:
    """Return a camera far above the centre of the plan that looks down, with y up the page."""
    size = np.array(_size_px(plan, round(_FINER * longest_px)))
    (low, high), far = plan.bounds, _FAR * float((plan.bounds[1] - plan.bounds[0]).max())
    pose = np.eye(4)
    pose[:3, :3] = np.diag([1.0, -1.0, -1.0])
    pose[:3, 3] = [*((low + high) / 2), float(np.median(heights)) + far]
    fx, fy = size / (high - low) * far
    return Cameras(pose[None], np.array([[fx, fy, size[0] / 2, size[1] / 2]]), size[None])


def _size_px(plan: Plan, longest_px: int) -> tuple[int, int]:
    """Return the width and height of a picture that fills the plan."""
    span = plan.bounds[1] - plan.bounds[0]
    width, height = np.maximum(1, np.round(span / span.max() * longest_px)).astype(int)
    return int(width), int(height)


def _webp(picture: object) -> bytes:
    from PIL import Image

    assert isinstance(picture, Image.Image)
    out = io.BytesIO()
    picture.save(out, format="WEBP", quality=80, method=4)
    return out.getvalue()
