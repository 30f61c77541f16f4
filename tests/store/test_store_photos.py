"""Photographs that a map keeps: once each, with a small picture, with their scene through merge, split and purge."""

import json

import numpy as np
import pytest
from raising import raises
from sqlalchemy import update
from store_samples import JPEG, kept_photo, make_cameras, make_gaussians

from gsmap.errors import CorruptError, InputError, NotFoundError
from gsmap.store import Store, merging, schema
from gsmap.store.photos import MAX_BYTES
from gsmap.store.scene_replacement import inherit
from gsmap.types.localized_photo import PhotoObjectObservation


@pytest.fixture
def scene(store):
    return store.scenes.add(make_gaussians(), make_cameras(), name="a")[0].id


def test_what_was_kept_is_read_back(store, scene):
    assert store.photos.add(kept_photo(scene, 1), JPEG)
    assert store.photos.add(kept_photo(scene, 2, captured_at=None), JPEG + b"2")
    assert store.photos.add(kept_photo(scene, 3, captured_at="2026-02-01"), JPEG + b"3")
    kept = store.photos.list()
    assert [one.sighting.name for one in kept] == ["photo3.jpg", "photo1.jpg", "photo2.jpg"], "dated ones first"
    assert kept[0].sighting.captured_at == "2026-02-01T00:00:00+00:00"
    one = kept[1].sighting
    want = kept_photo(scene, 1)
    for name in ("T_scene_camera", "covariance", "intrinsics_px"):
        assert np.array_equal(getattr(one, name), getattr(want, name))
    assert (one.size_px, one.probability, one.things[0].state) == (want.size_px, want.probability, "absent")
    assert [store.photos.jpeg(one.number) for one in kept] == [JPEG + b"3", JPEG, JPEG + b"2"]
    with pytest.raises(NotFoundError):
        store.photos.jpeg(9)


def test_the_same_photo_twice_is_one(store, scene):
    assert store.photos.add(kept_photo(scene), JPEG)
    assert not store.photos.add(kept_photo(scene, captured_at=None), JPEG + b"other")
    assert len(store.photos.list()) == 1


def test_one_that_was_taken_back_can_be_added_again(store, scene):
    store.photos.add(kept_photo(scene), JPEG)
    store.photos.remove(store.photos.find("photo0.jpg").number)
    assert store.photos.list() == []
    assert store.check().problems == ()
    store.prune()
    assert not list((store.arrays.root / "photos").glob("*/*"))
    assert store.check().problems == ()
    assert store.photos.add(kept_photo(scene), JPEG)
    assert store.photos.find("p2").sighting.name == "photo0.jpg"


def test_prune_leaves_the_pictures_of_photos_that_are_kept(store, scene):
    for number in (1, 2):
        store.photos.add(kept_photo(scene, number), JPEG + bytes([number]))
    store.photos.remove(store.photos.find("photo1.jpg").number)
    store.prune()
    assert store.photos.jpeg(store.photos.find("photo2.jpg").number) == JPEG + b"\2"
    assert store.check().ok


def test_photos_are_named_by_file_number_or_digest(store, scene):
    for number in (1, 2):
        store.photos.add(kept_photo(scene, number), JPEG)
    assert store.photos.find("0" * 63 + "1").number == 1
    assert store.photos.find("p2").sighting.name == "photo2.jpg"
    for which in ("0" * 10, "00", "nothing.jpg"):
        with raises(NotFoundError, code="photo_not_found"):
            store.photos.find(which)


@pytest.mark.parametrize("jpeg", [b"", b"\x89PNG", JPEG + bytes(MAX_BYTES)])
def test_only_a_small_jpeg_is_kept(store, scene, jpeg):
    with raises(InputError, code="photo_not_jpeg"):
        store.photos.add(kept_photo(scene), jpeg)
    assert store.photos.list() == []


@pytest.mark.parametrize(
    "values",
    [
        {"T_scene_camera": np.eye(4) * 2},
        {"covariance": np.full((6, 6), np.nan)},
        {"intrinsics_px": np.zeros(4)},
        {"probability": 1.5},
    ],
)
def test_what_cannot_be_is_refused(scene, values):
    from dataclasses import replace

    with pytest.raises(InputError):
        replace(kept_photo(scene), **values)


def test_a_thing_is_seen_or_absent():
    with pytest.raises(InputError):
        PhotoObjectObservation(np.zeros(3), "unseen", 0.5)


@pytest.mark.parametrize(
    "change",
    [
        {"T_scene_camera": [[1, 0], [0, 1]]},
        {"things": [{"position": [1, 2], "state": "seen", "share": 1}]},
        {"things": None},
        {"size_px": [640]},
        {"size_px": ["640", 480]},
        {"covariance": None},
    ],
)
def test_rows_that_gsmap_did_not_write_are_told(store, scene, change):
    store.photos.add(kept_photo(scene), JPEG)
    with store.catalog.write() as connection:
        table = schema.photo_sightings
        value = json.loads(json.dumps(connection.execute(table.select()).one().value)) | change
        connection.execute(update(table).values(value=value))
    with raises(CorruptError, code="catalog_invalid", match="photo_sightings"):
        store.photos.list()


def test_photos_go_with_their_scene(store, scene, tmp_path):
    other = store.scenes.add(make_gaussians(seed=2), make_cameras(), name="b")[0].id
    store.photos.add(kept_photo(scene, 1), JPEG)
    store.photos.add(kept_photo(other, 2), JPEG + b"2")
    with Store.create(tmp_path / "part") as part:
        assert merging.split(store, part, [scene]).num_photos == 1
        assert [one.sighting.name for one in part.photos.list()] == ["photo1.jpg"]
        assert part.photos.jpeg(part.photos.list()[0].number) == JPEG
        assert part.check().problems == ()
        assert merging.merge(part, store).num_photos == 1
        assert merging.merge(part, store).num_photos == 0, "again it adds nothing"
        assert len(part.photos.list()) == 2
        store.photos.remove(store.photos.find("photo2.jpg").number)
        merging.merge(part, store)
        assert [one.sighting.name for one in part.photos.list()] == ["photo1.jpg"], "taken back there, so here"
    store.scenes.remove("a")
    assert store.photos.list() == []


def test_a_photo_follows_a_scene_that_took_its_place(store, scene):
    new = store.scenes.add(make_gaussians(seed=2), make_cameras(), name="b")[0].id
    store.photos.add(kept_photo(scene), JPEG)
    inherit(store, scene, new)
    store.scenes.remove("a")
    assert [one.sighting.scene for one in store.photos.list()] == [new]


def test_a_damaged_picture_is_told(store, scene):
    import os

    store.photos.add(kept_photo(scene), JPEG)
    (archive,) = (store.arrays.root / "photos").glob("*/*")
    os.chmod(archive, 0o644)
    content = bytearray(archive.read_bytes())
    content[len(content) // 2] ^= 0xFF
    archive.write_bytes(bytes(content))
    (problem,) = store.check().problems
    assert "photos/" in problem
    with pytest.raises(CorruptError):
        store.photos.jpeg(1)
