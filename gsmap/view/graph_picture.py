"""Draw a scene graph for inspection."""

from __future__ import annotations

import colorsys

import numpy as np
from PIL import Image, ImageDraw
from scipy.spatial import cKDTree

from gsmap.errors import InputError
from gsmap.geometry.projection import in_image, on_surface, project
from gsmap.render import render
from gsmap.types import Cameras, Gaussians, NodeLayer, SceneGraph
from gsmap.types.views import View

_MAX_LANDMARKS = 150
_EDGES, _EDGE_M = 4, 1.5  # number of lines drawn per object, and their maximum length in metres


def draw_graph(gaussians: Gaussians, cameras: Cameras, graph: SceneGraph, *, width_px: int = 960) -> np.ndarray:
    """Draw a scene graph over a render from the camera that sees most nodes: (H, W, 3) uint8.

    Objects are discs with their number (the row of the layer), joined to the nearest of the visible neighbours that
    their context is counted over; a disc is a small ring where the object is hidden. The strongest landmarks are small
    squares in the colour of their channel: white and black lighter and darker than around, red and green, yellow and
    blue along a* and b*, magenta for density.

    Args:
        gaussians, cameras: The scene.
        graph: Its scene graph.
        width_px: Width of the picture.

    Raises:
        InputError: The scene has no cameras.
    """
    if len(cameras) == 0:
        raise InputError("a picture of the graph needs a scene with at least one camera", code="nothing_to_draw")
    view = _best_view(gaussians, cameras, graph, width_px)
    picture = Image.fromarray(view.rgb).convert("RGBA")
    over = Image.new("RGBA", picture.size)
    draw = ImageDraw.Draw(over)
    landmarks = graph.layers.get("landmarks") or graph.layers.get("landmarks:1")
    if landmarks is not None and len(landmarks):
        _draw_landmarks(draw, landmarks, view)
    objects = graph.layers.get("objects")
    if objects is not None and len(objects):
        _draw_objects(draw, objects, view, _EDGE_M / objects.unit_m)
    return np.asarray(Image.alpha_composite(picture, over).convert("RGB"))


def _best_view(gaussians: Gaussians, cameras: Cameras, graph: SceneGraph, width_px: int) -> View:
    """Sample a few cameras, and render the view of the camera that sees most nodes."""
    nodes = np.concatenate([layer.positions for layer in graph.layers.values()] or [np.zeros((0, 3))])
    some = cameras.evenly(12)
    seen = [_visible(nodes, _render(gaussians, some[i], 240), 0.1).sum() for i in range(len(some))]
    return _render(gaussians, _wide(some[int(np.argmax(seen))], width_px), 4 * width_px)


def _render(gaussians: Gaussians, camera: Cameras, longest_side_px: int) -> View:
    camera = camera.resized(longest_side_px)
    image = render(gaussians, camera)
    rgb = (np.clip(np.nan_to_num(image.colour[0]), 0, 1) * 255 + 0.5).astype(np.uint8)
    return View(rgb, image.depth[0], image.alpha[0], image.dominant_id[0], camera)


def _draw_objects(draw: ImageDraw.ImageDraw, layer: NodeLayer, view: View, local_distance: float) -> None:
    at, inside = _pixels(layer.positions, view)
    shown = _visible(layer.positions, view, 0.15)
    rows = np.flatnonzero(inside & shown)
    if len(rows) > 1:
        distance, near = cKDTree(layer.positions[rows]).query(layer.positions[rows], k=min(_EDGES + 1, len(rows)))
        for i, k in np.argwhere(distance <= local_distance):
            draw.line([*at[rows[i]], *at[rows[near[i, k]]]], fill=(255, 255, 255, 90), width=1)
    for i in np.flatnonzero(inside):
        colour = tuple(int(255 * c) for c in colorsys.hsv_to_rgb(i * 0.618034 % 1, 0.75, 1.0))
        x, y = at[i]
        if not shown[i]:
            draw.ellipse([x - 4, y - 4, x + 4, y + 4], outline=(*colour, 160))
            continue
        draw.ellipse([x - 9, y - 9, x + 9, y + 9], fill=(*colour, 220), outline=(0, 0, 0, 255))
        draw.text((x, y), str(i), fill=(0, 0, 0, 255), anchor="mm")


def _draw_landmarks(draw: ImageDraw.ImageDraw, layer: NodeLayer, view: View) -> None:
    rows = np.flatnonzero(_visible(layer.positions, view, 0.05))
    rows = rows[np.argsort(-layer.weights[rows], kind="stable")][:_MAX_LANDMARKS]
    at, _ = _pixels(layer.positions, view)
    octaves = max(1, -(-int(layer.types.max() + 1) // 7))
    colours = ["#ffffff", "#000000", "#ff3030", "#20c040", "#ffe020", "#3060ff", "#ff40ff"]
    for i in rows:
        x, y = at[i]
        draw.rectangle([x - 2, y - 2, x + 2, y + 2], fill=colours[min(6, layer.types[i] // octaves)], outline="#808080")


def _wide(camera: Cameras, width_px: int) -> Cameras:
    """Return the camera scaled to another image width."""
    ratio = width_px / camera.sizes_px[0, 0]
    size = np.maximum(1, np.round(camera.sizes_px * ratio)).astype(np.int64)
    return Cameras(camera.T_frame_camera, camera.intrinsics_px * ratio, size, camera.names)


def _visible(points: np.ndarray, view: View, tolerance: float) -> np.ndarray:
    """Return a mask (N,) of points on the visible surface, within a relative depth tolerance."""
    camera = view.camera
    rows, _ = on_surface(points, camera.T_camera_frame[0], camera.intrinsics_px[0], view.depth, tolerance)
    return np.isin(np.arange(len(points)), rows)


def _pixels(points: np.ndarray, view: View) -> tuple[np.ndarray, np.ndarray]:
    """Return pixel positions (N, 2) and a mask of points inside the image."""
    at, z = project(points, view.camera.T_camera_frame[0], view.camera.intrinsics_px[0])
    return at, in_image(at, z, view.camera.sizes_px[0], 1e-6)
