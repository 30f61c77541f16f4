from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree
from synthetic_changes import box, dated, patched, plain
from synthetic_walls import cameras_facing, texture, wall

from gsmap import compare
from gsmap.geometry.rotations import exp_so3
from gsmap.geometry.sh import rgb_of_sh0
from gsmap.merge import changes, default_params, merge
from gsmap.merge.changes import resolve_changes
from gsmap.merge.exposure import apply_gain
from gsmap.merge.mergers import tto
from gsmap.merge.references import render_references
from gsmap.merge.tile import LazyScene, merge_tile
from gsmap.render import render
from gsmap.types import Gaussians, Sim3
from gsmap.types.merging import UnchangedPlace

Params = type(default_params("tto"))


def quiet(fraction, text):
    pass


def standing(settled, index):
    """How many Gaussians of a capture still stand before the wall."""
    return int((settled.scenes[index].gaussians.means[:, 2] < -0.3).sum())


def test_what_a_later_capture_looked_through_is_gone():
    old, new = dated("old", 2020, wall(0, -1.5, 1.5), box(5)), dated("new", 2021, wall(1, -1.5, 1.5))
    settled = resolve_changes([old, new])
    assert standing(settled, 0) == 0
    assert len(box(5)) <= settled.num_removed[0] <= 1.05 * len(box(5))
    assert settled.num_removed[1] == 0
    # The other way round the box is new, and stays; so it does where nobody knows the time, or it is the same.
    later = replace(old, captured_at="2022-01-01")
    assert standing(resolve_changes([later, new]), 0) == len(box(5))
    for when in (None, new.captured_at):
        assert resolve_changes([replace(old, captured_at=when), new]).num_removed == [0, 0]


def test_nothing_is_outdated_where_the_changes_were_rejected():
    old, new = dated("old", 2020, wall(0, -1.5, 1.5), box(5)), dated("new", 2021, wall(1, -1.5, 1.5))
    S_frame_map = Sim3(exp_so3(np.array([0, 0, 0.6])), np.array([3.0, 1, 0]))  # the box lies in a frame of its own
    low, high = S_frame_map.apply(np.array([[-0.2, -0.15, -0.5], [0.2, 0.15, -0.5]]))
    middle, half = (low + high) / 2, np.array([0.25, 0.25, 0.01])
    around = (UnchangedPlace(S_frame_map, np.array([middle - half, middle + half])),)
    assert resolve_changes([replace(old, unchanged=around), new]).num_removed == [0, 0]
    # Beside the rejected place, and where the older one is preferred, all is as before.
    beside = replace(old, unchanged=(UnchangedPlace(Sim3.identity(), around[0].box),))
    assert resolve_changes([beside, new]).num_removed == resolve_changes([old, new]).num_removed
    bare, boxed = dated("old", 2020, wall(0, -1.5, 1.5)), dated("new", 2021, wall(1, -1.5, 1.5), box(5))
    once = replace(boxed, cameras=cameras_facing([0.0], distance=3.6))
    assert resolve_changes([replace(bare, unchanged=around), once], "best").num_removed == [0, 0]


def test_a_change_beside_a_rejected_place_takes_nothing_of_it():
    beside = replace(box(6), means=box(6).means + np.array([0.45, 0, 0], np.float32))
    old, new = dated("old", 2020, wall(0, -1.5, 1.5), box(5), beside), dated("new", 2021, wall(1, -1.5, 1.5))
    place = UnchangedPlace(Sim3.identity(), np.array([[0.25, -0.15, -0.5], [0.65, 0.15, -0.5]]), 0.02)
    left = resolve_changes([replace(old, unchanged=(place,)), new]).scenes[0].gaussians.means
    standing = left[left[:, 2] < -0.3]
    assert (standing[:, 0] > 0.22).all()
    assert len(standing) == len(beside)


@pytest.mark.parametrize("bounds", [None, np.array([[-1.0, -1, -2], [1, 1, 1]])])
def test_a_tile_keeps_what_stands_in_a_rejected_place(bounds):
    old, new = dated("old", 2020, wall(0, -1.5, 1.5), box(5)), dated("new", 2021, wall(1, -1.5, 1.5))
    around = UnchangedPlace(Sim3.identity(), np.array([[-0.2, -0.15, -0.5], [0.2, 0.15, -0.5]]))

    def merged(*unchanged):
        lazy = [
            LazyScene(s.scene_id, Sim3.identity(), lambda _, s=s: s.gaussians, s.cameras, s.captured_at)
            for s in (old, new)
        ]
        lazy[0] = replace(lazy[0], unchanged=unchanged)
        params = replace(default_params("union"), prefer="newest")
        return int((merge_tile(lazy, "union", params, bounds=bounds).gaussians.means[:, 2] < -0.3).sum())

    assert (merged(), merged(around)) == (0, len(box(5)))


def test_an_older_capture_in_another_exposure_loses_no_more_beside_what_went():
    scene = Gaussians.concatenate([wall(1, -1, 1, colour=plain), box(5)])
    old = dated("old", 2020, apply_gain(scene, np.full(3, 0.6)))
    assert resolve_changes([old, dated("new", 2021, wall(2, -1, 1, colour=plain))]).num_removed == [len(box(5)), 0]


def test_what_no_newer_capture_saw_stays():
    away = dated("new", 2021, wall(1, -1.5, 1.5), cameras=cameras_facing(np.linspace(-3.6, -3.0, 7)))
    old = dated("old", 2020, wall(0, -1.5, 1.5), box(5))
    assert resolve_changes([old, away]).num_removed == [0, 0]


def test_paint_is_told_from_exposure():
    old = dated("old", 2020, wall(0, -1.5, 1.5, colour=plain))
    painted = dated("new", 2021, wall(1, -1.5, 1.5, colour=patched))
    settled = resolve_changes([old, painted])
    left = settled.scenes[0].gaussians.means
    in_patch = (np.abs(left[:, 0]) < 0.25) & (np.abs(left[:, 1]) < 0.2)
    far = (np.abs(old.gaussians.means[:, 0]) > 0.4) | (np.abs(old.gaussians.means[:, 1]) > 0.35)
    assert in_patch.sum() == 0
    assert ((np.abs(left[:, 0]) > 0.4) | (np.abs(left[:, 1]) > 0.35)).sum() == far.sum()
    # The same picture a stop and a half darker and in warmer light says nothing of paint ...
    gain = np.array([0.5, 0.4, 0.3])
    lit = dated("new", 2021, apply_gain(wall(1, -1.5, 1.5, colour=plain), gain))
    assert resolve_changes([old, lit]).num_removed == [0, 0]
    # ... and hides none.
    both = dated("new", 2021, apply_gain(wall(1, -1.5, 1.5, colour=patched), gain))
    left = resolve_changes([old, both]).scenes[0].gaussians.means
    assert ((np.abs(left[:, 0]) < 0.25) & (np.abs(left[:, 1]) < 0.2)).sum() == 0


def test_pictures_of_what_is_not_so_any_more_are_not_learnt():
    bare, with_box = [wall(1, -1.5, 1.5)], [wall(0, -1.5, 1.5), box(5)]
    for before, after in ((with_box, bare), (bare, with_box)):
        old, new = dated("old", 2020, *before), dated("new", 2021, *after)
        settled = resolve_changes([old, new])
        plain_views = render_references([old, new], None, 0.0, 64, None, quiet)
        views = render_references(settled.scenes, None, 0.0, 64, settled, quiet)
        middle = 3  # looks straight at the box
        assert plain_views.weights[middle][24, 32] > 250
        assert views.weights[middle][24, 32] == 0
        assert views.weights[middle][24, 4] > 250
        np.testing.assert_array_equal(views.weights[middle + 7], plain_views.weights[middle + 7])


@pytest.mark.parametrize("prefer", ["newest", "best", "both"])
def test_who_is_preferred_is_shown(prefer):
    # The newer capture looked once, from afar; the older seven times, from near by.
    once = cameras_facing([0.0], distance=3.6)
    old = dated("old", 2020, wall(0, -1.5, 1.5), box(5))
    new = dated("new", 2021, wall(1, -1.5, 1.5), cameras=once)
    stands = standing(resolve_changes([old, new], prefer), 0) > 0.9 * len(box(5))
    assert stands == (prefer != "newest")
    # And where it is the older one that looked through, the newer's box leaves for `best` alone.
    bare, boxed = dated("old", 2020, wall(0, -1.5, 1.5)), dated("new", 2021, wall(1, -1.5, 1.5), box(5), cameras=once)
    stands = standing(resolve_changes([bare, boxed], prefer), 1) > 0.9 * len(box(5))
    assert stands == (prefer != "best")


def test_merged_it_looks_like_the_newest():
    blue = lambda x, y: np.tile([0.1, 0.2, 0.8], (len(x), 1))  # noqa: E731
    old = dated("a", 2020, wall(0, -1.5, 1.5), box(5))
    new = dated("b", 2021, wall(1, -1.5, 1.5, colour=lambda x, y: texture(x, y)), box(6, colour=blue))
    camera = cameras_facing([0.0])
    wanted = render(new.gaussians, camera).colour[0]
    merged = render(merge([old, new], "tto", Params(steps=60)).gaussians, camera).colour[0]
    assert np.abs(merged - wanted)[18:30, 26:38].mean() < 0.03
    mixed = render(merge([old, new], "tto", Params(steps=60, prefer="both")).gaussians, camera).colour[0]
    assert np.abs(mixed - wanted)[18:30, 26:38].mean() > 0.1


def test_what_is_new_stays_as_its_capture_has_it():
    old, new = dated("a", 2020, wall(0, -1.5, 1.5)), dated("b", 2021, wall(1, -1.5, 1.5), box(6))
    merged = merge([old, new], "tto", Params(steps=20)).gaussians
    stands, own = merged.means[:, 2] < -0.4, box(6)
    assert stands.sum() > 0.9 * len(own)
    row = cKDTree(own.means).query(merged.means[stands])[1]
    for name in ("means", "sh", "log_scales", "logit_opacities"):
        np.testing.assert_array_equal(getattr(merged, name)[stands], getattr(own, name)[row])


def test_what_lies_behind_the_newest_beside_a_change_wins_no_cell():
    back = wall(4, -0.2, 0.2, z=0.2, half_height=0.15)
    old = dated("a", 2020, wall(0, -1.5, 1.5, colour=plain), back)
    behind = np.arange(len(old.gaussians)) >= len(old.gaussians) - len(back)
    painted = resolve_changes([old, dated("b", 2021, wall(1, -1.5, 1.5, colour=patched))])
    assert painted.behind[0].sum() == len(back)
    assert not painted.behind[1].any()
    # Far from what changed nothing is said of it.
    unchanged = resolve_changes([old, dated("b", 2021, wall(1, -1.5, 1.5, colour=plain))])
    assert not unchanged.behind[0].any()
    new = dated("b", 2021, wall(1, -1.5, 1.5))
    both = [dated("a", 2020, wall(0, -1.5, 1.5)), new]
    settled = resolve_changes(both)
    wanted = render_references(settled.scenes, None, 1.0, 120, settled, quiet)
    for behind, share in ((False, (0.3, 0.7)), (True, (0.0, 0.05))):
        told = replace(settled, behind=[np.full(len(g), behind and i == 0) for i, g in enumerate(settled.changed)])
        origin = tto._start(settled.scenes, wanted, told, Params(kept_fraction=1.0), None)[1]
        assert share[0] <= (origin == 0).mean() <= share[1]


def test_the_newest_who_looked_decides():
    """A box that came, went, and came back: every capture is judged by the newest that knows better."""
    first = dated("a", 2020, wall(0, -1.5, 1.5), box(5))
    second = dated("b", 2021, wall(1, -1.5, 1.5))
    third = dated("c", 2022, wall(2, -1.5, 1.5), box(7))
    settled = resolve_changes([first, second, third])
    assert standing(settled, 2) == len(box(7))
    assert standing(resolve_changes([first, second]), 0) == 0
    # What stood until the newest came is gone from all before it, however many saw it.
    kept = resolve_changes([first, dated("b", 2021, wall(1, -1.5, 1.5), box(6)), dated("c", 2022, wall(2, -1.5, 1.5))])
    assert standing(kept, 0) == standing(kept, 1) == 0
    # What the newest never saw is decided by the one before.
    aside = cameras_facing(np.linspace(-3.6, -3.0, 7))
    assert standing(resolve_changes([first, second, dated("c", 2022, wall(2, -4.5, -2.5), cameras=aside)]), 0) == 0


def test_captures_are_compared_in_linear_time(monkeypatch):
    """Renders grow with the captures, not with their pairs."""
    calls = []

    def counted(gaussians, cameras, **options):
        calls.append(len(cameras))
        return render(gaussians, cameras, **options)

    for module in (changes, compare.capture_views, compare.comparison):
        monkeypatch.setattr(module, "render", counted)
    spent = {}
    for count in (4, 8, 16):
        calls.clear()
        scenes = [dated(f"{i:02d}", 2000 + i, wall(i, -0.8, 0.8, spacing=0.08)) for i in range(count)]
        resolve_changes(scenes, max_views=8)
        spent[count] = sum(calls)
    assert spent[16] - spent[8] == 2 * (spent[8] - spent[4])
    assert spent[16] <= 16 * (7 + 7 + 2 * 8)


def test_looks_of_many_captures_together_are_those_that_add_coverage():
    many = [dated(f"{i:02d}", 2000 + i, wall(i, -0.8, 0.8, spacing=0.08)) for i in range(6)]
    looks = [compare.render_views(scene) for scene in many[::-1]]
    stays = [np.ones(len(one.gaussians), dtype=bool) for one in looks]
    joined = compare.combine_views(list(zip(looks, stays, strict=True)), many[0], max_views=3)
    assert len(joined.views) == 6
    assert len(joined.gaussians) == sum(len(scene.gaussians) for scene in many)
    for view in joined.views:
        inside = view.dominant_id >= 0
        seen = joined.gaussians.means[view.dominant_id[inside]]
        assert np.abs(seen[:, 2]).max() < 0.1


def test_a_capture_of_another_place_costs_nothing(monkeypatch):
    near, far = dated("a", 2020, wall(0, -1, 1)), dated("b", 2021, wall(1, 9, 11), cameras=cameras_facing([10.0]))
    monkeypatch.setattr(compare, "compare", None)
    settled = resolve_changes([near, far])
    assert settled.num_removed == [0, 0]
    assert isinstance(settled.replacements[0], Gaussians)


def test_truth_grows_by_what_is_new_to_it_alone(monkeypatch):
    """Ten captures of one wall weigh, to the next, as much as one."""
    weights = []

    def weighed(older, newer):
        weights.append(len(newer.gaussians))
        return real(older, newer)

    real = compare.compare
    monkeypatch.setattr(compare, "compare", weighed)
    scenes = [dated(f"{i:02d}", 2000 + i, wall(i, -0.8, 0.8, spacing=0.08)) for i in range(6)]
    resolve_changes(scenes)
    assert weights[0] == len(scenes[-1].gaussians)
    assert max(weights) < 1.5 * weights[0]


def test_the_place_shows_in_the_newest_exposure():
    gain = np.array([0.7, 0.6, 0.5])
    old = dated("old", 2020, wall(0, -1.5, 1.5, colour=plain))
    new = dated("new", 2021, apply_gain(wall(1, -1.5, 1.5, colour=plain), gain))
    camera = cameras_facing([0.0])
    before, after = (render(s.gaussians, camera).colour[0] for s in (old, resolve_changes([old, new]).scenes[0]))
    middle = np.s_[12:36, 16:48]
    np.testing.assert_allclose((after[middle] / before[middle]).mean((0, 1)), gain, atol=0.03)
    assert resolve_changes([old, new], "both").scenes[0] is old


def test_the_newest_gamma_is_taken_with_its_exposure():
    """Dark and bright are brought to the newest's alike, as no gain does it."""
    ramp = lambda x, y: np.tile(np.clip(0.5 + 0.25 * x, 0.1, 0.9)[:, None], (1, 3))  # noqa: E731
    bent = lambda x, y: 0.9 * ramp(x, y) ** 1.4  # noqa: E731
    old, new = dated("old", 2020, wall(0, -1.5, 1.5, colour=ramp)), dated("new", 2021, wall(1, -1.5, 1.5, colour=bent))
    left = resolve_changes([old, new]).scenes[0].gaussians
    shown, wanted = rgb_of_sh0(left.sh[:, 0]), bent(*left.means[:, :2].T)
    seen = np.abs(left.means[:, 0]) < 1
    assert np.abs(shown - wanted)[seen].max() < 0.04
    assert np.ptp(wanted[seen]) > 0.4


def test_tiles_keep_each_capture_in_its_own_exposure():
    """Neighbouring tiles would come to other gains, or to none."""
    old = dated("old", 2020, wall(0, -1.5, 1.5, colour=plain))
    new = dated("new", 2021, apply_gain(wall(1, -1.5, 1.5, colour=plain), np.full(3, 0.6)))
    piece = resolve_changes([old, new], one_exposure=False)
    assert piece.scenes[0] is old or np.isin(piece.scenes[0].gaussians.sh, old.gaussians.sh).all()


def test_cameras_that_nobody_held_saw_nothing():
    old, new = dated("old", 2020, wall(0, -1.5, 1.5), box(5)), dated("new", 2021, wall(1, -1.5, 1.5))
    invented = replace(new, cameras=replace(new.cameras, synthesised=True))
    assert resolve_changes([old, invented]).num_removed == [0, 0]
    assert resolve_changes([old, new]).num_removed[0] > 0
