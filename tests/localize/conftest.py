"""Made once for all tests of the room: a made place with photographs of it; and a flat with a scan of a room of it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pytest
from scanned_flat import SEED, SIZE_PX, Flat, Scanned, scanned

import gsmap
from gsmap.geometry.rotations import exp_so3
from gsmap.localize import MapScene, Params, ViewIndex, new_segment, scene_features, view_index
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
    def placed(self) -> MapScene:
        found = scene_features(
            "scene", self.capture.gaussians, self.capture.cameras, sift.make({}, sift.Params()), Params().views
        )
        return MapScene("scene", self.S_world_scene, 0, None, lambda: self.capture.gaussians, lambda: found)

    @cached_property
    def index(self) -> ViewIndex:
        return view_index([new_segment([(self.placed.features, "0" * 32)])])

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


@pytest.fixture(scope="session")
def flat(tmp_path_factory: pytest.TempPathFactory) -> Flat:
    path = tmp_path_factory.mktemp("flat") / "flat.gsmap"
    captures = make_captures(SEED, 2, steps=0, num_frames=24, num_gaussians=20_000, size_px=SIZE_PX)
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
