"""Merging maps, splitting them, bringing scenes back: what travels, what holds, and that nothing is computed."""

import contextlib
import os
import shutil

import numpy as np
import pytest
from raising import raises
from sqlalchemy import select
from store_samples import key, make_cameras, make_gaussians

from gsmap.errors import ConfigError, CorruptError, GsmapError, InputError, NotFoundError
from gsmap.geometry.rotations import exp_so3
from gsmap.store import Store, schema
from gsmap.store.merging import import_scene, merge, split
from gsmap.store.revisions import newest_poses
from gsmap.store.scene_replacement import inherit
from gsmap.types import EdgeOutcome, PoseGraph, Prior, Registration, SceneGraph, ScenePose, Sim3


def add(store, seed, name=None, **more):
    return store.scenes.add(make_gaussians(60, seed=seed), make_cameras(), name=name or f"scene{seed}", **more)[0].id


def describe(store, *scenes):
    for scene in scenes:
        store.graphs.save(SceneGraph(scene), key("describe", scene))


def register(store, a, b, x=1.0, version=1):
    pose = Sim3(np.eye(3), np.array([x, 0, 0]))
    done = Registration(a, b, "accepted", S_target_source=pose, information=np.eye(7), proposer="graph:landmarks")
    return store.registrations.save(done, key("register", a, b, version=version))


def measure(store, a, b, x):
    pose = Sim3(np.eye(3), np.array([x, 0, 0]))
    done = Registration(a, b, "accepted", S_target_source=pose, information=np.eye(7), proposer="manual")
    return store.registrations.save(done)


def pose(scene, x=0.0, component=0, turn=0.0, covariance=None):
    S = Sim3(exp_so3(np.array([0.0, 0, turn])), np.array([x, 0, 0]))
    return ScenePose(scene, S, component, "placed", covariance)


def solve(store, *poses, edges=()):
    outcomes = {pair: EdgeOutcome("used", 1.0) for pair in edges}
    return store.revisions.save(PoseGraph({p.scene: p for p in poses}, outcomes))


def dump(store):
    """Every row of the catalog."""
    from sqlalchemy import select

    from gsmap.store import schema

    with store.catalog.read() as connection:
        return {t.name: sorted(map(str, connection.execute(select(t)).all())) for t in schema.metadata.sorted_tables}


def bytes_of(folder):
    beside = ("-shm", "-wal")
    return {p: p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file() and not p.name.endswith(beside)}


@pytest.fixture
def other(tmp_path):
    with Store.create(tmp_path / "other.gsmap") as made:
        yield made


def test_all_that_a_map_knows_travels(store, other, tmp_path):
    mine = add(store, 0)
    describe(store, mine)
    solve(store, pose(mine))
    a, b = add(other, 1, captured_at="2024-05-31"), add(other, 2)
    describe(other, a, b)
    edge = register(other, a, b)
    other.registrations.review(a, b, "confirm", "seen")
    other.scenes.edit(a, note="wet floor", tags_add=["hall"], author="ann")
    other.priors.set(Prior(b, Sim3.identity(), np.full(7, 0.1)))
    (tmp_path / "m.onnx").write_bytes(b"model")
    other.models.add("clip", tmp_path / "m.onnx", kind="clip")
    solve(other, pose(a), pose(b, 1.0), edges=[(a, b)])
    other.close()
    before = bytes_of(other.home)
    with Store.open(other.home, "r") as source:
        merged = merge(store, source)
        assert (merged.num_scenes, merged.num_graphs, merged.num_registrations, merged.num_reviews) == (2, 2, 1, 1)
        assert (merged.num_priors, merged.num_models, merged.num_revisions, merged.revision) == (1, 1, 1, 3)
        assert merged.num_facts == len(source.scenes.facts(a)) + len(source.scenes.facts(b))
        for scene in (a, b):
            assert source.scenes.facts(scene) == store.scenes.facts(scene)
            theirs, ours = source.scenes.gaussians(scene), store.scenes.gaussians(scene)
            assert np.array_equal(theirs.means, ours.means)
            box = np.array([[-5, -5, -5], [0, 0, 0]])
            assert len(source.scenes.gaussians(scene, box)) == len(store.scenes.gaussians(scene, box)) > 0
        assert store.scenes.get(a).tags == ("hall",)
        assert store.scenes.get(a).captured_at == source.scenes.get(a).captured_at
        found = store.registrations.get(a, b)
        assert (found.review, found.key, found.created_at) == ("confirm", edge.key, edge.created_at)
        assert store.recipes.get(found.recipe).to_json() == source.recipes.get(edge.recipe).to_json()
        assert [r.note for r in store.registrations.reviews(a, b)] == ["seen"]
        assert store.models.get("clip").path.read_bytes() == b"model"
        assert store.models.get("clip").path.is_relative_to(store.home)
        assert [r.origin for r in store.revisions.list()] == [None, {"map": source.id, "number": 1}, None]
        assert store.revisions.get(2).poses.keys() == {a, b}
        assert store.revisions.get(2).outcomes.keys() == {(a, b)}
    graph = store.revisions.get()
    assert {s: p.component for s, p in graph.poses.items()} == {a: 0, b: 0, mine: 1}
    assert graph.use(a, b) == "used"
    assert store.check().ok
    assert bytes_of(other.home) == before


def test_again_it_adds_nothing(store, other):
    a, b = add(other, 1), add(other, 2)
    describe(other, a, b)
    register(other, a, b)
    solve(other, pose(a), pose(b))
    solve(store, pose(add(store, 3, "scene1")))  # a name that is taken
    merged = merge(store, other)
    assert merged.renamed == {"scene1": "scene1-2"}
    before = dump(store)
    again = merge(store, other)
    assert (again.num_scenes, again.num_facts, again.num_revisions, again.num_registrations) == (0, 0, 0, 0)
    assert again.revision is None
    assert again.num_known == 2
    assert dump(store) == before
    back = merge(other, store)  # and what comes back is what the other had, and this map's own
    assert (back.num_scenes, back.num_known, back.num_registrations) == (1, 2, 0)
    assert other.revisions.get().poses.keys() == store.revisions.get().poses.keys()
    assert {s.name for s in other.scenes.list()} == {"scene1", "scene2", "scene1-2"}


@pytest.mark.guards("data")
def test_arrays_are_linked_and_their_bytes_compared(store, other):
    scene = add(other, 1)
    victim = next(p for p in (other.home / "arrays/scenes" / scene).rglob("*.zip") if p.is_file())
    merge(store, other)
    linked = store.home / victim.relative_to(other.home)
    assert linked.samefile(victim)
    second = add(other, 2)
    victim = next(p for p in (other.home / "arrays/scenes" / second).rglob("*.zip") if p.is_file())
    data = bytearray(victim.read_bytes())
    data[-1] ^= 1
    victim.write_bytes(data)
    before = dump(store)
    with raises(CorruptError, code="bytes_differ"):
        merge(store, other)
    assert dump(store) == before
    assert not list((store.home / "arrays" / "staging").iterdir())


def test_arrays_are_copied_where_links_cannot_be(store, other, monkeypatch):
    scene = add(other, 1)

    def refuse(*_):
        raise OSError(18, "Invalid cross-device link")

    monkeypatch.setattr(os, "link", refuse)
    merge(store, other)
    shutil.rmtree(other.home / "arrays")
    assert len(store.scenes.gaussians(scene)) == 60
    assert store.check().ok


def test_the_later_word_holds(store, other):
    a, b = add(store, 1), add(store, 2)
    for scene in (a, b):
        add(other, int(scene == b) + 1, "there")
    assert [s.name for s in store.scenes.list()] == ["scene1", "scene2"]
    merge(store, other)
    assert [s.name for s in store.scenes.list()] == ["scene1", "scene2"]  # a file's name is no later word
    undated = add(store, 5)
    assert add(other, 5, captured_at="2023-03-03") == undated
    merge(store, other)
    assert store.scenes.get(undated).captured_at[:10] == "2023-03-03"
    store.scenes.edit(a, tags_add=["x", "y"], captured_at="2024-01-01")
    other.scenes.edit(a, name="hall", captured_at="2024-02-02", tags_add=["z"])
    store.scenes.edit(b, name="attic")
    merge(store, other)
    scene = store.scenes.get(a)
    assert (scene.name, scene.captured_at[:10], scene.tags) == ("hall", "2024-02-02", ("x", "y", "z"))
    other.scenes.edit(b, name="loft", note="n1")
    store.scenes.edit(b, name="roof")
    other.scenes.edit(a, tags_remove=["z"])
    merge(store, other)
    assert store.scenes.get(b).name == "roof"
    assert store.scenes.get(a).tags == ("x", "y")
    times = [fact.created_at for fact in store.scenes.facts(b)]
    assert times == sorted(times)
    assert [f.value for f in store.scenes.facts(b) if f.kind == "name"][-3:] == ["attic", "loft", "roof"]


def test_of_a_pair_in_both_the_newest_counts(store, other):
    for one in (store, other):
        a, b = add(one, 1), add(one, 2)
    register(other, a, b, 1.0, version=1)
    first = register(store, a, b, 2.0, version=2)
    merge(store, other)
    assert store.registrations.get(a, b).key == first.key
    assert len(store.registrations.history(a, b)) == 2
    third = register(other, a, b, 3.0, version=3)
    store.registrations.adopt(store.registrations.history(a, b)[0].number)
    merge(store, other)
    current = store.registrations.get(a, b)
    assert current.registration.S_target_source.translation[0] == 1.0  # adopted after the third was computed
    assert current.adopts == store.registrations.history(a, b)[0].number
    assert third.key in {r.key for r in store.registrations.history(a, b)}


def test_what_people_said_of_a_pair_holds_in_the_order_of_time(store, other):
    for one in (store, other):
        a, b = add(one, 1), add(one, 2)
        register(one, a, b)
    other.registrations.review(a, b, "reject", "mirrored")
    store.registrations.review(a, b, "confirm", "no, it fits")
    merge(store, other)
    assert store.registrations.get(a, b).review == "confirm"
    assert [r.review for r in store.registrations.reviews(a, b)] == ["reject", "confirm"]
    measure(other, a, b, 5.0)
    store.registrations.review(a, b, "withdraw")
    merge(store, other)
    assert store.registrations.get(a, b).manual
    measure(store, a, b, 6.0)
    merge(other, store)
    assert other.registrations.get(a, b).registration.S_target_source.translation[0] == 6.0
    assert store.registrations.get(b, a).number == max(r.number for r in store.registrations.history(a, b))


@pytest.mark.guards("data")
def test_life_and_death_by_the_later_word(store, other):
    a, b, c = (add(store, i) for i in (1, 2, 3))
    store.scenes.remove(a)
    store.scenes.remove(b)
    add(other, 1)  # ingested after it was removed here
    add(other, 3)
    other.scenes.remove(c)  # removed after it was ingested here
    gone = add(other, 4)
    other.scenes.remove(gone)
    merged = merge(store, other)
    assert [s.id for s in store.scenes.list()] == [a]
    assert {s.id for s in store.scenes.list(removed=True)} == {b, c, gone}
    assert merged.num_scenes == 1
    assert merged.num_removed == 2
    assert any("is restored" in note for note in merged.notes)
    assert store.check().ok
    store.scenes.remove(a)
    assert merge(store, other).num_scenes == 0
    assert store.scenes.list() == []


def test_a_removal_there_before_the_last_ingest_here_changes_nothing(store, other):
    scene = add(other, 1)
    other.scenes.remove("scene1")
    assert add(store, 1) == scene
    assert merge(store, other).num_removed == 0
    assert [one.id for one in store.scenes.list()] == [scene]


def test_a_merge_places_no_removed_scene(store, other):
    a, b = (add(other, seed) for seed in (1, 2))
    solve(other, pose(a), pose(b, 1.0))
    assert (add(store, 1), add(store, 2)) == (a, b)
    solve(store, pose(a))
    store.scenes.remove("scene2")
    assert merge(store, other).revision is not None
    with store.catalog.read() as connection:
        assert set(newest_poses(connection).poses) == {a}


@pytest.mark.parametrize("mine_is_later", [True, False])
def test_of_two_priors_of_a_scene_the_later_one_stays(store, other, mine_is_later):
    for kept, sigma in ((other, 0.2), (store, 0.1)) if mine_is_later else ((store, 0.1), (other, 0.2)):
        kept.priors.set(Prior(add(kept, 1), Sim3.identity(), np.full(7, sigma)))
    merge(store, other)
    (one,) = store.priors.list()
    assert one.sigmas[0] == (0.1 if mine_is_later else 0.2)
    assert merge(store, other).num_priors == 0, "nothing new"
    assert [prior.sigmas[0] for prior in store.priors.list()] == [one.sigmas[0]]


def test_a_prior_that_was_withdrawn_does_not_come_back_with_a_replacement(store):
    old, new, free = add(store, 1), add(store, 2), np.full(7, np.inf)
    for sigma in (0.5, 1.5):  # the first is replaced by the second
        store.priors.set(Prior(old, Sim3.identity(), np.where(np.arange(7) < 6, sigma, free)))
    inherit(store, old, new)
    assert [one.sigmas[0] for one in store.priors.list() if one.scene == new] == [1.5]
    with store.catalog.read() as connection:
        assert len(connection.execute(select(schema.priors).where(schema.priors.c.scene == new)).all()) == 1
    store.priors.remove(old)
    third = add(store, 3)
    inherit(store, old, third)
    assert third not in {one.scene for one in store.priors.list()}


def test_scenes_in_both_tie_the_frames(store, other):
    a, b, c = (add(store, i) for i in (1, 2, 3))
    for i in (1, 2, 4):
        add(other, i)
    d = other.scenes.get("scene4").id
    solve(store, pose(a), pose(b, 3.0), pose(c, 0.0, 1))
    # The same two scenes in a frame that is turned and moved, and a third one beside them.
    T = Sim3(exp_so3(np.array([0.1, 0.4, -1.0])), np.array([7.0, 8, 9]))
    theirs = {s: T @ Sim3(np.eye(3), np.array([x, 0, 0])) for s, x in ((a, 0.0), (b, 3.001), (d, 5.0))}
    other.revisions.save(PoseGraph({s: ScenePose(s, S, 0, "placed") for s, S in theirs.items()}))
    merge(store, other)
    poses = store.revisions.get().poses
    assert {s: p.component for s, p in poses.items()} == {a: 0, b: 0, d: 0, c: 1}
    np.testing.assert_allclose(poses[d].S_map_scene.translation, [5, 0, 0], atol=5e-3)
    np.testing.assert_allclose(poses[b].S_map_scene.translation, [3, 0, 0], atol=1e-12)


@pytest.mark.guards("data")
def test_where_they_disagree_the_other_stays_apart(store, other):
    a, b = add(store, 1), add(store, 2)
    for i in (1, 2, 4):
        add(other, i)
    d = other.scenes.get("scene4").id
    solve(store, pose(a), pose(b, 3.0))
    solve(other, pose(a), pose(b, 4.0), pose(d, 5.0))
    merged = merge(store, other)
    poses = store.revisions.get().poses
    assert {s: p.component for s, p in poses.items()} == {a: 0, b: 0, d: 1}
    assert any("separate component" in note for note in merged.notes)
    assert any("separate component" in note for note in store.revisions.get().notes)
    # but not where both solutions leave that much open
    wide = np.diag([1e-4] * 3 + [1.0] * 3 + [1e-6])
    with Store.create(store.home.parent / "third") as third:
        for i in (1, 2, 4):
            add(third, i)
        solve(third, pose(a), pose(b, 4.0, covariance=wide), pose(d, 5.0, covariance=wide))
        with Store.create(store.home.parent / "fourth") as fourth:
            add(fourth, 1), add(fourth, 2)
            solve(fourth, pose(a, covariance=wide), pose(b, 3.0, covariance=wide))
            merge(fourth, third)
            assert {p.component for p in fourth.revisions.get().poses.values()} == {0}


def test_a_branch_comes_back(store):
    a = add(store, 1)
    solve(store, pose(a))
    store.branches.make("b")
    with Store.open(f"{store.home}@b") as branch:
        b = add(branch, 2)
        describe(branch, a, b)
        register(branch, a, b)
        branch.scenes.edit(a, name="better")
        solve(branch, pose(a, 0.5), pose(b, 1.0))
        merged = merge(store, branch)
        assert (merged.num_scenes, merged.num_known, merged.num_revisions, merged.revision) == (1, 1, 1, None)
        assert merged.num_bytes == 0
        assert store.revisions.get().poses[a].S_map_scene.translation[0] == 0.5  # solved from ours: it comes after it
        assert store.scenes.get(a).name == "better"
        branch.scenes.remove(b)
        merge(store, branch)
        assert [s.id for s in store.scenes.list()] == [a]
    store.branches.delete("b")
    store.prune()
    assert store.check().ok
    assert len(store.scenes.gaussians(b)) == 60  # revisions name it still


def test_refusals(store, other):
    with raises(ConfigError, code="same_map"):
        merge(store, store)
    with Store.open(store.home) as again, raises(ConfigError, code="same_map"):
        merge(store, again)


def test_killed_anywhere_the_map_is_whole(store, other, monkeypatch):
    """A failure at any change of the disk leaves the map as it was, and the repeat does all of it."""
    a, b = add(other, 1), add(other, 2)
    describe(other, a, b)
    register(other, a, b)
    solve(other, pose(a), pose(b))
    before, step = dump(store), 0
    while True:
        step += 2
        left = [step]
        real = {name: getattr(os, name) for name in ("link", "rename", "mkdir", "fsync")}

        def failing(name, left=left, real=real):
            def call(*arguments, **more):
                left[0] -= 1
                if left[0] == 0:
                    raise OSError(5, "Input/output error")
                return real[name](*arguments, **more)

            return call

        with monkeypatch.context() as patch:
            for name in real:
                patch.setattr(os, name, failing(name))
            with contextlib.suppress(GsmapError):
                merge(store, other)
        if left[0] > 0:
            break
        if dump(store) == before:
            assert store.check().ok
    assert step > 5
    assert merge(store, other).num_scenes == 0
    assert store.check().ok
    assert len(store.scenes.gaussians(b)) == 60


def test_settings_that_differ_are_told(store, other):
    (other.home / "settings.toml").write_text("[optimize]\ngate_probability = 0.9\n")
    (note,) = merge(store, other).notes
    assert "optimize.gate_probability" in note
    assert "0.9" in note


# --- splitting, and scenes that come back ----------------------------------------------------------------------------


def test_a_part_becomes_a_map(store, tmp_path):
    scenes = [add(store, i) for i in range(3)]
    describe(store, *scenes)
    register(store, scenes[0], scenes[1])
    register(store, scenes[1], scenes[2])
    store.registrations.review(scenes[0], scenes[1], "confirm", "seen")
    store.scenes.edit(scenes[0], tags_add=["x"])
    solve(store, *(pose(s, i) for i, s in enumerate(scenes)), edges=[(scenes[0], scenes[1]), (scenes[1], scenes[2])])
    before = dump(store)
    with Store.create(tmp_path / "part") as part:
        split(store, part, scenes[:2])
        assert part.id != store.id
        assert [s.name for s in part.scenes.list()] == ["scene0", "scene1"]
        assert part.scenes.facts(scenes[0]) == store.scenes.facts(scenes[0])
        assert part.registrations.get(scenes[0], scenes[1]).review == "confirm"
        assert len(part.registrations.current()) == 1
        (revision,) = part.revisions.list()
        assert revision.origin == {"map": store.id, "number": 1, "part": part.id}
        assert part.revisions.get().poses.keys() == set(scenes[:2])
        assert part.revisions.get().outcomes.keys() == {(scenes[0], scenes[1])}
        assert {g.key for g in part.graphs.list()} < {g.key for g in store.graphs.list()}
        assert part.check().ok
        assert dump(store) == before
        assert merge(store, part).num_revisions == 0  # it is part of what is here
        assert dump(store) == before
        add(part, 7)
        assert merge(part, store).num_scenes == 1
        assert part.revisions.get().poses.keys() == set(scenes)


def test_a_removed_scene_comes_back(store):
    a, b = add(store, 1), add(store, 2)
    describe(store, a)
    register(store, a, b)
    store.scenes.edit(a, note="wet")
    store.scenes.remove(a)
    add(store, 3, "scene1")
    back = store.scenes.restore("scene1")
    assert (back.id, back.name) == (a, "scene1-2")
    assert store.registrations.get(a, b) is not None
    assert store.graphs.find(key("describe", a)) is not None
    assert len(store.scenes.gaussians(a)) == 60
    assert store.check().ok
    with raises(InputError, code="not_removed"):
        store.scenes.restore(b)
    with raises(NotFoundError, code="scene_not_found"):
        store.scenes.restore("nobody")
    store.scenes.remove(a)
    assert store.scenes.restore(a[:8]).id == a
    store.scenes.remove(a)
    store.prune()
    with raises(NotFoundError, code="arrays_pruned"):
        store.scenes.restore(a)


def test_a_scene_comes_from_another_map(store, other):
    for one in (store, other):
        a, b = add(one, 1), add(one, 2)
    c = add(other, 3)
    describe(other, a, b, c)
    for first, second in ((a, b), (a, c), (b, c)):
        register(other, first, second)
    other.scenes.edit(a, note="wet")
    store.scenes.remove(a)
    store.prune()
    brought = import_scene(store, other, a)
    assert [s.id for s in store.scenes.list(removed=True)] == []
    assert {s.id for s in store.scenes.list()} == {a, b}
    assert brought.num_graphs == 1
    assert store.registrations.get(a, b) is not None
    assert len(store.registrations.current()) == 1
    assert store.check().ok


def damage(store, kind, group):
    """Turn a byte of a group's largest file."""
    path = max(
        (p for p in (store.home / "arrays" / kind / group).rglob("*") if p.is_file()), key=lambda p: p.stat().st_size
    )
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.unlink()  # it may have other names
    path.write_bytes(content)


@pytest.mark.parametrize("removed", [False, True])
def test_damaged_arrays_come_from_another_map(store, other, removed):
    for one in (store, other):
        a = add(one, 1)
        describe(one, a)
    graph = next(p.name for p in (store.home / "arrays" / "graphs").iterdir())
    before, rows = bytes_of(store.home / "arrays"), [dump(store)[table] for table in ("files", "groups", "results")]
    damage(store, "scenes", a)
    damage(store, "graphs", graph)
    if removed:
        store.scenes.remove(a)
    assert not store.check().ok
    damage(other, "scenes", a)
    with raises(CorruptError, code="bytes_differ"):
        import_scene(store, other, a)
    assert (store.scenes.removed_at(a) is not None) == removed
    shutil.rmtree(other.home / "arrays" / "scenes" / a)
    other.scenes.add(make_gaussians(60, seed=1), make_cameras(), name="scene1")
    brought = import_scene(store, other, a)
    assert brought.num_bytes > 0
    assert store.check().ok
    assert bytes_of(store.home / "arrays") == before
    assert [s.id for s in store.scenes.list()] == [a]
    assert [dump(store)[table] for table in ("files", "groups", "results")] == rows
    assert import_scene(store, other, a).num_bytes == 0
    assert len(store.scenes.gaussians(a)) == 60


def test_damaged_arrays_cannot_come_from_a_branch_of_the_same_map(store):
    a = add(store, 1)
    store.branches.make("b")
    damage(store, "scenes", a)
    with Store.open(f"{store.home}@b", "r") as branch, raises(CorruptError, code="arrays_corrupt"):
        import_scene(store, branch, a)


def test_what_was_said_last_of_a_scene_counts_after_a_merge_though_a_clock_was_ahead(store, tmp_path, monkeypatch):
    scene, _ = store.scenes.add(make_gaussians(20), make_cameras(), name="zero")
    with monkeypatch.context() as patched:
        patched.setattr("gsmap.store.facts.now", lambda: "2190-01-01T00:00:00.000000+00:00")
        store.scenes.edit("zero", name="first")
    with Store.create(tmp_path / "other.gsmap") as other:
        merge(other, store)
        store.scenes.edit("first", name="second", note="here")
        merge(other, store)
        assert other.scenes.get(scene.id).name == "second"
        other.scenes.edit("second", name="third")
        merge(store, other)
    assert store.scenes.get(scene.id).name == "third"
    assert [fact.value for fact in store.scenes.facts("third")] == ["zero", "first", "second", "here", "third"]
