import pytest
from raising import raises
from store_samples import make_cameras, make_gaussians

from gsmap.errors import InputError, NotFoundError, StoreError
from gsmap.store import Store


def said(store, ref: str) -> list[tuple[str, str, str]]:
    return [(fact.kind, fact.value, fact.author) for fact in store.scenes.facts(ref)]


def test_edit_and_its_history(store, two_scenes):
    scene = two_scenes[0]
    assert said(store, "scene0") == [("name", "scene0", "")]
    got = store.scenes.edit(
        "scene0", name="kitchen", captured_at="2026-05-31T14:00:00+02:00", tags_add=["winter", "night"], author="ada"
    )
    assert (got.id, got.name, got.captured_at) == (scene.id, "kitchen", "2026-05-31T14:00:00+02:00")
    assert got.tags == ("night", "winter")
    store.scenes.edit("kitchen", note="the door was open\nand the light off")
    got = store.scenes.edit("kitchen", captured_at="2026-06-01", tags_add=["day"], tags_remove=["night"])
    assert (got.captured_at, got.tags) == ("2026-06-01T00:00:00+00:00", ("day", "winter"))
    got = store.scenes.edit("kitchen", captured_at="")
    assert got.captured_at is None
    assert said(store, "kitchen") == [
        ("name", "scene0", ""),
        ("name", "kitchen", "ada"),
        ("captured_at", "2026-05-31T14:00:00+02:00", "ada"),
        ("tag", "winter", "ada"),
        ("tag", "night", "ada"),
        ("note", "the door was open\nand the light off", ""),
        ("captured_at", "2026-06-01T00:00:00+00:00", ""),
        ("tag", "day", ""),
        ("untag", "night", ""),
        ("captured_at", "", ""),
    ]
    times = [fact.created_at for fact in store.scenes.facts("kitchen")]
    assert times == sorted(times)
    assert times[0] < times[-1]
    with Store.open(store.folder, "r") as reader:
        assert [(s.name, s.tags) for s in reader.scenes.list()] == [("kitchen", ("day", "winter")), ("scene1", ())]
        assert reader.scenes.get(scene.id).tags == ("day", "winter")
        with raises(StoreError, code="not_writable"):
            reader.scenes.edit("kitchen", name="x")


def test_saying_the_same_again_writes_nothing(store, two_scenes):
    store.scenes.edit("scene0", captured_at="2026-06-01", tags_add=["a", "a"])
    before = said(store, "scene0")
    store.scenes.edit("scene0", name="scene0", captured_at="2026-06-01T00:00:00+00:00", tags_add=["a"])
    store.scenes.edit("scene0")
    assert said(store, "scene0") == before
    assert said(store, "scene1") == [("name", "scene1", "")]


@pytest.mark.parametrize(
    ("change", "code", "match"),
    [
        ({"name": ""}, "invalid_name", "name of a scene .*empty"),
        ({"name": "  "}, "invalid_name", "name of a scene .*empty"),
        ({"name": "a\nb"}, "invalid_name", r"name of a scene 'a\\nb'"),
        ({"name": "a\x1b[31mb"}, "invalid_name", r"name of a scene 'a\\x1b"),
        ({"name": "scene1"}, "name_taken", "'scene1'"),
        ({"captured_at": "yesterday"}, "invalid_date", "'yesterday'"),
        ({"note": "bell\x07"}, "invalid_name", "note 'bell"),
        ({"note": ""}, "invalid_name", "note .*empty"),
        ({"tags_add": ["good", "a\tb"]}, "invalid_name", r"tag 'a\\tb'"),
        ({"tags_add": [""]}, "invalid_name", "tag .*empty"),
        ({"name": "fine", "author": "a\x00b"}, "invalid_name", "author 'a"),
    ],
)
def test_what_is_refused_changes_nothing(store, two_scenes, change, code, match):
    before = store.scenes.list(), said(store, "scene0")
    with raises(InputError, code=code, match=match) as caught:
        store.scenes.edit("scene0", **change)
    assert "\x1b" not in str(caught.value)
    assert (*[s.name for s in store.scenes.list()],) == (*[s.name for s in before[0]],)
    assert said(store, "scene0") == before[1]


def test_unknown_scenes_and_tags(store, two_scenes):
    with raises(NotFoundError, code="tag_not_found"):
        store.scenes.edit("scene0", tags_remove=["a"])
    store.scenes.remove("scene0")
    with raises(NotFoundError, code="scene_removed"):
        store.scenes.edit(two_scenes[0].id, name="x")
    assert said(store, two_scenes[0].id) == [("name", "scene0", "")]  # its history stays
    assert store.scenes.edit("scene1", name="scene0").name == "scene0"  # the name is free


def test_names_of_new_scenes_are_checked_too(store):
    for bad in ("", "a\rb"):
        with raises(InputError, code="invalid_name"):
            store.scenes.add(make_gaussians(), make_cameras(), name=bad)
    with raises(InputError, code="invalid_date"):
        store.scenes.add(make_gaussians(), make_cameras(), name="a", captured_at="soon")
    assert store.scenes.list() == []
    assert store.scenes.add(make_gaussians(), make_cameras(), name="a:b")[0].name == "a:b"


def test_ingesting_the_same_again_with_another_date_sets_it(store):
    def add(when: str | None):
        return store.scenes.add(make_gaussians(), make_cameras(), name="a", captured_at=when)

    add("2026-01-01")
    again, is_new = add("2026-02-02")
    assert (again.captured_at, is_new) == ("2026-02-02T00:00:00+00:00", False)
    assert add(None)[0].captured_at == "2026-02-02T00:00:00+00:00"
    assert add("2026-02-02")[1] is False
    assert [(kind, value[:10]) for kind, value, _ in said(store, "a")] == [
        ("name", "a"),
        ("captured_at", "2026-01-01"),
        ("captured_at", "2026-02-02"),
    ]


def test_what_was_said_outlives_a_removal(store):
    scene, _ = store.scenes.add(make_gaussians(), make_cameras(), name="a", captured_at="2026-01-01")
    store.scenes.edit("a", tags_add=["x"])
    assert store.scenes.remove("a").tags == ("x",)
    assert store.scenes.list(removed=True)[0].tags == ("x",)
    back, _ = store.scenes.add(make_gaussians(), make_cameras(), name="b")
    assert (back.id, back.tags, back.captured_at) == (scene.id, ("x",), None)
    assert [kind for kind, _, _ in said(store, "b")] == ["name", "captured_at", "tag", "name", "captured_at"]


def test_a_date_read_from_a_file_fills_a_gap_and_overrules_nobody(store):
    def add(when: str | None, dated_by: str = ""):
        return store.scenes.add(make_gaussians(), make_cameras(), name="a", captured_at=when, dated_by=dated_by)[0]

    assert add(None).captured_at is None
    assert add("2026-01-01", "a.json").captured_at == "2026-01-01T00:00:00+00:00"
    assert add("2026-01-02", "a.json").captured_at == "2026-01-01T00:00:00+00:00"
    assert add("2026-01-03").captured_at == "2026-01-03T00:00:00+00:00"
    store.scenes.edit("a", captured_at="")
    assert add("2026-01-01", "a.json").captured_at is None  # it was taken back
    assert [(value[:10], author) for kind, value, author in said(store, "a") if kind == "captured_at"] == [
        ("2026-01-01", "a.json"),
        ("2026-01-03", ""),
        ("", ""),
    ]


def test_a_new_scene_keeps_what_its_date_was_read_from(store):
    store.scenes.add(make_gaussians(), make_cameras(), name="a", captured_at="2026-01-01", dated_by="a.json")
    assert said(store, "a")[-1] == ("captured_at", "2026-01-01T00:00:00+00:00", "a.json")


def test_edits_of_other_names_are_refused(store, two_scenes):
    scene = two_scenes[0]
    for name in ("title", "tag", "untag"):
        with pytest.raises(TypeError):
            store.scenes.edit(scene.id, **{name: "x"})
