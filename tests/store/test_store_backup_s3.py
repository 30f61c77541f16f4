"""Backups in an object store: a real server that speaks S3."""

import itertools
import time
from datetime import timedelta

import pytest
from raising import raises
from store_backups import fill, holdings
from store_samples import make_cameras, make_gaussians
from store_swift import BUCKET, ENVIRONMENT, Wire, refusal

from gsmap.errors import CorruptError, MissingDependencyError, NotFoundError, StoreError
from gsmap.store import storage as places_module
from gsmap.store.backup import Backup, restore, save
from gsmap.store.backup.repository import object_name
from gsmap.store.storage import open_storage

_numbers = itertools.count()


@pytest.fixture
def place(server, monkeypatch):
    for name, value in {**ENVIRONMENT, "AWS_ENDPOINT_URL": server.url}.items():
        monkeypatch.setenv(name, value)
    return open_storage(f"s3://{BUCKET}/maps/site {next(_numbers)}")


@pytest.fixture
def filled(store, tmp_path):
    fill(store, tmp_path)
    return store


def test_a_restored_map_holds_what_was_saved(filled, place, tmp_path):
    made = save(filled, place)
    assert [backup.target for backup in filled.backups.list()] == [place.url]
    assert restore(place, tmp_path / "r").snapshot == made.snapshot
    assert holdings(tmp_path / "r") == holdings(filled.catalog.folder)
    again = save(filled, place)
    assert again.num_files_new == 2  # the catalog and the list of files
    with raises(NotFoundError, code="not_a_backup"):
        restore(open_storage(f"{place.url}x"), tmp_path / "r2")


def test_verify_and_keep(filled, place, tmp_path):
    save(filled, place)
    backup = Backup.at(place)
    file = next(f for f in backup.files(backup.find()) if f.path.endswith("arrays.zip"))
    place.put(object_name(file.sha256), [b"x" * file.size_bytes], file.size_bytes)
    with raises(CorruptError, code="bytes_differ", match=file.sha256):
        restore(place, tmp_path / "r")
    assert save(filled, place, verify=True).problems == ()
    restore(place, tmp_path / "r")
    filled.scenes.remove("b")
    filled.prune(keep_revisions=0)
    made = save(filled, place, keep=1)
    assert len(made.deleted) == 2
    assert made.num_bytes_freed > 0
    needed = {f.sha256 for f in backup.files(backup.find())} | {backup.find().files}
    assert {name.rpartition("/")[2] for name in place.list("objects/")} == needed
    assert place.list("leases/") == {}
    restore(place, tmp_path / "r2")
    assert holdings(tmp_path / "r2") == holdings(filled.catalog.folder)


def test_large_objects_go_in_parts_and_appear_whole(filled, place, tmp_path, monkeypatch):
    monkeypatch.setattr(places_module, "SINGLE_PUT_BYTES", 1 << 10)
    monkeypatch.setattr(places_module, "_PART_BYTES", 5 << 20)
    (tmp_path / "big.onnx").write_bytes(bytes(range(256)) * (3 << 14))
    filled.models.add("big", tmp_path / "big.onnx", kind="clip")
    copy = filled.models.get("big").path
    good = copy.read_bytes()
    copy.write_bytes(good[:-1] + b"x")  # found when all but the last part is sent
    with raises(CorruptError, code="map_damaged"):
        save(filled, place)
    assert good[:0] == b""
    assert filled.models.get("big").sha256 not in {name.rpartition("/")[2] for name in place.list("objects/")}
    copy.write_bytes(good)
    save(filled, place)
    restore(place, tmp_path / "r")
    assert holdings(tmp_path / "r") == holdings(filled.catalog.folder)


def test_answers_that_are_lost_are_no_errors(server, filled, place, tmp_path, monkeypatch):
    wire = Wire(server.url, every=4)
    monkeypatch.setenv("AWS_ENDPOINT_URL", wire.url)
    save(filled, open_storage(place.url))
    filled.scenes.add(make_gaussians(seed=5), make_cameras(), name="c")
    save(filled, open_storage(place.url), verify=True, keep=1)
    restore(open_storage(place.url), tmp_path / "r")
    assert wire.lost > 10
    wire.close()
    assert holdings(tmp_path / "r") == holdings(filled.catalog.folder)
    assert len(Backup.at(place).names()) == 1


def test_a_put_whose_last_answer_was_lost(filled, place, monkeypatch):
    """Also where the library gives up trying: the object is there, under the digest of what was to be sent."""
    import obstore

    whole = obstore.put
    failed = []

    def put(store, name, *rest, **options):
        done = whole(store, name, *rest, **options)
        if name.startswith("objects/"):
            failed.append(name)
            raise obstore.exceptions.GenericError("the answer was lost")
        return done

    monkeypatch.setattr(place._api, "put", put)
    save(filled, place)
    assert len(failed) > 3
    monkeypatch.setattr(place._api, "put", _refuse)
    filled.scenes.add(make_gaussians(seed=5), make_cameras(), name="c")
    with raises(StoreError, code="storage_failed"):
        save(filled, place)


def _refuse(*arguments, **options):
    from obstore.exceptions import GenericError

    raise GenericError("no")


def test_what_cannot_be_reached_is_said_in_one_line(filled, place, monkeypatch, tmp_path):
    with pytest.raises(StoreError) as caught:
        save(filled, open_storage("s3://nobody/x"))
    assert "\n" not in str(caught.value)
    assert "s3://nobody/x" in str(caught.value)
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "a-wrong-secret")
    with raises(StoreError, code="storage_refused") as caught:
        save(filled, open_storage(place.url))
    assert "a-wrong-secret" not in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("code", ["ExpiredToken", "InvalidToken"])
def test_expired_credentials_are_named(server, place, monkeypatch, code):
    wire = Wire(server.url, faults={"GET": [refusal(400, code)]})
    monkeypatch.setenv("AWS_ENDPOINT_URL", wire.url)
    with raises(StoreError, code="storage_refused") as caught:
        list(open_storage(place.url).get("x"))
    assert code in str(caught.value)
    wire.close()


def test_a_request_without_an_answer_is_sent_again(server, place, monkeypatch):
    place.put("x", [b"1"], 1)
    monkeypatch.setattr(places_module, "_SILENCE", timedelta(seconds=1))
    wire = Wire(server.url, faults={"GET": [b""], "HEAD": [b""]})
    monkeypatch.setenv("AWS_ENDPOINT_URL", wire.url)
    there = open_storage(place.url)
    begun = time.monotonic()
    assert b"".join(there.get("x")) == b"1"
    assert there.size_bytes("x") == 1
    assert 1.5 < time.monotonic() - begun < 10
    wire.close()


def test_a_server_is_silent_during_a_long_upload(server, place, monkeypatch):
    monkeypatch.setattr(places_module, "_SILENCE", timedelta(seconds=0.5))
    wire = Wire(server.url, delay_s=1.0)
    monkeypatch.setenv("AWS_ENDPOINT_URL", wire.url)
    there = open_storage(place.url)
    content = bytes(places_module._SMALL_BYTES + 1)
    there.put("x", [content], len(content))
    assert there.put_if_absent("y", content)
    assert wire.answers == 2
    wire.close()


def test_without_the_package(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "obstore", None)
    with raises(MissingDependencyError, code="missing_dependency"):
        open_storage("s3://bucket/x")
