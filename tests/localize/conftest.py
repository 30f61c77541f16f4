"""A small map of three captures of a flat, and what a scanner measures in it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import gsmap
from gsmap.geometry.rotations import quats_to_matrices
from gsmap_synthetic import film, make_captures, make_place, walk
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


def scanned(seed: int, route: tuple[int, ...] = (0,), count: int = 10) -> Scanned:
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


@pytest.fixture(scope="session")
def flat(tmp_path_factory: pytest.TempPathFactory) -> Flat:
    path = tmp_path_factory.mktemp("flat") / "flat.gsmap"
    captures = make_captures(SEED, 3, steps=0, num_frames=20, num_gaussians=20_000, size_px=SIZE_PX)
    with gsmap.map.create(path) as m:
        m.change_settings({"describe.objects": False, "describe.things": False})
        for capture in captures:
            m.ingest(capture.gaussians, cameras=capture.cameras, name=capture.name)
        m.update()
        poses = m.pose_graph()
        assert poses is not None
        first = next(scene for scene in m.scenes() if scene.name == captures[0].name)
        assert poses.poses[first.id].status != "isolated"
        return Flat(path, poses.poses[first.id].S_map_scene.matrix() @ captures[0].T_scene_world)


@pytest.fixture
def opened(flat: Flat) -> Iterator[gsmap.map.Map]:
    with gsmap.map.open(flat.path) as m:
        yield m


@pytest.fixture(scope="session")
def room() -> Scanned:
    return scanned(SEED)


def save_depth(folder: Path, frames: Frames, i: int) -> tuple[Path, Path]:
    """A frame as a depth picture in millimetres, and its colours."""
    assert frames.depths_m is not None
    Image.fromarray(np.round(frames.depths_m[i] * 1000).astype(np.uint16)).save(folder / "depth.png")
    Image.fromarray(frames.images[i]).save(folder / "colour.png")
    return folder / "depth.png", folder / "colour.png"
