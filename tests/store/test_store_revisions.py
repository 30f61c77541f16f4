"""A revision adds what differs from the one before; prune gives its room back; what is read of one is exact."""

import json
from dataclasses import replace
from itertools import combinations, pairwise

import numpy as np
import pytest
from raising import raises
from sqlalchemy import delete, select
from store_samples import key, make_cameras, make_gaussians

from gsmap.errors import CorruptError, InputError, NotFoundError
from gsmap.geometry.rotations import exp_so3
from gsmap.store import Store, matrices
from gsmap.store import registrations as module
from gsmap.store.registrations import Registrations, _figure
from gsmap.store.schema import edges, poses, registrations, results, reviews
from gsmap.types import EdgeOutcome, PoseGraph, Registration, SceneGraph, ScenePose, Sim3

NUM = 12


@pytest.fixture
def store(tmp_path):
    with Store.create(tmp_path / "m.gsmap") as made:
        for k in range(NUM):
            made.scenes.add(make_gaussians(n=8, seed=k), make_cameras(1), name=f"s{k:02d}")
        yield made


@pytest.mark.parametrize("value", ['{"contradicted_priors": [7]}', '{"contradicted_priors": 7}'])
def test_provenance_that_gsmap_did_not_write_is_refused(store, value):
    scene = store.scenes.list()[0].id
    store.revisions.save(PoseGraph({scene: ScenePose(scene, Sim3.identity(), 0, "placed")}))
    with store.catalog.write() as connection:
        connection.exec_driver_sql("UPDATE revisions SET provenance = ?", (value,))
    for read in (store.revisions.get, store.revisions.list):
        with raises(CorruptError, code="catalog_invalid"):
            read()


def some_pose(rng):
    return Sim3(exp_so3(rng.normal(size=3)), rng.normal(size=3), float(rng.uniform(0.5, 2)))


def covariance(rng):
    root = rng.normal(size=(7, 7))
    made = root @ root.T
    return (made + made.T) / 2


def histories(store, rng, num=15):
    """Answers of which each differs from the one before in a few scenes and edges; scenes come and go."""
    ids = [scene.id for scene in store.scenes.list()]
    poses, outcomes = {}, {}
    for _ in range(num):
        for scene in rng.choice(ids, 2, replace=False).tolist():
            if scene in poses and rng.uniform() < 0.3:
                del poses[scene]
                outcomes = {pair: one for pair, one in outcomes.items() if scene not in pair}
            else:
                cov = covariance(rng) if rng.uniform() < 0.7 else None
                poses[scene] = ScenePose(scene, some_pose(rng), int(rng.integers(2)), "placed", cov)
        if len(poses) > 1:
            a, b = sorted(rng.choice(sorted(poses), 2, replace=False).tolist())
            doubt = bool(rng.uniform() < 0.5)
            outcomes[a, b] = EdgeOutcome("unused" if doubt else "used", float(rng.uniform()), "why" * doubt, doubt)
        yield PoseGraph(dict(poses), dict(outcomes), notes=(f"{len(poses)} scenes",))


def same(a: PoseGraph, b: PoseGraph) -> None:
    assert set(a.poses) == set(b.poses)
    for scene, one in a.poses.items():
        two = b.poses[scene]
        np.testing.assert_array_equal(one.S_map_scene.rotation, two.S_map_scene.rotation)
        np.testing.assert_array_equal(one.S_map_scene.translation, two.S_map_scene.translation)
        assert one.S_map_scene.scale == two.S_map_scene.scale
        assert (one.component, one.status) == (two.component, two.status)
        assert (one.covariance is None) == (two.covariance is None)
        if one.covariance is not None:
            np.testing.assert_array_equal(one.covariance, two.covariance)
    assert (a.outcomes, a.notes) == (b.outcomes, b.notes)


def count(store, table):
    with store.catalog.read() as connection:
        return connection.exec_driver_sql(f"SELECT count(*) FROM {table}").scalar()


@pytest.mark.guards("data")
def test_every_revision_is_read_as_it_was_saved(store):
    made = list(histories(store, np.random.default_rng(0)))
    for graph in made:
        store.revisions.save(graph)
    for number, graph in enumerate(made, 1):
        same(store.revisions.get(number), graph)
        line = store.revisions.entry(number)
        assert (line.num_scenes, line.num_components) == (
            len(graph.poses),
            len({pose.component for pose in graph.poses.values()}),
        )
        uses = [outcome.use for outcome in graph.outcomes.values()]
        assert (line.num_used, line.num_unused) == (uses.count("used"), uses.count("unused"))
        assert sorted(store.revisions.undecided(number).get(number, [])) == sorted(graph.undecided)
    same(store.revisions.get(), made[-1])
    assert {n: sorted(pairs) for n, pairs in store.revisions.undecided().items()} == {
        n: sorted(graph.undecided) for n, graph in enumerate(made, 1) if graph.undecided
    }


def test_a_revision_adds_what_differs(store):
    rng = np.random.default_rng(1)
    ids = [scene.id for scene in store.scenes.list()]
    poses = {scene: ScenePose(scene, some_pose(rng), 0, "placed", covariance(rng)) for scene in ids}
    outcomes = {(a, b): EdgeOutcome("used", 1.0) for a, b in pairwise(ids)}
    for k in range(30):
        poses[ids[k % 3]] = replace(poses[ids[k % 3]], S_map_scene=some_pose(rng))
        store.revisions.save(PoseGraph(dict(poses), outcomes))
    assert count(store, "poses") == NUM + 29
    assert count(store, "edges") == NUM - 1
    assert set(store.revisions.poses(ids[0])) == {ids[0]}
    assert set(store.revisions.outcomes(ids[0])) == {(ids[0], ids[1])}


def test_prune_gives_the_room_of_dropped_revisions_back(store):
    made = list(histories(store, np.random.default_rng(2), num=60))
    ids = [scene.id for scene in store.scenes.list()]
    rng = np.random.default_rng(3)
    for graph in made:
        moved = {scene: ScenePose(scene, some_pose(rng), 0, "placed", covariance(rng)) for scene in ids}
        store.revisions.save(replace(graph, poses=moved))
    last = store.revisions.get()
    lines = store.revisions.list()
    file = store.folder / "map.sqlite"
    with store.catalog.lock():
        store.catalog._fold(at_bytes=1)
    before = file.stat().st_size
    freed = store.prune(keep_revisions=3)
    assert freed.num_bytes == before - file.stat().st_size > 100_000
    assert count(store, "poses") <= 3 * NUM
    same(store.revisions.get(), last)
    for number in (58, 59, 60):
        assert store.revisions.get(number).poses
    with raises(NotFoundError, code="revision_dropped"):
        store.revisions.get(57)
    for old, now in zip(lines, store.revisions.list(), strict=True):
        assert replace(now, dropped_at=None) == old
        assert (now.dropped_at is None) == (now.number > 57)
    assert store.check().ok
    assert store.revisions.save(made[0]) == 61
    same(store.revisions.get(61), made[0])


def test_the_newest_poses_are_never_pruned(store):
    (graph,) = histories(store, np.random.default_rng(4), num=1)
    store.revisions.save(graph)
    store.prune(keep_revisions=0)
    same(store.revisions.get(), graph)
    same(store.revisions.get(1), graph)


def test_what_stands_of_every_pair_is_what_a_person_said_or_the_newest(store):
    """The lists of all pairs say of each what the pair itself says, whatever was computed and said in which order."""
    rng = np.random.default_rng(5)
    ids = [scene.id for scene in store.scenes.list()][:6]
    for k in range(150):
        a, b = sorted(rng.choice(ids, 2, replace=False).tolist())
        kind = rng.integers(6)
        if kind < 3:
            posed = {"S_target_source": some_pose(rng), "information": np.diag(rng.uniform(1, 2, 7))}
            status = ("accepted", "rejected", "no_match")[kind]
            store.registrations.save(
                Registration(a, b, status, **({} if kind == 2 else posed)), key("register", a, b, turn=k)
            )
        elif kind == 3:
            store.registrations.save(Registration(a, b, "accepted", "", some_pose(rng), np.eye(7), proposer="manual"))
        else:
            stored = store.registrations.get(a, b)
            if stored is not None and stored.registration.S_target_source is not None:
                store.registrations.review(a, b, str(rng.choice(["confirm", "reject"])))
            elif stored is not None and (stored.review or stored.manual):
                store.registrations.review(a, b, "withdraw")
    store.scenes.remove("s05")
    alone = {}
    for a in ids[:5]:
        for b in ids[:5]:
            if a < b and (stored := store.registrations.get(a, b)) is not None:
                alone[a, b] = stored
    listed = {(one.registration.target, one.registration.source): one for one in store.registrations.current()}
    assert {pair: (one.number, one.review) for pair, one in listed.items()} == {
        pair: (one.number, one.review) for pair, one in alone.items()
    }
    assert any(one.review for one in alone.values())
    firsts = [store.registrations.history(*pair)[0].number for pair in listed]
    assert firsts == sorted(firsts)
    standing = store.registrations.summaries()
    assert [(one.target, one.source) for one in standing] == sorted(alone)
    for one in standing:
        stored = alone[one.target, one.source]
        assert (one.number, one.review, one.key, one.manual) == (
            stored.number,
            stored.review,
            stored.key,
            stored.manual,
        )
        assert one.usable == stored.is_usable
    assert store.registrations.summaries(usable=True) == [one for one in standing if one.usable]
    fresh = {name: store.registrations.summaries(usable=name) for name in (False, True)}
    living = {":".join(sorted(ends)) for ends in alone}
    tried = {one.pair: one for one in store.registrations.all_summaries() if one.pair in living}
    assert set(tried) == living
    for pair, stored in alone.items():
        one = tried[":".join(pair)]
        assert (one.key, one.usable) == (stored.key, stored.is_usable)
        assert one.is_specified == (stored.manual or stored.review == "confirm")
        disagreement = stored.registration.evidence.get("disagreement", float("nan"))
        accepted = stored.registration.status == "accepted"
        assert np.array_equal(one.disagreement, disagreement if accepted else float("nan"), equal_nan=True)
        assert one.keys == {stored.key for stored in store.registrations.history(*pair)} - {""}
    for usable_only, told in fresh.items():  # the same of what is remembered now
        assert [one[:7] for one in store.registrations.summaries(usable=usable_only)] == [one[:7] for one in told]
    usable = store.registrations.current_usable()
    assert [one.number for one in usable] == [one.number for one in standing if one.usable]
    some = ids[1:4]
    among = [one.number for one in store.registrations.current_usable(some)]
    assert among == [one.number for one in standing if one.usable and {one.target, one.source} <= set(some)]
    assert 0 < len(among) < len(usable)
    half = store.registrations.newest_number() // 2
    assert store.registrations.pairs_registered_after(half) == {
        (a, b)
        for a, b in combinations(sorted(ids), 2)
        if any(r.number > half for r in store.registrations.history(a, b))
    }
    of_one = {one.number for one in store.registrations.current_of_scene(ids[1])}
    assert of_one == {one.number for pair, one in alone.items() if ids[1] in pair}
    pairs = sorted(alone)[:4]
    assert {one.number for one in store.registrations.current_of_pairs([p[::-1] for p in pairs])} == {
        alone[pair].number for pair in pairs
    }


def test_numbers_come_back_to_the_last_bit():
    rng = np.random.default_rng(6)
    S, matrix = some_pose(rng), covariance(rng)
    back = matrices.pose_of_bytes(matrices.pose_bytes(S))
    np.testing.assert_array_equal(back.rotation, S.rotation)
    np.testing.assert_array_equal(back.translation, S.translation)
    assert back.scale == S.scale
    assert back.is_rigid == S.is_rigid
    np.testing.assert_array_equal(matrices.matrix_of_bytes(matrices.matrix_bytes(matrix)), matrix)
    np.testing.assert_array_equal(matrices.covariance_of_bytes(matrices.covariance_bytes(matrix)), matrix)


def test_registrations_are_kept_together_as_one_by_one(store):
    rng = np.random.default_rng(7)
    ids = sorted(scene.id for scene in store.scenes.list())[:4]
    made = []
    for k, (a, b) in enumerate(combinations(ids, 2)):
        pose = {} if k % 2 else {"S_target_source": some_pose(rng), "information": covariance(rng)}
        status = "no_match" if k % 2 else "accepted"
        evidence = {"disagreement": 0.1 * k}
        made.append((Registration(a, b, status, evidence=evidence, **pose), key("register", a, b, turn=k % 3)))
    one_by_one = [store.registrations.save(*one) for one in made]
    newest = store.registrations.newest_number()
    store.registrations.save_all(made)
    assert store.registrations.newest_number() == newest + len(made)
    found = store.registrations.newest_with_keys([name for _, name in made])
    for saved, (registration, _), read in zip(one_by_one, made, found, strict=True):
        last = store.registrations.history(registration.target, registration.source)[-1]
        assert (last.key, last.recipe, last.number > newest) == (saved.key, saved.recipe, True)
        assert read.evidence == last.registration.evidence == saved.registration.evidence
        if registration.information is not None:
            np.testing.assert_array_equal(last.registration.information, registration.information)
            assert matrices.pose_bytes(read.S_target_source) == matrices.pose_bytes(registration.S_target_source)
    assert [one.source for one in store.registrations.newest_with_keys(["0" * 32, made[1][1], made[0][1]])] == [
        ids[2],
        ids[1],
    ]
    for wrong in ((made[0][0], None), (Registration(ids[0], "0" * 32, "no_match"), made[0][1])):
        with pytest.raises(InputError):
            store.registrations.save_all([made[1], wrong])
    assert store.registrations.newest_number() == newest + len(made)
    store.registrations.save_all([])


@pytest.mark.guards("data")
def test_a_revision_made_from_the_newest_writes_the_rows_of_one_that_is_compared(tmp_path, store):
    """What is the very same object in both answers need not be looked at; unless another was saved meanwhile."""
    rows = []
    for trusting in (False, True):
        with Store.create(tmp_path / f"{trusting}.gsmap") as other:
            for k in range(NUM):
                other.scenes.add(make_gaussians(n=8, seed=k), make_cameras(1), name=f"s{k:02d}")
            last = None
            for graph in histories(other, np.random.default_rng(8)):
                number = other.revisions.save(graph, after=(last if trusting else None))
                same(other.revisions.get(), graph)
                scenes, pairs = other.revisions.changed_after(number - 1)
                before = PoseGraph({}) if last is None else last[1]
                assert scenes == {s for s, pose in graph.poses.items() if before.poses.get(s) is not pose}
                assert pairs >= {p for p, out in graph.outcomes.items() if p not in before.outcomes}
                last = (number, graph)
            with other.catalog.read() as connection:
                counted = [connection.execute(select(t).order_by(*t.c[:3])).all() for t in (poses, edges)]
                listed = [vars(one) | {"created_at": ""} for one in other.revisions.list()]
            rows.append(([list(map(str, of_one)) for of_one in counted], listed))
            stale = last
            moved = PoseGraph({s: ScenePose(s, Sim3.identity(), 0, "placed") for s in last[1].poses})
            other.revisions.save(moved)
            other.revisions.save(stale[1], after=stale)
            same(other.revisions.get(), stale[1])
    assert rows[0] == rows[1]


def test_brief_scenes_are_what_lists_have(store):
    store.scenes.edit("s02", captured_at="2026-05-31T14:00:00+02:00")
    store.scenes.remove("s03")
    names = ("id", "name", "scale_policy", "captured_at", "thinning")
    assert [[getattr(one, name) for name in names] for one in store.scenes.summaries()] == [
        [getattr(one, name) for name in names] for one in store.scenes.list()
    ]
    assert {scene.id: scene.bounds.tolist() for scene in store.scenes.list()} == {
        scene: box.tolist() for scene, box in store.scenes.bounds().items()
    }
    some = [scene.id for scene in store.scenes.list()[2:4]]
    assert [scene.id for scene in store.scenes.list(among=some)] == some


def test_graphs_are_listed_from_memory_until_they_are_replaced(store):
    for scene in store.scenes.list():
        up = None if scene.name == "s01" else np.array([0.0, 0.6, 0.8])
        store.graphs.save(SceneGraph(scene.id, {}, up, 0.5), key("describe", scene.id))
    first = store.graphs.list()
    assert {(g.unit_m, g.up) for g in first} == {(0.5, None), (0.5, (0.0, 0.6, 0.8))}
    graph = SceneGraph(first[0].scene, {}, np.array([1.0, 0, 0]), 2.0)
    store.graphs.save(graph, key("describe", graph.scene_id))
    assert {g.scene for g in store.graphs.list() if g.unit_m == 2.0} == {graph.scene_id}
    with store.catalog.write() as connection:
        connection.execute(results.update().where(results.c.scene == first[1].scene).values(about={"up": [1, "x", 0]}))
    with Store.open(store.folder, "r") as other, raises(CorruptError, code="catalog_invalid", match=r"results\.about"):
        other.graphs.list()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('{"log_nfa":-3.5,"disagreement":0.01051047480010089,"seen_m2":1e2}', 0.01051047480010089),
        ('{"disagreement":-2e-3}', -2e-3),
        ('{"disagreement":Infinity,"x":1}', np.inf),
        ('{"x":1,"disagreement":NaN}', np.nan),
        ('{"x":{"disagreement":1.0},"y":2}', np.nan),  # of something else
        ('{"x":{"disagreement":1.0,"z":3},"y":2}', np.nan),
        ('{"x":{"y":2},"disagreement":1.0}', 1.0),
        ('{"disagreement":1.0,"disagreement":2.0}', 2.0),
        ('{ "disagreement" : 0.5 }', 0.5),
        ('{"x":"\\"disagreement\\":3.0","disagreement":4.0}', 4.0),
        ('{"x":"\\"disagreement\\":3.0"}', np.nan),
        ('{"x":"{","disagreement":6.0}', 6.0),
        ("{}", np.nan),
    ],
)
def test_what_disagrees_is_read_as_json_says_it(text, said):
    assert np.array_equal(json.loads(text).get("disagreement", np.nan), said, equal_nan=True)
    assert np.array_equal(_figure(text, "disagreement"), said, equal_nan=True)


def test_of_pairs_and_graphs_what_is_new_is_read(store, monkeypatch):
    """And of that what is asked for: evidence is not parsed."""
    ids, read, parsed = sorted(scene.id for scene in store.scenes.list()), [], []
    for k, pair in enumerate(combinations(ids, 2)):
        evidence = {f"figure_{i}": i * 0.1 for i in range(12)} | {"disagreement": k * 0.01}
        edge = Registration(
            *pair, "accepted", S_target_source=Sim3.identity(), evidence=evidence, information=np.eye(7)
        )
        store.registrations.save(edge, key("register", *pair))
    for scene in ids:
        notes = ("a remark that is longer than all else that a graph says of its frame, and as JSON quite long",)
        store.graphs.save(SceneGraph(scene, {}, np.array([0.0, 0.6, 0.8]), 0.5, notes=notes), key("describe", scene))
    add, loads = module._add_summaries, json.loads
    monkeypatch.setattr(module, "_add_summaries", lambda known, rows: read.append(len(rows)) or add(known, rows))
    monkeypatch.setattr(json, "loads", lambda text: parsed.append(len(text)) or loads(text))
    store.registrations.all_summaries()
    assert read == [len(ids) * (len(ids) - 1) // 2]
    assert max(parsed, default=0) < 60
    said = store.graphs.list()
    assert {(one.unit_m, one.up) for one in said} == {(0.5, (0.0, 0.6, 0.8))}
    store.registrations.save(Registration(*ids[:2], "no_match"), key("register", *ids[:2], turn=1))
    parsed.clear()
    for _ in range(2):
        store.registrations.summaries()
        store.graphs.list()
    assert (read[1:], parsed) == ([1, 0], [])


def test_what_is_remembered_of_pairs_is_what_is_read_anew(store):
    """Whatever is registered, said and taken away between two times that it is asked for."""
    rng = np.random.default_rng(6)
    ids = sorted(scene.id for scene in store.scenes.list())[:4]
    for k in range(80):
        a, b = sorted(rng.choice(ids, 2, replace=False).tolist())
        kind = rng.integers(4)
        stored = store.registrations.get(a, b)
        if kind < 2 or stored is None:
            posed = {"S_target_source": some_pose(rng), "information": np.eye(7), "evidence": {"disagreement": k / 80}}
            store.registrations.save(Registration(a, b, "accepted", **posed), key("register", a, b, turn=k))
        elif kind == 2:
            store.registrations.review(a, b, "confirm" if stored.review is None else "withdraw")
        else:  # a purge takes the newest, and the next one its number
            newest, said = store.registrations.newest_number(), select(reviews.c.registration)
            with store.catalog.write() as connection:
                mine = (registrations.c.number == newest) & registrations.c.number.not_in(said)
                connection.execute(delete(registrations).where(mine))
            if k % 2:
                posed = {"S_target_source": some_pose(rng), "information": np.eye(7)}
                store.registrations.save(Registration(a, b, "accepted", **posed), key("register", a, b, turn=k))
        anew = Registrations(store.catalog)
        assert sorted(map(str, store.registrations.all_summaries())) == sorted(map(str, anew.all_summaries()))
        assert dict(store.registrations.current_keys()) == {
            one.pair: "" if one.is_specified else one.key for one in store.registrations.all_summaries()
        }


def test_a_revision_is_found_by_an_integer_of_numpy(store):
    """As a table of revisions in pandas has."""
    scene = store.scenes.list()[0].id
    number = np.int64(store.revisions.save(PoseGraph({scene: ScenePose(scene, Sim3.identity(), 0, "placed")})))
    assert set(store.revisions.get(number).poses) == {scene}
    assert store.revisions.entry(number).number == number
