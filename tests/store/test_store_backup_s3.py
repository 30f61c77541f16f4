"""Backups in an object store: a real server that speaks S3."""

import contextlib
import itertools
import shutil
import socket
import tempfile
import threading
from pathlib import Path

import pytest
from store_backups import fill, holdings
from store_samples import make_cameras, make_gaussians
from store_swift import BUCKET, ENVIRONMENT, Swift, why_not

from gsmap.errors import CorruptError, MissingDependencyError, NotFoundError, StoreError
from gsmap.store.backup import Backup, restore, save
from gsmap.store.backup import places as places_module
from gsmap.store.backup.places import place_of
from gsmap.store.backup.repository import object_name


@pytest.fixture(scope="module")
def server():
    pytest.importorskip("obstore")
    folder = Path(tempfile.mkdtemp(prefix="gsmap-s3-"))
    reason = why_not(folder)
    try:
        if reason:
            pytest.skip(reason)
        with Swift(folder) as swift:
            swift.make_bucket()
            yield swift
    finally:
        shutil.rmtree(folder, ignore_errors=True)


_numbers = itertools.count()


@pytest.fixture
def place(server, monkeypatch):
    for name, value in {**ENVIRONMENT, "AWS_ENDPOINT_URL": server.url}.items():
        monkeypatch.setenv(name, value)
    return place_of(f"s3://{BUCKET}/maps/site {next(_numbers)}")


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
    with pytest.raises(NotFoundError, match="no backup"):
        restore(place_of(f"{place.url}x"), tmp_path / "r2")


def test_verify_and_keep(filled, place, tmp_path):
    first = save(filled, place).snapshot
    file = next(f for f in Backup.at(place).files(first) if f.path.endswith("arrays.zip"))
    place.put(object_name(file.sha256), [b"x" * file.size_bytes], file.size_bytes)
    with pytest.raises(CorruptError, match=file.sha256):
        restore(place, tmp_path / "r")
    assert save(filled, place, verify=True).problems == ()
    restore(place, tmp_path / "r")
    filled.scenes.remove("b")
    filled.prune(keep_revisions=0)
    made = save(filled, place, keep=1)
    assert len(made.deleted) == 2
    assert made.num_bytes_freed > 0
    needed = {f.sha256 for f in Backup.at(place).files(made.snapshot)} | {made.snapshot.files}
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
    with pytest.raises(CorruptError, match="differs"):
        save(filled, place)
    assert good[:0] == b""
    assert filled.models.get("big").sha256 not in {name.rpartition("/")[2] for name in place.list("objects/")}
    copy.write_bytes(good)
    save(filled, place)
    restore(place, tmp_path / "r")
    assert holdings(tmp_path / "r") == holdings(filled.catalog.folder)


class Lossy:
    """A wire to the server on which the answer to every so many-th request is lost after the server has done it."""

    def __init__(self, url, every):
        self.host, port = url.removeprefix("http://").split(":")
        self.port = int(port)
        self.every = every
        self.lost = 0
        self._count = itertools.count(1)
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.url = f"http://127.0.0.1:{self._listening.getsockname()[1]}"
        threading.Thread(target=self._accept, daemon=True).start()

    def close(self):
        self._listening.close()

    def _accept(self):
        while True:
            try:
                client, _ = self._listening.accept()
            except OSError:
                return
            server = socket.create_connection((self.host, self.port))
            threading.Thread(target=self._forward, args=(client, server), daemon=True).start()
            threading.Thread(target=self._answer, args=(server, client), daemon=True).start()

    def _forward(self, client, server):
        try:
            while data := client.recv(1 << 16):
                server.sendall(data)
        except OSError:
            pass

    def _answer(self, server, client):
        try:
            while data := server.recv(1 << 16):
                if data.startswith(b"HTTP/1.1 ") and next(self._count) % self.every == 0:
                    self.lost += 1
                    break  # the server has done it, and nobody hears of it
                client.sendall(data)
        except OSError:
            pass
        for one in (client, server):
            with contextlib.suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
            one.close()


def test_answers_that_are_lost_are_no_errors(server, filled, place, tmp_path, monkeypatch):
    wire = Lossy(server.url, every=4)
    monkeypatch.setenv("AWS_ENDPOINT_URL", wire.url)
    save(filled, place_of(place.url))
    filled.scenes.add(make_gaussians(seed=5), make_cameras(), name="c")
    save(filled, place_of(place.url), verify=True, keep=1)
    restore(place_of(place.url), tmp_path / "r")
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
    with pytest.raises(StoreError, match="cannot write"):
        save(filled, place)


def _refuse(*arguments, **options):
    from obstore.exceptions import GenericError

    raise GenericError("no")


def test_what_cannot_be_reached_is_said_in_one_line(filled, place, monkeypatch, tmp_path):
    with pytest.raises(StoreError) as caught:
        save(filled, place_of("s3://nobody/x"))
    assert "\n" not in str(caught.value)
    assert "s3://nobody/x" in str(caught.value)
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "a-wrong-secret")
    with pytest.raises(StoreError, match="not allowed") as caught:
        save(filled, place_of(place.url))
    assert "a-wrong-secret" not in str(caught.value)
    assert "\n" not in str(caught.value)


def test_without_the_package(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "obstore", None)
    with pytest.raises(MissingDependencyError, match=r"gsmap\[cloud\]"):
        place_of("s3://bucket/x")
