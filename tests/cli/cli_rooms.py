"""What the tests of this room share: parts of a textured room as files with known truth, and changes of a map."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

import gsmap.map
from gsmap import formats
from gsmap.change import recipe_key
from gsmap.geometry.rotations import exp_so3
from gsmap.geometry.sh import sh0_of_rgb
from gsmap.geometry.transforms import transform_gaussians
from gsmap.types import Change, ChangeReport, Gaussians, Sim3

SIZE = np.array([6.0, 4.0, 2.5])


def write_captures(folder: Path) -> None:
    """``left`` and ``right`` share the middle of one room; ``odd:one`` is another room. Truth lies in ``truth/``."""
    (folder / "truth").mkdir(parents=True)
    rooms = {"left": (7, 0.0, 4.2), "right": (7, 1.8, 6.0), "odd:one": (8, 0.0, 6.0)}
    for k, (name, (room, low, high)) in enumerate(rooms.items()):
        S = Sim3(exp_so3(np.array([0.0, 0.0, 0.7 * k])), np.array([2.0, -1.0, 0.3]) * k)
        write_capture(folder, name, S, room, low, high, k)
        (folder / "truth" / f"{name}.json").write_text(json.dumps({"T_scene_world": S.matrix().tolist()}))


def write_capture(folder: Path, name: str, S: Sim3, room: int, low: float, high: float, seed: int) -> None:
    """Part of a room between two values of x, in a frame of its own, with the cameras that look around in it."""
    gaussians = transform_gaussians(_surfaces(np.random.default_rng(seed), room, low, high, 9_000), S)
    formats.write(folder / f"{name}.ply", gaussians)
    frames = [
        {
            "id": i,
            "img_name": f"{name}_{i}",
            "width": 96,
            "height": 72,
            "position": (pose[:3, 3]).tolist(),
            "rotation": pose[:3, :3].tolist(),
            "fx": 60.0,
            "fy": 60.0,
        }
        for i, pose in enumerate(S.matrix() @ view for view in _views(low, high))
    ]
    (folder / f"{name}.cameras.json").write_text(json.dumps(frames))


def _surfaces(rng: np.random.Generator, room: int, low: float, high: float, count: int) -> Gaussians:
    """Gaussians on floor, walls and boxes of a room, between two values of x; colours depend on the place."""
    boxes = [(np.zeros(3), SIZE)]
    furniture = np.random.default_rng(room)
    for _ in range(10):
        corner = np.r_[furniture.uniform(0.2, 5), furniture.uniform(0.2, 3), 0.0]
        boxes.append((corner, corner + furniture.uniform(0.4, 1.0, 3)))
    faces = [
        (start, end - start, axis, side)
        for k, (start, end) in enumerate(boxes)
        for axis in range(3)
        for side in (0.0, 1.0)
        if not (k == 0 and axis == 2 and side)  # no ceiling
    ]
    areas = np.array([np.prod(np.delete(size, axis)) for _, size, axis, _ in faces])
    chosen = rng.choice(len(faces), count, p=areas / areas.sum())
    unit = rng.uniform(size=(count, 3))
    for i, (_, _, axis, side) in enumerate(faces):
        unit[chosen == i, axis] = side
    points = np.array([faces[i][0] for i in chosen]) + unit * np.array([faces[i][1] for i in chosen])
    points = points[(points[:, 0] >= low) & (points[:, 0] <= high)]
    n = len(points)
    return Gaussians(
        points + rng.normal(scale=0.004, size=points.shape),
        np.tile([1.0, 0, 0, 0], (n, 1)),
        np.full((n, 3), np.log(0.04)),
        np.full(n, 3.0),
        sh0_of_rgb(_texture(points, room))[:, None],
    )


def _texture(points: np.ndarray, room: int) -> np.ndarray:
    """(N, 3) colours that vary over decimetres, the same wherever a point is sampled twice."""
    rng = np.random.default_rng(room + 100)
    waves, phases = rng.normal(size=(3, 8, 3)) * 5, rng.uniform(0, 6, (3, 8))
    return np.stack([0.5 + 0.12 * np.sin(points @ w.T + p).sum(1) for w, p in zip(waves, phases, strict=True)], 1)


def _views(low: float, high: float) -> np.ndarray:
    """(C, 4, 4) cameras in the middle of the part, looking around and a little down."""
    views = []
    for x in np.linspace(low + 1, high - 1, 2):
        for angle in np.arange(6) * np.pi / 3:
            forward = np.array([np.cos(angle), np.sin(angle), -0.3])
            forward /= np.linalg.norm(forward)
            right = np.cross(forward, [0.0, 0, 1])
            right /= np.linalg.norm(right)
            pose = np.eye(4)
            pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], 1)
            pose[:3, 3] = [x, SIZE[1] / 2, 1.5]
            views.append(pose)
    return np.array(views)


def save_changes(site: Path) -> None:
    """What a comparison of left and right might have found, so that nothing is rendered here."""
    box, rows = np.array([[0.0, 0, 0], [0.5, 0.5, 1]]), np.arange(5, dtype=np.int32)
    moved = Sim3(np.eye(3), np.array([1.0, 0, 0]))
    chair = Change("moved", box, box.astype(np.float32), rows, rows[:3], moved, "half", 0.875, {"through": 6.0})
    report = ChangeReport((chair,), 0.75, np.array([1.0, 1.125, 0.875]), ("it was dark",))
    with gsmap.map.open(site) as m:
        m.edit("left", captured_at="2026-05-30")
        m.edit("right", captured_at="2026-05-31")
        left, right = (m.pose_graph().poses[m.store.scenes.get(name).id] for name in ("left", "right"))
        where = {"older": left.scene, "newer": right.scene, "S_frame_newer": right.S_map_scene}
        where |= {"S_newer_older": right.S_map_scene.inverse() @ left.S_map_scene}
        m.store.changes.save(report, recipe_key(m.settings.change).of(left.scene, right.scene), **where)
