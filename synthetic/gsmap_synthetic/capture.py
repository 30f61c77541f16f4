"""Film a synthetic place: walks at head height, and colour and depth frames along them by ray casting."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from gsmap.errors import ConfigError, InputError
from gsmap.types import Cameras
from gsmap_synthetic.bake import Skin
from gsmap_synthetic.place import Door, Place, Room

_HEAD_M = 1.5
_FOCAL = 0.62  # Focal length over image width: 78 degrees across, what a phone's wide lens sees.


@dataclass(frozen=True, eq=False)
class Frames:
    """Posed colour frames, with depth where there is one: what a scanner app or robot delivers, and a trainer takes.

    Args:
        images: (C, H, W, 3) uint8 display colours.
        cameras: C cameras in the frame of the walk (a synthetic place's own frame, or whatever the poses came in).
        depths_m: (C, H, W) float32 depth along the optical axis, 0 where unknown; None without depth.
    """

    images: np.ndarray
    cameras: Cameras
    depths_m: np.ndarray | None = None

    def __post_init__(self) -> None:
        shape = self.images.shape
        sizes = self.cameras.sizes_px
        if len(shape) != 4 or shape[3] != 3 or len(self.cameras) != shape[0] or (sizes != [shape[2], shape[1]]).any():
            raise InputError(
                f"frames need images (C, H, W, 3) of their cameras' sizes, got {shape} for {self.cameras!r}"
            )
        if self.depths_m is not None and self.depths_m.shape != shape[:3]:
            raise InputError(f"depth has shape {self.depths_m.shape}, the images {shape}")

    def __len__(self) -> int:
        return len(self.images)

    def __getitem__(self, index) -> Frames:
        rows = np.atleast_1d(np.arange(len(self))[index])
        return Frames(self.images[rows], self.cameras[rows], None if self.depths_m is None else self.depths_m[rows])


def default_routes(place: Place, count: int) -> list[tuple[int, ...]]:
    """Routes of ``count`` captures through two neighbouring rooms each; three captures share one room a pair.

    Every route shares a room with an earlier one; rooms already walked come before new ones, so routes close cycles.
    """
    doors = sorted({(min(d.a, d.b), max(d.a, d.b)) for d in place.doors})
    order, left = doors[:1], doors[1:]
    while left:
        walked = {room for route in order for room in route}
        best = max(left, key=lambda route: len(walked & set(route)))
        order.append(best)
        left.remove(best)
    return [order[i % len(order)] for i in range(count)]


def unused_doors(place: Place, route: Sequence[int]) -> list[int]:
    """The doors a route does not pass, which whoever walks it leaves shut."""
    passed = {frozenset(pair) for pair in itertools.pairwise(route)}
    return [i for i, door in enumerate(place.doors) if frozenset((door.a, door.b)) not in passed]


def walk(place: Place, route: Sequence[int], num_frames: int, seed: int = 0) -> np.ndarray:
    """(num_frames, 4, 4) camera poses of a walk through rooms: a loop in each while looking around, then the doorway.

    Raises:
        ConfigError: two rooms of the route that follow each other share no doorway, or too few frames.
    """
    for a, b in itertools.pairwise(route):
        if place.door_between(a, b) is None:
            raise ConfigError(
                f"rooms {a} and {b} of this place share no doorway: a walk cannot go from one to the other"
            )
    passages = len(route) - 1
    per_passage = 4 if num_frames >= 16 * len(route) else 1
    if num_frames < 4 * len(route) + per_passage * passages:
        raise ConfigError(f"a walk through {len(route)} rooms needs at least {5 * len(route)} frames, got {num_frames}")
    rng = np.random.default_rng([place.seed, seed, 5])
    areas = np.array([place.rooms[r].size_m.prod() for r in route]) ** 0.5
    shares = np.maximum(4, np.floor((num_frames - per_passage * passages) * areas / areas.sum()).astype(int))
    shares[int(np.argmax(shares))] += num_frames - per_passage * passages - shares.sum()
    poses = []
    for k, index in enumerate(route):
        neighbour = route[k + 1] if k < passages else route[k - 1] if k else index
        door = place.door_between(index, neighbour)
        poses += _look_around(place.rooms[index], door, int(shares[k]), rng)
        if k < passages:
            poses += _pass_door(place, index, route[k + 1], per_passage, rng)
    return np.stack(poses)


def _look_around(room: Room, door: Door | None, count: int, rng: np.random.Generator) -> list[np.ndarray]:
    """A loop around the free middle of a room, beginning and ending by a door.

    The walker turns twice, so that every direction is seen from two places.
    """
    radii = np.maximum(0.5 * room.size_m - 0.8, 0.3) * rng.uniform(0.6, 1.0, 2)
    phase, turn = rng.uniform(0, 2 * np.pi), rng.choice([-1.0, 1.0])
    if door is not None:
        phase = np.arctan2(*((door.xy - room.center) / radii)[::-1]) + rng.uniform(-0.3, 0.3)
    yaw0, tilt0, sway = rng.uniform(0, 2 * np.pi), rng.uniform(0, 2 * np.pi), rng.uniform(0.1, 0.3)
    out = []
    for i in range(count):
        angle = phase + turn * 2 * np.pi * i / count
        way = radii * [np.cos(angle), np.sin(angle)]
        reach = next((r for r in np.linspace(1, 0.05, 20) if room.is_free((room.center + r * way)[None])[0]), 0.05)
        x, y = room.center + reach * way
        yaw = yaw0 + turn * 4 * np.pi * i / count + sway * np.sin(3 * angle)
        pitch = -0.12 + 0.26 * np.sin(tilt0 + 5 * angle)
        out.append(look_along(x, y, _HEAD_M + 0.12 * np.sin(2 * angle + tilt0), yaw, pitch))
    return out


def _pass_door(place: Place, a: int, b: int, count: int, rng: np.random.Generator) -> list[np.ndarray]:
    """Through the doorway from room a to b, looking ahead and once back."""
    door = place.door_between(a, b)
    assert door is not None  # Routes are checked before they are walked.
    normal = np.array([0.0, 1.0]) if door.along_x else np.array([1.0, 0.0])
    if normal @ (place.rooms[b].center - door.xy) < 0:
        normal = -normal
    heading = np.arctan2(normal[1], normal[0])
    out = []
    for i in range(count):
        x, y = door.xy + normal * (-0.5 + 1.0 * (i + 0.5) / count)
        back = np.pi if i % 2 else 0.0
        out.append(look_along(x, y, _HEAD_M, heading + back + rng.uniform(-0.35, 0.35), -0.1))
    return out


def look_along(x: float, y: float, z: float, yaw: float, pitch: float) -> np.ndarray:
    """Camera-to-place pose at a point, looking along yaw (from +x, about +z) and pitch (up positive)."""
    forward = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
    right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    out = np.eye(4)
    out[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    out[:3, 3] = x, y, z
    return out


def film(
    place: Place,
    poses: np.ndarray,
    *,
    size_px: tuple[int, int] = (320, 240),
    shut: Iterable[int] = (),
    gain: float | np.ndarray = 1.0,
    gamma: float = 1.0,
    focal: float = _FOCAL,
    sky: Callable[[np.ndarray], np.ndarray] | None = None,
    name: str = "frame",
    progress: Callable[[float, str], None] | None = None,
) -> Frames:
    """Render colour (2 x 2 supersampled) and depth frames of a place from camera-to-place poses (C, 4, 4).

    ``shut`` names the doors (indices) that are closed meanwhile. ``gain`` (one, or one a channel: white balance) and
    ``gamma`` imitate a camera's exposure: colours become ``clip(gain * colour ** gamma)``. ``focal`` is the focal
    length as a share of the image's width. ``sky`` gives the colours (n, 3) of directions (n, 3) in which there is
    nothing, which are black by default.
    """
    width, height = size_px
    focal *= width
    count = len(poses)
    cameras = Cameras(
        poses,
        np.tile([focal, focal, width / 2, height / 2], (count, 1)),
        np.tile(size_px, (count, 1)),
        tuple(f"{name}_{i:03d}" for i in range(count)),
    )
    images = np.empty((count, height, width, 3), np.uint8)
    depths = np.empty((count, height, width), np.float32)
    skin = place.skin.with_shut(shut)
    fine, centre = _pixel_rays(size_px, focal, 2), _pixel_rays(size_px, focal, 1)
    for i, pose in enumerate(poses):
        colour = _look(skin, pose, fine, 0.5 / focal, sky).reshape(height, 2, width, 2, 3)
        colour = 0.25 * (colour[:, 0, :, 0] + colour[:, 0, :, 1] + colour[:, 1, :, 0] + colour[:, 1, :, 1])
        images[i] = np.round(255 * np.clip(gain * colour**gamma, 0, 1))
        distance, *_ = skin.cast(*_placed(centre, pose))
        depths[i] = np.where(np.isfinite(distance), distance, 0).reshape(
            height, width
        )  # Rays have unit z: this is depth.
        if progress:
            progress((i + 1) / count, f"filming {name} {i + 1}/{count}")
    return Frames(images, cameras, depths)


def _pixel_rays(size_px: tuple[int, int], focal: float, samples: int) -> np.ndarray:
    """Camera-frame ray directions of unit depth through a grid of samples x samples points per pixel, rows first."""
    width, height = size_px
    x = ((np.arange(width * samples) + 0.5) / samples - width / 2) / focal
    y = ((np.arange(height * samples) + 0.5) / samples - height / 2) / focal
    xx, yy = np.meshgrid(x, y)
    return np.stack([xx, yy, np.ones_like(xx)], axis=-1).reshape(-1, 3).astype(np.float32)


def _placed(rays: np.ndarray, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Origins and directions of camera-frame rays in the place's frame."""
    # einsum, not matmul: so thin a product gains nothing from BLAS threads and loses much when cores are busy.
    directions = np.einsum("nj,ij->ni", rays, pose[:3, :3].astype(np.float32))
    return np.broadcast_to(pose[:3, 3].astype(np.float32), rays.shape), directions


def _look(
    skin: Skin, pose: np.ndarray, rays: np.ndarray, pixel: float, sky: Callable[[np.ndarray], np.ndarray] | None
) -> np.ndarray:
    """(n, 3) colours seen along camera-frame rays of unit depth; the sky's, or black, where there is nothing."""
    origins, directions = _placed(rays, pose)
    distance, quad, s, t = skin.cast(origins, directions)
    hit = np.isfinite(distance)
    colours = skin.colour(quad, s, t, pixel * np.where(hit, distance, 1))
    if hit.all():
        return colours
    colours = colours * hit[:, None]
    if sky is not None:
        colours[~hit] = sky(directions[~hit])
    return colours
