"""A small map of three captures of a flat, and a scan of a room of it."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from scanned_flat import SEED, SIZE_PX, Flat, Scanned, scanned

import gsmap
from gsmap_synthetic import make_captures


@pytest.fixture(scope="session")
def flat(tmp_path_factory: pytest.TempPathFactory) -> Flat:
    path = tmp_path_factory.mktemp("flat") / "flat.gsmap"
    captures = make_captures(SEED, 2, steps=0, num_frames=18, num_gaussians=20_000, size_px=SIZE_PX)
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
