"""What two scenes say of each other through their cameras, on walls placed for the purpose, and the verdict on it."""

from dataclasses import replace

import numpy as np
import pytest
from register_worlds import splat_world

from gsmap.geometry.rotations import exp_so3
from gsmap.geometry.transforms import transform_cameras, transform_gaussians
from gsmap.register import verdict
from gsmap.register.evidence import (
    CrossViewStats,
    PoseEvidence,
    _depth_range,
    _opponent_colours,
    _pattern_correlation,
    measure,
)
from gsmap.register.surface import Surface
from gsmap.register.view_cache import ViewCache, select_views
from gsmap.types import Cameras, Gaussians, Proposal, Sim3

_RIGHT = Sim3.identity()


def _wall(z, *, width=4.0, height=3.0, centre=(0.0, 0.0), step=0.03, seed=0, gain=1.0, offset=0.0) -> Gaussians:
    """A textured wall across the z axis, as Gaussians on a jittered grid; the texture is a function of place."""
    rng = np.random.default_rng([seed, int(100 * z)])
    x, y = np.meshgrid(np.arange(-width / 2, width / 2, step), np.arange(-height / 2, height / 2, step))
    points = np.c_[x.ravel() + centre[0], y.ravel() + centre[1], np.full(x.size, z)]
    points[:, :2] += rng.uniform(-0.3, 0.3, (len(points), 2)) * step
    paint = np.random.default_rng(seed)
    waves, phases = paint.normal(size=(3, 8, 3)) * 6, paint.uniform(0, 6, (3, 8))
    colours = np.stack([0.5 + 0.1 * np.sin(points @ w.T + p).sum(1) for w, p in zip(waves, phases, strict=True)], 1)
    sh = (np.clip(colours, 0, 1) * gain + offset - 0.5)[:, None] / 0.28209479177387814
    n = len(points)
    return Gaussians(points, np.tile([1.0, 0, 0, 0], (n, 1)), np.full((n, 3), np.log(0.02)), np.full(n, 4.0), sh)


def _cameras(*centres, turn=(0.0, 0.0, 0.0)) -> Cameras:
    """Cameras that look along z."""
    poses = np.tile(np.eye(4), (len(centres), 1, 1))
    poses[:, :3, :3] = exp_so3(np.asarray(turn))
    poses[:, :3, 3] = centres
    return Cameras(poses, np.tile([120.0, 120, 80, 60], (len(poses), 1)), np.tile([160, 120], (len(poses), 1)))


_HERE = _cameras((0.0, 0, 0), (0.3, 0, 0), (-0.3, 0.1, 0))


def _measured(target, source, pose=_RIGHT, cameras=(_HERE, _HERE), unit_s=1.0) -> PoseEvidence:
    """The evidence of two scenes; the target is in metres, the source in units of ``unit_s``."""
    views = [
        None if c is None else (ViewCache(g, c), unit)
        for g, c, unit in ((target, cameras[0], 1.0), (source, cameras[1], unit_s))
    ]
    return measure(Surface.of(target), Surface.of(source, unit_s), pose, tuple(views))


@pytest.mark.parametrize(("ahead_m", "made", "said"), [(1.5, False, True), (1.5, True, False), (0.5, True, True)])
def test_a_made_view_vouches_for_a_metre_in_front_of_what_it_sees(ahead_m, made, said):
    cameras = replace(_HERE, synthesised=made)
    # A part of the source lies on the target's wall, the other in front of it.
    beside = _wall(3.0, width=1.5, centre=(-1.0, 0.0))
    board = _wall(3.0 - ahead_m, width=0.8, height=0.8, centre=(0.4, 0.0))
    with_board = _measured(_wall(3.0), Gaussians.concatenate([beside, board]), cameras=(cameras, None))
    without = _measured(_wall(3.0), beside, cameras=(cameras, None))
    assert without.free_space_violation == 0.0
    assert (with_board.free_space_violation > 0.1) is said


def test_two_captures_of_one_wall_agree():
    found = _measured(_wall(3.0), _wall(3.0))
    assert found.free_space_violation == 0.0
    assert found.colour_correlation > 0.95
    assert found.colour_t > 4
    assert found.num_seen > 2000


@pytest.mark.guards("answers")
def test_what_stands_in_front_contradicts_and_what_lies_behind_does_not():
    bare, screened = _wall(3.0), Gaussians.concatenate([_wall(3.0), _wall(1.5, width=0.8, height=2.0)])
    # To the cameras of the bare wall the screen stands in the way; to the others the wall behind it is hidden.
    assert 0.1 < _measured(bare, screened, cameras=(_HERE, None)).free_space_violation < 0.6
    assert _measured(screened, bare, cameras=(_HERE, None)).free_space_violation < 0.005
    # Both ways together, the contradiction counts.
    for pair in ((bare, screened), (screened, bare)):
        assert 0.1 < _measured(*pair).free_space_violation < 0.6


def test_a_wall_seen_past_the_edge_of_another_is_judged_where_both_see():
    # The source's wall is set back by half a metre: before the target's cameras it lies behind, and proves nothing;
    # the source's cameras saw through the target's.
    target, source = _wall(3.0), _wall(3.5)
    one_sided = [_measured(target, source, cameras=c) for c in ((_HERE, None), (None, _HERE))]
    assert np.isnan(one_sided[0].free_space_violation)
    assert one_sided[1].free_space_violation > 0.95
    assert _measured(target, source).free_space_violation > 0.95


def test_exposure_does_not_matter_and_another_texture_does():
    target = _wall(3.0)
    same, dim, other = (
        _measured(target, s) for s in (_wall(3.0), _wall(3.0, gain=0.6, offset=0.1), _wall(3.0, seed=5))
    )
    assert abs(same.colour_correlation - dim.colour_correlation) < 0.02
    assert abs(other.colour_correlation) < 0.15
    assert abs(other.colour_t) < 3
    assert other.free_space_violation == 0.0  # the shape is right


def test_a_pose_a_little_off_agrees_less():
    target, source = _wall(3.0), _wall(3.0)
    right, near, far = (_measured(target, source, Sim3(np.eye(3), [x, 0, 0])) for x in (0.0, 0.05, 0.3))
    assert right.colour_correlation > near.colour_correlation + 0.02
    assert near.colour_correlation > far.colour_correlation + 0.3


def test_rooms_half_a_turn_off_contradict_each_other():
    world = splat_world(0, points=30_000)
    surfaces = Surface.of(world.target.gaussians), Surface.of(world.source.gaussians)
    views = (world.target.views, 1.0), (world.source.views, 1.0)
    right = measure(*surfaces, world.S_target_source, views)
    assert right.free_space_violation < 0.01
    assert right.colour_correlation > 0.6
    assert right.colour_t > 5
    assert right.num_seen > 500
    # About the vertical through the middle of the shared part.
    turn = exp_so3([0, 0, np.pi])
    middle = np.array([3.0, 2.0, 1.2])
    wrong = measure(*surfaces, Sim3(turn, middle - turn @ middle) @ world.S_target_source, views)
    assert wrong.colour_correlation < 0.1
    assert wrong.free_space_violation > 0.1


def test_units_and_frames_change_nothing():
    target, source = Gaussians.concatenate([_wall(3.0), _wall(1.5, width=0.8)]), _wall(3.0)
    expected = _measured(target, source)
    move = Sim3(exp_so3([0.3, -1.0, 0.5]), [5.0, -2.0, 1.0], 4.0)  # the source's own unit is a quarter of a metre
    moved, cameras = transform_gaussians(source, move), transform_cameras(_HERE, move)
    pose = Sim3(move.rotation, move.translation * 0.25).inverse()
    found = _measured(target, moved, pose, (_HERE, cameras), unit_s=0.25)
    assert found.free_space_violation == pytest.approx(expected.free_space_violation, abs=0.01)
    assert found.colour_correlation == pytest.approx(expected.colour_correlation, abs=0.01)
    # A pose may scale by itself, too.
    larger = Sim3(np.eye(3), np.zeros(3), 1.2)
    grown, cameras = transform_gaussians(source, larger), transform_cameras(_HERE, larger)
    found = _measured(target, grown, larger.inverse(), (_HERE, cameras))
    assert found.free_space_violation == pytest.approx(expected.free_space_violation, abs=0.02)
    assert found.colour_correlation == pytest.approx(expected.colour_correlation, abs=0.02)


def test_cameras_that_see_nothing_say_nothing():
    wall = _wall(3.0)
    away, inside = _cameras((0.0, 0, 0), turn=(0.0, np.pi, 0.0)), _cameras((0.0, 0, 3.0), (0.5, 0, 3.0))
    for sightless in (away, inside):
        alone = _measured(wall, wall, cameras=(sightless, sightless))
        assert np.isnan(alone.free_space_violation)
        assert (alone.num_seen, alone.colour_correlation, alone.colour_t) == (0, 0.0, 0.0)
        # The other scene's cameras are heard all the same.
        helped = _measured(wall, wall, cameras=(sightless, _HERE))
        assert helped.free_space_violation == 0.0
        assert helped.num_seen == 0
        assert helped.colour_correlation > 0.95


def test_without_cameras_the_colours_of_coinciding_cells_speak():
    wall = _wall(3.0)
    right, other = (_measured(wall, s, cameras=(None, None)) for s in (_wall(3.0), _wall(3.0, seed=5)))
    assert np.isnan(right.free_space_violation)
    assert right.colour_correlation > 0.9
    assert right.colour_t > 4
    assert abs(other.colour_correlation) < 0.15


def test_haze_that_only_a_foreign_camera_meets_is_not_held_against_a_scene():
    # Floaters between the camera and the wall: faint or huge, so no surface.
    rng = np.random.default_rng(0)
    points = np.c_[rng.uniform(-1, 1, (600, 2)), rng.uniform(1, 2.5, 600)]
    quats, sh = np.tile([1.0, 0, 0, 0], (600, 1)), np.zeros((600, 1, 3))
    faint = Gaussians(points, quats, np.full((600, 3), np.log(0.1)), np.full(600, -2.5), sh)
    huge = Gaussians(points, quats, np.full((600, 3), np.log(0.5)), np.full(600, 2.0), sh)
    for haze in (faint, huge):
        found = _measured(_wall(3.0), Gaussians.concatenate([_wall(3.0), haze]), cameras=(_HERE, None))
        assert found.free_space_violation < 0.01
        assert found.colour_correlation > 0.95


def test_view_cache_prefers_cameras_that_nothing_hides_the_points_from():
    # A screen before the first camera hides the wall from it.
    scene = Gaussians.concatenate([_wall(3.0), _wall(0.5, width=0.8, height=0.7)])
    cache = ViewCache(scene, _cameras((0.0, 0, 0), (0.0, 0, 0.8)))
    on_wall = _wall(3.0).means
    assert cache.select_views(on_wall, 1) == [1]
    assert cache.select_views(np.array([[0.0, 0, -5.0]]), 2) == []  # behind both


def test_points_are_hidden_where_the_depth_image_is_nearer():
    """The left half of an image shows something a metre away."""
    depth = np.full((120, 160), 9.0)
    depth[:, :80] = 1.0
    camera = _cameras((0.0, 0, 0))
    for x in (-1.2, -0.4, 0.4, 1.2):
        for y in (-0.9, 0.2, 0.9):
            seen = select_views(camera, np.array([[x, y, 3.0]]), 1, [depth.ravel()])
            assert seen == ([0] if x > 0 else [])


def test_a_pattern_is_compared_where_most_of_a_patch_shows_it():
    """Of three patches one is whole, one is seen at its rim alone, and one has no pattern in the second scene."""
    rng = np.random.default_rng(0)
    a, patch = rng.uniform(size=(64 + 20 + 64, 3)), np.repeat([0, 1, 2], [64, 20, 64])
    b = 0.5 * a + 0.1
    b[patch == 2] = 0.4
    found = _pattern_correlation(a, b, patch)
    assert found[patch == 0] == pytest.approx(np.ones(64))
    assert np.isnan(found[patch != 0]).all()


def test_a_pattern_differs_only_far_below_what_is_usual_in_the_pair():
    """21 Gaussians of a square decimetre each, with the correlation of the pattern on each."""

    def other_m2(correlations):
        stats = CrossViewStats.of(21)
        stats.agrees[:] = True
        stats.add_pixels(np.arange(21), np.full(21, 0.01), np.array(correlations))
        through, other, observed = stats.areas_m2()
        assert (through, observed) == pytest.approx((0.0, 0.21))
        return other

    assert other_m2([0.9] * 18 + [0.0, 0.05, 0.15]) == pytest.approx(0.02)
    assert other_m2(np.linspace(-0.6, 0.8, 21)) == 0.0, "a noisy capture"
    assert other_m2([np.nan] * 21) == 0.0


def test_opponent_colours_of_greys_are_their_lightness():
    greys = np.repeat([[0.3], [2.0], [-1.0]], 3, axis=1)
    np.testing.assert_allclose(_opponent_colours(greys), [[0.3, 0, 0], [1, 0, 0], [0, 0, 0]], atol=1e-12)


def test_depths_range_over_all_neighbours():
    depth = np.random.default_rng(0).uniform(1, 5, (6, 7))
    solid = np.random.default_rng(1).uniform(size=depth.shape) < 0.7
    low, high = _depth_range(depth, solid)
    for i, j in np.ndindex(6, 7):
        here = slice(max(i - 1, 0), i + 2), slice(max(j - 1, 0), j + 2)
        near = depth[here][solid[here]]
        assert (low[i, j], high[i, j]) == (near.min(initial=np.inf), near.max(initial=-np.inf))


_SURE = Proposal("landmarks", Sim3.identity(), with_scale=False, num_inliers=30, log_nfa=-20.0, runner_up=0.2)
_UNSURE = replace(_SURE, log_nfa=-2.0)
_GOOD = PoseEvidence(
    overlap=0.4, num_coinciding=3000, free_space_violation=0.01, num_seen=2000, colour_correlation=0.7, colour_t=8.0
)
_SIGMAS = (0.003, 0.011, 1e-6)


@pytest.mark.parametrize(
    ("change", "proposal", "accepted"),
    [
        ({}, _SURE, True),
        ({}, _UNSURE, True),
        ({"free_space_violation": 0.05}, _SURE, True),
        ({"free_space_violation": 0.12}, _SURE, True),  # a place that changed, its colours beyond doubt
        ({"free_space_violation": 0.12, "colour_correlation": 0.4}, _SURE, True),
        ({"free_space_violation": 0.25}, _SURE, False),
        ({"free_space_violation": 0.05, "colour_correlation": 0.4}, _SURE, True),
        ({"free_space_violation": 0.05, "colour_correlation": 0.4}, _UNSURE, True),
        ({"free_space_violation": 0.16, "colour_correlation": 0.16, "overlap": 0.1}, _UNSURE, False),
        ({"free_space_violation": 0.015, "colour_correlation": 0.4}, _UNSURE, True),
        ({"colour_correlation": 0.1}, _SURE, False),
        ({"colour_correlation": 0.0, "colour_t": 0.0, "free_space_violation": np.nan, "num_seen": 0}, _SURE, False),
        ({"free_space_violation": np.nan, "num_seen": 0}, _SURE, True),  # no cameras, but a clique beyond chance
        ({"free_space_violation": np.nan, "num_seen": 0}, _UNSURE, False),
        ({"overlap": 0.05}, _UNSURE, True),
        ({"overlap": 0.05, "num_coinciding": 400, "colour_correlation": 0.2}, _UNSURE, False),
        ({"num_coinciding": 100}, _SURE, False),
    ],
)
@pytest.mark.guards("answers")
def test_verdict(change, proposal, accepted):
    reason = verdict.decide(proposal, replace(_GOOD, **change), _SIGMAS)
    assert (reason == "") == accepted


@pytest.mark.parametrize(
    ("share", "num_judged", "contradicts"),
    [
        (0.182, 190, False),  # 35 of 190 where 34 are allowed: a binomial's standard deviation is 5
        (0.24, 190, False),
        (0.26, 190, True),
        (0.182, 20_000, False),
        (0.19, 20_000, True),
        (0.17, 20_000, False),
        (0.182, 0, True),  # of how many is not known
        (np.nan, 0, False),
    ],
)
def test_free_space_is_violated_only_beyond_what_so_few_gaussians_explain(share, num_judged, contradicts):
    evidence = replace(_GOOD, free_space_violation=share, num_judged=num_judged)
    reason = verdict.contradiction(_SURE, evidence, verdict.Params(max_free_space_violation=0.18))
    assert ("free-space" in reason) == contradicts


def test_the_direction_that_is_violated_says_of_how_many_gaussians():
    """A screen before the wall: only the source's is seen through, and the target's cameras judge it."""
    bare = _wall(3.0, width=3.0, height=2.0)
    found = _measured(bare, Gaussians.concatenate([bare, _wall(2.0, width=0.6, height=1.0, seed=5)]))
    whole = _measured(bare, bare)
    assert found.free_space_violation > 0.05
    assert found.num_judged >= found.num_seen > 0
    assert round(found.free_space_violation * found.num_judged) == pytest.approx(
        found.free_space_violation * found.num_judged, abs=1e-6
    )
    assert whole.num_judged > 0


@pytest.mark.guards("answers")
def test_verdict_refuses_what_is_known_too_loosely():
    assert "determines the pose only" in verdict.decide(_SURE, _GOOD, (0.05, 0.011, 1e-6))
    assert "too little surface" in verdict.decide(_SURE, _GOOD, None)
    assert verdict.decide(replace(_SURE, flaw="mirrored"), _GOOD, _SIGMAS) == "mirrored"


def test_what_disagrees_is_measured_as_area_however_it_was_seen():
    """A screen of known size before a wall that both see, in one of two captures: both ways round the same area."""
    bare = _wall(3.0, width=3.0, height=2.0)
    screened = Gaussians.concatenate([bare, _wall(2.0, width=0.6, height=1.0, seed=5)])
    found, back = _measured(bare, screened), _measured(screened, bare)
    for evidence in (found, back):
        assert evidence.disagreement * evidence.seen_m2 == pytest.approx(0.7, rel=0.2)  # with its rim
    assert found.disagreement == pytest.approx(back.disagreement, rel=0.1)
    # Gaussians half as wide and four times as many are no more surface.
    dense = Gaussians.concatenate([bare, _wall(2.0, width=0.6, height=1.0, step=0.015, seed=5)])
    assert _measured(bare, dense).disagreement == pytest.approx(found.disagreement, rel=0.2)


def test_one_wall_seen_twice_disagrees_in_nothing():
    found = _measured(_wall(3.0), _wall(3.0, gain=0.8, offset=0.1))
    assert found.disagreement < 0.005
    assert found.seen_m2 > 10


def test_another_pattern_on_the_same_surface_disagrees_and_another_exposure_does_not():
    """A picture of one square metre hangs on the wall in both captures, and is another one in the second."""
    wall = _wall(3.0, width=3.0, height=2.0)
    pictures = [_wall(2.98, width=1.0, height=1.0, seed=seed) for seed in (5, 6)]
    one, other = (Gaussians.concatenate([wall, picture]) for picture in pictures)
    changed = _measured(one, other)
    assert changed.free_space_violation < 0.005
    assert 0.4 < changed.disagreement * changed.seen_m2 < 2.6  # of one square metre, in each direction
    assert _measured(one, one).disagreement < 0.005


def test_without_cameras_nobody_says_what_disagrees():
    found = _measured(_wall(3.0), _wall(3.0), cameras=(None, None))
    assert np.isnan(found.disagreement)
    assert found.seen_m2 == 0.0
