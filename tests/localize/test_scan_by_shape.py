"""A pair without colours is told by its shape, or not at all."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from gsmap.geometry.camera_synthesis import synthesise_cameras
from gsmap.geometry.rotations import angle_between
from gsmap.localize.scan import as_gaussians
from gsmap.register import SceneView, by_shape
from gsmap.register.by_shape import register_by_shape
from gsmap.register.evidence import PoseEvidence
from gsmap.register.pose_selection import EvaluatedPose
from gsmap.types import NodeLayer, SceneGraph, Sim3
from gsmap.types.registration import Proposal
from gsmap.types.scan import Scan
from gsmap_synthetic import film, make_captures, make_place, walk

SEEN = PoseEvidence(
    overlap=0.6, num_coinciding=8000, free_space_violation=0.02, num_seen=9000, disagreement=0.01, seen_m2=40
)


def proposal(inliers: int = 100) -> Proposal:
    return Proposal("kiss_matcher", Sim3.identity(), False, inliers)


def test_evidence_only_speaks_for_or_against() -> None:
    sure = by_shape.probability(proposal(), SEEN, 0.2)
    assert sure > 0.95
    for worse in (
        replace(SEEN, disagreement=0.3),
        replace(SEEN, overlap=0.05),
        replace(SEEN, disagreement=float("nan")),
    ):
        assert by_shape.probability(proposal(), worse, 0.2) < sure
    assert by_shape.probability(proposal(6), SEEN, 0.2) < sure
    hopeless = PoseEvidence(overlap=0.1, free_space_violation=0.4, disagreement=0.3, seen_m2=20)
    assert by_shape.probability(proposal(6), hopeless, 0.2) < 0.1


def view(name: str, gaussians: Any, cameras: Any) -> SceneView:
    graph = SceneGraph(name, {"landmarks": NodeLayer.empty("none")})
    return SceneView(name, gaussians, cameras, graph, "known")


@pytest.fixture(scope="module")
def pair() -> tuple[SceneView, SceneView, np.ndarray]:
    place = make_place(31, rooms=3)
    options: dict[str, Any] = {"steps": 0, "num_frames": 20, "num_gaussians": 20_000, "size_px": (144, 108)}
    (capture,) = make_captures(31, 1, place=place, routes=[(0, 1)], **options)
    frames = film(place, walk(place, (0,), 8, seed=5), size_px=(144, 108))
    from scanned_flat import world_points

    gaussians = as_gaussians(Scan(world_points(frames)[0]), 0.02)
    target = view("capture", capture.gaussians, capture.cameras)
    return target, view("scan", gaussians, synthesise_cameras(gaussians)), capture.T_scene_world


def test_a_room_is_found_by_its_shape(pair: tuple[SceneView, SceneView, np.ndarray]) -> None:
    target, source, T = pair
    found = register_by_shape(target, source)
    assert found.status == "accepted", found.reason
    assert found.S_target_source is not None
    assert found.evidence["probability"] > 0.9
    assert np.degrees(angle_between(found.S_target_source.rotation, T[:3, :3])) < 1
    off = found.S_target_source.apply(source.centre) - T[:3, :3] @ source.centre - T[:3, 3]
    assert np.linalg.norm(off) < 0.05


def test_a_shape_that_fits_twice_is_ambiguous(
    pair: tuple[SceneView, SceneView, np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    target, source, _ = pair
    covariance = np.eye(7) * 1e-8
    twice = [EvaluatedPose(proposal(), SEEN, covariance, flaw="") for _ in range(2)]
    monkeypatch.setattr(by_shape, "evaluate_by_shape", lambda *_: twice)
    assert "fit in two ways" in register_by_shape(target, source).reason
    monkeypatch.setattr(by_shape, "evaluate_by_shape", lambda *_: twice[:1])
    assert register_by_shape(target, source).status == "accepted"
    wide = [EvaluatedPose(proposal(), SEEN, np.eye(7), flaw="")]
    monkeypatch.setattr(by_shape, "evaluate_by_shape", lambda *_: wide)
    assert "determines the pose only to" in register_by_shape(target, source).reason
    monkeypatch.setattr(by_shape, "evaluate_by_shape", lambda *_: [])
    assert register_by_shape(target, source).status == "no_match"


def test_shapes_of_unknown_size_are_not_compared(pair: tuple[SceneView, SceneView, np.ndarray]) -> None:
    target, source, _ = pair
    unknown = replace(source, scale_policy="unknown", graph=SceneGraph("scan"))
    assert "metres" in register_by_shape(target, unknown).reason
