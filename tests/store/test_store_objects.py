"""Numbers of objects stay with what is there, and words with numbers."""

import numpy as np
import pytest
from raising import raises
from sqlalchemy import func, insert, select, update
from store_samples import computed, keep_objects, make_cameras, make_gaussians

from gsmap.errors import CorruptError, InputError, NotFoundError
from gsmap.store import Store, merging, purging, scene_replacement, schema

A, B, FAR = [[0, 0, 0], [1, 1, 1]], [[4, 0, 0], [5, 1, 1]], [[9, 9, 0], [10, 10, 1]]


@pytest.fixture
def scenes(store) -> list[str]:
    return [
        store.scenes.add(make_gaussians(50, seed), make_cameras(), name=name)[0].id
        for seed, name in enumerate(("may", "june"))
    ]


def test_what_was_kept_is_read_as_it_was(store, scenes):
    may, june = scenes
    assert keep_objects(store, {may: A, june: B}, {june: FAR}) == ["o1", "o2"]
    (kept,) = store.objects.sets()
    assert [thing.id for thing in kept.objects] == ["o1", "o2"]
    assert list(kept.poses) == scenes
    assert [(s.scene, s.state, s.looked, s.asked) for s in kept.objects[1].sightings] == [
        (may, "absent", 0.75, june),
        (june, "seen", 1.0, ""),
    ]
    np.testing.assert_array_equal(kept.objects[0].sightings[1].box, B)


def test_numbers_stay_and_new_things_get_new_ones(store, scenes):
    may, june = scenes
    assert keep_objects(store, {may: A}, {may: B}) == ["o1", "o2"]
    nearly = np.array(B) + 0.1
    assert keep_objects(store, {may: FAR}, {may: nearly, june: B}, {may: A}) == ["o3", "o2", "o1"]
    assert len(store.objects.sets()) == 1, "what knew a capture before is out of date"
    assert store.objects.match_numbers([{may: B}, {june: FAR}]) == [2, None]


def test_a_picture_on_a_wall_is_known_again(store, scenes):
    picture = [[0, 0, 1], [0.5, 0.001, 1.5]]
    keep_objects(store, {scenes[0]: picture})
    assert store.objects.match_numbers([{scenes[0]: np.array(picture) + np.array([0, 0.004, 0])}]) == [1]
    assert store.objects.match_numbers([{scenes[0]: np.array(picture) + np.array([0.6, 0, 0])}]) == [None]


def test_two_that_become_one_and_part_again_have_their_numbers(store, scenes):
    may, june = scenes
    assert keep_objects(store, {may: A}, {june: B}) == ["o1", "o2"]
    assert keep_objects(store, {may: A, june: B}) == ["o1"]
    assert keep_objects(store, {june: B}, {may: A}) == ["o2", "o1"]


def test_numbers_are_unique_in_a_map_when_a_component_comes_apart(store):
    a, b, c = (store.scenes.add(make_gaussians(9, i), make_cameras(), name=f"{i}")[0].id for i in range(3))
    assert keep_objects(store, {a: A, b: A, c: A}, {a: B, b: B}) == ["o1", "o2"]
    apart = computed({c: A}), computed({a: A, b: A}, {a: B, b: B})
    assert [[thing.id for thing in made.objects] for made in store.objects.save(apart)] == [["o3"], ["o1", "o2"]]
    components = {a: 1, b: 1, c: 0}
    assert store.objects.split_objects({1: 1, 2: 1, 3: 0}, components) == {3: 1}
    # Each part is made again by itself, from boxes that differ a little: numbers stay.
    for shift in (0.02, -0.01, 0.03):
        assert keep_objects(store, {c: np.array(A) + shift}, seed=str(shift)) == ["o3"]
        assert keep_objects(store, {a: np.array(A) + shift, b: A}, {a: B, b: B}, seed=str(shift)) == ["o1", "o2"]
    assert store.objects.match_numbers([{c: A}, {a: A, b: A}, {a: B, b: B}]) == [3, 1, 2]
    assert keep_objects(store, {a: A, b: A, c: np.array(A) + 0.03}, {a: B, b: B}) == ["o1", "o2"], "one again"
    assert store.objects.split_objects({1: 0, 2: 0}, dict.fromkeys(components, 0)) == {}


def test_words_are_kept_with_their_history(store, scenes):
    keep_objects(store, {scenes[0]: A}, {scenes[0]: B})
    store.objects.edit(1, name="sofa", label="seat", author="ann")
    store.objects.edit(1, name="sofa")  # says nothing new
    store.objects.edit(1, label="", note="oak\nold")
    assert store.objects.annotations()["o1"].name == "sofa"
    assert (store.objects.annotations()["o1"].label, store.objects.annotations()["o1"].note) == ("", "oak\nold")
    assert [(f.kind, f.value, f.author) for f in store.objects.facts()["o1"]] == [
        ("name", "sofa", "ann"),
        ("label", "seat", "ann"),
        ("label", "", ""),
        ("note", "oak\nold", ""),
    ]
    for number, values in (
        (2, {"name": "SOFA"}),
        (2, {"name": "o7"}),
        (2, {"name": "1,2,3"}),
        (2, {"name": "a\x1b[1m"}),
        (2, {"note": " "}),
        (1, {"same_as": 1}),
    ):
        with pytest.raises(InputError):
            store.objects.edit(number, **values)
    store.objects.edit(1, same_as=2)
    with raises(InputError, code="already_same"):
        store.objects.edit(2, same_as=1)
    with pytest.raises(NotFoundError):
        store.objects.edit(3, name="x")
    with pytest.raises(NotFoundError):
        store.objects.edit(1, same_as=3)
    assert "o2" not in store.objects.annotations()


@pytest.mark.parametrize(
    "value",
    [
        {},
        {"poses": {}, "things": [], "objects": [], "metres": 1.0},
        {"objects": [{"id": "o1"}]},
        {"objects": [{"sightings": [[9, "seen", 0, None, 1.0, -1]]}]},
        {"objects": [{"sightings": [[0, "gone", 0, None, 1.0, -1]]}]},
        {"objects": [{"id": "../x"}]},
        {"objects": [{"box": [[0, 0, 0], [1, 1, "1e999"]]}]},
    ],
)
def test_a_strangers_objects_are_refused(store, scenes, value):
    keep_objects(store, {scenes[0]: A})
    with store.catalog.write() as connection:
        whole = connection.execute(select(schema.results.c.about)).scalar_one()
        if "poses" not in value and value:
            value = whole | {"objects": [whole["objects"][0] | value["objects"][0]]}
            if set(value["objects"][0]) == {"id"}:
                value["objects"][0] = {"id": "o1"}
        connection.execute(update(schema.results).values(about=value))
    if value.get("objects") == whole["objects"]:
        return
    with raises(CorruptError, code="catalog_invalid", match="results"):
        store.objects.sets()


def test_merging_maps_joins_numbers_and_words(store, scenes, tmp_path):
    may, june = scenes
    keep_objects(store, {may: A}, {may: B, june: A}, {june: FAR})
    store.objects.edit(2, name="sofa")
    store.objects.edit(3, label="lamp", same_as=1)
    with Store.create(tmp_path / "part") as part:
        assert merging.split(store, part, [june]).num_objects == 2
        assert part.objects.match_numbers([{june: A}, {june: FAR}]) == [1, 2]
        assert part.objects.annotations()["o1"].name == "sofa"
        assert part.objects.annotations()["o2"].same_as == "", "o1 stayed behind"
        part.objects.edit(1, note="red")
    with Store.create(tmp_path / "other") as other:
        other.scenes.add(make_gaussians(50, 9), make_cameras(), name="attic")
        keep_objects(other, {other.scenes.get("attic").id: A})
        done = merging.merge(other, store)
        assert (done.num_objects, done.num_object_facts) == (3, 3)
        assert other.objects.annotations()["o4"].same_as == "o2", "their numbers become ours"
        with Store.open(tmp_path / "part") as part:
            again = merging.merge(other, part)
        assert (again.num_objects, again.num_object_facts) == (0, 1)
        assert other.objects.annotations()["o3"].note == "red"
        assert merging.merge(other, store).num_object_facts == 0, "again it adds nothing"


def test_a_purge_forgets_what_only_that_scene_showed(store, scenes):
    may, june = scenes
    keep_objects(store, {may: A, june: A}, {may: B})
    store.objects.edit(1, name="sofa")
    store.objects.edit(2, name="secret lamp")
    receipt = purging.begin(store, may).receipt
    assert receipt["rows"]["object_facts"] == 1
    assert receipt["rows"]["object_places"] == 2
    assert set(store.objects.annotations()) == {"o1"}
    assert store.objects.sets() == []
    assert store.objects.places(1).keys() == {june}
    assert keep_objects(store, {june: FAR}) == ["o3"], "a number is not given again"


def test_a_capture_in_the_place_of_another_shows_its_objects(store, scenes):
    may, june = scenes
    keep_objects(store, {may: A})
    scene_replacement.inherit(store, may, june)
    assert store.objects.match_numbers([{june: A}]) == [1]
    assert store.objects.sets() == []


def test_prune_drops_what_was_made_with_captures_that_are_gone(store, scenes):
    may, _june = scenes
    keep_objects(store, {may: A})
    store.objects.edit(1, name="sofa")
    store.scenes.remove(may)
    store.prune()
    assert store.objects.sets() == []
    assert store.objects.annotations()["o1"].name == "sofa", "the scene may be restored from elsewhere"
    with store.catalog.read() as connection:
        assert connection.execute(select(func.count()).select_from(schema.object_places)).scalar_one() == 1


def test_kinds_of_facts_are_checked(store, scenes):
    keep_objects(store, {scenes[0]: A})
    row = {"object": 1, "kind": "owner", "value": "x", "author": "", "created_at": "x"}
    with raises(InputError, code="invalid_column_value"), store.catalog.write() as connection:
        connection.execute(insert(schema.object_facts), row)


# --- clocks -----------------------------------------------------------------------------------------------------------


def test_a_word_counts_that_was_said_last_whatever_the_clock_said(store, scenes, tmp_path, monkeypatch):
    keep_objects(store, {scenes[0]: A})
    with monkeypatch.context() as patched:
        patched.setattr("gsmap.store.objects.now", lambda: "2190-01-01T00:00:00.000000+00:00")
        store.objects.edit(1, name="first")
    store.objects.edit(1, name="second")
    with Store.create(tmp_path / "other.gsmap") as other:
        merging.merge(other, store)
        other.objects.edit(1, label="seat")
        merging.merge(store, other)
        for one in (store, other):
            assert (one.objects.annotations()["o1"].name, one.objects.annotations()["o1"].label) == ("second", "seat")
            assert [fact.value for fact in one.objects.facts()["o1"]] == ["first", "second", "seat"]
