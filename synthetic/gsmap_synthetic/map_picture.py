"""Draw a map with its camera paths: an oblique view without ceilings and near walls, and a top view."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gsmap.errors import InputError
from gsmap.geometry.boxes import box_corners
from gsmap.geometry.projection import project
from gsmap.geometry.rotations import quats_to_matrices
from gsmap.geometry.transforms import transform_cameras, transform_gaussians
from gsmap.types import Cameras, Gaussians, Sim3

_COLOURS = [(233, 99, 46), (43, 128, 224), (46, 160, 92), (178, 74, 190), (214, 164, 24), (20, 165, 170)]
_PAPER = (252, 251, 248)
_INK = (40, 42, 48)

Part = tuple[str, Gaussians, Cameras]


def map_picture(parts: Sequence[Part], edges: Sequence[tuple[str, str]] = (), *, width_px: int = 1400) -> np.ndarray:
    """Draw placed scenes: an oblique view without near walls, and a top view with camera paths and edges.

    Args:
        parts: (name, Gaussians, cameras) of each placed scene, in the map frame.
        edges: Pairs of names of scenes that edges connect.
        width_px: Width of the picture; its content scales along.

    Returns:
        (H, W, 3) uint8.

    Raises:
        InputError: There are no parts.
    """
    from PIL import Image, ImageDraw

    if not parts:
        raise InputError("a picture of a map needs at least one placed scene", code="nothing_to_draw")
    parts = _upright(parts)
    unit = width_px / 1600
    margin, head, foot = round(28 * unit), round(28 * unit), round(84 * unit)
    split = round(0.585 * (width_px - 3 * margin))
    height = round(0.80 * split)
    panels = [(margin, split), (2 * margin + split, width_px - 3 * margin - split)]
    page = Image.new("RGB", (width_px, head + height + foot), _PAPER)
    low, high = _bounds(parts)
    views = [_view(low, high, elevation, (w, height)) for (_, w), elevation in zip(panels, (52.0, 89.9), strict=True)]
    for (x, _), view in zip(panels, views, strict=True):
        page.paste(Image.fromarray(_render(parts, view, low, high)), (x, head))
    draw = ImageDraw.Draw(page, "RGBA")
    for (x, _), view, full in zip(panels, views, (False, True), strict=True):
        _draw_walks(draw, parts, view, (x, head), unit, full)
    _draw_ties(draw, parts, edges, views[1], (panels[1][0], head), unit)
    _draw_legend(draw, parts, edges, (margin, head + height + round(24 * unit)), unit)
    return np.asarray(page)


def _upright(parts: Sequence[Part]) -> list[Part]:
    """Rotate the parts so that z is up, walls are along x and y, and the longer side is along x."""
    up = _find_up(parts)
    x = np.cross([0, 1.0, 0] if abs(up[1]) < 0.9 else [1.0, 0, 0], up)
    x /= np.linalg.norm(x)
    level = np.stack([x, np.cross(up, x), up])
    normals = np.concatenate([_normals(g) for _, g, _ in parts]) @ level.T
    flat = normals[np.abs(normals[:, 2]) < 0.3]
    # Walls repeat every quarter turn, so average the angle four times over.
    angle = np.angle(np.exp(4j * np.arctan2(flat[:, 1], flat[:, 0])).sum()) / 4 if len(flat) else 0.0
    c, s = np.cos(-angle), np.sin(-angle)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ level
    size = np.ptp(np.concatenate([cameras.centers for *_, cameras in parts]) @ turn.T, axis=0)
    if size[1] > size[0]:
        turn = np.array([[0, -1.0, 0], [1, 0, 0], [0, 0, 1]]) @ turn
    S = Sim3(turn, np.zeros(3))
    return [(name, transform_gaussians(g, S), transform_cameras(cameras, S)) for name, g, cameras in parts]


def _find_up(parts: Sequence[Part]) -> np.ndarray:
    """Estimate the up direction: mean up axis of the cameras, refined by normals of nearly level surfaces."""
    up = -np.concatenate([cameras.T_frame_camera[:, :3, 1] for *_, cameras in parts]).mean(0)
    up /= max(np.linalg.norm(up), 1e-12)
    normals = np.concatenate([_normals(g) for _, g, _ in parts])
    for limit_deg in (20, 8):
        along = normals @ up
        level = np.abs(along) > np.cos(np.radians(limit_deg))
        if level.sum() > 100:
            up = (normals[level] * np.sign(along[level])[:, None]).mean(0)
            up /= np.linalg.norm(up)
    return up


def _normals(gaussians: Gaussians) -> np.ndarray:
    """Return the normals of flat Gaussians, which lie along surfaces: their shortest axes."""
    log_scales = np.sort(gaussians.log_scales, axis=1)
    flat = gaussians[(log_scales[:, 1] - log_scales[:, 0] > 1.0) & (gaussians.opacities > 0.5)]
    rotation = quats_to_matrices(flat.quats)
    return rotation[np.arange(len(flat)), :, flat.log_scales.argmin(1)]


def _bounds(parts: Sequence[Part]) -> tuple[np.ndarray, np.ndarray]:
    """Return the box to draw: it contains 99 % of the Gaussians, and its top is slightly above the cameras."""
    means = np.concatenate([g.means for _, g, _ in parts])
    low, high = np.quantile(means, [0.005, 0.995], axis=0)
    eyes = np.median(np.concatenate([cameras.centers[:, 2] for *_, cameras in parts]))
    high[2] = eyes + 0.3 * max(eyes - low[2], 0.0)
    return low, high


def _view(low: np.ndarray, high: np.ndarray, elevation_deg: float, size_px: tuple[int, int]) -> Cameras:
    """Return a distant camera at an elevation in the south whose image just contains the box."""
    width, height = size_px
    tilt = np.radians(elevation_deg)
    forward = np.array([0, np.cos(tilt), -np.sin(tilt)])
    right = np.array([1.0, 0, 0])
    if elevation_deg < 80:
        turn = np.radians(-22.0)  # A corner view shows two rows of walls.
        spin = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
        forward, right = spin @ forward, spin @ right
    elif (high - low)[0] > (high - low)[1] and width < height:
        right, forward = np.array([0, 1.0, 0]), np.array([-1e-3, 0, -1.0])
        forward /= np.linalg.norm(forward)
    rotation = np.stack([right, np.cross(forward, right), forward], axis=1)
    center = 0.5 * (low + high)
    local = (box_corners(np.stack([low, high])) - center) @ rotation
    distance = 6.0 * np.linalg.norm(high - low)
    spread = np.abs(local[:, :2]).max(0) / (distance - np.abs(local[:, 2]).max())
    focal = 0.48 * min(width / spread[0] / 1.0, height / spread[1] / 1.0)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, center - distance * forward
    return Cameras(pose[None], np.array([[focal, focal, width / 2, height / 2]]), np.array([[width, height]]))


def _render(parts: Sequence[Part], view: Cameras, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Render the parts without ceilings and without surfaces that face away: (H, W, 3) uint8."""
    from PIL import Image

    from gsmap.render import render

    eye = view.centers[0]
    kept = []
    for _, g, cameras in parts:
        inside = (
            (g.means[:, 2] < high[2])
            & (g.means[:, :2] > low[:2] - 0.5).all(1)
            & (g.means[:, :2] < high[:2] + 0.5).all(1)
        )
        kept.append(g[inside & _faces(g, cameras, eye)])
    big = Cameras(view.T_frame_camera, 2 * view.intrinsics_px, 2 * view.sizes_px)
    paper = tuple(c / 255 for c in _PAPER)
    image = render(Gaussians.concatenate(kept), big, background=paper, depth=False, dominant_id=False).colour[0]
    image = Image.fromarray(np.round(255 * np.clip(image, 0, 1)).astype(np.uint8))
    return np.asarray(image.resize(tuple(view.sizes_px[0]), Image.Resampling.LANCZOS))


def _faces(gaussians: Gaussians, cameras: Cameras, eye: np.ndarray) -> np.ndarray:
    """Return a mask (N,) that is True for Gaussians that face the eye with the side that the scene's cameras saw.

    The side seen is the one towards the cameras in whose renders the Gaussian dominates a pixel.
    """
    from gsmap.render import render

    toward = np.zeros((len(gaussians), 3))
    for i in range(len(cameras)):
        seen = render(gaussians, cameras[i].resized(160), depth=False).dominant_id
        ids = np.unique(seen[seen >= 0])
        way = cameras.centers[i] - gaussians.means[ids]
        toward[ids] += way / np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-9)
    axis = gaussians.log_scales.argmin(1)
    normal = quats_to_matrices(gaussians.quats)[np.arange(len(gaussians)), :, axis]
    normal *= np.sign((normal * toward).sum(1, keepdims=True))
    to_eye = eye - gaussians.means
    return ((normal * to_eye).sum(1) / np.linalg.norm(to_eye, axis=1) > -0.02) & (toward != 0).any(1)


def _project(points: np.ndarray, view: Cameras, corner: tuple[int, int]) -> np.ndarray:
    """Project map points to page positions (n, 2) in a panel."""
    return project(points, view.T_camera_frame[0], view.intrinsics_px[0])[0] + corner


def _draw_walks(draw, parts: Sequence[Part], view: Cameras, corner, unit: float, full: bool) -> None:
    """Draw the camera path of each scene in the scene's colour and, with ``full``, the viewing directions."""
    for k, (_, _, cameras) in enumerate(parts):
        colour = _COLOURS[k % len(_COLOURS)]
        path = [tuple(p) for p in _project(cameras.centers, view, corner)]
        if full:
            reach = 0.05 * np.linalg.norm(np.ptp(cameras.centers, axis=0))
            ahead = _project(cameras.centers + reach * cameras.T_frame_camera[:, :3, 2], view, corner)
            for a, b in zip(path, ahead, strict=True):
                draw.line([a, tuple(b)], fill=(*colour, 150), width=max(1, round(1.5 * unit)))
        draw.line(path, fill=(255, 255, 255, 200), width=round(6 * unit), joint="curve")
        draw.line(path, fill=(*colour, 255), width=round(3.5 * unit), joint="curve")
        radius = 3.6 * unit if full else 2.6 * unit
        for x, y in path:
            draw.ellipse(
                [x - radius, y - radius, x + radius, y + radius], fill=(*colour, 255), outline=(255, 255, 255, 255)
            )


def _draw_ties(
    draw, parts: Sequence[Part], edges: Sequence[tuple[str, str]], view: Cameras, corner, unit: float
) -> None:
    """Draw scenes as labelled discs at the centres of their cameras, and the edges between them."""
    middle = {name: _project(cameras.centers.mean(0)[None], view, corner)[0] for name, _, cameras in parts}
    for a, b in edges:
        if a in middle and b in middle:
            ends = [tuple(middle[a]), tuple(middle[b])]
            draw.line(ends, fill=(255, 255, 255, 230), width=round(9 * unit))
            draw.line(ends, fill=(*_INK, 255), width=round(5 * unit))
    for k, (name, _, _) in enumerate(parts):
        x, y = middle[name]
        radius = 19 * unit
        draw.ellipse(
            [x - radius, y - radius, x + radius, y + radius],
            fill=_COLOURS[k % len(_COLOURS)],
            outline="white",
            width=round(3 * unit),
        )
        draw.text((x, y), _letter(k), fill="white", font=_font(22 * unit), anchor="mm")


def _draw_legend(draw, parts: Sequence[Part], edges, corner: tuple[int, int], unit: float) -> None:
    x, y = corner
    radius = 15 * unit
    middle = y + radius
    for k, (name, gaussians, cameras) in enumerate(parts):
        draw.ellipse([x, y, x + 2 * radius, y + 2 * radius], fill=_COLOURS[k % len(_COLOURS)])
        draw.text((x + radius, middle), _letter(k), fill="white", font=_font(18 * unit), anchor="mm")
        text = f"{name}   {len(gaussians):,} Gaussians, {len(cameras)} views"
        draw.text((x + 2.7 * radius, middle), text, fill=_INK, font=_font(20 * unit), anchor="lm")
        x += 2.7 * radius + draw.textlength(text, font=_font(20 * unit)) + 36 * unit
    if edges:
        draw.line([(x, middle), (x + 34 * unit, middle)], fill=_INK, width=round(5 * unit))
        draw.text((x + 44 * unit, middle), "registered", fill=_INK, font=_font(20 * unit), anchor="lm")


def _letter(index: int) -> str:
    return chr(ord("A") + index) if index < 26 else str(index + 1)


def _font(size: float):
    from PIL import ImageFont

    return ImageFont.load_default(max(8, round(size)))
