import numpy as np
from synthetic_walls import cameras_facing, two_scenes, wall

from gsmap.merge import PosedScene
from gsmap.merge.exposure import apply_gain, balance_exposure
from gsmap.merge.reference_view_cache import surface_axes
from gsmap.merge.references import render_references, view_schedule
from gsmap.render import render


def quiet(fraction, text):
    pass


def test_surface_points_lie_on_the_wall():
    camera = cameras_facing([0.2])
    seen = render(wall(0, -1.5, 1.5), camera)
    points = np.stack(surface_axes(camera, seen.depth[0]), axis=-1)[seen.alpha[0] > 0.95]
    assert len(points) > 500
    assert np.abs(points[:, 2]).max() < 0.03
    assert points[:, 0].min() < 0 < points[:, 0].max()


def test_references_count_only_what_was_seen_of_the_tile():
    parts = two_scenes()
    whole = render_references(parts, None, 0.0, 64, None, quiet)
    assert len(whole) == 14
    tile = np.array([[0.6, -2, -2], [2, 2, 2]])
    views = render_references(parts, tile, 0.0, 64, None, quiet)
    # Only capture b reaches there, and only some of its cameras look that way.
    assert set(views.scene.tolist()) == {1}
    assert 0 < len(views) < 7
    assert all(w.max() == 255 and w.min() == 0 for w in views.weights)


def test_views_take_turns_in_proportion_to_what_they_show():
    order = view_schedule(np.array([0.1, 0.2, 0.4]), 700, seed=0)
    np.testing.assert_allclose(np.bincount(order), [100, 200, 400], atol=2)
    first = np.bincount(order[:70], minlength=3)
    np.testing.assert_allclose(first, [10, 20, 40], atol=3)
    np.testing.assert_array_equal(order, view_schedule(np.array([0.1, 0.2, 0.4]), 700, seed=0))


def test_a_gain_multiplies_every_colour():
    g = wall(0, -1, 1)
    gain = np.array([1.2, 0.9, 1.05])
    camera = cameras_facing([0.0])
    np.testing.assert_allclose(
        render(apply_gain(g, gain), camera).colour, render(g, camera).colour * gain.astype(np.float32), atol=1e-5
    )


def test_exposure_is_balanced_where_captures_meet():
    a, b = two_scenes(grain=0.0)
    gain = np.array([1.25, 1.1, 0.9])
    brighter = PosedScene(apply_gain(b.gaussians, gain), b.cameras, "b")
    _, log_gains = balance_exposure([a, brighter])
    np.testing.assert_allclose(log_gains[1] - log_gains[0], -np.log(gain), atol=0.02)
    np.testing.assert_allclose(log_gains.sum(0), 0, atol=1e-9)
    parts, log_gains = balance_exposure([a, b])
    assert parts[0] is a
    assert not log_gains.any()


def test_captures_that_do_not_meet_keep_their_exposure():
    a = PosedScene(wall(0, -3, -2), cameras_facing([-2.5]), "a")
    b = PosedScene(apply_gain(wall(1, 2, 3), np.full(3, 1.5)), cameras_facing([2.5]), "b")
    assert not balance_exposure([a, b])[1].any()


def test_of_many_views_those_are_reproduced_that_add_most():
    scene = wall(0, -1.5, 1.5)
    crowd = PosedScene(scene, cameras_facing(np.full(20, -0.9)), "a", "2020-01-01")
    newer = PosedScene(scene, cameras_facing(np.linspace(-0.9, 0.9, 5)), "b", "2021-01-01")
    views = render_references([crowd, newer], None, 0.0, 64, None, quiet, max_views=6)
    assert len(views) == 6
    # One place that twenty cameras look at needs few of them; the others each see what no other does.
    assert (views.scene == 1).sum() >= 4
    assert views.cameras.centers[:, 0].max() > 0.8
    assert len(render_references([crowd, newer], None, 0.0, 64, None, quiet)) == 25
