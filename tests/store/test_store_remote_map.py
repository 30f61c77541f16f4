"""Maps without a folder: arrays in a real object store that speaks S3, the catalog in a real PostgreSQL server."""

import errno
import itertools
import os
import threading
import time

import numpy as np
import pytest
from raising import raises
from store_samples import key, made_change, make_cameras, make_gaussians, save_comparison
from store_swift import BUCKET, ENVIRONMENT, Wire, refusal

import gsmap.map
from gsmap.errors import BusyError, ConfigError, CorruptError, NotFoundError, StoreError
from gsmap.store import Store, advisory_locks, cache, remote_map
from gsmap.store.backup import clone, restore, save
from gsmap.store.layout import CHUNK_ROWS
from gsmap.store.merging import merge
from gsmap.store.object_arrays import merge_ranges
from gsmap.store.storage import BucketStorage, StorageRequestError, open_storage
from gsmap.types import Gaussians, NodeLayer, SceneGraph

_numbers = itertools.count()
BOX = np.array([[0.0, 0, 0], [1, 1, 1]])
GAUSSIANS = ("means", "quats", "log_scales", "logit_opacities", "sh")


@pytest.fixture
def bucket(server, monkeypatch, tmp_path):
    """A place in the bucket, and everything of this user in a folder of the test."""
    for name, value in {**ENVIRONMENT, "AWS_ENDPOINT_URL": server.url}.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setenv("GSMAP_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    return f"s3://{BUCKET}/homes/site {next(_numbers)}"


@pytest.fixture
def home(bucket, postgres_database):
    """A map whose home is a bucket."""
    with Store.create(bucket, catalog_url=postgres_database) as store:
        yield store


def cold(tmp_path):
    """Let nothing be kept on this machine."""
    for path in (tmp_path / "cache" / "files").glob("*"):
        path.unlink()


def graph(scene):
    layer = NodeLayer(np.ones((4, 3)), np.eye(4), [0] * 4, [1] * 4, np.ones((4, 2, 3)), np.ones((4, 2)), [0] * 4, "d")
    return SceneGraph(scene, {"objects": layer})


def same(a, b):
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in GAUSSIANS)


def test_a_map_is_made_once_and_needs_a_server(bucket, postgres_database):
    with raises(NotFoundError, code="map_not_found"):
        Store.open(bucket)
    assert not Store.exists(bucket)
    with raises(ConfigError, code="bucket_needs_catalog"):
        Store.create(bucket)
    with Store.create(bucket, catalog_url=postgres_database) as made:
        assert made.location == bucket
    assert Store.exists(bucket)
    with raises(StoreError, code="already_exists"):
        Store.create(bucket, catalog_url=postgres_database)
    place = open_storage(f"{bucket} other")
    place.put("x", [b"1"], 1)
    with raises(StoreError, code="folder_not_empty"):
        Store.create(place.url, catalog_url=postgres_database)


@pytest.mark.parametrize("status", [403, 409, 500])
def test_a_map_that_could_not_be_made_leaves_its_database_empty(server, bucket, postgres_database, monkeypatch, status):
    wire = Wire(server.url, faults={"PUT": [refusal(status, "No")] * 9})
    monkeypatch.setenv("AWS_ENDPOINT_URL", wire.url)
    with raises(StoreError, code="storage_refused" if status == 403 else "storage_failed"):
        Store.create(bucket, catalog_url=postgres_database)
    wire.close()
    monkeypatch.setenv("AWS_ENDPOINT_URL", server.url)
    Store.create(bucket, catalog_url=postgres_database).close()
    with Store.open(bucket) as store:
        assert store.scenes.list() == []


@pytest.mark.parametrize("fails", [True, False])
def test_a_map_is_made_though_the_answer_was_lost(bucket, postgres_database, monkeypatch, fails):
    """Sent again, the request finds its own object."""
    put = BucketStorage.put_if_absent

    def lose(self, name, content):
        assert put(self, name, content)
        if fails:
            raise StorageRequestError("the answer was lost", code="storage_failed")
        return False

    monkeypatch.setattr(BucketStorage, "put_if_absent", lose)
    with Store.create(bucket, catalog_url=postgres_database) as store:
        assert store.scenes.list() == []


def test_what_is_kept_is_read_by_another_machine(home, bucket, tmp_path, monkeypatch, postgres_database):
    g, c = make_gaussians(), make_cameras()
    scene, written = home.scenes.add(g, c, name="a")
    other, _ = home.scenes.add(make_gaussians(seed=1), c, name="b")
    assert written
    assert not home.scenes.add(g, c, name="a")[1]
    home.graphs.save(graph(scene.id), key("describe", scene.id))
    save_comparison(home, scene.id, other.id, made_change(BOX))
    (tmp_path / "net.onnx").write_bytes(b"no network")
    home.models.add("net", tmp_path / "net.onnx", kind="clip")
    with gsmap.map.open(bucket) as m:
        m.change_settings({"register.verdict.max_log_nfa": -6})
    monkeypatch.setenv("GSMAP_CACHE", str(tmp_path / "elsewhere"))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "nobody"))
    with raises(StoreError, code="untrusted_catalog"):
        Store.open(bucket, "r")
    monkeypatch.setenv("GSMAP_CATALOG", postgres_database)
    with gsmap.map.open(bucket) as m:
        assert m.settings.register.verdict.max_log_nfa == -6
        store = m.store
        assert same(store.scenes.gaussians("a"), home.scenes.gaussians("a"))
        assert store.scenes.cameras("a").names == c.names
        assert store.graphs.load("a").num_nodes == 4
        assert store.models.get("net").path.read_bytes() == b"no network"
        (comparison,) = store.changes.current()
        assert len(store.changes.load(comparison.number).changes) == 1
        assert store.check().problems == ()


def test_trust_is_asked_for_and_given(home, bucket, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "nobody"))
    assert not gsmap.map.catalog_of(bucket).trusted
    with raises(StoreError, code="untrusted_catalog"):
        Store.open(bucket)
    assert gsmap.map.trust(bucket).trusted
    Store.open(bucket).close()


def test_what_is_missing_or_differs_is_told_and_mended(home, tmp_path):
    g, c = make_gaussians(), make_cameras()
    scene, _ = home.scenes.add(g, c, name="a")
    place = home.arrays._storage
    (name,) = place.list("arrays/")
    good = b"".join(place.get(name))
    flipped = good[:100] + bytes([good[100] ^ 1]) + good[101:]
    for spoil in (lambda: place.delete(name), lambda: place.put(name, [flipped], len(good))):
        cold(tmp_path)
        spoil()
        (problem,) = home.check().problems
        assert f"{home.location}/{name}" in problem
        with raises(CorruptError, code=("arrays_corrupt", "bytes_differ")):
            home.scenes.gaussians("a")
        home.scenes.add(g, c, name="a")
        assert home.check().ok
        assert len(home.scenes.gaussians("a")) == len(g)
    assert scene.id in name


def test_what_this_machine_keeps_may_rot(home, tmp_path):
    home.scenes.add(make_gaussians(), make_cameras(), name="a")
    whole = home.scenes.gaussians("a")
    (kept,) = (tmp_path / "cache" / "files").iterdir()
    data = kept.read_bytes()
    kept.write_bytes(data[:200] + bytes(100) + data[300:])
    assert same(home.scenes.gaussians("a"), whole)
    assert kept.read_bytes() == data


@pytest.mark.parametrize("broken", ["folder", "file", "full", "unreadable"])
def test_a_broken_cache_stops_no_reading(home, tmp_path, monkeypatch, caplog, broken):
    home.scenes.add(make_gaussians(), make_cameras(), name="a")
    whole = home.scenes.gaussians("a")
    files = tmp_path / "cache" / "files"
    (kept,) = files.iterdir()
    if broken == "full":
        kept.unlink()

        def keep_nothing(root):
            raise OSError(errno.ENOSPC, "no space")

        monkeypatch.setattr(cache, "make_room", keep_nothing)
    elif broken == "unreadable":
        monkeypatch.setattr(cache, "find", lambda sha256: files)
    else:
        kept.unlink()
        if broken == "folder":
            kept.mkdir()
        else:
            files.rmdir()
            files.touch()
    for _ in range(2):
        assert same(home.scenes.gaussians("a"), whole)
    assert len([r for r in caplog.records if str(tmp_path / "cache") in r.getMessage()]) == 1


def test_a_damaged_file_that_stays_in_the_cache_stops_no_reading(home, tmp_path, monkeypatch):
    home.scenes.add(make_gaussians(), make_cameras(), name="a")
    whole = home.scenes.gaussians("a")
    (kept,) = (tmp_path / "cache" / "files").iterdir()
    kept.write_bytes(kept.read_bytes()[:200])

    def refuse(*arguments):
        raise OSError(errno.EROFS, "read-only")

    monkeypatch.setattr(cache, "drop", refuse)
    monkeypatch.setattr(cache, "keep", refuse)
    assert same(home.scenes.gaussians("a"), whole)


def test_a_cache_that_is_no_folder_is_named(home, bucket, tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("GSMAP_CACHE", str(tmp_path / "file"))
    with pytest.raises(StoreError) as caught:
        Store.open(bucket)
    assert str(tmp_path / "file") in str(caught.value)


def test_prune_and_purge_reclaim_objects(home, tmp_path):
    place = home.arrays._storage
    first, _ = home.scenes.add(make_gaussians(), make_cameras(), name="a")
    home.graphs.save(graph(first.id), key("describe", first.id))
    home.scenes.add(make_gaussians(seed=1), make_cameras(), name="b")
    place.put(f"arrays/scenes/{'0' * 32}/x", [b"12345"], 5)  # of a writer that died
    assert home.check().orphans == (f"scenes/{'0' * 32}",)
    (tmp_path / "net.onnx").write_bytes(b"no network")
    home.models.add("net", tmp_path / "net.onnx", kind="clip")
    assert home.prune().num_orphans == 1
    assert len(place.list("models/")) == 1
    home.models.remove("net")
    assert len(place.list("arrays/")) == 3
    home.scenes.remove("a")
    assert home.prune().scene_names == ("a",)
    assert place.list("models/") == {}
    assert len(place.list("arrays/")) == 1
    with gsmap.map.open(home.location) as m:
        m.store.scenes.gaussians("b")
        assert len(list((tmp_path / "cache" / "files").iterdir())) == 1
        assert m.purge("b").num_groups == 1
        assert not list((tmp_path / "cache" / "files").iterdir())
    assert place.list("arrays/") == {}
    assert home.check().ok


@pytest.mark.guards("data")
def test_a_group_that_a_prune_took_for_an_orphan_is_sent_again(home, monkeypatch):
    """Between sending and naming nobody knows of it."""
    from gsmap.store import scenes

    real = scenes.publish

    def pruned_first(catalog, connection, arrays, staged, kind, group_id):
        arrays.drop(kind, group_id)
        real(catalog, connection, arrays, staged, kind, group_id)

    monkeypatch.setattr(scenes, "publish", pruned_first)
    home.scenes.add(make_gaussians(), make_cameras(), name="a")
    assert home.check().ok


def test_answers_that_are_lost_are_no_errors(server, bucket, postgres_database, monkeypatch):
    wire = Wire(server.url, every=4)
    monkeypatch.setenv("AWS_ENDPOINT_URL", wire.url)
    with Store.create(bucket, catalog_url=postgres_database) as store:
        for seed in range(4):
            store.scenes.add(make_gaussians(seed=seed), make_cameras(), name=f"s{seed}")
        assert store.check().ok
        assert len(store.scenes.list()) == 4
        assert len(store.arrays.groups()) == 4
    assert wire.lost > 3
    wire.close()


@pytest.mark.parametrize("count", [200_000, pytest.param(1_000_000, marks=pytest.mark.slow)])
def test_a_box_takes_few_requests_and_few_bytes(server, home, bucket, monkeypatch, tmp_path, count):
    """A square of 2.6 percent of a place of 100 m, as in a million Gaussians one of 26,000."""
    rng = np.random.default_rng(0)
    means = rng.uniform([0, 0, 0], [100, 100, 5], (count, 3))
    rest = np.tile([1.0, 0, 0, 0], (count, 1)), np.full((count, 3), -4.0), rng.normal(size=count)
    home.scenes.add(Gaussians(means, *rest, rng.normal(size=(count, 1, 3))), make_cameras(), name="a")
    cold(tmp_path)
    wire = Wire(server.url)
    monkeypatch.setenv("AWS_ENDPOINT_URL", wire.url)
    box = np.array([[63.0, 63, -1], [79.1, 79.1, 9]])
    with Store.open(bucket, "r") as store:
        with store.catalog.read() as connection:
            from gsmap.store.chunk_boxes import chunks_touching

            number = connection.exec_driver_sql("SELECT number FROM scenes").scalar()
            touched = len(chunks_touching(connection, number, box))
        before = wire.answers, wire.num_bytes
        found = store.scenes.gaussians("a", box)
        requests, num_bytes = wire.answers - before[0], wire.num_bytes - before[1]
        size = store.scenes.num_bytes("a")
    wire.close()
    assert len(found) == pytest.approx(0.026 * count, rel=0.1)
    assert requests <= 6
    assert num_bytes <= 1.5 * touched * CHUNK_ROWS / count * size
    print(f"{len(found)} of {count}: {requests} requests, {num_bytes} bytes, {touched} chunks, {size} in all")


def test_ranges_that_are_near_are_one_request():
    assert merge_ranges([(0, 5), (5, 9), (20, 30), (31, 40), (90, 95)], 2) == [(0, 40), (90, 95)]
    assert merge_ranges([(7, 9), (0, 3), (2, 5)], 9) == [(0, 5), (7, 9)]
    assert merge_ranges([], 3) == []


def test_a_pair_is_fetched_once(server, home, bucket, monkeypatch):
    home.scenes.add(make_gaussians(), make_cameras(), name="a")
    wire = Wire(server.url)
    monkeypatch.setenv("AWS_ENDPOINT_URL", wire.url)
    with Store.open(bucket, "r") as store:
        store.scenes.gaussians("a")
        before = wire.answers
        store.scenes.gaussians("a")
        store.scenes.cameras("a")
    with Store.open(bucket, "r") as store:
        opened = wire.answers
        store.scenes.gaussians("a")
        assert wire.answers == opened
    assert opened - before <= 2  # catalog.url and settings.toml
    wire.close()


def test_what_is_kept_is_bounded(tmp_path, monkeypatch):
    monkeypatch.setenv("GSMAP_CACHE", str(tmp_path))
    monkeypatch.setenv("GSMAP_CACHE_MB", "1")
    import hashlib

    content = [bytes([i]) * 400_000 for i in range(4)]
    digests = [hashlib.sha256(c).hexdigest() for c in content]
    for i, (digest, one) in enumerate(zip(digests, content, strict=True)):
        path = cache.keep(digest, [one], "it")
        os.utime(path, (i, i))
        if i == 2:
            assert cache.find(digests[1]) is not None  # used last
    assert [cache.find(digest) is not None for digest in digests] == [False, True, False, True]
    with raises(CorruptError, code="bytes_differ"):
        cache.keep(digests[0], [b"x"], "it")
    assert cache.find(digests[0]) is None
    monkeypatch.setenv("GSMAP_CACHE_MB", "much")
    with raises(ConfigError, code="invalid_environment"):
        cache.keep(digests[0], [content[0]], "it")


def test_a_backup_a_clone_and_a_merge_leave_the_bucket(home, tmp_path):
    scene, _ = home.scenes.add(make_gaussians(), make_cameras(), name="a")
    home.graphs.save(graph(scene.id), key("describe", scene.id))
    (tmp_path / "net.onnx").write_bytes(b"no network")
    home.models.add("net", tmp_path / "net.onnx", kind="clip")
    next((home.home / "models").iterdir()).unlink()  # as on another machine
    save(home, open_storage(tmp_path / "backup"))
    restore(open_storage(tmp_path / "backup"), tmp_path / "back")
    clone(home, tmp_path / "clone")
    with Store.create(tmp_path / "merged") as into:
        merge(into, home)
    for path in ("back", "clone", "merged"):
        with Store.open(tmp_path / path) as store:
            assert store.check().ok
            assert same(store.scenes.gaussians("a"), home.scenes.gaussians("a"))
            assert store.graphs.load("a").num_nodes == 4
            assert store.models.get("net").path.read_bytes() == b"no network"


def test_a_map_is_merged_into_a_bucket(home, tmp_path):
    with Store.create(tmp_path / "other") as other:
        scene, _ = other.scenes.add(make_gaussians(), make_cameras(), name="a")
        other.graphs.save(graph(scene.id), key("describe", scene.id))
        merge(home, other)
        assert same(home.scenes.gaussians("a"), other.scenes.gaussians("a"))
    assert home.check().ok


def test_what_a_bucket_cannot_do_is_refused(home):
    for tag in (False, True):
        with raises(ConfigError, code="no_branches_in_bucket"):
            home.branches.make("b", tag=tag)
    assert home.branches.list() == []


def test_a_folder_may_be_named_by_a_url(tmp_path):
    with Store.create(f"file://{tmp_path}/a%20map") as store:
        store.scenes.add(make_gaussians(), make_cameras(), name="a")
    with Store.open(f"file://localhost{tmp_path}/a%20map") as store:
        assert store.check().ok
    assert (tmp_path / "a map" / "map.sqlite").is_file()
    for bad in ("file://elsewhere/x", "http://x/y", "gs://b"):
        with raises(ConfigError, code="invalid_location"):
            Store.open(bad)


def test_a_bucket_named_with_a_password_is_refused(tmp_path):
    for bad in ("s3://user:secret@bucket/site", "s3://bucket/site?key=1", "s3:///site"):
        with raises(ConfigError, code="invalid_location"):
            Store.exists(bad)


def test_nothing_is_brought_from_or_to_elsewhere(home):
    for name in ("../x", "models/../x", "/etc/passwd", "models/", "models"):
        with raises(CorruptError, code="invalid_stored_name"):
            remote_map.RemoteMap(home.location).fetch(name)


def test_a_home_that_names_no_database_is_refused(bucket):
    place = open_storage(bucket)
    for content in (b"x" * 2_000_000, b"mysql://h/db\n", b"\xff"):
        place.put("catalog.url", [content], len(content))
        with raises(CorruptError, code=("file_too_large", "catalog_invalid")):
            Store.open(bucket)


# --- locks of the server ---------------------------------------------------------------------------------------------


def test_one_writes_at_a_time_and_no_folder_is_locked(home, bucket):
    with Store.open(bucket) as other:
        other.catalog.patience_s = 0.2
        with home.catalog.write():
            with raises(BusyError, code="lock_busy"), other.catalog.write():
                pass
            with pytest.raises(BusyError), other.catalog.lock(patience_s=0.0):
                pass
            with other.catalog.read():
                pass  # nobody who reads waits
        with home.catalog.lock(), home.catalog.write(), pytest.raises(BusyError), other.catalog.write():
            pass
        with other.catalog.write():
            pass
        with home.catalog.pause_writers(), pytest.raises(BusyError), other.catalog.write():
            pass
    assert not (home.folder / "lock").exists()


def test_who_died_holds_no_lock(home, bucket):
    with Store.open(bucket) as other:
        connection = home.catalog.engine.connect()
        connection.begin()
        advisory_locks.acquire(connection, advisory_locks.WRITER, 1.0, "x")
        other.catalog.patience_s = 0.2
        with pytest.raises(BusyError), other.catalog.write():
            pass
        connection.invalidate()  # as where the process is gone
        connection.close()
        other.catalog.patience_s = 5.0
        with other.catalog.write():
            pass


def test_writers_wait_for_each_other(home, bucket):
    """Each adds one to what it has read, and none is lost."""
    from sqlalchemy import text

    with home.catalog.write() as connection:
        connection.execute(text("CREATE TABLE counter (n integer)"))
        connection.execute(text("INSERT INTO counter VALUES (0)"))

    def count():
        with Store.open(bucket) as store:
            for _ in range(5):
                with store.catalog.write() as connection:
                    n = connection.execute(text("SELECT n FROM counter")).scalar_one()
                    time.sleep(0.01)
                    connection.execute(text("UPDATE counter SET n = :n"), {"n": n + 1})

    threads = [threading.Thread(target=count) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    with home.catalog.read() as connection:
        assert connection.execute(text("SELECT n FROM counter")).scalar_one() == 15
    assert remote_map.is_remote(bucket)
