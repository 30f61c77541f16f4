"""What an answer did not change stays to the last bit, and what stays is never far from what the edges say."""

import numpy as np
import pytest

from gsmap.geometry.rotations import exp_so3
from gsmap.geometry.similarities import Similarities, exp
from gsmap.optimize import Params, keep_unchanged_poses, optimize
from gsmap.types import Edge, Sim3

SIGMAS = np.array([2e-4] * 3 + [1e-3] * 3 + [1e-3])
PARAMS = Params()


class Street:
    """Captures four metres apart, each with noisy edges to the two before it."""

    def __init__(self, seed: int = 0) -> None:
        self.rng, self.edges, self.truth = np.random.default_rng(seed), [], []

    @property
    def ids(self) -> list[str]:
        return [f"{k:032x}" for k in range(len(self.truth))]

    def grow(self, *more: int) -> None:
        k = len(self.truth)
        self.truth.append(Sim3(exp_so3([0, 0, 0.02 * k]), [4.0 * k, np.sin(k / 5), 0]))
        for before in [*range(max(0, k - 2), k), *more]:
            step = self.rng.normal(size=(1, 7)) * SIGMAS * [1, 1, 1, 1, 1, 1, 0]
            S = self.truth[before].inverse() @ self.truth[k] @ exp(step).item(0)
            self.edges.append(Edge(self.ids[before], self.ids[k], S, np.diag(SIGMAS**-2.0)))

    def solved(self, previous=None):
        return optimize(self.ids, self.edges, (), previous, PARAMS)


def apart(one, two, edges) -> float:
    """How far two answers put neighbours from each other, at most, in standard deviations of their edge."""
    a, b = (
        Similarities.stack([g.poses[e.target].S_map_scene.inverse() @ g.poses[e.source].S_map_scene for e in edges])
        for g in (one, two)
    )
    xi = (a.inverse() @ b).log()
    return float(np.sqrt(np.einsum("ei,eij,ej->e", xi, np.array([e.information for e in edges]), xi)).max())


def moved(before, after) -> set[str]:
    return {
        scene
        for scene, pose in after.poses.items()
        if scene not in before.poses or pose.S_map_scene is not before.poses[scene].S_map_scene
    }


@pytest.fixture(scope="module")
def street() -> Street:
    made = Street()
    for _ in range(40):
        made.grow()
    return made


def test_a_new_scene_moves_only_its_surroundings(street):
    before = street.solved()
    ids = set(street.ids)
    street.grow()
    answer = street.solved(before)
    kept = keep_unchanged_poses(answer, before, street.edges, PARAMS)
    assert len(moved(before, answer)) == len(street.ids)
    far = moved(before, kept)
    assert set(street.ids) - ids <= far
    assert len(far) < 20
    assert apart(answer, kept, street.edges) < 10 * PARAMS.max_unchanged_sigmas
    for scene, pose in kept.poses.items():
        assert pose.component == answer.poses[scene].component
        assert pose.status == answer.poses[scene].status


def test_keeping_again_and_again_does_not_drift():
    street = Street(1)
    for _ in range(12):
        street.grow()
    kept = street.solved()
    for _ in range(25):
        street.grow()
        answer = street.solved(kept)
        kept = keep_unchanged_poses(answer, kept, street.edges, PARAMS)
        assert apart(answer, kept, street.edges) < 10 * PARAMS.max_unchanged_sigmas
    fresh = street.solved()
    steps = [fresh.poses[s].S_map_scene.inverse() @ kept.poses[s].S_map_scene for s in street.ids]
    sigma = [np.sqrt(np.diag(fresh.poses[s].covariance)) for s in street.ids]
    off = np.abs(Similarities.stack(steps).log()) - 1e-9
    assert (off <= 20 * PARAMS.max_unchanged_sigmas * np.array(sigma)).all()


def test_a_loop_that_closes_moves_what_it_holds(street):
    before = street.solved()
    street.grow(2)
    answer = street.solved(before)
    kept = keep_unchanged_poses(answer, before, street.edges, PARAMS)
    assert len(moved(before, kept)) > len(street.ids) // 2
    assert apart(answer, kept, street.edges) < 10 * PARAMS.max_unchanged_sigmas


def test_without_an_answer_before_nothing_is_kept(street):
    answer = street.solved()
    assert keep_unchanged_poses(answer, None, street.edges, PARAMS) is answer
