"""Killed anywhere, the map opens whole and nothing that was acknowledged is lost."""

import errno
import os
import random
import signal
import subprocess
import time

import pytest
import store_children
from raising import raises
from store_children import messages
from store_samples import make_cameras, make_gaussians

from gsmap.errors import StoreError
from gsmap.store import Store


def kill_at_random(tmp_path, start, kills: int, seed: int) -> None:
    path = tmp_path / "site.gsmap"
    Store.create(path).close()
    rng = random.Random(seed)
    alive: set[str] = set()
    revisions = killed_inside = 0
    for kill in range(kills):
        process, pipe = start(store_children.work, str(path), 100 * kill)
        assert pipe.poll(60)  # it has begun
        time.sleep(rng.uniform(0, 0.4))
        os.kill(process.pid, signal.SIGKILL)
        process.join()
        begun = None
        for state, step, what in messages(pipe):
            begun = (step, what) if state == "begin" else None
            if (state, step) == ("done", "add"):
                alive.add(what)
            elif (state, step) == ("done", "remove"):
                alive.discard(what)
            elif (state, step) == ("done", "revise"):
                revisions = what
        killed_inside += begun is not None
        with Store.open(path) as store:
            found = {scene.id for scene in store.scenes.list()}
            # Only the step under way may have happened or not.
            if begun is not None and begun[0] == "add":
                assert alive <= found
                assert len(found - alive) <= 1
            elif begun is not None and begun[0] == "remove":
                assert alive - {begun[1]} <= found <= alive
            else:
                assert found == alive
            alive = found
            assert revisions <= (store.revisions.newest_number() or 0) <= revisions + 1
            revisions = store.revisions.newest_number() or 0
            for scene in random.Random(kill).sample(sorted(found), min(2, len(found))):
                assert len(store.scenes.gaussians(scene)) == 300
            if kill % 10 == 9:
                assert store.check().problems == ()
    assert killed_inside > kills / 3
    with Store.open(path) as store:
        assert store.check().problems == ()
        store.prune()
        report = store.check()
        assert (report.problems, report.orphans) == ((), ())
        assert not list(store.arrays.staging.iterdir())
        assert all(len(store.scenes.gaussians(scene)) == 300 for scene in alive)


def test_killed_at_fifty_random_moments(tmp_path, start):
    kill_at_random(tmp_path, start, 50, seed=1)


@pytest.mark.slow
def test_killed_at_five_hundred_random_moments(tmp_path, start):
    kill_at_random(tmp_path, start, 500, seed=2)


def test_killed_at_every_step(tmp_path, start):
    path = tmp_path / "site.gsmap"
    with Store.create(path) as store:
        kept = store_children.add(store, 0)
    places, step = [], 1
    while True:
        process, pipe = start(store_children.die_at, str(path), 1, step)
        process.join()
        (said,) = messages(pipe)
        with Store.open(path) as store:
            assert store.check().problems == ()
            assert len(store.scenes.gaussians(kept)) == 300
            if said == "through":
                assert len(store.scenes.list()) == 2
                break
            assert [s.id for s in store.scenes.list()] == [kept]  # it was not committed yet
            if step % 2:
                store.prune()
                assert store.check().orphans == ()
        places.append(said)
        step += 1
    assert any("os.rename" in place for place in places)
    assert len(places) >= 6


@pytest.mark.parametrize("code", store_children.CODES)
def test_a_failing_disk_is_one_typed_error_and_changes_nothing(tmp_path, start, code):
    path = tmp_path / "site.gsmap"
    Store.create(path).close()
    process, pipe = start(store_children.fail_at_steps, str(path), code)
    process.join(120)
    said = messages(pipe)
    for step, kind, text, added, problems in said:
        assert problems == (), step
        # Some failures change nothing, such as that of making a folder that is there.
        assert added == (kind == "through"), (step, kind, text)
        if kind != "through":
            assert kind == {errno.ENOSPC: "DiskFullError", errno.EIO: "DiskError"}[code], (step, kind, text)
            assert "\n" not in text
            assert "damaged" not in text
            assert os.strerror(code) in text
    assert said[-1][1] == "through"
    assert sum(kind != "through" for _, kind, *_ in said) > 3


def test_a_full_disk(tmp_path):
    disk = tmp_path / "disk"
    disk.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=3m", "none", disk], capture_output=True).returncode:
        pytest.skip("needs the right to mount a small file system")
    try:
        with Store.create(disk / "m") as store:
            kept, _ = store.scenes.add(make_gaussians(2000), make_cameras(), name="a")
            with raises(StoreError, code="disk_full"):
                store.scenes.add(make_gaussians(40_000, degree=3), make_cameras(), name="b")
            assert [s.id for s in store.scenes.list()] == [kept.id]
            assert store.check().problems == ()
            (disk / "filler").write_bytes(b"x" * (os.statvfs(disk).f_bavail * os.statvfs(disk).f_frsize - 8192))

            def fill() -> None:
                for i in range(200):
                    store.exports.begin(f"/out/{i}", revision=None, settings={"x": "y" * 4000})

            with raises(StoreError, code="disk_full"):
                fill()
            assert store.check().problems == ()
            (disk / "filler").unlink()
            assert store.scenes.add(make_gaussians(100), make_cameras(), name="c")[1]
            assert store.check().problems == ()
    finally:
        subprocess.run(["umount", disk], check=True)


def test_eight_writers_and_two_readers(tmp_path, start, context):
    path = tmp_path / "site.gsmap"
    Store.create(path).close()
    stop = context.Event()
    readers = [start(store_children.read_some, str(path), stop) for _ in range(2)]
    writers = [start(store_children.write_some, str(path), i, 4) for i in range(8)]
    for process, pipe in writers:
        process.join(120)
        assert messages(pipe) == ["done"]
    stop.set()
    for process, pipe in readers:
        process.join(120)
        assert messages(pipe) == ["done"]
    with Store.open(path) as store:
        assert len(store.scenes.list()) == 8 * 4 + 4
        assert [r.number for r in store.revisions.list()] == list(range(1, 33))
        report = store.check()
        assert (report.problems, report.orphans) == ((), ())


def test_check_finds_a_flipped_bit_in_every_file(tmp_path):
    rng = random.Random(4)
    with Store.create(tmp_path / "m") as store:
        for seed in range(2):
            store_children.add(store, seed)
        store.models.add("net", __file__, kind="clip")
        assert store.check().ok
        files = [p for folder in ("arrays", "models") for p in (store.folder / folder).rglob("*") if p.is_file()]
        assert len(files) == 3
        for file in files * 10:
            whole = file.read_bytes()
            broken = bytearray(whole)
            broken[rng.randrange(len(broken))] ^= 1 << rng.randrange(8)
            file.write_bytes(broken)
            (problem,) = store.check().problems
            assert str(file) in problem
            file.write_bytes(whole)
        file.unlink()
        assert "missing" in store.check().problems[0]
        file.write_bytes(whole)
        (files[0].parent / "stranger").touch()
        assert "is not a file of the map" in store.check().problems[0]


def test_check_finds_flipped_bits_in_the_catalog(tmp_path):
    """Where SQLite notices nothing, the digest does; a later change of the map is no damage."""
    rng = random.Random(5)
    with Store.create(tmp_path / "m") as store:
        for seed in range(2):
            store_children.add(store, seed)
    file = tmp_path / "m" / "map.sqlite"
    whole, stamp = file.read_bytes(), file.stat()
    assert not file.with_name("map.sqlite-wal").exists()
    for _ in range(60):
        broken = bytearray(whole)
        broken[rng.randrange(len(broken))] ^= 1 << rng.randrange(8)
        file.write_bytes(broken)
        os.utime(file, ns=(stamp.st_atime_ns, stamp.st_mtime_ns))  # as a bad disk leaves it
        try:
            with Store.open(tmp_path / "m", "r") as store:
                assert not store.check().ok
        except StoreError:
            pass
    file.write_bytes(whole)
    os.utime(file, ns=(stamp.st_atime_ns, stamp.st_mtime_ns))
    for mode in "rwr":
        with Store.open(tmp_path / "m", mode) as store:
            assert store.check().problems == ()
            if mode == "w":
                store_children.add(store, 3)
                assert store.check().problems == ()
