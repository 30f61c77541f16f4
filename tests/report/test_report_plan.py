import io

import numpy as np
import pytest
from PIL import Image

from gsmap.geometry.rotations import exp_so3
from gsmap.geometry.similarities import exp
from gsmap.geometry.uncertainty import largest_sigma, middle_covariance_m2
from gsmap.report import PlanEdge, PlanScene, density_picture, make_plan, top_picture
from gsmap.report.draw_plan import draw_plan, ellipse
from gsmap.report.plan import rings
from gsmap.types import Gaussians, ScenePose, Sim3

NONE = np.zeros((0, 3))


def room(rng: np.random.Generator, size=(8.0, 3.0, 2.5), num: int = 4000) -> np.ndarray:
    """Points on the floor and the walls of a room, z up."""
    points = rng.uniform(size=(num, 3)) * size
    side = rng.integers(0, 5, num)
    for axis, at in ((0, 0), (0, 1), (1, 0), (1, 1), (2, 0)):
        points[side == 2 * axis + at, axis] = at * size[axis]
    return points


def shown(points: np.ndarray, **more) -> PlanScene:
    return PlanScene(
        **({"name": "a", "status": "placed", "points": points, "track": NONE, "middle": points.mean(0)} | more)
    )


def test_the_middle_is_as_uncertain_as_drawn_poses_say():
    rng = np.random.default_rng(1)
    root = rng.normal(size=(7, 7)) * 0.01
    pose = ScenePose("a", Sim3(exp_so3(rng.normal(size=3)), rng.normal(size=3), 2.0), 0, "placed", root @ root.T)
    middle = np.array([3.0, -1.0, 0.5])
    drawn = exp(rng.multivariate_normal(np.zeros(7), pose.covariance, 20_000))
    points = pose.S_map_scene.apply(drawn.apply(np.tile(middle, (len(drawn), 1))))
    told = middle_covariance_m2(pose, middle, metres_per_unit=0.5)
    np.testing.assert_allclose(told, np.cov((0.5 * points).T), atol=0.06 * np.trace(told))
    assert middle_covariance_m2(ScenePose("a", pose.S_map_scene, 0, "placed"), middle, 1.0) is None
    turn = exp_so3(np.array([0.4, -0.2, 1.0]))
    assert largest_sigma(turn @ np.diag([1e-4, 9e-4, 4e-4]) @ turn.T) == pytest.approx(0.03)


def test_a_plan_is_seen_from_above_with_its_walls_along_the_page():
    points = room(np.random.default_rng(2))
    turn = exp_so3([0.4, -0.8, 1.1])
    plan = make_plan([shown(points @ turn.T)], [], turn @ [0, 0, 1.0], metres_per_unit=0.5)
    np.testing.assert_allclose(plan.R_plan_map @ turn @ [0, 0, 1.0], [0, 0, 1], atol=1e-9)
    width, height = plan.bounds[1] - plan.bounds[0]
    assert width == pytest.approx(4.4, abs=0.25)
    assert height == pytest.approx(1.9, abs=0.25)
    np.testing.assert_allclose(plan.place(points @ turn.T)[:, 2], 0.5 * points[:, 2], atol=1e-9)


def test_outlines_follow_what_a_scene_shows():
    rng = np.random.default_rng(3)
    points = rng.uniform(size=(6000, 3)) * [8, 8, 0.1]
    points = points[(points[:, 0] < 4) | (points[:, 1] < 4)]  # an L
    (ring,) = make_plan([shown(points)], [], None).footprints[0]
    x, y = ring.T
    area = 0.5 * abs(np.dot(x, np.roll(y, 1)) - np.dot(y, np.roll(x, 1)))
    assert area == pytest.approx(48, rel=0.05)  # corners are smoothed


def test_outlines_hold_all_ground_and_no_floaters():
    rng = np.random.default_rng(7)
    ground = rng.uniform(size=(3000, 3)) * [10, 8, 0.1]
    plant = rng.normal(size=(200_000, 3)) * 0.3 + [5, 4, 0]  # 98.5 % of the points
    hall = ground + np.array([30, 0, 0])
    haze = rng.uniform(-50, 50, (2000, 3))
    far = rng.uniform(-1e7, 1e7, (5, 3))
    for points, area in (((ground, plant), 80), ((ground, plant, hall), 160), ((ground, plant, haze, far), 80)):
        found = make_plan([shown(np.concatenate(points), middle=np.zeros(3))], [], None).footprints[0]
        areas = [np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1)) for x, y in (ring.T for ring in found)]
        assert 0.5 * sum(areas) == pytest.approx(area, rel=0.05)


def test_rings_go_around_cells_and_holes():
    mask = np.zeros((6, 5), bool)
    mask[1:4, 1:4] = True
    mask[2, 2] = False
    mask[4, 4] = True  # touches at a corner
    found = rings(mask)
    areas = [0.5 * float(np.dot(r[:, 0], np.roll(r[:, 1], -1)) - np.dot(r[:, 1], np.roll(r[:, 0], -1))) for r in found]
    assert abs(sum(areas)) == mask.sum()


def test_an_ellipse_holds_its_share():
    rng = np.random.default_rng(4)
    covariance = np.array([[4.0, 1.5], [1.5, 1.0]])
    points = rng.multivariate_normal(np.zeros(2), covariance, 40_000)
    edge = ellipse(covariance)
    limits = np.einsum("ni,ij,nj->n", edge, np.linalg.inv(covariance), edge)
    np.testing.assert_allclose(limits, limits[0], rtol=1e-9)
    inside = np.einsum("ni,ij,nj->n", points, np.linalg.inv(covariance), points) <= limits[0]
    assert inside.mean() == pytest.approx(0.95, abs=0.005)


def test_small_ellipses_are_magnified_by_a_round_factor():
    points = room(np.random.default_rng(5))
    for sigma, factor in ((1e-3, 200), (0.1, 2), (5.0, 1)):
        plan = make_plan([shown(points, covariance_m2=np.eye(3) * sigma**2)], [], None)
        assert draw_plan(plan, "p")[1] == factor
    assert draw_plan(make_plan([shown(points)], [], None), "p")[1] == 0


def blobs(at: np.ndarray, colours: np.ndarray) -> Gaussians:
    n = len(at)
    quats = np.tile([1.0, 0, 0, 0], (n, 1))
    return Gaussians(at, quats, np.full((n, 3), np.log(0.15)), np.full(n, 6.0), ((colours - 0.5) / 0.28209)[:, None])


def test_the_picture_lies_where_the_plan_has_it_and_shows_no_ceiling():
    rng = np.random.default_rng(6)
    points = room(rng)
    red = np.array([6.0, 2.0, 0.2])
    ceiling = np.column_stack([rng.uniform(0, 8, 500), rng.uniform(0, 3, 500), np.full(500, 2.5)])
    at = np.concatenate([points[points[:, 2] == 0][:400], red[None], ceiling])
    colours = np.tile([0.2, 0.8, 0.2], (len(at), 1))
    colours[len(at) - 501] = [1, 0, 0]
    colours[-500:] = [0, 0, 1]
    plan = make_plan([shown(points)], [], None)
    eyes = np.column_stack([rng.uniform(0, 8, 20), rng.uniform(0, 3, 20), np.full(20, 1.6)])
    S_map_scene = Sim3(exp_so3(rng.normal(size=3)), rng.normal(size=3), 1.0)
    part = blobs(S_map_scene.inverse().apply(at), colours)
    picture = np.asarray(Image.open(io.BytesIO(top_picture([(part, S_map_scene)], plan, eyes, 400))), float) / 255
    assert max(picture.shape[:2]) == 400
    x, y = (plan.place(red)[0, :2] - plan.bounds[0]) / (plan.bounds[1] - plan.bounds[0])
    pixel = picture[int((1 - y) * picture.shape[0]), int(x * picture.shape[1])]
    assert pixel[0] > 0.7
    assert pixel[3] > 0.9
    seen = picture[picture[..., 3] > 0.9]
    assert (seen[:, 2] < 0.6).mean() > 0.95  # the ceiling is blue
    assert picture[0, 0, 3] < 0.1


def test_landmarks_are_shaded_where_they_lie():
    points = room(np.random.default_rng(7))
    plan = make_plan([shown(points)], [], None)
    picture = np.asarray(Image.open(io.BytesIO(density_picture(points, plan, 600))))
    assert picture.shape[2] == 4
    assert picture[0, 0, 3] < 10 < picture[..., 3].max()


def test_what_has_no_extent_is_still_drawn():
    one = shown(np.zeros((8, 3)), middle=np.zeros(3))
    plan = make_plan([one, one], [PlanEdge(0, 1, "used")], None)
    assert np.isfinite(plan.bounds).all()
    assert "<svg" in draw_plan(plan, "p")[0].html
    assert make_plan([], [], None) is None
    assert make_plan([shown(np.full((8, 3), np.nan), middle=np.zeros(3))], [], None) is None


def test_ellipses_turn_with_the_plan():
    points = room(np.random.default_rng(8))
    turn = exp_so3([0.0, 0.0, 0.6])
    along = turn @ np.diag([4.0, 1.0, 1.0]) @ turn.T * 1e-4  # longest along the room
    plan = make_plan([shown(points @ turn.T, covariance_m2=along)], [], None)
    np.testing.assert_allclose(plan.covariances[0], np.diag([4e-4, 1e-4]), atol=3e-5)
