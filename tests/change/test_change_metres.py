"""Changes of a map whose unit is not the metre: found in metres, told in the map's frame."""

import numpy as np
import pytest
from change_room import box, capture, shell

import gsmap.map
from gsmap.geometry.transforms import transform_cameras, transform_gaussians
from gsmap.types import Sim3

UNIT = 10.0  # metres
QUICK = {"change.max_views": 16, "change.longest_side_px": 128}


@pytest.fixture
def made(tmp_path):
    """Makes maps of a room before and after a box went, in a unit."""
    room = [*shell(), *box(2.2, 2.5, 0.6, 0.5, 0.7, 5)]
    scenes = [capture([*room, *box(0.9, 1.2, 0.5, 0.4, 0.6, 6)], 1), capture(room, 2)]
    opened = []

    def make(unit):
        S = Sim3(np.eye(3), np.zeros(3), 1 / unit)
        m = gsmap.map.create(tmp_path / f"{unit}.gsmap")
        opened.append(m)
        m = m.with_settings(QUICK)
        for day, scene in enumerate(scenes, 1):
            gaussians, cameras = transform_gaussians(scene.gaussians, S), transform_cameras(scene.cameras, S)
            m.ingest(gaussians, cameras=cameras, name=scene.scene_id, scale="unknown", captured_at=f"2026-01-0{day}")
        m.add_edge("c1:c2", Sim3.identity(), np.array([1e-3] * 3 + [1e-3 / unit] * 3 + [1e-6]))
        m.optimize()
        m.edit("c1", metres_per_unit=unit)
        return m

    yield make
    for m in opened:
        m.close()


def test_changes_are_found_in_metres_and_told_in_the_map(made, tmp_path, monkeypatch):
    monkeypatch.setenv("GSMAP_WORKERS", "1")
    metric, other = made(1.0), made(UNIT)
    one, two = metric.changes(), other.changes(pictures=tmp_path / "pictures")
    (gone,), (found,) = one.changes, two.changes
    assert (gone.kind, found.kind) == ("disappeared", "disappeared")
    np.testing.assert_allclose(found.box_m, gone.box_m, atol=0.11)  # a voxel
    np.testing.assert_allclose(found.box * UNIT, found.box_m)
    assert np.abs(found.box_m - [[0.65, 1.0, 0.0], [1.15, 1.4, 0.6]]).max() < 0.12
    assert found.confidence == pytest.approx(gone.confidence, abs=0.05)
    assert two.pairs[0].seen_share == pytest.approx(one.pairs[0].seen_share, abs=0.01)
    np.testing.assert_array_equal(other.show_change(found.id).box_m, found.box_m)
    voxels = other.read_change(found.id).voxels * UNIT
    assert (np.abs(voxels - [0.9, 1.2, 0.3]) < [0.4, 0.35, 0.45]).all()
    assert (tmp_path / "pictures" / f"{found.id}.png").is_file()
    # The same metre is the same comparison, another one is another.
    assert other.changes().pairs[0].compared_at == two.pairs[0].compared_at
    other.edit("c1", metres_per_unit=2 * UNIT)
    assert other.changes().pairs[0].compared_at != two.pairs[0].compared_at


def test_a_capture_that_moved_by_less_than_a_length_in_metres_is_not_compared_again(made, monkeypatch):
    monkeypatch.setenv("GSMAP_WORKERS", "1")
    other = made(UNIT)
    at = other.changes().pairs[0].compared_at
    other.add_edge("c1:c2", Sim3(np.eye(3), [0.01 / UNIT, 0, 0]), np.array([1e-3] * 3 + [1e-3 / UNIT] * 3 + [1e-6]))
    other.optimize()
    assert other.changes().pairs[0].compared_at == at  # by 1 cm
    other.add_edge("c1:c2", Sim3(np.eye(3), [0.05 / UNIT, 0, 0]), np.array([1e-3] * 3 + [1e-3 / UNIT] * 3 + [1e-6]))
    other.optimize()
    assert other.changes().pairs[0].compared_at != at  # by 5 cm, though by 0.005 units
