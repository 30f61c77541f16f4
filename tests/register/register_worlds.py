"""Worlds of nodes with known partners, for the tests of this room."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gsmap.geometry.rotations import exp_so3
from gsmap.register import SceneView
from gsmap.register.correspondences import Correspondences
from gsmap.types import Cameras, Gaussians, NodeLayer, SceneGraph, Sim3


@dataclass
class NodeWorld:
    target: NodeLayer
    source: NodeLayer
    partner: np.ndarray  # row of the source for each row of the target, -1 where it has none
    S_target_source: Sim3
    matches: Correspondences  # the true pairs and some wrong ones
    up_target: np.ndarray
    up_source: np.ndarray

    def graphs(self) -> tuple[SceneGraph, SceneGraph]:
        return (
            SceneGraph("target", {"landmarks": self.target}, self.up_target),
            SceneGraph("source", {"landmarks": self.source}, self.up_source),
        )


def layer(rng, n, *, positions=None, embeddings=None, types=3, dim=16, type_ids=None) -> NodeLayer:
    positions = rng.uniform(0, 1, (n, 3)) * [8, 6, 2.5] if positions is None else positions
    embeddings = rng.normal(size=(n, dim)) if embeddings is None else embeddings
    embeddings = embeddings / np.linalg.norm(embeddings, axis=1, keepdims=True)
    type_ids = rng.integers(0, types, n) if type_ids is None else type_ids
    extents = np.stack([positions - 0.1, positions + 0.1], 1)
    return NodeLayer(
        positions, embeddings, type_ids, np.ones(n), extents, embeddings, np.zeros(n, np.int32), descriptor_id="test"
    )


def node_world(seed=0, shared=80, extra=80, noise_m=0.02, wrong=200, scale=1.0, embedding_noise=0.05) -> NodeWorld:
    """Two scenes that share ``shared`` nodes; the frames differ by a random rotation, translation and scale."""
    rng = np.random.default_rng(seed)
    S = Sim3(exp_so3(rng.normal(size=3) * 2), rng.normal(size=3) * 10, scale)
    inverse = S.inverse()
    room = np.array([8.0, 6.0, 2.5])
    common = rng.uniform(0, 1, (shared, 3)) * room
    features, types = rng.normal(size=(shared, 16)), rng.integers(0, 3, shared)

    def side(move):
        points = np.concatenate([common, rng.uniform(0, 1, (extra, 3)) * room])
        points = points + rng.normal(size=points.shape) * noise_m
        e = np.concatenate([features + rng.normal(size=features.shape) * embedding_noise, rng.normal(size=(extra, 16))])
        order = rng.permutation(shared + extra)
        kinds = np.concatenate([types, rng.integers(0, 3, extra)])
        return layer(rng, len(points), positions=move(points)[order], embeddings=e[order], type_ids=kinds[order]), order

    target, order_t = side(lambda x: x)
    source, order_s = side(inverse.apply)
    where = np.empty(shared + extra, int)
    where[order_s] = np.arange(shared + extra)
    partner = np.where(order_t < shared, where[order_t], -1)
    rows = np.flatnonzero(partner >= 0)
    t = np.concatenate([rows, rng.integers(0, len(target), wrong)]).astype(np.int32)
    s = np.concatenate([partner[rows], rng.integers(0, len(source), wrong)]).astype(np.int32)
    up = np.array([0.0, 0, 1])
    matches = Correspondences(
        target.positions[t],
        source.positions[s],
        t,
        s,
        np.ones(len(t), np.float32),
    )
    return NodeWorld(target, source, partner, S, matches, up, S.rotation.T @ up)


def two_pose_world(seed=0, first=40, second=30, extra=20) -> tuple[NodeWorld, Sim3]:
    """A node world some of whose shared nodes moved together between the captures, and the pose of those."""
    world = node_world(seed, shared=first + second, extra=extra, embedding_noise=0.02)
    rng = np.random.default_rng(seed + 1)
    moved = np.flatnonzero(world.partner >= 0)
    moved = rng.choice(moved, second, replace=False)
    motion = Sim3(exp_so3([0.0, 0.0, 1.2]), [2.5, -3.0, 0.4])
    positions = world.target.positions.copy()
    positions[moved] = motion.apply(positions[moved])
    world.target = replace(world.target, positions=positions)
    return world, motion @ world.S_target_source


def texture(points: np.ndarray, seed: int) -> np.ndarray:
    """(N, 3) colours in [0, 1] that vary over decimetres, the same wherever a point is sampled twice."""
    rng = np.random.default_rng(seed)
    waves, phases = rng.normal(size=(3, 8, 3)) * 5, rng.uniform(0, 6, (3, 8))
    return np.stack([0.5 + 0.12 * np.sin(points @ w.T + p).sum(1) for w, p in zip(waves, phases, strict=True)], 1)


def _room_points(rng, count: int, seed: int) -> np.ndarray:
    """Points on the floor, walls and furniture of a 6 x 4 x 2.5 m room."""
    boxes = [(np.zeros(3), np.array([6.0, 4.0, 2.5]))]
    furniture = np.random.default_rng(seed + 1000)
    for _ in range(10):
        low = np.r_[furniture.uniform(0.2, 5, 1), furniture.uniform(0.2, 3, 1), 0.0]
        boxes.append((low, low + furniture.uniform(0.4, 1.0, 3)))
    faces = []
    for k, (low, high) in enumerate(boxes):
        size = high - low
        for axis in range(3):
            for side in (low[axis], high[axis]):
                if k == 0 and axis == 2 and side > 0:
                    continue  # no ceiling
                area = np.prod(np.delete(size, axis))
                faces.append((area, low, size, axis, side))
    areas = np.array([f[0] for f in faces])
    chosen = rng.choice(len(faces), count, p=areas / areas.sum())
    points = rng.uniform(0, 1, (count, 3))
    for i, (_, low, size, axis, side) in enumerate(faces):
        rows = chosen == i
        points[rows] = low + points[rows] * size
        points[rows, axis] = side
    return points


HALF_TURN = Sim3(exp_so3([0.0, 0.0, np.pi]), [6.0, 4.0, 0.0])
"""About the vertical through the middle of a room."""


@dataclass
class SplatWorld:
    target: SceneView
    source: SceneView
    S_target_source: Sim3


def splat_world(
    seed=0,
    *,
    place=(7, 7),
    scale=1.0,
    policy="auto",
    nodes=150,
    points=40_000,
    noise_m=0.005,
    cut_m=(3.8, 2.2),
    offset_m=10.0,
    with_cameras=True,
    symmetric=False,
) -> SplatWorld:
    """Two captures of textured rooms, as Gaussians, cameras and landmark nodes; ``place`` seeds each room.

    The target holds x < cut_m[0] of its room, the source x > cut_m[1] of its own. A symmetric room looks the same, in
    shape, colours and nodes, after half a turn about its middle: two poses lay the captures on each other equally well.
    """
    rng = np.random.default_rng(seed)
    S = Sim3(exp_so3(rng.normal(size=3) * 2), rng.normal(size=3) * offset_m, scale)
    views = []
    for k, (move, room) in enumerate(((Sim3.identity(), place[0]), (S.inverse(), place[1]))):

        def inside(p, k=k):
            return p[:, 0] < cut_m[0] if k == 0 else p[:, 0] > cut_m[1]

        p = _room_points(rng, points, room)
        if symmetric:
            half = p[:, 0] < HALF_TURN.translation[0] / 2
            p = np.concatenate([p[half], HALF_TURN.apply(p[half])])
        p = p[inside(p)]
        turned = symmetric & (p[:, 0] > HALF_TURN.translation[0] / 2)
        colours = texture(np.where(turned[:, None], HALF_TURN.apply(p), p) if symmetric else p, room)
        p = p + rng.normal(size=p.shape) * noise_m
        sh = ((colours - 0.5) / 0.28209479177387814)[:, None]
        n = len(p)
        gaussians = Gaussians(
            move.apply(p),
            np.tile([1.0, 0, 0, 0], (n, 1)),
            np.full((n, 3), np.log(0.02 * move.scale)),
            np.full(n, 3.0),
            sh,
        )
        fixed = np.random.default_rng(room)
        spots = _room_points(fixed, nodes * 2, room)
        features, kinds = fixed.normal(size=(nodes * 2, 16)), fixed.integers(0, 3, nodes * 2)
        if symmetric:
            half = spots[:, 0] < HALF_TURN.translation[0] / 2
            spots = np.concatenate([spots[half], HALF_TURN.apply(spots[half])])
            features, kinds = np.tile(features[half], (2, 1)), np.tile(kinds[half], 2)
        keep = inside(spots)
        spots, features, kinds = spots[keep], features[keep], kinds[keep]
        spots = spots + rng.normal(size=spots.shape) * 0.02
        features = features + rng.normal(size=features.shape) * 0.1
        order = rng.permutation(len(spots))
        # A guess of the unit is off by a factor that differs between captures.
        unit = 1.1 ** (1 - 2 * k) / move.scale
        layers = {}
        if policy != "unknown":
            layers["landmarks"] = layer(
                rng, len(order), positions=move.apply(spots)[order], embeddings=features[order], type_ids=kinds[order]
            )
        if policy != "known":
            layers["landmarks:0"] = replace(
                layer(
                    rng,
                    len(order),
                    positions=move.apply(spots)[order],
                    embeddings=features[order],
                    type_ids=kinds[order],
                ),
                unit_m=unit,
            )
        graph = SceneGraph(f"s{k}", layers, move.rotation @ [0.0, 0, 1.0], unit if policy != "known" else 1.0)
        cameras = None
        if with_cameras:
            x = (0.8, 3.2) if k == 0 else (2.8, 5.2)
            poses = []
            for i in range(12):
                centre = np.r_[rng.uniform(*x), rng.uniform(0.8, 3.2), 1.6]
                yaw = 2 * np.pi * i / 12
                forward = np.array([np.cos(yaw), np.sin(yaw), -0.3])
                forward /= np.linalg.norm(forward)
                right = np.cross(forward, [0, 0, 1.0])
                right /= np.linalg.norm(right)
                pose = np.eye(4)
                pose[:3, :3] = move.rotation @ np.stack([right, np.cross(forward, right), forward], 1)
                pose[:3, 3] = move.apply(centre)
                poses.append(pose)
            cameras = Cameras(np.array(poses), np.tile([200.0, 200, 160, 120], (12, 1)), np.tile([320, 240], (12, 1)))
        views.append(SceneView(f"s{k}", gaussians, cameras, graph, policy))
    return SplatWorld(views[0], views[1], S)
