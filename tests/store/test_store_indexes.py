"""Segments of the retrieval index and lookups: kept whole, replaced in one step, forgotten with their scenes."""

import numpy as np
import pytest
from raising import raises
from sqlalchemy import text
from store_samples import key, make_cameras, make_gaussians

from gsmap.errors import CorruptError
from gsmap.store import Store, purging
from gsmap.store.indexes import Lookup
from gsmap.types import SceneGraph
from gsmap.types.retrieval import Candidate, IndexArrays, IndexedScene

A, B = "a" * 32, "b" * 32


def arrays(count=5, seed=0):
    rng = np.random.default_rng(seed)
    nodes = rng.integers(0, 256, (count, 58), dtype=np.uint8)
    return IndexArrays(np.arange(count, dtype=np.int64), np.arange(count + 1, dtype=np.int64), nodes)


def members(*scenes):
    return [IndexedScene(scene, scene[::-1], True, False, 1.5) for scene in scenes]


@pytest.fixture
def store(tmp_path):
    with Store.create(tmp_path / "map.gsmap") as made:
        yield made


def add(store, count=3):
    return [store.scenes.add(make_gaussians(60, seed=i), make_cameras(), name=f"s{i}")[0].id for i in range(count)]


def bodies(store):
    return [name for kind, name in store.arrays.groups() if kind == "indexes"]


def test_a_segment_comes_back_as_it_was_kept(store):
    given = arrays(40)
    assert store.indexes.save_segment(A, members(B, A), given, ())
    (found,) = store.indexes.segments(A)
    assert list(found.members) == members(B, A)
    keys, starts = found.lists()
    assert np.array_equal(keys, given.keys)
    assert np.array_equal(starts, given.starts)
    assert np.array_equal(found.rows(3, 17), given.nodes[3:17])
    assert store.indexes.segments(B) == []
    assert store.indexes.save_segment(A, members(B, A), given, ())  # as another process would that did the same
    assert len(store.indexes.segments(A)) == 1
    assert store.check().ok
    assert store.prune().num_bytes == 0
    assert np.array_equal(store.indexes.segments(A)[0].rows(0, 40), given.nodes)


def test_what_a_segment_takes_the_place_of_leaves_the_disk(store):
    store.indexes.save_segment(A, members(A), arrays(seed=1), ())
    store.indexes.save_segment(A, members(B), arrays(seed=2), ())
    first, second = store.indexes.segments(A)
    assert store.indexes.save_segment(A, members(A, B), arrays(10), [first.id, second.id])
    (only,) = store.indexes.segments(A)
    assert len(only.members) == 2
    assert len(bodies(store)) == 1
    # Others did the same meanwhile: what would be in place of what is gone is not kept.
    assert not store.indexes.save_segment(A, members(A), arrays(3), [first.id])
    assert [s.id for s in store.indexes.segments(A)] == [only.id]
    # Another index lies beside it.
    store.indexes.save_segment(B, members(A), arrays(5), (), beside={A})
    assert [s.id for s in store.indexes.segments(A)] == [only.id]
    assert len(bodies(store)) == 2
    # Another recipe in its place: the older segments go.
    store.indexes.save_segment(B, members(A), arrays(4), [s.id for s in store.indexes.segments(B)])
    assert store.indexes.segments(A) == []
    assert len(bodies(store)) == 1
    store.indexes.forget([s.id for s in store.indexes.segments(B)])
    assert bodies(store) == []
    assert store.check().ok


def test_a_branch_keeps_the_segments_it_names(store):
    store.indexes.save_segment(A, members(A), arrays(seed=1), ())
    store.branches.make("other")
    (before,) = store.indexes.segments(A)
    store.indexes.save_segment(A, members(A, B), arrays(9), [before.id])
    assert len(bodies(store)) == 2
    with Store.open(f"{store.home}@other") as branch:
        (kept,) = branch.indexes.segments(A)
        assert np.array_equal(kept.rows(0, 5), arrays(seed=1).nodes)
        branch.indexes.forget([kept.id])
    assert len(bodies(store)) == 1


def test_lookups_are_kept_replaced_and_left(store):
    a, b, c = add(store)
    found = Lookup(a, A, (Candidate(b, 12.5, 30.0), Candidate(c, 0.1 + 0.2, 1.0)))
    store.indexes.save_lookups([found, Lookup(b, A, ())])
    assert store.indexes.lookups([a, c]) == [found]
    assert store.indexes.lookup_states() == {a: (A, None), b: (A, None)}
    store.indexes.set_num_left({a: 2, b: 0, c: 5})
    assert store.indexes.lookup_states() == {a: (A, 2), b: (A, 0)}
    store.indexes.save_lookups([Lookup(a, B, ())])
    assert store.indexes.lookup_states() == {a: (B, None), b: (A, 0)}
    # A scene that was away while others asked asks anew when it is back.
    store.scenes.remove(b)
    store.indexes.save_lookups([])
    assert set(store.indexes.lookup_states()) == {a}


def test_a_purged_scene_is_in_no_segment_and_no_lookup(store):
    a, b, c = add(store)
    for scene in (a, b, c):
        store.graphs.save(SceneGraph(scene), key("describe", scene))
    store.indexes.save_segment(A, members(a, b), arrays(seed=1), ())
    store.indexes.save_segment(A, members(c), arrays(seed=2), ())
    store.indexes.save_lookups([Lookup(a, A, (Candidate(b, 2.0, 3.0), Candidate(c, 1.0, 1.0))), Lookup(b, A, ())])
    store.scenes.remove(b)
    purging.finish(store, purging.begin(store, b), ())
    assert [[m.scene for m in s.members] for s in store.indexes.segments(A)] == [[c]]
    assert len(bodies(store)) == 1
    (left,) = store.indexes.lookups([a, b])
    assert [one.scene for one in left.candidates] == [c]
    with store.catalog.read() as connection:
        told = connection.execute(text("SELECT about FROM results UNION ALL SELECT candidates FROM lookups"))
        assert not any(b in row for row in told.scalars())
    assert store.check().ok


def test_a_damaged_segment_is_named_by_check(store):
    store.indexes.save_segment(A, members(A), arrays(), ())
    (group,) = bodies(store)
    (archive,) = (store.arrays.root / "indexes" / group).iterdir()
    archive.write_bytes(b"damaged".ljust(archive.stat().st_size, b"."))
    problems = store.check().problems
    assert any(group in problem for problem in problems)
    with raises(CorruptError, code="arrays_corrupt"):
        store.indexes.segments(A)[0].rows(0, 5)


@pytest.mark.parametrize("told", ['[["x",1]]', '[["../../x","' + A + '",true,true,1.0]]', '{"a":1}', "[3]"])
def test_members_that_gsmap_did_not_write_are_refused(store, told):
    store.indexes.save_segment(A, members(A), arrays(), ())
    with store.catalog.write() as connection:
        connection.execute(text("UPDATE results SET about = :m"), {"m": f'{{"members":{told}}}'})
    with raises(CorruptError, code="catalog_invalid"):
        store.indexes.segments(A)
