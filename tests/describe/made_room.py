"""A furnished room in which every Gaussian knows whose it is, and cameras that look about in it."""

import numpy as np

from gsmap.geometry.rotations import matrices_to_quats
from gsmap.geometry.sh import sh0_of_rgb
from gsmap.types import Cameras, Gaussians

SPACING_M = 0.05
SHELL = -1


class Room:
    """A 4 x 3 x 2.5 m room of flat Gaussians in which every Gaussian knows whose it is."""

    def __init__(self, seed: int = 0) -> None:
        self.rng = np.random.default_rng(seed)
        self.points: list[np.ndarray] = []
        self.normals: list[np.ndarray] = []
        self.colours: list[np.ndarray] = []
        self.owners: list[np.ndarray] = []
        for axis, end in enumerate((4.0, 3.0, 2.5)):
            for at in (0.0, end):
                low, high = np.zeros(3), np.array([4.0, 3.0, 2.5])
                low[axis] = high[axis] = at
                self.rectangle(low, high, (0.8, 0.8, 0.75), SHELL)

    def rectangle(self, low, high, colour, owner) -> None:
        """Gaussians on an axis-parallel rectangle, 2 mm off it."""
        low, high = np.array(low, float), np.array(high, float)
        axis = int(np.argmin(high - low))
        count = int(np.prod(np.delete(high - low, axis)) / SPACING_M**2) + 1
        points = self.rng.uniform(low, high, (count, 3))
        points[:, axis] += self.rng.normal(0, 0.002, count)
        self.points.append(points)
        self.normals.append(np.tile(np.eye(3)[axis], (count, 1)))
        self.colours.append(np.clip(np.array(colour) + self.rng.normal(0, 0.01, (count, 3)), 0, 1))
        self.owners.append(np.full(count, owner))

    def box(self, low, high, colour, owner) -> None:
        """The faces of a box that can be seen: not its bottom, nor its back where it stands against a wall."""
        low, high = np.array(low, float), np.array(high, float)
        for axis in range(3):
            for at in (low[axis], high[axis]) if axis < 2 else (high[axis],):
                a, b = low.copy(), high.copy()
                a[axis] = b[axis] = at
                if at > 0.04:
                    self.rectangle(a, b, colour, owner)

    def made(self) -> tuple[Gaussians, np.ndarray]:
        points, normals = np.concatenate(self.points), np.concatenate(self.normals)
        frames = np.stack([np.roll(normals, 1, axis=1), np.roll(normals, 2, axis=1), normals], axis=2)
        scales = np.tile(np.log([0.6 * SPACING_M, 0.6 * SPACING_M, 0.005]), (len(points), 1))
        sh = sh0_of_rgb(np.concatenate(self.colours))[:, None]
        quats = matrices_to_quats(frames)
        return Gaussians(points, quats, scales, np.full(len(points), 3.0), sh), np.concatenate(self.owners)


def furnished() -> tuple[Gaussians, np.ndarray]:
    """A cupboard and a table by the walls, a box on the table, a picture, and a lamp whose pole is too thin to see."""
    room = Room()
    room.box([0.03, 0.5, 0.0], [0.5, 1.5, 1.8], (0.5, 0.3, 0.2), 0)
    room.box([2.0, 0.03, 0.0], [3.2, 0.7, 0.75], (0.3, 0.4, 0.6), 1)
    room.box([2.4, 0.2, 0.75], [2.7, 0.5, 1.0], (0.7, 0.2, 0.2), 1)
    room.rectangle([1.0, 2.955, 1.2], [1.7, 2.955, 1.7], (0.2, 0.5, 0.3), 2)
    room.box([3.3, 2.3, 0.0], [3.7, 2.7, 0.2], (0.1, 0.1, 0.1), 3)
    room.box([3.3, 2.3, 1.3], [3.7, 2.7, 1.6], (0.9, 0.9, 0.6), 3)
    return room.made()


def looking_about(
    count: int = 12, at: tuple[float, float, float] = (2.0, 1.6, 1.5), turn_deg: float = 360.0
) -> Cameras:
    """Cameras at one place of the room, level and a little down, spread over a turn that begins along x."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    for i in range(count):
        yaw, pitch = np.radians(turn_deg) * i / count, -0.35
        forward = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
        right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
        poses[i, :3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
        poses[i, :3, 3] = at
    return Cameras(poses, np.tile([70.0, 70, 64, 48], (count, 1)), np.tile([128, 96], (count, 1)))
