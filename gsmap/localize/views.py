"""Which views of a scene are rendered to find photographs by: some of its own cameras, and some off their path."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmap.geometry.camera_synthesis import synthesise_cameras
from gsmap.geometry.projection import in_image, project
from gsmap.types import Cameras, Gaussians


@dataclass(frozen=True)
class Params:
    """How many views of a scene, and of what size.

    Args:
        image_size_px: longer side of the renders, and of photographs while features are looked for in them.
        own: of the scene's cameras, at most.
        made: views off their path, at most, where there is free space.
        turn: how far to move is as much of another view as to turn by a radian, as a share of the distance of what is
            seen.
        sample: opaque centres that stand for the scene while made views are chosen.
    """

    image_size_px: int = 480
    own: int = 24
    made: int = 8
    turn: float = 0.6
    sample: int = 4000


def choose_views(gaussians: Gaussians, cameras: Cameras, params: Params | None = None) -> Cameras:
    """Cameras from which the scene is rendered; first its own, then made ones.

    Its own are thinned to those that are farthest from each other in place and direction, so that a standstill does
    not use them up. Made ones stand in its free space, and are taken for the surface that the chosen own ones do not
    see from the front or from near: what somebody photographs who did not walk along.

    Returns:
        At most ``own + made`` cameras, resized to the size of the renders.
    """
    params = params or Params()
    points = _sample(gaussians, params.sample)
    made = cameras if cameras.synthesised else synthesise_cameras(gaussians)
    if cameras.synthesised:
        chosen = cameras[_spread(cameras, points, params.own + params.made, params.turn)]
    else:
        chosen = cameras[_spread(cameras, points, params.own, params.turn)]
        more = made[_adding(points, chosen, made, params)]
        chosen = Cameras(
            np.concatenate([chosen.T_frame_camera, more.T_frame_camera]),
            np.concatenate([chosen.intrinsics_px, more.intrinsics_px]),
            np.concatenate([chosen.sizes_px, more.sizes_px]),
        )
    return chosen.resized(params.image_size_px)


def _sample(gaussians: Gaussians, count: int) -> np.ndarray:
    """(P, 3) opaque centres that stand for the scene."""
    solid = np.flatnonzero(gaussians.logit_opacities > 0.0)
    rows = np.linspace(0, len(solid) - 1, min(len(solid), count)).astype(int)
    return gaussians.means[solid[rows]].astype(np.float32)


def _spread(cameras: Cameras, points: np.ndarray, count: int, turn: float) -> np.ndarray:
    """Rows of the cameras that are farthest from each other, in their order."""
    if len(cameras) <= count or not len(points):
        return np.arange(len(cameras))[:count]
    from_middle = np.linalg.norm(points - np.median(cameras.centers, axis=0), axis=1)
    lever = turn * float(np.median(from_middle))
    features = np.concatenate([cameras.centers, lever * cameras.T_frame_camera[:, :3, 2]], axis=1)
    chosen = [0]
    apart = np.linalg.norm(features - features[0], axis=1)
    while len(chosen) < count:
        chosen.append(int(np.argmax(apart)))
        apart = np.minimum(apart, np.linalg.norm(features - features[chosen[-1]], axis=1))
    return np.sort(chosen)


def _adding(points: np.ndarray, own: Cameras, made: Cameras, params: Params) -> list[int]:
    """Rows of the made cameras that see most of what those before see badly, or not at all."""
    best = np.zeros(len(points))
    for camera in range(len(own)):
        best = np.maximum(best, _detail(points, own, camera))
    details = [_detail(points, made, camera) for camera in range(len(made))]
    chosen: list[int] = []
    while len(chosen) < params.made:
        # How much larger it is seen than before, at most twice: nearer still shows no more than the splats hold.
        gains = [np.log2(np.maximum(d, 1e-9) / np.maximum(best, d / 2 + 1e-9)).clip(0, 1).sum() for d in details]
        pick = int(np.argmax(gains)) if gains else -1
        if pick < 0 or gains[pick] < 0.01 * len(points):
            break
        chosen.append(pick)
        best = np.maximum(best, details[pick])
    return chosen


def _detail(points: np.ndarray, cameras: Cameras, row: int) -> np.ndarray:
    """(P,) pixels per unit with which a camera sees each point; 0 where something stands before it, or outside."""
    coarse = cameras[[row]].resized(24)
    width, height = (int(v) for v in coarse.sizes_px[0])
    pixels, depth = project(points, coarse.T_camera_frame[0], coarse.intrinsics_px[0])
    seen = np.flatnonzero(in_image(pixels, depth, coarse.sizes_px[0]))
    column, line = pixels[seen].astype(np.int64).T
    nearest = np.full(width * height, np.inf, np.float32)
    np.minimum.at(nearest, line * width + column, depth[seen])
    front = seen[depth[seen] <= 1.15 * nearest[line * width + column]]
    out = np.zeros(len(points))
    out[front] = cameras.intrinsics_px[row, 0] / cameras.sizes_px[row].max() / depth[front]
    return out
