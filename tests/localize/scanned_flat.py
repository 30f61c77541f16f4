"""What a scanner measures in a made flat, and where the flat lies in a map."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from gsmap.geometry.rotations import quats_to_matrices
from gsmap_synthetic import film, make_place, walk
from gsmap_synthetic.capture import Frames

SIZE_PX = (144, 108)
SEED = 11


@dataclass(frozen=True)
class Scanned:
    """A room as a scanner measured it, in a frame of its own.

    Args:
        points, colours: (N, 3) metres, and uint8.
        T_scan_world: (4, 4).
        frames: what it was made from.
    """

    points: np.ndarray
    colours: np.ndarray
    T_scan_world: np.ndarray
    frames: Frames


@dataclass(frozen=True)
class Flat:
    """A map, and where the flat's own frame lies in it."""

    path: Path
    S_map_world: np.ndarray


def scanned(seed: int, route: tuple[int, ...] = (0,), count: int = 6) -> Scanned:
    """A room of a made place, scanned on a walk of its own, which no capture made."""
    place = make_place(seed, rooms=3)
    frames = film(place, walk(place, route, count, seed=99), size_px=SIZE_PX)
    rng = np.random.default_rng(seed)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = quats_to_matrices(rng.normal(size=4)), rng.uniform(-3, 3, 3)
    points, colours = world_points(frames)
    return Scanned(points @ T[:3, :3].T + T[:3, 3], colours, T, frames)


def world_points(frames: Frames) -> tuple[np.ndarray, np.ndarray]:
    """(N, 3) of all pixels of the frames with a depth, in the frames' frame; and their colours."""
    points, colours = [], []
    assert frames.depths_m is not None
    for i in range(len(frames)):
        depth = frames.depths_m[i]
        row, column = np.nonzero(depth > 0)
        fx, fy, cx, cy = frames.cameras.intrinsics_px[i]
        z = depth[row, column]
        at = np.stack([(column + 0.5 - cx) / fx * z, (row + 0.5 - cy) / fy * z, z], axis=1)
        pose = frames.cameras.T_frame_camera[i]
        points.append(at @ pose[:3, :3].T + pose[:3, 3])
        colours.append(frames.images[i][row, column])
    return np.concatenate(points), np.concatenate(colours)


def save_depth(folder: Path, frames: Frames, i: int) -> tuple[Path, Path]:
    """A frame as a depth picture in millimetres, and its colours."""
    assert frames.depths_m is not None
    Image.fromarray(np.round(frames.depths_m[i] * 1000).astype(np.uint16)).save(folder / "depth.png")
    Image.fromarray(frames.images[i]).save(folder / "colour.png")
    return folder / "depth.png", folder / "colour.png"
