"""One made room, captured once, and photographs of it from elsewhere: made once for all tests of the room."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pytest

from gsmap.geometry.rotations import exp_so3
from gsmap.localize import Params, PlacedFeatures, ViewIndex, scene_features
from gsmap.localize.extractors import sift
from gsmap.types import Sim3
from gsmap.types.localization import Photo
from gsmap_synthetic import film, make_captures, make_place, walk


@dataclass(eq=False)
class World:
    """A place, one capture of it in its own frame, and photographs with truth (camera to place)."""

    seed: int
    focal: float = 0.7

    @cached_property
    def place(self):
        return make_place(self.seed, rooms=3, texel_m=0.012)

    @cached_property
    def capture(self):
        return make_captures(
            num_captures=1,
            place=self.place,
            routes=[(0,)],
            steps=150,
            num_frames=24,
            num_gaussians=40_000,
            size_px=(400, 300),
        )[0]

    @cached_property
    def S_world_scene(self) -> Sim3:
        return Sim3.from_matrix(self.capture.T_scene_world).inverse()

    @cached_property
    def placed(self) -> PlacedFeatures:
        found = scene_features(
            "scene", self.capture.gaussians, self.capture.cameras, sift.make({}, sift.Params()), Params().views
        )
        return PlacedFeatures("scene", self.S_world_scene, 0, None, lambda: self.capture.gaussians, lambda: found)

    @cached_property
    def index(self) -> ViewIndex:
        found = self.placed.features
        views = np.arange(found.num_views)
        return ViewIndex(("scene",), found.summaries, np.zeros_like(views), views)

    @cached_property
    def poses(self) -> np.ndarray:
        """(3, 4, 4) of photographs: beside where the capture's cameras stood."""
        rng = np.random.default_rng(3)
        own = walk(self.place, (0,), 24, seed=0)[[3, 10, 20]].copy()
        for pose in own:
            pose[:3, :3] = pose[:3, :3] @ exp_so3(rng.normal(size=3) * 0.03)
            pose[:3, 3] += rng.normal(size=3) * 0.06
        return own

    @cached_property
    def photos(self) -> list[Photo]:
        frames = film(self.place, self.poses, size_px=(480, 360), focal=self.focal, gain=0.85)
        return [
            Photo(image, intrinsics, 0.0, f"photo {i}")
            for i, (image, intrinsics) in enumerate(zip(frames.images, frames.cameras.intrinsics_px, strict=True))
        ]


@pytest.fixture(scope="session")
def world() -> World:
    return World(7)


@pytest.fixture(scope="session")
def elsewhere() -> World:
    return World(8)
