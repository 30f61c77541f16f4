"""Scenes that are kept compact: what is read of them, what goes, and how they come back."""

import os
import shutil

import numpy as np
import pytest
from raising import raises
from store_samples import key, made_change, make_cameras, make_gaussians, save_comparison

from gsmap.errors import CorruptError, InputError
from gsmap.geometry.morton import morton_order
from gsmap.geometry.rotations import quats_to_matrices
from gsmap.store import Store, compact, purging
from gsmap.store.layout import CHUNK_ROWS
from gsmap.store.merging import merge
from gsmap.types import Gaussians, SceneGraph, Segments
from gsmap.types.gaussians import FIELDS


def sorted_gaussians(n=500, degree=1, seed=0) -> Gaussians:
    made = make_gaussians(n, seed=seed, degree=degree)
    return made[morton_order(made.means)]


@pytest.mark.parametrize("degree", [0, 1, 3])
@pytest.mark.parametrize("n", [1, 700, CHUNK_ROWS + 9])
@pytest.mark.guards("data")
def test_compact_gaussians_differ_by_less_than_a_step(n, degree):
    g = sorted_gaussians(n, degree)
    back = compact.round_trip(g)
    assert back.sh.shape == g.sh.shape
    assert np.abs(back.means - g.means).max() <= 10 / 65535
    turn = np.einsum("nij,nkj->nik", quats_to_matrices(back.quats), quats_to_matrices(g.quats))
    assert np.trace(turn, axis1=1, axis2=2).min() > 3 - 1e-4
    assert np.abs(back.opacities - g.opacities).max() <= 0.51 / 255
    for rounded, exact, least in (
        (back.log_scales, g.log_scales, 0.06),
        (back.sh[:, 0], g.sh[:, 0], 0.02),
        (back.sh[:, 1:].reshape(n, -1), g.sh[:, 1:].reshape(n, -1), 0.06),
    ):
        step = np.maximum(least, np.ptp(exact, axis=0) / 255) if exact.size else 0
        assert (np.abs(rounded - exact) <= 0.5001 * step + 1e-6).all()


def test_values_that_are_all_equal_and_extreme_opacities_come_back():
    g = sorted_gaussians(20)
    same = Gaussians(np.tile(g.means[:1], (20, 1)), g.quats, g.log_scales[:1].repeat(20, 0), np.full(20, 40.0), g.sh)
    back = compact.round_trip(same)
    np.testing.assert_allclose(back.means, same.means, atol=1e-6)
    np.testing.assert_allclose(back.log_scales, same.log_scales, atol=1e-6)
    assert np.isfinite(back.logit_opacities).all()


def test_a_thinned_scene_reads_whole_and_in_pieces(store):
    g = make_gaussians(3 * CHUNK_ROWS)
    scene, _ = store.scenes.add(g, make_cameras(), name="a")
    before = store.scenes.gaussians("a")
    shown = np.arange(len(g)) % 3 > 0
    thinned = store.scenes.thin("a", shown, up=(0.0, 0.0, 1.0))
    assert thinned.thinning.num_gaussians == len(g)
    assert thinned.thinning.up == (0.0, 0.0, 1.0)
    assert (thinned.id, thinned.num_gaussians) == (scene.id, int(shown.sum()))
    np.testing.assert_array_equal(thinned.bounds, scene.bounds)
    after = store.scenes.gaussians("a")
    np.testing.assert_allclose(after.means, before.means[shown], atol=2e-4)
    np.testing.assert_array_equal(store.scenes.cameras("a").T_frame_camera, make_cameras().T_frame_camera)
    box = np.array([[3.0, 3, 3], [5, 5, 5]])  # in the last chunk
    reach = 3 * after.scales.max(1, keepdims=True)
    wanted = ((after.means >= box[0] - reach) & (after.means <= box[1] + reach)).all(1)
    np.testing.assert_array_equal(store.scenes.gaussians("a", box).means, after.means[wanted])
    within = ((after.means >= box[0]) & (after.means <= box[1])).all(1)
    np.testing.assert_array_equal(store.scenes.gaussians_within("a", box).quats, after.quats[within])
    np.testing.assert_array_equal(store.scenes.unread("a").sh, after.sh)
    assert store.check().ok


def test_each_array_of_a_thinned_scene_is_read_for_its_fields_alone(store, monkeypatch):
    g = make_gaussians(2 * CHUNK_ROWS)
    store.scenes.add(g, make_cameras(), name="a")
    store.scenes.thin("a", np.arange(len(g)) % 4 > 0)
    after, source, rows = store.scenes.gaussians("a"), store.scenes.chunks("a"), slice(100, CHUNK_ROWS + 100)
    names, read = [], store.scenes._arrays.read

    def recorded(*args, only, **kwargs):
        names.extend(only)
        return read(*args, only=only, **kwargs)

    monkeypatch.setattr(store.scenes._arrays, "read", recorded)
    found = Gaussians(*(np.zeros_like(getattr(after[rows], name)) for name in FIELDS))
    source.read(FIELDS[:-1], rows.start, rows.stop, found)
    source.read(FIELDS[-1:], rows.start, rows.stop, found)
    assert sorted(names) == sorted(compact.shapes(0, 0))
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(found, name), getattr(after[rows], name))
    columns = np.concatenate(list(store.scenes.source("a").columns("sh0")))
    np.testing.assert_array_equal(columns, after.sh[:, :1])


def test_thinning_frees_what_was_there_but_not_what_a_tag_names(store):
    for i, name in enumerate("ab"):
        scene, _ = store.scenes.add(make_gaussians(2000, seed=i), make_cameras(), name=name)
        store.graphs.save(SceneGraph(scene.id), key("describe", scene.id))
    whole = store.scenes.num_bytes("a")
    store.scenes.thin("a", np.ones(2000, bool))
    assert store.scenes.num_bytes("a") < 0.4 * whole
    assert store.graphs.load("a") is None
    assert store.graphs.load("b") is not None
    assert store.reclaim().num_bytes > 0.9 * whole
    store.branches.make("before", tag=True)
    store.scenes.thin("b", np.ones(2000, bool))
    assert store.reclaim().num_bytes == 0
    assert store.check().ok
    with Store.open(f"{store.location}@before", "r") as tag:
        assert tag.scenes.get("b").thinning is None
        np.testing.assert_array_equal(
            np.sort(tag.scenes.gaussians("b").means[:, 0]), np.sort(make_gaussians(2000, 1).means[:, 0])
        )


def test_ingesting_the_capture_again_makes_it_whole(store):
    g = make_gaussians(900)
    store.scenes.add(g, make_cameras(), name="a")
    before = store.scenes.gaussians("a")
    store.scenes.thin("a", np.arange(900) < 800)
    store.reclaim()
    again, new = store.scenes.add(g, make_cameras(), name="other")
    assert (again.name, again.thinning, again.num_gaussians, new) == ("a", None, 900, True)
    np.testing.assert_array_equal(store.scenes.gaussians("a").sh, before.sh)
    store.reclaim()
    assert store.check().ok


def test_what_cannot_be_thinned_is_refused_and_nothing_changes(store):
    store.scenes.add(make_gaussians(50), make_cameras(), name="a")
    for shown in (np.ones(49, bool), np.zeros(50, bool)):
        with raises(InputError, code="cannot_keep"):
            store.scenes.thin("a", shown)
    once = store.scenes.thin("a", np.arange(50) < 40)
    assert store.scenes.thin("a", np.ones(40, bool)).thinning == once.thinning
    assert store.scenes.get("a").num_gaussians == 40


def test_numbers_that_make_no_gaussians_are_refused():
    arrays = compact.pack(sorted_gaussians(20))
    wide = {"compact.boxes": np.tile([[[-1e308], [1e308]]], (1, 1, 3))}
    steep = {"compact.log_scales_range": np.array([[0.0, 0, 0], [1e300, 1, 1]])}
    for wrong in (wide, steep):
        with raises(CorruptError, code="not_finite"):
            compact.unpack(arrays | wrong, np.arange(20))


def test_files_of_a_thinned_scene_that_a_copy_has_too_are_told_of(store, tmp_path):
    scene, _ = store.scenes.add(make_gaussians(50), make_cameras(), name="a")
    store.scenes.thin("a", np.arange(50) < 40)
    store.reclaim()
    shutil.copytree(store.folder, tmp_path / "linked", copy_function=os.link)
    assert purging.begin(store, scene.id).receipt["linked_files"] == 1


def test_a_graph_of_the_compact_gaussians_goes_when_the_scene_is_whole_again(store):
    g = make_gaussians(60)
    scene, _ = store.scenes.add(g, make_cameras(), name="a")
    store.scenes.thin("a", np.arange(60) < 40)
    store.graphs.save(SceneGraph(scene.id), key("describe", scene.id))
    store.scenes.add(g, make_cameras(), name="a")
    assert store.graphs.load("a") is None
    assert store.check().ok


def test_a_merge_that_makes_a_scene_whole_brings_its_graph_instead_of_the_compact_one(store, tmp_path):
    g = make_gaussians(60)
    with Store.create(tmp_path / "other.gsmap") as other:
        for one in (store, other):
            scene, _ = one.scenes.add(g, make_cameras(), name="a")
        other.graphs.save(SceneGraph(scene.id, notes=("whole",)), key("describe", scene.id))
        store.scenes.thin("a", np.arange(60) < 40)
        store.graphs.save(SceneGraph(scene.id, notes=("compact",)), key("describe", scene.id))
        merge(store, other)
    assert store.scenes.get("a").thinning is None
    assert store.graphs.load("a").notes == ("whole",)
    assert store.check().ok


# --- rows that the map keeps ------------------------------------------------------------------------------------------

BOX = [[0.0, 0, 0], [1, 1, 1]]


def things_of(members) -> Segments:
    z = np.zeros
    return Segments(members, z((2, 3)), z((2, 2, 3)), z((2, 3)), z((0, 3)), z((0, 3)), z(2))


def two_captures(store, n=60):
    """Two scenes of which the first has things, and a change of known rows of both."""
    ids = [store.scenes.add(make_gaussians(n, seed=i), make_cameras(), name="ab"[i])[0].id for i in range(2)]
    members = np.arange(n, dtype=np.int32) % 3 - 1
    store.graphs.save(SceneGraph(ids[0], segments=things_of(members)), key("describe", ids[0]))
    gone = made_change(BOX, before=np.array([3, 8, 40, 59], np.int32), after=np.array([7, 1], np.int32))
    return ids, members, save_comparison(store, *ids, gone).number


def keep_every_third_out(store, scene, n=60):
    """Thin a scene, its graph of things with it; which rows stay."""
    stays = np.arange(n) % 3 > 0
    graph = store.graphs.load(scene)
    store.scenes.thin(scene, stays)
    store.graphs.save(graph, key("thin", scene))
    return stays


def rows_at(store, scene, rows):
    return store.scenes.gaussians(scene).means[rows]


def test_rows_of_changes_and_things_are_the_same_gaussians_after_thinning(store):
    ids, members, number = two_captures(store)
    before = store.scenes.gaussians(ids[0]).means
    stays = keep_every_third_out(store, ids[0])
    (change,) = store.changes.load(number).changes
    np.testing.assert_allclose(rows_at(store, ids[0], change.before), before[[8, 40, 59]], atol=2e-4)
    np.testing.assert_array_equal(change.after, [7, 1])
    np.testing.assert_array_equal(store.graphs.load(ids[0]).segments.members, members[stays])
    store.scenes.add(make_gaussians(60, seed=0), make_cameras(), name="a")
    (change,) = store.changes.load(number).changes
    np.testing.assert_array_equal(change.before, [3, 8, 40, 59])


def test_a_comparison_of_a_thinned_capture_is_of_the_same_gaussians_when_it_is_whole_again(store):
    ids, _, _ = two_captures(store)
    keep_every_third_out(store, ids[0])
    wanted = np.array([0, 5, 39], np.int32)  # of 40
    there = rows_at(store, ids[0], wanted)
    number = save_comparison(store, *ids, made_change(BOX, before=wanted), version=2).number
    np.testing.assert_array_equal(store.changes.load(number).changes[0].before, wanted)
    store.scenes.add(make_gaussians(60, seed=0), make_cameras(), name="a")
    (change,) = store.changes.load(number).changes
    np.testing.assert_allclose(rows_at(store, ids[0], change.before), there, atol=2e-4)


def test_rows_that_were_counted_before_a_thinning_are_mapped_and_others_refused(store):
    ids, _, _ = two_captures(store)
    keep_every_third_out(store, ids[0])
    change = made_change(BOX, before=np.array([3, 8], np.int32))
    number = save_comparison(store, *ids, change, version=2, counted=(60, 60)).number
    np.testing.assert_array_equal(store.changes.load(number).changes[0].before, [5])
    with pytest.raises(InputError):
        save_comparison(store, *ids, change, version=3, counted=(50, 60))


def test_things_of_a_thinned_capture_fit_the_whole_one_that_they_are_merged_into(store, tmp_path):
    ids, members, number = two_captures(store)
    with Store.create(tmp_path / "other.gsmap") as other:
        merge(other, store)
        keep_every_third_out(store, ids[0])
        other.graphs.forget([graph.key for graph in other.graphs.list() if graph.scene == ids[0]])
        merge(other, store)
        assert other.scenes.get(ids[0]).thinning is None
        np.testing.assert_array_equal(other.graphs.load(ids[0], key("thin", ids[0])).segments.members, members)
        np.testing.assert_array_equal(other.changes.load(number).changes[0].before, [3, 8, 40, 59])
