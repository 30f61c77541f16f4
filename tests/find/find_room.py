"""One room in which stools repeat, captured twice."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).resolve().parents[1] / "describe"))
from made_room import Room, looking_about

from gsmap.geometry.rotations import exp_so3
from gsmap.geometry.transforms import transform_cameras, transform_gaussians
from gsmap.map import Map
from gsmap.types import PoseGraph, ScenePose, Sim3

FRAMES = {
    "may": Sim3(exp_so3(np.array([0, 0, 0.4])), np.array([3.0, 1, 0.2])),
    "june": Sim3(exp_so3(np.array([0, 0, -1.0])), np.array([-2.0, 5, 1])),
}
DATES = {"may": "2026-05-31", "june": "2026-06-30"}
YELLOW = [(0.8, 2.3), (2.3, 2.4), (3.4, 1.2)]
RED, TABLE, CUPBOARD = (1.3, 0.5), (2.6, 0.35), (0.25, 1.0)
SETTINGS = {"describe.landmarks": False, "describe.object.num_cameras": 12}


def capture(seed: int):
    room = Room(seed)
    room.box([0.03, 0.5, 0.0], [0.5, 1.5, 1.8], (0.5, 0.3, 0.2), 0)
    room.box([2.0, 0.03, 0.0], [3.2, 0.7, 0.75], (0.25, 0.35, 0.75), 1)
    for i, (x, y) in enumerate([*YELLOW, RED]):
        colour = (0.75, 0.7, 0.1) if i < len(YELLOW) else (0.8, 0.1, 0.1)
        room.box([x - 0.2, y - 0.2, 0.0], [x + 0.2, y + 0.2, 0.45], colour, 2 + i)
    return room.made()[0], looking_about()


def fill(m: Map) -> None:
    """Ingest and place the captures; they are not described."""
    for number, name in enumerate(FRAMES, start=1):
        gaussians, cameras = capture(number)
        S = FRAMES[name]
        m.ingest(
            transform_gaussians(gaussians, S),
            cameras=transform_cameras(cameras, S),
            name=name,
            captured_at=DATES[name],
            scale="known",
        )
    poses = {s.id: ScenePose(s.id, FRAMES[s.name].inverse(), 0, "placed") for s in m.scenes()}
    m.store.revisions.save(PoseGraph(poses))
