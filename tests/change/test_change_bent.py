"""Changes between captures of which one is bent, beside what changed in the place that they show."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from change_room import box, capture, stripes

import gsmap.map
from gsmap import change
from gsmap.geometry.transforms import transform_cameras, transform_gaussians
from gsmap.geometry.warps import deform_gaussians
from gsmap.map import Map
from gsmap.map.changes.compare import standing_comparisons
from gsmap.methods import RecipeKey
from gsmap.types import Cameras, ChangeReport, EdgeOutcome, PosedScene, PoseGraph, Registration, ScenePose, Sim3
from gsmap.types.registration import DEFORMATION_NOTES

SAG_M = 0.16  # 4 % of four metres
WENT = box(1.6, 1.2, 0.5, 0.4, 0.6, 6)
ROOM = [
    ([0, 0, 0], [4, 0, 0], [0, 3.4, 0], stripes(1)),
    ([0, 3.4, 0], [4, 0, 0], [0, 0, 2.2], stripes(2)),
    ([0, 0, 0], [0, 3.4, 0], [0, 0, 2.2], stripes(3)),
    ([4, 3.4, 0], [0, -3.4, 0], [0, 0, 2.2], stripes(4)),
    *box(2.7, 2.8, 1.2, 0.6, 1.6, 5),
    *box(0.6, 2.4, 0.8, 1.2, 0.9, 7),
    *box(3.4, 1.2, 0.7, 0.9, 0.7, 8),
]
POSE = Sim3(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([3.0, -1, 0.5]))


def walk(seed: int, count: int = 12) -> Cameras:
    """Cameras along the open side of the room, looking into it."""
    rng = np.random.default_rng([seed, 5])
    T = np.tile(np.eye(4), (count, 1, 1))
    for k, x in enumerate(np.linspace(0.6, 3.4, count)):
        eye = np.array([x, rng.uniform(-1.2, -0.4), 1.2 + 0.3 * (k % 3)])
        forward = np.array([rng.uniform(0, 4), rng.uniform(1.2, 3.4), rng.uniform(0, 1)]) - eye
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0, 0, 1.0])
        right /= np.linalg.norm(right)
        T[k, :3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
        T[k, :3, 3] = eye
    return Cameras(T, np.tile([88.0, 88, 64, 48], (count, 1)), np.tile([128, 96], (count, 1)))


def visited(rectangles: list, seed: int) -> PosedScene:
    return replace(capture(rectangles, seed), cameras=walk(seed))


def bent(scene: PosedScene) -> PosedScene:
    """Bend a capture: its ends rise by the sag."""

    def move(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        way, jacobians = (points[:, 0] - 2) / 2, np.tile(np.eye(3), (len(points), 1, 1))
        jacobians[:, 1, 0] = SAG_M * way
        return points + SAG_M * way[:, None] ** 2 * [0, 1, 0], jacobians

    gaussians = deform_gaussians(scene.gaussians, *move(scene.gaussians.means.astype(np.float64)))
    poses = scene.cameras.T_frame_camera.copy()
    poses[:, :3, 3], turns = move(poses[:, :3, 3])
    u, _, vt = np.linalg.svd(turns @ poses[:, :3, :3])
    poses[:, :3, :3] = u @ vt
    return PosedScene(gaussians, replace(scene.cameras, T_frame_camera=poses), scene.scene_id)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Map]:
    """A room, and the same room captured bent after a box went; their edge is named as bent."""
    with gsmap.map.create(tmp_path_factory.mktemp("bent") / "site.gsmap") as m:
        june, july = visited([*ROOM, *WENT], 1), bent(visited(ROOM, 2))
        m.ingest(june.gaussians, cameras=june.cameras, name="june", captured_at="2026-06-15", scale="known")
        away = POSE.inverse()
        gaussians, cameras = transform_gaussians(july.gaussians, away), transform_cameras(july.cameras, away)
        m.ingest(gaussians, cameras=cameras, name="july", captured_at="2026-07-15", scale="known")
        m.describe()
        a, b = (m.store.scenes.get(name).id for name in ("june", "july"))
        note = f"{DEFORMATION_NOTES[0]}to fit"
        edge = Registration(a, b, "accepted", "", POSE, np.eye(7), 99, 99, 0.8, "test", notes=(note,))
        m.store.registrations.save(edge, RecipeKey("register", "pair", {"register": 1}).of(a, b))
        placed = {a: ScenePose(a, Sim3.identity(), 0, "placed"), b: ScenePose(b, POSE, 0, "placed")}
        m.store.revisions.save(PoseGraph(placed, {(a, b): EdgeOutcome("used")}))
        yield m


@pytest.mark.guards("answers")
def test_a_bent_capture_changed_only_where_the_place_did(site: Map) -> None:
    report = site.changes()
    (went,) = (row for row in report.changes if row.kind != "lighting")
    assert went.kind == "disappeared"
    assert went.confidence > 0.9
    at = went.box_m - [1.6, 1.2, 0.3]
    assert np.abs(at - [[-0.25, -0.2, -0.3], [0.25, 0.2, 0.3]]).max() < 0.25  # the newer capture keeps its shape
    (pair,) = report.pairs
    assert "june is warped onto the other" in pair.notes[0]


def test_a_bent_pair_without_a_graph_is_not_compared(site: Map) -> None:
    try:
        (pair,) = site.with_settings({"describe.landmarks": False}).changes().pairs
    finally:
        site.with_settings({"describe.landmarks": True})
    assert (pair.num_changes, pair.seen_share) == (0, 0)
    assert pair.notes[0].startswith("not compared")


def test_a_comparison_without_a_warp_does_not_stand(site: Map) -> None:
    june, july = (site.store.scenes.get(name).id for name in ("june", "july"))
    site.store.changes.save(
        ChangeReport((), 1.0, np.ones(3)),
        change.recipe_key(site.settings.change).of(june, july),
        older=june,
        newer=july,
        S_newer_older=POSE.inverse(),
        S_frame_newer=POSE,
    )
    assert standing_comparisons(site.store, site.settings) == []
    assert len(site.changes().changes) > 0
    assert len(standing_comparisons(site.store, site.settings)) == 1
