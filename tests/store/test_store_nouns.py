import shutil
from dataclasses import fields, replace

import numpy as np
import pytest
from raising import raises
from scipy.spatial.transform import Rotation
from store_samples import key, make_cameras, make_gaussians

from gsmap.errors import ConfigError, CorruptError, InputError, NotFoundError, StoreError
from gsmap.store import MANUAL, Store
from gsmap.types import (
    EdgeOutcome,
    NodeLayer,
    PoseGraph,
    Prior,
    Provenance,
    Registration,
    SceneGraph,
    ScenePose,
    Sim3,
    Tile,
)
from gsmap.types.rows.maps import PruneReport


def pose(seed: int = 0, scale: float = 1.0) -> Sim3:
    return Sim3(Rotation.random(random_state=seed).as_matrix(), np.random.default_rng(seed).normal(size=3), scale)


def assert_pose(a: Sim3, b: Sim3) -> None:
    assert (a.rotation == b.rotation).all()
    assert (a.translation == b.translation).all()
    assert a.scale == b.scale


def layer(m: int = 7, descriptor_id: str = "m1") -> NodeLayer:
    r = np.random.default_rng(m)
    return NodeLayer(
        r.normal(size=(m, 3)),
        r.normal(size=(m, 16)),
        r.integers(0, 9, m),
        r.uniform(size=m),
        r.normal(size=(m, 2, 3)),
        r.normal(size=(m, 8)),
        r.integers(0, 9, m),
        descriptor_id,
        0.1 + 0.2,
    )


def registration(target: str, source: str, **more: object) -> Registration:
    fields = {
        "status": "accepted",
        "S_target_source": pose(1, 1.25),
        "information": np.diag(np.arange(1.0, 8)) / 3,
        "num_inliers": 12,
        "num_correspondences": 99,
        "overlap": 0.1 + 0.2,
        "proposer": "landmarks",
        "exact": False,
        "seconds": {"match": 0.5, "refine": 0.25, "verdict": 1e-3},
        "evidence": {"logNFA": np.float32(-7.5), "runner_up": 0.3},
        "notes": ("no package",),
    }
    return Registration(target, source, **(fields | more))


# -- scene graphs


def test_graph_round_trip(store, two_scenes):
    up = np.array([0, 0.6, 0.8])
    graph = SceneGraph(
        two_scenes[0].id, {"objects": layer(5), "landmarks:0/x": layer(0, "m2")}, up, 0.4, ("few nodes",)
    )
    made = key("describe", graph.scene_id, "auto", voxel_m=0.1 + 0.2)
    store.graphs.save(graph, made)
    kept = store.graphs.find(made)
    assert (kept.key, kept.recipe) == (made.digest, made.recipe)
    assert store.recipes.get(kept.recipe).to_json() == made.to_json()
    assert kept.layers == {"objects": 5, "landmarks:0/x": 0}
    back = store.graphs.load("scene0", made)
    assert (back.scene_id, back.unit_m, back.notes) == (two_scenes[0].id, 0.4, ("few nodes",))
    np.testing.assert_array_equal(back.up, up)
    assert list(back.layers) == ["objects", "landmarks:0/x"]
    for name, nodes in graph.layers.items():
        for part in fields(nodes):
            a, b = getattr(nodes, part.name), getattr(back.layers[name], part.name)
            assert type(a) is type(b)
            assert getattr(a, "dtype", None) == getattr(b, "dtype", None)
            np.testing.assert_array_equal(a, b, part.name)


@pytest.mark.guards("data")
def test_a_damaged_graph_is_mended_by_saving_it_again(store, two_scenes):
    scene, made = two_scenes[0].id, key("describe", two_scenes[0].id)
    graph = SceneGraph(scene, {"objects": layer()})
    store.graphs.save(graph, made)
    kept = store.graphs.find(made)
    assert store.graphs.damaged([made, key("describe", "other")]) == set()
    (place,) = (store.folder / "arrays" / "graphs").iterdir()
    broken = next(place.rglob("*.zip"))
    content = broken.read_bytes()
    for spoil in (broken.unlink, lambda: broken.write_bytes(b"x" * len(content)), lambda: shutil.rmtree(place)):
        spoil()
        assert store.graphs.damaged([made]) == {made.digest}
        with raises(CorruptError, code=("arrays_missing", "arrays_corrupt")) as caught:
            store.graphs.load(scene, made)
        assert "ingest" not in str(caught.value)
        (problem, *_) = store.check().problems
        assert f"scene scene0: compute it again with gsmap describe {store.location} scene0" in problem
        store.graphs.save(graph, made)
        assert store.graphs.find(made) == kept
        assert (store.check().problems, store.graphs.damaged([made])) == ((), set())
        assert broken.read_bytes() == content
        assert store.graphs.load(scene, made).num_nodes == 7


def test_a_damaged_graph_that_another_replaces_is_no_problem_any_more(store, two_scenes):
    scene, made = two_scenes[0].id, key("describe", two_scenes[0].id)

    def spoil():
        for path in store.folder.glob("arrays/graphs/*/arrays.zip"):
            path.write_bytes(b"")
        return store.check().problems

    for replaced in (lambda: store.graphs.save(SceneGraph(scene), made), lambda: store.graphs.forget([made])):
        store.graphs.save(SceneGraph(scene, {"objects": layer()}), made)
        store.prune()
        assert len(spoil()) == 1
        replaced()
        assert store.check().ok
        assert store.prune().num_orphans == 1
    assert store.graphs.find(made) is None
    for m in (3, 4):
        store.graphs.save(SceneGraph(scene, {"objects": layer(m)}), made)
    found = spoil()  # one that was replaced before it was damaged
    assert len(found) == 2
    assert sum(f"an unused graph: remove it with gsmap prune {store.location})" in problem for problem in found) == 1


def test_a_damaged_graph_of_a_tag_or_of_a_removed_scene(store, two_scenes):
    scene = two_scenes[0].id
    store.graphs.save(SceneGraph(scene, {"objects": layer()}), key("describe", scene))
    store.branches.make("v1", tag=True)
    store.scenes.remove("scene0")
    for path in store.folder.glob("arrays/graphs/*/arrays.zip"):
        path.unlink()
    of_map, of_tag = store.check().problems
    assert f"gsmap restore-scene {store.location} {scene[:12]}, then gsmap describe {store.location} scene0" in of_map
    assert of_tag.startswith("v1: ")
    assert "scene scene0: restore the file from a backup" in of_tag


def test_graphs_by_key(store, two_scenes):
    scene = two_scenes[0].id
    a, b = key("describe", scene, "auto"), key("describe", scene, "known")
    assert store.graphs.find(a) is None
    assert store.graphs.load("scene0") is None
    store.graphs.save(SceneGraph(scene, {"objects": layer(3)}), a)
    first = store.graphs.find(a)
    store.graphs.save(SceneGraph(scene, {"objects": layer(4)}), b)
    store.graphs.save(SceneGraph(scene, {"objects": layer(3)}), a)
    assert store.graphs.find(a) == first  # nothing happened
    assert store.graphs.find(a).num_nodes == store.graphs.find(a.digest).num_nodes == 3
    assert store.graphs.load("scene0").num_nodes == 4  # the newest
    assert store.graphs.load("scene1", a) is None
    assert [g.key for g in store.graphs.list()] == [a.digest, b.digest]
    assert [r.recipe for r in store.recipes.list()] == [a.recipe]  # once for both
    store.graphs.save(SceneGraph(scene, {"objects": layer(9)}), a)
    assert store.graphs.load("scene0", a.digest).num_nodes == 9
    assert len(store.graphs.list()) == 2
    store.prune()  # the replaced graph's bytes go
    assert store.check().ok
    assert store.graphs.load("scene0", a).num_nodes == 9
    with pytest.raises(NotFoundError):
        store.graphs.save(SceneGraph("unknown", {}), key("describe", "unknown"))
    with raises(InputError, code="key_input_mismatch"):
        store.graphs.save(SceneGraph(scene, {}), key("describe"))


def test_empty_graph(store, two_scenes):
    made = key("describe", two_scenes[0].id)
    store.graphs.save(SceneGraph(two_scenes[0].id), made)
    assert store.graphs.load("scene0", made).layers == {}


def test_unknown_recipe(store):
    with raises(NotFoundError, code="recipe_not_found"):
        store.recipes.get("nothing")


# -- registrations


def test_registration_round_trip(store, two_scenes):
    a, b = (s.id for s in two_scenes)
    r, made = registration(a, b), key("register", "graph a", "graph b", max_log_nfa=-8.0)
    store.registrations.save(r, made)
    back = store.registrations.get("scene1", "scene0")
    assert (back.key, back.recipe, back.adopts) == (made.digest, made.recipe, None)
    assert store.recipes.get(back.recipe).settings == {"max_log_nfa": -8.0}
    assert back.review is None
    got = back.registration
    assert_pose(got.S_target_source, r.S_target_source)
    np.testing.assert_array_equal(got.information, r.information)
    names = ("target", "source", "status", "reason", "num_inliers", "num_correspondences", "overlap", "proposer")
    for name in (*names, "notes"):
        assert getattr(got, name) == getattr(r, name)
    assert got.exact is False
    assert got.seconds == r.seconds
    assert got.evidence == {"logNFA": -7.5, "runner_up": 0.3}
    none = registration(a, b, status="no_match", S_target_source=None, information=None, reason="not enough nodes")
    assert store.registrations.save(none, made).registration.S_target_source is None


def test_history_and_current(store, two_scenes):
    a, b = (s.id for s in two_scenes)
    k1, k2 = key("register", "1"), key("register", "2")
    assert store.registrations.get(a, b) is None
    assert store.registrations.newest_with_key(k1) is None
    assert store.registrations.newest_with_key("") is None
    store.registrations.save(registration(a, b, num_inliers=1), k1)
    store.registrations.save(registration(b, a, num_inliers=2), k2)  # the other direction is the same pair
    assert [r.registration.num_inliers for r in store.registrations.history(a, b)] == [1, 2]
    assert [r.registration.num_inliers for r in store.registrations.current()] == [2]
    assert store.registrations.get(a, b).registration.target == b
    assert store.registrations.newest_with_key(k1).registration.num_inliers == 1
    assert store.registrations.newest_with_key(k1.digest).number == 1
    store.scenes.remove("scene0")
    assert store.registrations.current() == []
    with raises(InputError, code="same_scene"):
        store.registrations.get(b, b)
    with raises(InputError, code="invalid_registration"):
        store.registrations.save(registration(a, b))


def test_going_back_to_older_settings_makes_the_older_result_current(store, two_scenes):
    a, b = (s.id for s in two_scenes)
    k1, k2 = key("register", gate=1), key("register", gate=2)
    first = store.registrations.save(registration(a, b, num_inliers=1), k1)
    store.registrations.save(registration(b, a, num_inliers=2), k2)
    adopted = store.registrations.adopt(store.registrations.newest_with_key(k1).number)
    assert (adopted.adopts, adopted.key, adopted.recipe) == (first.number, k1.digest, k1.recipe)
    assert_pose(adopted.registration.S_target_source, first.registration.S_target_source)
    assert adopted.registration.evidence == first.registration.evidence
    assert store.registrations.get(a, b).number == adopted.number
    assert [r.number for r in store.registrations.current()] == [adopted.number]
    for number in (first.number, adopted.number):  # it is the newest already
        assert store.registrations.adopt(number).number == adopted.number
    again = store.registrations.adopt(store.registrations.newest_with_key(k2).number)
    third = store.registrations.adopt(store.registrations.newest_with_key(k1).number)  # which is an adopted row itself
    assert (again.adopts, third.adopts) == (2, first.number)
    assert [r.number for r in store.registrations.history(a, b)] == [1, 2, 3, 4, 5]
    with raises(NotFoundError, code="registration_not_found"):
        store.registrations.adopt(99)


def test_a_confirmed_pose_outlives_what_is_adopted(store, two_scenes):
    a, b = (s.id for s in two_scenes)
    old = store.registrations.save(registration(a, b), key("register", gate=1))
    kept = store.registrations.save(registration(a, b), key("register", gate=2))
    store.registrations.review(a, b, "confirm")
    assert store.registrations.adopt(old.number).number > kept.number
    assert store.registrations.get(a, b).number == kept.number


def test_reviews(store, two_scenes):
    a, b = (s.id for s in two_scenes)
    with raises(NotFoundError, code="registration_not_found"):
        store.registrations.review("scene0", "scene1", "confirm")
    first = store.registrations.save(registration(a, b, num_inliers=1), key("register", "1"))
    with raises(InputError, code="nothing_to_withdraw"):
        store.registrations.review(a, b, "withdraw")
    assert store.registrations.review("scene0", "scene1", "confirm", "looked at it").review == "confirm"
    store.registrations.save(registration(a, b, num_inliers=2), key("register", "2"))
    for found in (store.registrations.get(a, b), *store.registrations.current()):
        assert (found.number, found.review) == (first.number, "confirm")  # a person's pose stays
    assert store.registrations.review("scene1", "scene0", "reject").review == "reject"
    assert store.registrations.current()[0].registration.num_inliers == 2
    assert store.registrations.review("scene0", "scene1", "withdraw").review is None
    assert [r.review for r in store.registrations.reviews(a, b)] == ["confirm", "reject", "withdraw"]
    assert store.registrations.reviews(a, b)[0].note == "looked at it"
    with raises(ConfigError, code="invalid_choice", match="review .*'maybe'"):
        store.registrations.review(a, b, "maybe")
    none = registration(a, b, status="no_match", S_target_source=None, reason="look alike")
    store.registrations.save(none, key("register", "3"))
    with raises(InputError, code="no_pose_of_pair"):
        store.registrations.review(a, b, "confirm")
    vague = registration(a, b, status="rejected", information=None, reason="colours disagree")
    store.registrations.save(vague, key("register", "4"))
    with raises(InputError, code="no_uncertainty_of_pair"):
        store.registrations.review(a, b, "confirm")
    assert store.registrations.get(a, b).review is None


def measured(a: str, b: str, **more: object) -> Registration:
    return registration(a, b, proposer=MANUAL, notes=("tape measure",), **more)


def current(store, a: str, b: str) -> tuple[int, str | None] | None:
    """Number and review of a pair's current registration, which both ways of asking agree on."""
    found = store.registrations.get(a, b)
    assert [r.number for r in store.registrations.current()] == ([] if found is None else [found.number])
    return None if found is None else (found.number, found.review)


@pytest.mark.guards("data")
def test_a_measurement_stands_until_it_is_withdrawn(store, two_scenes):
    a, b = (s.id for s in two_scenes)
    save, review = store.registrations.save, store.registrations.review
    computed = save(registration(a, b), key("register", "1")).number
    mine = save(measured(b, a))
    assert (mine.manual, mine.key, mine.recipe) == (True, "", None)
    assert mine.registration.notes == ("tape measure",)
    later = save(registration(a, b), key("register", "2")).number
    assert current(store, a, b) == (mine.number, None)
    review(a, b, "reject")
    assert current(store, a, b) == (mine.number, "reject")
    review(a, b, "withdraw")  # of the rejection
    assert current(store, a, b) == (mine.number, None)
    review(a, b, "withdraw")  # of the measurement
    assert current(store, a, b) == (later, None)
    with raises(InputError, code="nothing_to_withdraw"):
        review(a, b, "withdraw")
    review(a, b, "confirm")
    assert current(store, a, b) == (later, "confirm")
    assert store.registrations.adopt(computed).adopts == computed  # the measurement does not count as newest
    with raises(InputError, code="registration_measured"):
        store.registrations.adopt(mine.number)


def test_the_newest_word_of_a_person_counts(store, two_scenes):
    a, b = (s.id for s in two_scenes)
    save, review = store.registrations.save, store.registrations.review
    computed = save(registration(a, b), key("register")).number
    for word in ("confirm", "reject"):
        review(a, b, word)
        first, second = save(measured(a, b)).number, save(measured(a, b)).number
        assert current(store, a, b) == (second, None)  # measured after the word was given
        review(a, b, "withdraw")
        assert current(store, a, b) == (first, None)
        review(a, b, "withdraw")
        assert current(store, a, b) == (computed, word)


@pytest.mark.guards("data")
def test_a_measurement_alone(store, two_scenes):
    a, b = (s.id for s in two_scenes)
    mine = store.registrations.save(measured(a, b)).number
    assert store.registrations.review(a, b, "confirm").review == "confirm"
    store.registrations.review(a, b, "withdraw")
    assert current(store, a, b) == (mine, None)
    assert store.registrations.review(a, b, "withdraw") is None
    assert current(store, a, b) is None
    assert [r.number for r in store.registrations.history(a, b)] == [mine]
    with raises(InputError, code="invalid_registration"):
        store.registrations.save(measured(a, b, status="rejected"))
    with raises(InputError, code="invalid_registration"):
        store.registrations.save(measured(a, b), key("register"))


# -- revisions and priors


def graph_of(scenes, shift: float = 0.0) -> PoseGraph:
    a, b = (s.id for s in scenes)
    covariance = np.diag(np.arange(1.0, 8)) / 7
    placed = {
        a: ScenePose(a, Sim3(np.eye(3), [shift, 0, 0]), 0, "placed", covariance),
        b: ScenePose(b, None, 1, "isolated"),
    }
    outcomes = {(a, b): EdgeOutcome("tentative", np.float64(2.5), "no cycle", undecided=True)}
    settings = {"chi2": 12.02, "seed": np.int64(3), "robust": "gnc"}
    return PoseGraph(placed, outcomes, settings, Provenance("incremental", "ef01", 7, "abcd", (b,)), ("no marginals",))


def test_revisions(store, two_scenes):
    assert store.revisions.newest_number() is None
    assert store.revisions.get() is None
    made = key("optimize", "all edges", gate=0.999)
    assert store.revisions.save(graph_of(two_scenes)) == 1
    assert store.revisions.save(graph_of(two_scenes, 0.5), made, note="new scene") == 2
    assert store.revisions.newest().key == made.digest
    a, b = (s.id for s in two_scenes)
    for number, shift in ((1, 0.0), (2, 0.5), (None, 0.5)):
        got = store.revisions.get(number)
        assert got.poses[a].S_map_scene.translation[0] == shift
        np.testing.assert_array_equal(got.poses[a].covariance, np.diag(np.arange(1.0, 8)) / 7)
        assert got.poses[b].S_map_scene is None
        assert (got.poses[b].status, got.poses[b].component) == ("isolated", 1)
        assert got.outcomes == {(a, b): EdgeOutcome("tentative", 2.5, "no cycle", undecided=True)}
        assert got.undecided == ((a, b),)
        assert got.settings == {"chi2": 12.02, "seed": 3, "robust": "gnc"}
        assert got.provenance == Provenance("incremental", "ef01", 7, "abcd", (b,))
        assert got.notes == ("no marginals",)
    first, second = store.revisions.list()
    assert (first.number, first.num_scenes, first.num_placed, first.num_components) == (1, 2, 1, 2)
    assert (first.num_used, first.num_tentative, first.num_unused, first.num_undecided) == (0, 1, 0, 1)
    assert (first.key, first.recipe) == ("", None)
    assert (second.note, second.key, second.recipe) == ("new scene", made.digest, made.recipe)
    with raises(NotFoundError, code="revision_not_found"):
        store.revisions.get(3)


def test_outcomes_come_back(store, two_scenes):
    a, b = (s.id for s in two_scenes)
    every = [EdgeOutcome("used", 0.1 + 0.2), EdgeOutcome("unused", None, "contradicts"), EdgeOutcome("tentative")]
    for outcome in every:
        store.revisions.save(PoseGraph({}, {(a, b): outcome, (b, a): every[0]}))
        assert store.revisions.get().outcomes == {(a, b): outcome, (b, a): every[0]}
    counts = [(r.num_used, r.num_tentative, r.num_unused) for r in store.revisions.list()]
    assert counts == [(2, 0, 0), (1, 0, 1), (1, 1, 0)]


def test_a_revision_of_unknown_scenes_leaves_nothing(store):
    with pytest.raises(StoreError):
        store.revisions.save(PoseGraph({"0" * 32: ScenePose("x", None, 0, "isolated")}))
    assert store.revisions.list() == []


def test_priors(store, two_scenes):
    sigmas = np.array([0.1, 0.1, np.inf, 1, 1, 1, np.inf])
    store.priors.set(Prior("scene0", pose(3), sigmas))
    store.priors.set(Prior("scene0", pose(4), sigmas, np.array([0, 0.6, 0.8]), 0.03))
    (got,) = store.priors.list()
    assert got.up.tolist() == [0, 0.6, 0.8]
    assert got.up_sigma_rad == 0.03
    assert got.scene == two_scenes[0].id
    assert_pose(got.S_map_scene, pose(4))
    np.testing.assert_array_equal(got.sigmas, sigmas)
    store.priors.remove("scene0")
    assert store.priors.list() == []
    with raises(NotFoundError, code="prior_not_found"):
        store.priors.remove("scene0")
    for bad in (np.zeros(7), np.ones(6), np.full(7, np.nan)):
        with raises(InputError, code="invalid_sigma"):
            store.priors.set(Prior("scene0", pose(), bad))


# -- models


def test_models(store, tmp_path):
    file = tmp_path / "net.onnx"
    file.write_bytes(b"first")
    kept = store.models.add("clip", file, kind="clip", options={"size_px": np.int64(224), "mean": (0.5, 0.5)})
    assert kept.path.read_bytes() == b"first"
    assert kept.path.is_relative_to(store.folder)
    assert store.models.get("clip").options == {"size_px": 224, "mean": [0.5, 0.5]}
    file.write_bytes(b"second")
    store.models.add("clip", file, kind="clip")
    linked = store.models.add("sam", file, kind="sam_encoder", copy=False)
    assert linked.path == file
    assert store.models.get("clip").path.read_bytes() == b"second"
    assert len(list((store.folder / "models").iterdir())) == 2
    assert store.check().ok
    store.prune()
    assert len(list((store.folder / "models").iterdir())) == 1
    file.write_bytes(b"third!")
    assert "model sam differs" in store.check().problems[0]
    store.models.remove("sam")
    assert store.check().ok
    with raises(NotFoundError, code="model_not_found"):
        store.models.get("sam")
    with raises(NotFoundError, code="file_not_found"):
        store.models.add("x", tmp_path / "none", kind="clip")


# -- exports


def tile(path: str, scenes, shift: float = 0.0) -> Tile:
    poses = {s.id: Sim3(np.eye(3), [shift, 0, 0]) for s in scenes}
    recipe = key("merge", steps=300).to_json()
    return Tile("key", 0, np.array([[0, 0, 0], [1, 2, 3.0]]), poses, 42, recipe, True, path, "ab" * 32, ("a seam",))


def test_exports_keep_the_newest_tile_of_a_path(store, two_scenes, tmp_path):
    revision = store.revisions.save(graph_of(two_scenes))
    first = store.exports.begin(tmp_path / "out", revision=revision, settings={"tile_size_m": 10})
    store.exports.add_tile(first, tile("0/a.ply", two_scenes))
    store.exports.add_tile(first, tile("0/b.ply", two_scenes))
    second = store.exports.begin(tmp_path / "out" / ".." / "out", revision=None)
    store.exports.add_tile(second, tile("0/b.ply", two_scenes, 0.25))
    other = store.exports.begin(tmp_path / "other", revision=None)
    store.exports.add_tile(other, tile("0/a.ply", two_scenes, 9.0))
    a, b = store.exports.tiles(tmp_path / "out")
    assert (a.path, b.path) == ("0/a.ply", "0/b.ply")
    assert b.poses[two_scenes[0].id].translation[0] == 0.25
    np.testing.assert_array_equal(a.bounds, [[0, 0, 0], [1, 2, 3]])
    assert (a.key, a.num_gaussians, a.truncated, a.sha256, a.notes) == ("key", 42, True, "ab" * 32, ("a seam",))
    assert a.recipe == key("merge", steps=300).to_json()
    assert len(store.recipes.list()) == 1
    store.exports.forget(tmp_path / "out", ["0/a.ply"])
    assert [t.path for t in store.exports.tiles(tmp_path / "out")] == ["0/b.ply"]
    assert [t.path for t in store.exports.tiles(tmp_path / "other")] == ["0/a.ply"]
    assert store.exports.targets() == sorted([str(tmp_path / "out"), str(tmp_path / "other")])
    assert [(e.number, e.revision, e.num_tiles) for e in store.exports.list()] == [
        (1, 1, 2),
        (2, None, 1),
        (3, None, 1),
    ]
    assert store.exports.list()[0].settings == {"tile_size_m": 10}
    with pytest.raises(NotFoundError):
        store.exports.add_tile(99, tile("x", two_scenes))
    with raises(InputError, code="invalid_recipe"):
        store.exports.add_tile(first, replace(tile("x", two_scenes), recipe={"method": "tto"}))
    store.exports.add_tile(first, replace(tile("x", two_scenes), recipe={}))
    assert store.exports.tiles(tmp_path / "out")[-1].recipe == {}


def test_several_changes_in_one_transaction(store, two_scenes):
    a, b = (s.id for s in two_scenes)

    def change() -> None:
        with store.transaction():
            store.registrations.save(registration(a, b), key("register"))
            store.revisions.save(graph_of(two_scenes))
            assert store.revisions.newest_number() == 1  # seen from inside
            raise RuntimeError

    with pytest.raises(RuntimeError):
        change()
    assert store.registrations.current() == []
    assert store.revisions.newest_number() is None


# -- prune


def test_prune_keeps_what_a_revision_names(tmp_path):
    with Store.create(tmp_path / "m") as store:
        scenes = [store.scenes.add(make_gaussians(seed=i), make_cameras(), name=f"scene{i}")[0] for i in range(3)]
        for scene in (scenes[0].id, scenes[2].id):
            store.graphs.save(SceneGraph(scene, {"objects": layer()}), key("describe", scene))
        store.revisions.save(graph_of(scenes[:2]))
        store.scenes.remove("scene0")
        store.scenes.remove("scene2")
        would = store.prune(dry_run=True)
        assert (would.scene_names, would.num_graphs, would.dry_run) == (("scene2",), 1, True)
        assert len(store.scenes.gaussians(scenes[2].id)) == 500
        done = store.prune()
        assert (done.scene_names, done.num_graphs, done.num_bytes) == (("scene2",), 1, would.num_bytes)
        assert done.num_bytes > 10_000
        assert len(store.scenes.gaussians(scenes[0].id)) == 500  # revision 1 can still be exported
        with raises(NotFoundError, code="scene_removed"):
            store.scenes.gaussians(scenes[2].id)
        assert store.check().ok

        store.revisions.save(PoseGraph({scenes[1].id: ScenePose(scenes[1].id, pose(), 0, "placed")}))
        assert store.prune().scene_names == ()
        dropped = store.prune(keep_revisions=1)
        assert (dropped.scene_names, dropped.revisions) == (("scene0",), (1,))
        assert [bool(r.dropped_at) for r in store.revisions.list()] == [True, False]
        with raises(NotFoundError, code="revision_dropped"):
            store.revisions.get(1)
        assert [(r.num_scenes, r.num_placed) for r in store.revisions.list()][1] == (1, 1)  # its line stays
        assert store.prune().num_bytes == 0
        assert store.check().ok
        assert len(store.scenes.gaussians("scene1")) == 500
        assert len(list((tmp_path / "m" / "arrays" / "scenes").iterdir())) == 1


def test_a_dry_run_counts_everything_and_changes_nothing(store, two_scenes, tmp_path):
    """Orphans, leftovers of dead writers, models and replaced graphs too; also of a map that is open for reading."""
    scene, made = two_scenes[0].id, key("describe", two_scenes[0].id)
    for nodes in (3, 4):  # the second takes the first one's place
        store.graphs.save(SceneGraph(scene, {"objects": layer(nodes)}), made)
    (tmp_path / "net.onnx").write_bytes(b"x" * 1000)
    store.models.add("net", tmp_path / "net.onnx", kind="clip")
    store.models.remove("net")
    for folder in (f"scenes/{'0' * 32}", "staging/leftover"):
        (store.folder / "arrays" / folder).mkdir()
        (store.folder / "arrays" / folder / "c").write_bytes(b"x" * 5000)
    store.scenes.remove("scene1")
    before = {p: p.stat().st_mtime_ns for p in store.folder.rglob("*")}
    with Store.open(store.folder, "r") as reader:
        would = reader.prune(dry_run=True)
    assert would == store.prune(dry_run=True)
    assert {p: p.stat().st_mtime_ns for p in store.folder.rglob("*")} == before
    assert (would.scene_names, would.num_orphans, would.num_models) == (("scene1",), 1, 1)
    assert would.num_bytes > 11_000
    assert store.prune() == replace(would, dry_run=False)
    assert store.prune(dry_run=True) == PruneReport(dry_run=True)
    assert store.check().ok
