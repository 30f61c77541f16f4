"""Changes between captures: kept whole, under numbers that stay, with the words on them, through all a map can do."""

import numpy as np
import pytest
from raising import raises
from store_samples import key, made_change, make_cameras, make_gaussians, save_comparison

import gsmap.map
from gsmap.errors import ConfigError, CorruptError, InputError, NotFoundError
from gsmap.geometry.rotations import exp_so3
from gsmap.store import Store
from gsmap.store.backup import clone, restore, save
from gsmap.store.merging import merge, split
from gsmap.store.scene_replacement import inherit
from gsmap.store.storage import FolderStorage
from gsmap.types import ChangeReport, PoseGraph, SceneGraph, ScenePose, Sim3

CHAIR = np.array([[0.0, 0, 0], [1, 1, 1]])
TABLE = np.array([[3.0, 0, 0], [4, 2, 1]])


@pytest.fixture
def ids(two_scenes):
    return [scene.id for scene in two_scenes]


def moved_by(x):
    return CHAIR + np.array([x, 0, 0])


def groups(store):
    folder = store.home / "arrays" / "changes"
    return sorted(path.name for path in folder.iterdir()) if folder.is_dir() else []


def numbers(comparison):
    return [change.number for change in comparison.changes]


def spoil(store, group):
    for path in store.home.glob(f"arrays/changes/{group}/arrays.zip"):
        path.unlink()  # arrays may be links
        path.write_bytes(b"x" * 40)


def test_round_trip(store, ids):
    found = made_change(CHAIR), made_change(TABLE, "appeared", 3, before=np.zeros(0, np.int32), symmetry="none")
    S, frame = Sim3(exp_so3(np.array([0, 0, 0.1])), np.array([0.1 + 0.2, 0, 0]), 1.5), Sim3(np.eye(3), np.ones(3))
    kept = save_comparison(store, *ids, *found, S=S, S_frame_newer=frame, notes=["dark"])
    assert (kept.older, kept.newer, kept.seen_share, kept.notes, kept.whole) == (*ids, 0.625, ("dark",), True)
    assert kept.key == key("change", *ids, version=1).digest
    assert store.recipes.get(kept.recipe).stage == "change"
    assert (kept.S_newer_older.matrix() == S.matrix()).all()
    assert (kept.S_frame_newer.matrix() == frame.matrix()).all()
    np.testing.assert_array_equal(kept.gains, [1, 0.5, 2])
    (again,) = store.changes.current()
    assert numbers(again) == numbers(kept) == [1, 2]
    report = store.changes.load(kept.number)
    for a, b in zip(report.changes, found, strict=True):
        assert (a.kind, a.symmetry, a.confidence, a.evidence) == (b.kind, b.symmetry, b.confidence, b.evidence)
        assert (a.S_after_before is None) == (b.S_after_before is None)
        for name in ("box", "voxels", "before", "after"):
            x, y = getattr(a, name), getattr(b, name)
            assert x.dtype == y.dtype
            np.testing.assert_array_equal(x, y)
    change = store.changes.get(2)
    assert (change.kind, change.status, change.older, change.newer) == ("appeared", "open", *ids)
    assert store.check().ok


def test_nothing_changed_takes_no_arrays(store, ids):
    kept = save_comparison(store, *ids)
    assert (kept.whole, kept.changes, groups(store)) == (True, (), [])
    assert store.changes.load(kept.number).changes == ()
    assert save_comparison(store, *ids).number == kept.number


def test_what_makes_no_sense_is_refused(store, ids):
    report, pose = ChangeReport((), 1.0, np.ones(3)), Sim3.identity()
    for named, pair in ((ids[::-1], ids), (ids, ids[::-1]), ([ids[0]] * 2, [ids[0]] * 2)):
        with raises(InputError, code="key_input_mismatch"):
            store.changes.save(
                report, key("change", *named), older=pair[0], newer=pair[1], S_newer_older=pose, S_frame_newer=pose
            )
    with pytest.raises(NotFoundError):
        save_comparison(store, ids[0], "0" * 32)
    for call in (lambda: store.changes.get(9), lambda: store.changes.load(9)):
        with pytest.raises(NotFoundError):
            call()


def test_words_and_numbers_survive_another_comparison(store, ids):
    first = save_comparison(store, *ids, made_change(CHAIR), made_change(TABLE), made_change(CHAIR, "recoloured"))
    assert numbers(first) == [1, 2, 3]
    assert store.changes.review(1, "confirm", "seen it").status == "confirmed"
    assert store.changes.review(3, "reject").status == "rejected"
    # The newer scene lies elsewhere now, and the boxes with it; the table is another kind of change.
    shift = np.array([10.0, 0, 0])
    chair = moved_by(10.1)
    moved = Sim3(np.eye(3), shift)
    second = save_comparison(
        store, *ids, made_change(TABLE + shift, "replaced"), made_change(chair), version=2, S_frame_newer=moved
    )
    assert numbers(second) == [4, 1]
    assert [change.status for change in second.changes] == ["open", "confirmed"]
    assert second.notes == (
        "c1 was confirmed before this comparison, and stays confirmed",
        "c3, which was rejected, was not detected again",
    )
    with raises(NotFoundError, code="change_not_found"):
        store.changes.review(3, "confirm")
    # It is the same one again by the one after that.
    third = save_comparison(store, *ids, made_change(CHAIR, "recoloured"), made_change(TABLE), version=3)
    assert numbers(third) == [3, 2]
    assert [change.status for change in third.changes] == ["rejected", "open"]
    assert [word.note for word in store.changes.reviews(1)] == ["seen it"]
    assert [numbers(one) for one in store.changes.current()] == [[3, 2]]


def test_the_change_that_overlaps_most_is_the_same(store, ids):
    save_comparison(store, *ids, made_change(CHAIR), made_change(moved_by(0.8)))
    near = moved_by(0.7)
    again = save_comparison(store, *ids, made_change(near), made_change(moved_by(-0.1)), version=2)
    assert numbers(again) == [2, 1]
    alone = save_comparison(store, *ids, made_change(moved_by(50)), version=3)
    assert numbers(alone) == [5]


def test_a_pair_whose_dates_were_swapped_begins_anew(store, ids):
    save_comparison(store, *ids, made_change(CHAIR, "appeared"))
    store.changes.review(1, "confirm")
    other = save_comparison(store, *ids[::-1], made_change(CHAIR, "appeared"))
    assert (numbers(other), other.changes[0].status) == ([2], "open")
    assert [one.older for one in store.changes.current()] == [ids[1]]


def test_reviews_can_be_withdrawn(store, ids):
    save_comparison(store, *ids, made_change(CHAIR))
    with raises(InputError, code="nothing_to_withdraw"):
        store.changes.review(1, "withdraw")
    with pytest.raises(ConfigError):
        store.changes.review(1, "maybe")
    store.changes.review(1, "confirm")
    assert store.changes.review(1, "withdraw", "I was wrong").status == "open"
    assert [word.review for word in store.changes.reviews(1)] == ["confirm", "withdraw"]


def test_damage_is_found_and_mended(store, ids):
    found = made_change(CHAIR)
    kept = save_comparison(store, *ids, found)
    assert store.changes.damaged([kept.number]) == set()
    (group,) = groups(store)
    spoil(store, group)
    assert store.changes.damaged([kept.number, 99]) == {kept.number}
    (problem, *_) = store.check().problems
    assert (
        f"the changes of scene0:scene1: compute them again with gsmap changes {store.location} scene0:scene1" in problem
    )
    with raises(CorruptError, code="arrays_missing"):
        store.changes.load(kept.number)
    assert save_comparison(store, *ids, found).number == kept.number
    assert store.check().ok
    np.testing.assert_array_equal(store.changes.load(kept.number).changes[0].voxels, found.voxels)


@pytest.mark.guards("data")
def test_rows_of_gaussians_that_a_scene_lacks_are_refused(store, ids):
    kept = save_comparison(store, *ids, made_change(CHAIR, after=np.array([500], np.int32)))
    with raises(CorruptError, code="catalog_invalid", match="result of a comparison"):
        store.changes.load(kept.number)


@pytest.mark.guards("data")
def test_prune_takes_what_was_superseded_and_what_lost_a_scene(store, ids):
    first = save_comparison(store, *ids, made_change(CHAIR))
    (old,) = groups(store)
    second = save_comparison(store, *ids, made_change(CHAIR), version=2)
    assert len(groups(store)) == 2
    assert store.prune(dry_run=True).num_bytes > 0
    store.prune()
    assert old not in groups(store)
    assert len(groups(store)) == 1
    with raises(NotFoundError, code="arrays_pruned"):
        store.changes.load(first.number)
    assert len(store.changes.load(second.number).changes) == 1
    assert store.check().ok
    store.revisions.save(PoseGraph({s: ScenePose(s, Sim3.identity(), 0, "placed") for s in ids}))
    store.scenes.remove(ids[0])
    assert store.changes.current() == []
    store.prune()
    assert len(groups(store)) == 1  # a revision that is kept names both scenes
    store.prune(keep_revisions=0)
    assert groups(store) == []
    assert store.check().ok
    store.scenes.add(make_gaussians(seed=0), make_cameras(), name="back")
    (one,) = store.changes.current()
    assert (one.whole, numbers(one)) == (False, [1])


def test_purge_forgets_them(store, ids):
    third = store.scenes.add(make_gaussians(seed=7), make_cameras(), name="third")[0].id
    save_comparison(store, *ids, made_change(CHAIR), notes=["scene0 is dark"])
    save_comparison(store, ids[1], third, made_change(TABLE), notes=["scene0 stood here"])
    store.changes.review(1, "confirm", "mine")
    store.changes.review(2, "confirm", "as in scene0")
    store.close()
    with gsmap.map.open(store.location) as m:
        report = m.purge("scene0")
        assert {k: report.num_rows[k] for k in ("comparisons", "changes", "change_reviews")} == {
            "comparisons": 1,
            "changes": 1,
            "change_reviews": 1,
        }
        assert report.num_groups == 2
        assert "a note of change 2" in report.mentions
        (left,) = m.store.changes.current()
        assert (numbers(left), left.notes) == ([2], ("a scene that was purged stood here",))
        assert len(groups(m.store)) == 1
        assert m.check().ok


def test_backup_restore_and_clone_bring_them(store, ids, tmp_path):
    save_comparison(store, *ids, made_change(CHAIR))
    kept = save_comparison(store, *ids, made_change(CHAIR), version=2)
    store.changes.review(1, "confirm", "seen")
    save(store, FolderStorage(tmp_path / "backup"))
    restore(FolderStorage(tmp_path / "backup"), tmp_path / "back.gsmap")
    clone(store, tmp_path / "clone.gsmap")
    for path in (tmp_path / "back.gsmap", tmp_path / "clone.gsmap"):
        with Store.open(path) as copy:
            assert copy.check().ok
            (one,) = copy.changes.current()
            assert (one.number, numbers(one), one.changes[0].status) == (kept.number, [1], "confirmed")
            assert len(copy.changes.load(one.number).changes[0].voxels) == 4


def test_a_branch_goes_its_own_way(store, ids):
    save_comparison(store, *ids, made_change(CHAIR))
    store.branches.make("b")
    with Store.open(f"{store.location}@b") as branch:
        branch.changes.review(1, "reject")
        save_comparison(branch, *ids, made_change(CHAIR), version=2)
        branch.prune()
        assert branch.changes.get(1).status == "rejected"
    assert store.changes.get(1).status == "open"
    store.prune()
    assert len(groups(store)) == 2
    assert store.check().ok
    merge(store, Store.open(f"{store.location}@b", "r"))
    assert store.changes.get(1).status == "rejected"
    assert len(store.changes.load(store.changes.current()[0].number).changes) == 1


@pytest.fixture
def other(tmp_path):
    with Store.create(tmp_path / "other.gsmap") as made:
        yield made


def test_they_travel_with_their_scenes(store, other):
    a, b, c = (other.scenes.add(make_gaussians(500, seed=i), make_cameras(), name=f"scene{i}")[0].id for i in range(3))
    store.scenes.add(make_gaussians(500, seed=8), make_cameras(), name="mine")
    save_comparison(other, a, b, made_change(TABLE, "appeared"), made_change(CHAIR))
    save_comparison(other, a, b, made_change(CHAIR), made_change(TABLE), version=2)
    save_comparison(other, b, c, made_change(TABLE))
    other.changes.review(2, "confirm", "seen")
    merged = merge(store, other)
    assert (merged.num_comparisons, merged.num_change_reviews) == (3, 1)
    found = {(one.older, one.newer): one for one in store.changes.current()}
    assert found.keys() == {(a, b), (b, c)}
    chair = found[a, b].changes[0]
    assert (chair.status, len(store.changes.load(chair.comparison).changes[1].voxels)) == ("confirmed", 4)
    assert [word.note for word in store.changes.reviews(chair.number)] == ["seen"]
    assert store.check().ok
    again = merge(store, other)
    assert (again.num_comparisons, again.num_change_reviews, again.num_bytes) == (0, 0, 0)
    other.changes.review(4, "reject")
    assert merge(store, other).num_change_reviews == 1
    with Store.create(store.home.with_name("part.gsmap")) as part:
        done = split(store, part, [a, b])
        assert (done.num_comparisons, len(part.changes.current())) == (2, 1)
        assert len(groups(part)) == 1  # those of the comparison that counts
        assert part.check().ok


def test_what_both_maps_found_is_one_change(store, other, ids):
    for scene in range(2):
        other.scenes.add(make_gaussians(seed=scene), make_cameras(), name=f"scene{scene}")
    save_comparison(other, *ids, made_change(TABLE), made_change(CHAIR), version=3)
    other.changes.review(2, "confirm", "there")
    save_comparison(store, *ids, made_change(CHAIR), version=2)
    merged = merge(store, other)
    assert (merged.num_comparisons, merged.num_change_reviews) == (1, 1)
    (mine,) = store.changes.current()
    assert numbers(mine) == [1]
    assert mine.changes[0].status == "confirmed"
    assert store.check().ok
    # Theirs is the later one now.
    save_comparison(other, *ids, made_change(CHAIR), made_change(TABLE), version=4)
    merge(store, other)
    (theirs,) = store.changes.current()
    assert (numbers(theirs)[0], theirs.changes[0].status) == (1, "confirmed")
    assert len(store.changes.load(theirs.number).changes) == 2


def test_a_scene_that_supersedes_the_other_of_a_pair_is_not_compared_with_itself(store, ids):
    older, newer = ids
    save_comparison(store, older, newer, made_change(CHAIR))
    store.scenes.remove(older)
    inherit(store, older, newer)
    assert store.changes.current() == []
    store.scenes.restore(older)
    (kept,) = store.changes.current()
    assert (kept.older, kept.newer, numbers(kept)) == (older, newer, [1])
    assert store.check().ok


def test_the_last_comparison_review_and_graph_count_whatever_the_clock_said(store, ids, monkeypatch):
    with monkeypatch.context() as patched:
        patched.setattr("gsmap.store.catalog.now", lambda: "2190-01-01T00:00:00.000000+00:00")
        save_comparison(store, *ids, made_change(CHAIR))
        store.changes.review(1, "confirm")
        store.graphs.save(SceneGraph(ids[0], notes=("first",)), key("describe", ids[0], version=1))
    last = save_comparison(store, *ids, made_change(CHAIR), made_change(TABLE), version=2)
    store.changes.review(1, "reject")
    store.graphs.save(SceneGraph(ids[0], notes=("second",)), key("describe", ids[0], version=2))
    (current,) = store.changes.current()
    assert (current.number, len(current.changes)) == (last.number, 2)
    assert store.changes.get(1).status == "rejected"
    assert [one.review for one in store.changes.reviews(1)] == ["confirm", "reject"]
    assert store.graphs.load(ids[0]).notes == ("second",)
