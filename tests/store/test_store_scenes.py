from dataclasses import replace

import numpy as np
import pytest
from raising import raises
from sqlalchemy import select, text
from store_samples import make_cameras, make_gaussians

from gsmap.errors import CorruptError, InputError, NotFoundError
from gsmap.geometry.camera_models import camera_model, pinhole_views
from gsmap.geometry.morton import morton_order
from gsmap.store import Store, scene_content, scene_id, scene_refs, schema
from gsmap.store.chunk_boxes import chunk_boxes
from gsmap.store.layout import CHUNK_ROWS
from gsmap.types import Cameras, Gaussians

NAMES = ("means", "quats", "log_scales", "logit_opacities", "sh")


def rows(g: Gaussians) -> np.ndarray:
    """Gaussians as rows in an order of their own, to compare sets."""
    table = np.concatenate([getattr(g, n).reshape(len(g), -1) for n in NAMES], axis=1)
    return table[np.lexsort(table.T)]


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("n", [1, 500, CHUNK_ROWS, 2 * CHUNK_ROWS + 17])
def test_what_goes_in_comes_out(store, n, degree):
    g, c = make_gaussians(n, degree=degree), make_cameras()
    scene, is_new = store.scenes.add(
        g, c, name="a", captured_at="2026-01-02T03:04:05+00:00", source="a.ply", antialiased=True, notes=("hm",)
    )
    assert is_new
    assert (scene.num_gaussians, scene.sh_degree, scene.num_cameras) == (n, degree, 3)
    np.testing.assert_array_equal(rows(store.scenes.gaussians("a")), rows(g))
    cameras = store.scenes.cameras("a")
    np.testing.assert_array_equal(cameras.T_frame_camera, c.T_frame_camera)
    np.testing.assert_array_equal(cameras.intrinsics_px, c.intrinsics_px)
    assert cameras.names == c.names
    again = store.scenes.get("a")
    assert (again.captured_at, again.source, again.antialiased) == ("2026-01-02T03:04:05+00:00", "a.ply", True)
    np.testing.assert_array_equal(again.bounds, [g.means.min(0), g.means.max(0)])
    assert store.scenes.notes("a") == ("hm",)


def test_same_content_twice_changes_nothing(store):
    first, _ = store.scenes.add(make_gaussians(), make_cameras(), name="a")
    before = {p: p.stat().st_mtime_ns for p in (store.folder / "arrays").rglob("*")}
    again, is_new = store.scenes.add(make_gaussians(), make_cameras(), name="other")
    assert not is_new
    assert (again.id, again.name) == (first.id, "a")
    assert {p: p.stat().st_mtime_ns for p in (store.folder / "arrays").rglob("*")} == before
    assert len(store.scenes.list()) == 1


def test_id_depends_on_all_content(store):
    g, c = make_gaussians(), make_cameras()
    ids = {scene_id(g, c), scene_id(g, c[:2]), scene_id(g[:-1], c)}
    for name in NAMES:
        changed = {n: getattr(g, n).copy() for n in NAMES}
        changed[name].flat[-1] += 1
        ids.add(scene_id(Gaussians(**changed), c))
    assert len(ids) == 8


def test_refs(store, two_scenes):
    a, b = two_scenes
    assert store.scenes.get("scene0").id == a.id
    assert store.scenes.get(b.id).name == "scene1"
    assert store.scenes.get(b.id[:12]).name == "scene1"
    for ref in ("nothing", "", "zzz", "%", "_"):
        with raises(NotFoundError, code="scene_not_found"):
            store.scenes.get(ref)


def test_a_beginning_of_several_ids_is_refused(store, monkeypatch):
    monkeypatch.setattr(scene_refs, "_MIN_PREFIX", 1)  # instead of millions of scenes
    for i in range(20):  # of 20 ids two begin with the same of 16 digits
        store.scenes.add(make_gaussians(2, seed=i), make_cameras(), name=f"scene {i}")
    firsts = [s.id[0] for s in store.scenes.list()]
    twice = next(d for d in firsts if firsts.count(d) > 1)
    with raises(NotFoundError, code="scene_ambiguous"):
        store.scenes.get(twice)


def test_few_digits_are_a_name_and_no_beginning_of_an_id(store):
    """A scene called by digits that was removed must not lead to another whose id begins with them."""
    kept, gone = (store.scenes.add(make_gaussians(2, seed=i), make_cameras(), name="x")[0] for i in range(2))
    store.scenes.edit(gone.id, name=kept.id[:2])
    store.scenes.remove(gone.id)
    with raises(NotFoundError, code="scene_not_found"):
        store.scenes.get(kept.id[:2])
    assert store.scenes.find_any(kept.id[:2]).id == gone.id
    assert store.scenes.find_any(kept.id[:6]).id == kept.id
    with raises(InputError, code="invalid_name"):
        store.scenes.edit(kept.id, name=gone.id)


def test_names_stay_unique(store):
    for i in range(3):
        store.scenes.add(make_gaussians(seed=i), make_cameras(), name="a")
    assert [s.name for s in store.scenes.list()] == ["a", "a-2", "a-3"]


def test_remove_leaves_a_tombstone_and_frees_the_name(store, two_scenes):
    a = two_scenes[0]
    store.scenes.remove("scene0")
    assert [s.name for s in store.scenes.list()] == ["scene1"]
    assert [s.name for s in store.scenes.list(removed=True)] == ["scene0"]
    with pytest.raises(NotFoundError):
        store.scenes.get("scene0")
    assert store.scenes.removed_at(a.id)
    assert len(store.scenes.gaussians(a.id)) == 500  # history can still be exported
    with raises(NotFoundError, code="scene_removed"):
        store.scenes.remove(a.id)
    c, is_new = store.scenes.add(make_gaussians(seed=7), make_cameras(), name="scene0")
    assert is_new
    assert c.name == "scene0"


def test_removed_content_comes_back(store):
    a, _ = store.scenes.add(make_gaussians(), make_cameras(), name="a")
    for prune in (False, True):
        store.scenes.remove(a.id)
        if prune:
            store.prune()
        back, is_new = store.scenes.add(make_gaussians(), make_cameras(), name="back")
        assert is_new
        assert (back.id, back.name) == (a.id, "back")
        assert len(store.scenes.gaussians("back")) == 500
        assert store.check().ok


def test_bounds_read_exactly_what_reaches_in(store):
    g = make_gaussians(5 * CHUNK_ROWS)
    store.scenes.add(g, make_cameras(), name="a")
    low, high = np.array([-1.0, 0, 2]), np.array([0.5, 1, 3])
    reach = 3 * g.scales.max(1, keepdims=True).astype(np.float64)
    expected = g[((g.means >= low - reach) & (g.means <= high + reach)).all(1)]
    found = store.scenes.gaussians("a", np.array([low, high]))
    assert len(found) > 100
    # The chunk boxes are tighter than the sphere around a Gaussian, so only ones that cannot touch may be missing.
    inside = expected[((expected.means >= low) & (expected.means <= high)).all(1)]
    kept = {tuple(m) for m in found.means.tolist()}
    assert {tuple(m) for m in inside.means.tolist()} <= kept <= {tuple(m) for m in expected.means.tolist()}
    assert len(store.scenes.gaussians("a", np.array([[90.0] * 3, [91.0] * 3]))) == 0
    with raises(InputError, code="invalid_box"):
        store.scenes.gaussians("a", np.zeros((3, 2)))


def test_what_lies_within_bounds_is_read_and_of_chunks_without_any_only_means(store, monkeypatch):
    g = make_gaussians(5 * CHUNK_ROWS)
    store.scenes.add(g, make_cameras(), name="a")
    whole = store.scenes.gaussians("a")
    box = np.array([[2.0, 2, 2], [4.0, 4, 4]])
    within = ((whole.means >= box[0]) & (whole.means < box[1])).all(1)
    assert 100 < within.sum() < len(g)
    np.testing.assert_array_equal(rows(store.scenes.gaussians_within("a", box)), rows(whole[within]))
    without = np.arange(len(g)) % 3 == 0
    found = store.scenes.gaussians_within("a", box, without)
    np.testing.assert_array_equal(rows(found), rows(whole[within & ~without]))
    everything = np.array([[-99.0] * 3, [99.0] * 3])
    np.testing.assert_array_equal(store.scenes.gaussians_within("a", everything).sh, whole.sh)
    asked = []
    real = store.arrays.read
    monkeypatch.setattr(store.arrays, "read", lambda *a, **k: asked.append(k) or real(*a, **k))
    beside = np.array([[-99.0, -99, -99], [whole.means[:, 0].min() - 1e-6, 99, 99]])
    assert len(store.scenes.gaussians_within("a", beside)) == 0 < len(store.scenes.gaussians("a", beside))
    assert asked[0]["only"] == ["means"]
    assert asked[0]["rows"]
    assert asked[1]["rows"] == []
    store.scenes.thin("a", np.ones(len(g), bool))
    compact = store.scenes.gaussians("a")
    within = ((compact.means >= box[0]) & (compact.means < box[1])).all(1)
    np.testing.assert_array_equal(rows(store.scenes.gaussians_within("a", box)), rows(compact[within]))


def test_chunks_are_read_by_ranges_and_lie_in_their_boxes(store):
    g = make_gaussians(3 * CHUNK_ROWS + 7)
    store.scenes.add(g, make_cameras(), name="a")
    for _ in range(2):
        whole, found = store.scenes.gaussians("a"), store.scenes.chunks("a")
        assert (found.num_gaussians, found.rows, len(found.boxes)) == (len(g), CHUNK_ROWS, 4)
        low, high = found.boxes[:, 0], found.boxes[:, 1]
        chunk = np.arange(len(g)) // CHUNK_ROWS
        assert (whole.means >= low[chunk]).all()
        assert (whole.means <= high[chunk]).all()
        for start, stop in ((0, 2 * CHUNK_ROWS), (2 * CHUNK_ROWS + 5, len(g))):
            part = whole[np.zeros(stop - start, int)]
            for fields in (NAMES[:2], NAMES[2:]):
                found.read(fields, start, stop, part)
            for name in NAMES:
                np.testing.assert_array_equal(getattr(part, name), getattr(whole, name)[start:stop])
        store.scenes.thin("a", np.ones(len(g), bool))


def test_bounds_read_few_chunks(store, monkeypatch):
    store.scenes.add(make_gaussians(8 * CHUNK_ROWS), make_cameras(), name="a")
    asked = []
    real = store.arrays.read
    monkeypatch.setattr(store.arrays, "read", lambda *a, **k: asked.append(k["rows"]) or real(*a, **k))
    store.scenes.gaussians("a", np.array([[-5.0] * 3, [-4.5] * 3]))
    assert sum(stop - start for start, stop in asked[0]) <= 2 * CHUNK_ROWS


def test_scenes_do_not_mix_in_the_tree(store):
    store.scenes.add(make_gaussians(3 * CHUNK_ROWS, seed=1), make_cameras(), name="a")
    store.scenes.add(make_gaussians(2 * CHUNK_ROWS, seed=2), make_cameras(), name="b")
    whole = np.array([[-99.0] * 3, [99.0] * 3])
    assert len(store.scenes.gaussians("a", whole)) == 3 * CHUNK_ROWS
    assert len(store.scenes.gaussians("b", whole)) == 2 * CHUNK_ROWS
    with store.catalog.read() as connection:
        plan = str(connection.execute(text("EXPLAIN QUERY PLAN SELECT chunk FROM chunk_boxes WHERE s0 = 1")).all())
    assert "VIRTUAL TABLE INDEX" in plan


def test_morton_order_keeps_neighbours_together():
    points = np.random.default_rng(0).uniform(size=(40_000, 3)).astype(np.float32)
    order = morton_order(points)
    assert sorted(order) == list(range(len(points)))
    g = make_gaussians(40_000)
    boxes = chunk_boxes(g[morton_order(g.means)], 1000)
    plain = chunk_boxes(g, 1000)
    volume = np.prod(boxes[:, 1] - boxes[:, 0], axis=1).mean() / np.prod(plain[:, 1] - plain[:, 0], axis=1).mean()
    assert volume < 0.25
    np.testing.assert_array_equal(morton_order(np.zeros((5, 3), np.float32)), np.arange(5))


def test_chunk_boxes_hold_three_sigmas():
    g = make_gaussians(50)
    from gsmap.geometry.rotations import quats_to_matrices

    for i, (low, high) in enumerate(chunk_boxes(g, 1)):
        half = quats_to_matrices(g.quats[i]) * g.scales[i]
        reach = 3 * np.sqrt(np.diag(half @ half.T))
        np.testing.assert_allclose(low, g.means[i] - reach, atol=1e-5)
        np.testing.assert_allclose(high, g.means[i] + reach, atol=1e-5)


def test_no_gaussians_and_odd_camera_names(store):
    with raises(InputError, code="no_gaussians"):
        store.scenes.add(Gaussians.empty(), make_cameras(), name="a")
    c = make_cameras(2)
    odd = type(c)(c.T_frame_camera, c.intrinsics_px, c.sizes_px, ("a\nb", "c"))
    with raises(InputError, code="invalid_name"):
        store.scenes.add(make_gaussians(), odd, name="a")
    assert not store.scenes.list()
    assert not store.arrays.groups()


def test_damage_is_found_on_reading_and_mended_by_ingesting_again(store):
    g, c = make_gaussians(), make_cameras()
    scene, _ = store.scenes.add(g, c, name="a")
    file = store.folder / "arrays" / "scenes" / scene.id / "arrays.zip"
    for harm in (
        lambda: file.unlink(),
        lambda: file.write_bytes(file.read_bytes()[:-9]),
        lambda: file.write_bytes(bytes([file.read_bytes()[0]]) + file.read_bytes()[1:-30] + bytes(30)),
    ):
        harm()
        with raises(CorruptError, code=("arrays_missing", "arrays_corrupt")):
            store.scenes.gaussians("a")
        assert not store.check().ok
        mended, written = store.scenes.add(g, c, name="a")
        assert written
        assert mended.id == scene.id
        assert len(store.scenes.gaussians("a")) == 500
        assert store.check().ok


def test_reads_while_another_writes(tmp_path):
    with Store.create(tmp_path / "m") as writer, Store.open(tmp_path / "m", "r") as reader:
        writer.scenes.add(make_gaussians(), make_cameras(), name="a")
        with writer.transaction():
            writer.scenes.remove("a")
            assert [s.name for s in reader.scenes.list()] == ["a"]
        assert reader.scenes.list() == []


def test_a_failed_transaction_leaves_nothing(store, two_scenes):
    def change() -> None:
        with store.transaction():
            store.scenes.remove("scene0")
            store.scenes.remove("scene1")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        change()
    assert len(store.scenes.list()) == 2


def test_real_capture(store, shared_data):
    from gsmap.ingest import read_captures

    (capture,) = read_captures(shared_data / "kitchen_splats" / "k0.ply")
    scene, _ = store.scenes.add(capture.gaussians, capture.cameras, name=capture.name, source=capture.source)
    np.testing.assert_array_equal(rows(store.scenes.gaussians("k0")), rows(capture.gaussians))
    assert scene.name == "k0"


@pytest.mark.parametrize("name", ["a\u200bb", "a\u200d", "\ufeffa", "a\u00adb", "x\U000e0041", "\u202ea", "\u2060"])
def test_names_with_characters_that_nobody_sees_are_refused(store, name):
    with raises(InputError, code="invalid_name"):
        store.scenes.add(make_gaussians(), make_cameras(), name=name)
    assert store.scenes.list() == []


@pytest.mark.parametrize("name", ["نمی\u200cخواهم", "👩\u200d🚀", "salle à manger", "部屋"])
def test_names_in_any_script_are_kept(store, name):
    assert store.scenes.add(make_gaussians(), make_cameras(), name=name)[0].name == name


def with_lenses() -> Cameras:
    """A pinhole, a distorted photo and a panorama."""
    pinhole = make_cameras()[:1]
    bent = camera_model("OPENCV", 640, 480, (500.0, 510.0, 320.0, 240.0, -0.1, 0.02, 1e-3, 0.0))
    panorama = camera_model("EQUIRECTANGULAR", 640, 320, (640.0, 320.0))
    views = [pinhole_views(model, pinhole.T_frame_camera[0], name) for model, name in ((bent, "b"), (panorama, "p"))]
    return Cameras.concatenate([pinhole, *views])


def test_lenses_come_back_and_count_as_content(store):
    given = with_lenses()
    g = make_gaussians()
    scene, _ = store.scenes.add(g, given, name="a")
    for name in ("a", store.scenes.thin("a", np.ones(len(g), bool)).id):
        found = store.scenes.cameras(name)
        assert found.lenses[0] is None
        for lens, want in zip(found.lenses[1:], given.lenses[1:], strict=True):
            assert (lens.photo, lens.model) == (want.photo, want.model)
            np.testing.assert_array_equal(lens.R_photo_camera, want.R_photo_camera)
        assert found.photo_rows == given.photo_rows
    assert scene.id != scene_id(g, replace(given, lenses=()))
    assert scene_id(g, make_cameras()) == scene_id(g, replace(make_cameras(), lenses=(None,) * 3))


@pytest.mark.parametrize("wrong", ["[null]", '{"a": 1}', "[{}, 1]", "[" * 9999, "nonsense"])
def test_damaged_lenses_are_reported(store, monkeypatch, wrong):
    monkeypatch.setattr(scene_content, "lens_array", lambda cameras: np.frombuffer(wrong.encode(), np.uint8))
    store.scenes.add(make_gaussians(), with_lenses(), name="a")
    with raises(CorruptError, code="catalog_invalid"):
        store.scenes.cameras("a")


def test_a_scene_without_its_chunk_boxes_is_found(store):
    """Without them a reader of a box would see none of the scene."""
    for seed in range(2):
        store.scenes.add(make_gaussians(50, seed=seed), make_cameras(), name=f"scene{seed}")
    assert store.check().ok
    with store.catalog.write() as connection:
        number = connection.execute(select(schema.scenes.c.number).where(schema.scenes.c.name == "scene1")).scalar_one()
        connection.exec_driver_sql(f"DELETE FROM {schema.CHUNK_BOXES} WHERE s0 = {number}")
    (problem,) = store.check().problems
    assert "scene1" in problem
