"""What two captures of a made wall say of each other."""

import numpy as np
import pytest

from gsmap import compare
from gsmap.compare import AGREE, COLOUR, GONE, HIDDEN, OTHER_BEHIND, OTHER_IN_FRONT, REPAINTED, SAME, UNSEEN
from gsmap.compare.capture_views import MAX_TOLERANCE_M, MIN_TOLERANCE_M
from gsmap.compare.colours import IDENTITY, balance
from gsmap.types import Cameras, Gaussians, PosedScene

SH_C0 = 0.28209479177387814


def plain(x, y):
    return np.stack([0.6 + 0.05 * np.sin(x), 0.55 + 0.05 * np.cos(y), 0.5 + 0 * x], axis=-1)


def patched(x, y):
    blue = ((np.abs(x) < 0.3) & (np.abs(y) < 0.25))[:, None]
    return np.where(blue, [0.2, 0.3, 0.7], plain(x, y))


def panel(seed, low, high, z=0.0, half_height=0.6, colour=plain, spacing=0.04):
    """Flat Gaussians on a plane, jittered."""
    rng = np.random.default_rng(seed)
    xs, ys = np.meshgrid(np.arange(low, high, spacing), np.arange(-half_height, half_height, spacing))
    x, y = (v.ravel() + rng.uniform(-0.4, 0.4, v.size) * spacing for v in (xs, ys))
    means = np.stack([x, y, z + rng.normal(0, 0.2 * spacing, len(x))], axis=1)
    scales = np.log(np.tile([0.8 * spacing, 0.8 * spacing, 0.1 * spacing], (len(x), 1)))
    sh = ((colour(x, y) - 0.5) / SH_C0)[:, None]
    return Gaussians(means, np.tile([1.0, 0, 0, 0], (len(x), 1)), scales, np.full(len(x), 4.0), sh)


def cameras(xs, distance=1.2):
    T = np.tile(np.eye(4), (len(xs), 1, 1))
    T[:, 0, 3], T[:, 2, 3] = xs, -distance
    return Cameras(T, np.tile([60.0, 60, 32, 24], (len(xs), 1)), np.tile([64, 48], (len(xs), 1)))


def looks(*parts, xs=None, distance=1.2):
    own = cameras(np.linspace(-0.6, 0.6, 7) if xs is None else xs, distance)
    return compare.render_views(PosedScene(Gaussians.concatenate(list(parts)), own))


def wall(seed, **options):
    return panel(seed, -1.5, 1.5, **options)


def box(seed, **options):
    return panel(seed, -0.2, 0.2, z=-0.5, half_height=0.15, **options)


def inside(gaussians):
    """Of a wall: (N,) well within the patch; and (N,) well outside of it, and where both captures looked."""
    x, y = np.abs(gaussians.means[:, :2]).T
    return (x < 0.22) & (y < 0.18), ((x > 0.4) | (y > 0.35)) & (x < 1.0) & (y < 0.4)


def test_a_capture_knows_what_it_saw_well():
    own = looks(wall(0), xs=[0.0, 0.1])
    x, y = np.abs(own.gaussians.means[:, :2]).T
    middle = (x < 0.4) & (y < 0.35)
    assert (own.times_seen[middle] == 2).mean() > 0.9
    assert (own.times_seen[x > 0.9] == 0).all()
    assert not own.surface[x > 0.9].any()
    assert own.surface[middle].mean() > 0.5
    near, far = looks(wall(0), xs=[0.0], distance=0.6), looks(wall(0), xs=[0.0], distance=1.2)
    middle = (x < 0.2) & (y < 0.2) & (near.times_seen > 0) & (far.times_seen > 0)
    assert np.median(near.sharpness[middle] / far.sharpness[middle]) == pytest.approx(4, rel=0.05)


def test_a_thing_that_went_and_one_that_came():
    boxed, bare = looks(wall(0), box(5)), looks(wall(1))
    segment = boxed.gaussians.means[:, 2] < -0.3
    for found, of_box, of_wall, seen in (
        (compare.compare(boxed, bare), "older", "newer", OTHER_IN_FRONT),
        (compare.compare(bare, boxed), "newer", "older", OTHER_BEHIND),
    ):
        state = getattr(found, of_box).state
        assert (state[segment] == GONE).all()
        assert not (state[~segment] >= REPAINTED).any()
        assert not (getattr(found, of_wall).state >= REPAINTED).any()
        middle = found.newer_views[3].outcome  # looks straight at the box
        assert (middle[20:28, 28:36] == seen).any()
        assert not np.isin(middle[20:28, 28:36], (AGREE, COLOUR)).any()
        assert (middle[:, :8] == AGREE).mean() > 0.5
        assert not np.isin(middle[:, :8], (COLOUR, OTHER_IN_FRONT, OTHER_BEHIND)).any()


def test_what_stands_behind_something_new_is_hidden_and_not_gone():
    bare, boxed = looks(wall(0)), looks(wall(1), panel(6, -1.5, 1.5, z=-0.5))
    state = compare.compare(bare, boxed).older.state
    seen = bare.times_seen > 2
    assert (state[seen] == HIDDEN).mean() > 0.95
    assert not (state == GONE).any()


def test_what_the_other_never_saw_is_unseen():
    here, away = looks(wall(0), box(5)), looks(wall(1), xs=np.linspace(-3.6, -3.2, 4))
    state = compare.compare(here, away).older.state
    assert (state[here.gaussians.means[:, 0] > -0.5] == UNSEEN).all()


def test_paint_is_found_through_any_exposure():
    old, painted = looks(wall(0)), wall(1, colour=patched)
    for gain in (np.ones(3), np.array([0.5, 0.4, 0.3])):
        sh = painted.sh * gain.astype(np.float32)
        sh[:, 0] += (gain - 1) * 0.5 / SH_C0
        new = looks(Gaussians(painted.means, painted.quats, painted.log_scales, painted.logit_opacities, sh))
        found = compare.compare(old, new)
        np.testing.assert_allclose(found.balance.gains(), gain, rtol=0.2)
        for evidence, gaussians in ((found.older, old.gaussians), (found.newer, new.gaussians)):
            patch, rest = inside(gaussians)
            assert (evidence.state[patch] == REPAINTED).all()
            assert (evidence.state[rest] == SAME).all()
        assert found.newer_views[3].outcome[24, 32] == COLOUR
        assert not (found.newer_views[3].outcome[:8] == COLOUR).any()


def test_texture_that_lies_a_pixel_off_is_no_paint():
    rng = np.random.default_rng(0)
    blocks = rng.uniform(0.1, 0.9, (12, 16, 3)).repeat(4, axis=0).repeat(4, axis=1).astype(np.float32)
    moved, both = np.roll(blocks, 1, axis=1), np.ones((48, 64), dtype=bool)
    chroma, lightness = IDENTITY.differences(blocks, moved, both)
    assert np.abs(chroma[:, 1:]).max() == np.abs(lightness[:, 1:]).max() == 0
    # A block in another colour is another matter, and so is what lies on no common surface.
    moved[20:32, 20:32] = [0.9, 0.1, 0.1]
    chroma, _ = IDENTITY.differences(blocks, moved, both)
    assert (np.abs(chroma[22:30, 22:30]).max(-1) > 0.1).mean() > 0.9
    both[20:32, 20:32] = False
    assert not IDENTITY.differences(blocks, moved, both)[0][20:32, 20:32].any()


def test_depths_that_agree_set_the_tolerance():
    def off(metres, noise):
        rng = np.random.default_rng(0)
        other = wall(1)
        other.means[:, 2] += metres + rng.normal(0, noise, len(other)).astype(np.float32)
        return compare.compare(looks(wall(0)), looks(other)).tolerance_m[0]

    assert off(0.0, 0.0) == MIN_TOLERANCE_M
    assert MIN_TOLERANCE_M < off(0.01, 0.0) < off(0.015, 0.0) <= MAX_TOLERANCE_M


def test_a_line_of_colours_is_not_bent_by_what_was_painted():
    rng = np.random.default_rng(0)
    a = rng.uniform(0.1, 0.7, (5000, 3))
    b = 1.2 * a**1.1
    b[:1500] = rng.uniform(0, 1, (1500, 3))
    line = balance(a, b)
    np.testing.assert_allclose(line.applied(a[1500:]), np.clip(1.2 * a[1500:] ** 1.1, 0, 1), atol=0.03)
    assert balance(a[:10], b[:10]).slope.tolist() == [1, 1, 1]


def test_a_capture_without_cameras_says_nothing_and_is_told():
    blind = compare.render_views(PosedScene(Gaussians.concatenate([wall(0), box(5)])))
    seeing = looks(wall(1))
    assert not blind.views
    found = compare.compare(blind, seeing)
    assert (found.older.state[blind.gaussians.means[:, 2] < -0.3] == GONE).all()
    assert (compare.compare(seeing, blind).older.state == UNSEEN).all()
    assert compare.compare(blind, blind).balance.slope.tolist() == [1, 1, 1]
    nothing = compare.render_views(PosedScene(Gaussians.empty(), cameras([0.0])))
    assert (compare.compare(seeing, nothing).older.state == UNSEEN).all()
