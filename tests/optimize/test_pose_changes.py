"""Changes of poses between two answers, against hand-computed ones."""

from __future__ import annotations

import numpy as np
import pytest

from gsmap.geometry.rotations import exp_so3
from gsmap.optimize import diff, motion, moved
from gsmap.types import PoseGraph, ScenePose, Sim3

TURN = Sim3(exp_so3([0, 0, np.pi / 2]), np.array([0.0, 0, 0]), 2.0)


def test_motion_is_measured_at_the_content() -> None:
    """A quarter turn and twice the size take (3, 0, 0) to (0, 6, 0)."""
    assert motion(Sim3.identity(), TURN) == pytest.approx((90.0, 0.0, 2.0))
    assert motion(Sim3.identity(), TURN, np.array([3.0, 0, 0])) == pytest.approx((90.0, np.hypot(3, 6), 2.0))
    assert motion(TURN, Sim3.identity(), np.array([3.0, 0, 0])) == pytest.approx((90.0, np.hypot(3, 6), 0.5))


@pytest.mark.guards("answers")
@pytest.mark.parametrize(("threshold_m", "yes"), [(6.70, True), (6.71, False)])
def test_a_scene_has_moved_where_any_of_its_corners_has(threshold_m: float, yes: bool) -> None:
    corners = np.array([[0.0, 0, 0], [3.0, 0, 0], [0, 0, 1.0]])
    assert moved(Sim3.identity(), TURN, threshold_m, corners) is yes
    assert moved(Sim3.identity(), TURN, threshold_m, corners[::-1]) is yes
    assert moved(TURN, TURN, 0.0, corners) is False


def test_a_scene_without_content_has_not_moved() -> None:
    assert moved(Sim3.identity(), TURN, 0.1, np.zeros((0, 3))) is False


@pytest.mark.guards("answers")
def test_each_scene_of_both_answers_has_its_change() -> None:
    def graph(**poses: tuple[Sim3, int]) -> PoseGraph:
        return PoseGraph({s: ScenePose(s, S, component, "placed") for s, (S, component) in poses.items()}, {})

    here = Sim3.identity()
    up, larger = Sim3(np.eye(3), np.array([0.0, 0, 1])), Sim3(np.eye(3), np.zeros(3), 2.0)
    before = graph(a=(here, 0), b=(here, 0), c=(here, 0), d=(here, 0), e=(here, 0), gone=(here, 1))
    after = graph(new=(here, 0), a=(here, 0), b=(TURN, 0), c=(here, 1), d=(up, 0), e=(larger, 0))
    found = diff(before, after, {"b": np.array([3.0, 0, 0])})
    assert [(s, change.kind) for s, change in found.items()] == [
        ("new", "added"),
        ("a", "same"),
        ("b", "moved"),
        ("c", "moved"),  # to another component
        ("d", "moved"),
        ("e", "moved"),  # by its scale alone
        ("gone", "removed"),
    ]
    assert (found["b"].rotation_deg, found["b"].translation) == pytest.approx((90.0, np.hypot(3, 6)))
    assert (found["new"].components, found["gone"].components) == ((None, 0), (1, None))
