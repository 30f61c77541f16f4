"""Made places with things that repeat, and what is true of them: for fitting and scoring how things are found.

Each place is a furnished flat of three rooms, to which chairs of one look are added, and armchairs and small things of
another, wherever there is room; others that look different stand among them. It is captured three times.
"""

from __future__ import annotations

import pickle
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gsmap.describe import Params, describe
from gsmap.geometry.transforms import transform_cameras, transform_gaussians
from gsmap.types import SceneGraph, Sim3
from gsmap_synthetic import DemoCapture, Place, make_captures, make_place
from gsmap_synthetic.change import sight
from gsmap_synthetic.edits import Add, Edit, edit_place
from gsmap_synthetic.furniture import PIECES
from gsmap_synthetic.layout import overlap
from gsmap_synthetic.small import SMALL

SIZE_PX = (240, 180)
_NEAR_M = 0.06  # a Gaussian so near to what a pixel shows is of it
_TWINS = (("chair", 4), ("chair", 3), ("armchair", 2), ("plant", 2), ("box", 3))
_CLEAR_M = 0.25
_PARAMS = Params(landmarks=False)


@dataclass(frozen=True, eq=False)
class FindPlace:
    """A made place.

    Args:
        captures: three of them.
        looks: by object id, what it looks like: equal for twins, and for nothing else.
        names: by object id, what it is.
    """

    place: Place
    captures: list[DemoCapture]
    looks: dict[int, int]
    names: dict[int, str]

    def owners(self, capture: DemoCapture) -> np.ndarray:
        """(N,) ids of the objects that a capture's Gaussians lie on, by its own views; -1 for none."""
        S_world_scene = Sim3.from_matrix(capture.T_scene_world).inverse()
        cameras = transform_cameras(capture.cameras, S_world_scene)
        means = transform_gaussians(capture.gaussians, S_world_scene).means.astype(np.float64)
        ids, depths = sight(self.place, cameras)
        votes = np.zeros((len(means), len(self.place.objects)), np.uint16)
        for row in range(len(cameras)):
            T = cameras.T_camera_frame[row]
            local = means @ T[:3, :3].T + T[:3, 3]
            z = local[:, 2]
            fx, fy, cx, cy = cameras.intrinsics_px[row]
            with np.errstate(divide="ignore", invalid="ignore"):
                x, y = fx * local[:, 0] / z + cx, fy * local[:, 1] / z + cy
            inside = (z > 0.05) & (x >= 0) & (y >= 0) & (x < SIZE_PX[0]) & (y < SIZE_PX[1])
            at = np.flatnonzero(inside)
            column, line = x[at].astype(int), y[at].astype(int)
            seen = ids[row][line, column]
            on = (np.abs(depths[row][line, column] - z[at]) < _NEAR_M) & (seen >= 0)
            votes[at[on], seen[on]] += 1
        return np.where(votes.any(1), votes.argmax(1), -1)


def make(seed: int, *, rooms: int = 3, captures: int = 3, frames: int = 40, gaussians: int = 30_000) -> FindPlace:
    """The place of a seed."""
    plain = make_place(seed, rooms=rooms)
    rng = np.random.default_rng([seed, 41])
    edits: list[Edit] = []
    looks = {thing.id: thing.id for thing in plain.objects}
    used = {
        room: [_rect(plain, thing.id) for thing in plain.objects if thing.room == room and _stands(thing.kind)]
        for room in range(len(plain.rooms))
    }
    count = len(plain.objects)
    for group, (name, copies) in enumerate(_TWINS):
        piece = {**PIECES, **SMALL}[name]
        size = tuple(float(rng.uniform(*side)) for side in (piece.width_m, piece.depth_m))
        look = int(rng.integers(1 << 30))
        for _ in range(copies):
            spot = _spot(rng, plain, used, size)
            if spot is None:
                continue
            room, T = spot
            edits.append(Add(name, room, T, size, look))
            looks[count] = -1 - group
            count += 1
    place = edit_place(plain, edits) if edits else plain
    made = make_captures(
        seed,
        captures,
        place=place,
        steps=0,
        num_frames=frames,
        num_gaussians=gaussians,
        size_px=SIZE_PX,
        vary_exposure=True,
        shut_doors=False,
    )
    names = {thing.id: thing.name for thing in place.objects}
    return FindPlace(place, made, looks, names)


def _stands(kind: str) -> bool:
    return kind in ("furniture", "small")


def _rect(place: Place, thing: int) -> np.ndarray:
    """What an object covers of the floor: lowest and highest corner, place frame."""
    corners = np.concatenate([np.asarray(place.surfaces.corners[q]) for q in place.surfaces.of(thing)])
    return np.concatenate([corners[:, :2].min(0), corners[:, :2].max(0)])


def _spot(
    rng: np.random.Generator, place: Place, used: dict[int, list[np.ndarray]], size: tuple[float, ...]
) -> tuple[int, np.ndarray] | None:
    """A free place on the floor of a room, at any turn, and the pose of a piece that stands there."""
    for _ in range(60):
        room = int(rng.integers(len(place.rooms)))
        x0, y0, x1, y1 = place.rooms[room].rect_m
        reach = float(np.hypot(*size)) / 2
        if min(x1 - x0, y1 - y0) < 2 * reach + 0.6:
            continue
        at = rng.uniform([x0 + reach + 0.1, y0 + reach + 0.1], [x1 - reach - 0.1, y1 - reach - 0.1])
        rect = np.concatenate([at - reach, at + reach])
        if any(overlap(rect, other, _CLEAR_M) for other in used[room]):
            continue
        used[room].append(rect)
        yaw = rng.uniform(0, 2 * np.pi)
        c, s = np.cos(yaw), np.sin(yaw)
        T = np.eye(4)
        T[:2, :2] = [[c, -s], [s, c]]
        T[:2, 3] = at - T[:2, :2] @ [0, size[1] / 2]
        return room, T
    return None


@dataclass(frozen=True, eq=False)
class Sightings:
    """All things of the captures of a place, and what they are.

    Args:
        graphs: of each capture, objects and things alone.
        owners: (capture, thing) by index: the object that most of it is of, -1 where less than half is of one.
        whole: (capture, thing): the share of the object's Gaussians there that it has.
    """

    graphs: list[SceneGraph]
    owners: dict[tuple[int, int], int]
    whole: dict[tuple[int, int], float]
    looks: dict[int, int]
    names: dict[int, str]


def sightings(place: FindPlace) -> Sightings:
    """Describe the captures of a place, and look up what their things are."""
    graphs, owners, whole = [], {}, {}
    for c, capture in enumerate(place.captures):
        owner = place.owners(capture)
        graphs.append(describe(capture.name, capture.gaussians, capture.cameras, _PARAMS, scale_policy="known"))
        things = graphs[-1].segments
        assert things is not None
        for t in range(len(things)):
            mine = owner[things.members == t]
            ids, counts = np.unique(mine[mine >= 0], return_counts=True)
            best = int(ids[counts.argmax()]) if len(ids) and 2 * counts.max() > len(mine) else -1
            owners[c, t] = best
            whole[c, t] = float(counts.max() / (owner == best).sum()) if best >= 0 else 0.0
    return Sightings(graphs, owners, whole, place.looks, place.names)


def cached(seed: int, folder: Path | None) -> Sightings:
    """The sightings of the place of a seed, kept in a folder for the next time."""
    path = None if folder is None else folder / f"find_{seed}.pickle"
    if path is not None and path.exists():
        return pickle.loads(path.read_bytes())
    found = sightings(make(seed))
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(pickle.dumps(found))
    return found
