"""Who is at work: one holder at a time; a process that ended holds nothing, one of another machine for a while."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from datetime import UTC, datetime, timedelta, tzinfo
from functools import partial
from pathlib import Path

import pytest
from raising import raises
from sqlalchemy import insert, select, update

from gsmap import platform
from gsmap.errors import BusyError, StoreError
from gsmap.store import Store, schema
from gsmap.store.leases import Leases
from gsmap.types.lock_owner import LockOwner, this_process

HOLD = """
import sys, time
from gsmap.store import Store
store = Store.open(sys.argv[1])
assert store.leases.try_hold("poses", "optimize")
print("held", flush=True)
time.sleep(60)
"""


@pytest.fixture
def another(store: Store) -> Iterator[subprocess.Popen[str]]:
    """Another process of this machine that holds ``poses``."""
    command = [sys.executable, "-c", HOLD, str(store.folder)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=os.environ | {"PYTHONPATH": _path()})
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    yield process
    process.kill()
    process.communicate()


def _path() -> str:
    return os.pathsep.join([str(Path(__file__).parents[2]), *sys.path])


def rows(store: Store) -> dict[str, str]:
    """Until when each lease holds, as it is written down."""
    with store.catalog.read() as connection:
        return {row.what: row.expires_at for row in connection.execute(select(schema.leases))}


def of_another_machine(store: Store, what: str, *, seconds_left: float) -> None:
    """A lease that a process of another machine took."""
    now = time.time()
    row = {
        "what": what,
        "token": "t",
        "host": "elsewhere",
        "process": f"{os.getpid()} 1 other-boot/pid:[1]",
        "task": "update",
        "since": _text(now - 3600),
        "expires_at": _text(now + seconds_left),
    }
    with store.catalog.write() as connection:
        connection.execute(insert(schema.leases), row)


def _text(seconds: float) -> str:
    return datetime.fromtimestamp(seconds, UTC).isoformat(timespec="microseconds")


def test_one_holds_and_the_other_is_told_who(store: Store, another: subprocess.Popen[str]) -> None:
    who = rf"gsmap optimize \(process {another.pid} on \S+, since \d\d:\d\d\)"
    with raises(BusyError, code="lease_held", match=who), store.leases.hold("poses", "update"):
        pass
    assert [lease.pid for lease in store.leases.others()] == [another.pid]
    with store.leases.hold("graph k", "update"):
        assert {lease.what: lease.task for lease in store.leases.list()} == {"poses": "optimize", "graph k": "update"}
        assert [lease.what for lease in store.leases.others()] == ["poses"]
    assert list(rows(store)) == ["poses"]


def test_what_a_killed_process_held_is_free_at_once(store: Store, another: subprocess.Popen[str]) -> None:
    another.send_signal(signal.SIGKILL)
    another.wait()
    assert store.leases.list() == []
    assert store.leases.try_hold("poses", "update")
    assert [lease.task for lease in store.leases.list()] == ["update"]


@pytest.mark.skipif(not platform.IS_LINUX, reason="only Linux knows when a process started")
def test_a_killed_process_that_nobody_buried_is_gone(store: Store, another: subprocess.Popen[str]) -> None:
    another.send_signal(signal.SIGKILL)
    deadline = time.monotonic() + 10
    while Path(f"/proc/{another.pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z":
        assert time.monotonic() < deadline
        time.sleep(0.01)
    assert store.leases.list() == []


@pytest.mark.skipif(not platform.IS_LINUX, reason="only Linux knows when a process started")
def test_a_later_process_of_the_same_number_is_another_one() -> None:
    me = this_process("update")
    number, started, machine = me.process.split(" ")
    assert not me.is_gone
    assert LockOwner("update", me.host, f"{number} {int(started) - 1} {machine}", me.since).is_gone
    assert not LockOwner("update", me.host, f"{number} {int(started) - 1} elsewhere", me.since).is_gone
    for nonsense in ("", "x", "-1 1", f"0 1 {machine}", "99999999999 1"):
        assert not LockOwner("update", me.host, nonsense, me.since).is_gone


def test_a_lease_of_another_machine_holds_until_it_runs_out(store: Store) -> None:
    of_another_machine(store, "poses", seconds_left=1.0)
    assert not store.leases.try_hold("poses", "update")
    time.sleep(1.1)
    assert store.leases.list() == []
    assert store.leases.try_hold("poses", "update")


def test_a_lease_longer_than_any_is_none(store: Store) -> None:
    """The clock was set back, or somebody wrote it into a map that he gives away."""
    of_another_machine(store, "poses", seconds_left=1e6)
    assert store.leases.try_hold("poses", "update")


@pytest.mark.guards("data")
@pytest.mark.parametrize(("lease_s", "free"), [(1.9, False), (2.1, True)])
def test_another_machine_s_lease_counts_up_to_twice_its_length(store: Store, lease_s: float, free: bool) -> None:
    mine = Leases(store.catalog, lease_s=100.0, heartbeat_s=20.0)
    of_another_machine(store, "poses", seconds_left=100 * lease_s)
    assert mine.try_hold("poses", "update") is free
    mine.close()


@pytest.mark.guards("data")
def test_all_that_a_process_holds_is_renewed_while_it_holds_it(store: Store) -> None:
    mine = Leases(store.catalog, lease_s=1.0, heartbeat_s=0.2)
    assert mine.acquire(["a", "b", "c"], "update").ours == ("a", "b", "c")
    mine.release(["b"])
    first = rows(store)
    time.sleep(1.5)
    held = rows(store)
    assert set(held) == {"a", "c"}
    assert all(held[what] > first[what] for what in held)
    assert not store.leases.try_hold("a", "update")
    assert [t.name for t in threading.enumerate()].count("gsmap-leases") == 1
    mine.close()
    assert rows(store) == {}
    assert "gsmap-leases" not in [t.name for t in threading.enumerate()]


@pytest.mark.guards("data")
def test_what_was_lost_is_not_taken_back(store: Store) -> None:
    """A machine slept, another one took over: neither a heartbeat nor giving back touches the other's lease."""
    mine = Leases(store.catalog, lease_s=1.0, heartbeat_s=0.1)
    assert mine.try_hold("a", "update")
    with store.catalog.write() as connection:
        connection.execute(update(schema.leases).values(token="other", expires_at=_text(time.time() + 30)))
    before = rows(store)
    time.sleep(0.4)
    mine.close()
    assert rows(store) == before


def test_several_attend_and_each_sees_the_others(store: Store) -> None:
    with Store.open(store.folder) as second, store.leases.announce("update") as before:
        with second.leases.announce("describe") as others:
            assert before == []
            assert [(other.what, other.task, other.pid) for other in others] == [("map", "update", os.getpid())]
            with second.leases.announce("register") as again:  # within what it does already
                assert len(again) == 1
            assert len(store.leases.list()) == 2
            assert second.leases.try_hold("graph k", "jobs")  # is part of what it does
            assert {lease.task for lease in store.leases.others()} == {"describe"}
            second.leases.release(["graph k"])
        assert [lease.task for lease in second.leases.list()] == ["update"]
    assert rows(store) == {}


def test_a_map_opened_for_reading_is_told_nothing(store: Store) -> None:
    with Store.open(store.folder, "r") as reader, store.leases.announce("update"):
        before = rows(store)
        with reader.leases.announce("status") as others:
            assert [lease.task for lease in others] == ["update"]
            assert rows(store) == before


def test_what_cannot_be_told_is_no_error(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    """A full disk: what a verb does may need nothing written there."""

    def full(*_: object, **__: object) -> None:
        raise StoreError("the disk is full")

    monkeypatch.setattr(store.catalog, "write", full)
    with store.leases.announce("export") as others:
        assert others == []


def test_no_more_are_taken_than_asked_for_and_none_that_is_done(store: Store) -> None:
    assert store.leases.try_hold("c", "update")
    with Store.open(store.folder) as second:
        taken = second.leases.acquire("abcdef", "update", limit=2, done=lambda whats: set(whats) & {"a", "d"})
        assert taken.ours == ("b", "e")
        assert taken.done == {"a", "d"}
        taken = second.leases.acquire("abcdef", "update", limit=2, give_back=["b"])
        assert taken.ours == ("a", "b")
        assert set(rows(store)) == {"a", "b", "c", "e"}


def compete(openers: Sequence[Callable[[], Store]]) -> None:
    """Several take three of twelve at a time until there are none: each is got by one."""
    won: list[str] = []
    everyone = threading.Barrier(len(openers))

    def take(opener: Callable[[], Store]) -> None:
        with opener() as mine:
            everyone.wait()
            for _ in range(4):
                won.extend(mine.leases.acquire([str(i) for i in range(12)], "update", limit=3).ours)
            everyone.wait()  # all hold what they have while others ask

    threads = [threading.Thread(target=take, args=(opener,)) for opener in openers]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(won, key=int) == [str(i) for i in range(12)]


@pytest.mark.guards("data")
def test_of_many_one_gets_each(store: Store) -> None:
    compete([lambda: Store.open(store.folder)] * 4)


def test_words_of_a_stranger_do_not_reach_the_terminal_raw() -> None:
    assert "\x1b" not in LockOwner("up\x1b[2Jdate", "h\nost", "1 2 3", "\x1b]0;x\x07").who


def test_on_postgres_the_server_s_clock_counts(
    tmp_path: Path, postgres_database: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Wrong(datetime):
        @classmethod
        def now(cls, tz: tzinfo | None = None) -> datetime:
            return datetime.now(tz) + timedelta(days=1)

    with Store.create(tmp_path / "m", catalog_url=postgres_database) as first, Store.open(tmp_path / "m") as second:
        assert first.leases.acquire(["x", "y"], "update").ours == ("x", "y")
        monkeypatch.setattr("gsmap.store.leases.datetime", Wrong)  # this machine's clock is a day ahead
        assert second.leases.acquire(["x", "z"], "update").ours == ("z",)
        assert {lease.what for lease in second.leases.others()} == {"x", "y"}
        first.leases.release(["x"])
        assert second.leases.try_hold("x", "update")
        of_another_machine(first, "w", seconds_left=1.0)
        assert not first.leases.try_hold("w", "update")
        time.sleep(1.1)
        assert first.leases.try_hold("w", "update")
        mine = Leases(first.catalog, lease_s=1.0, heartbeat_s=0.2)
        assert mine.try_hold("v", "update")
        before = rows(first)["v"]
        time.sleep(0.6)
        assert rows(first)["v"] > before
        mine.close()
        assert "v" not in rows(first)


def test_of_many_on_postgres_one_gets_each(tmp_path: Path, postgres_database: str) -> None:
    """Machines that share the server and no lock file."""
    Store.create(tmp_path / "m", catalog_url=postgres_database).close()
    for i in range(4):
        shutil.copytree(tmp_path / "m", tmp_path / f"m{i}")
    compete([partial(Store.open, tmp_path / f"m{i}", catalog_url=postgres_database) for i in range(4)])
