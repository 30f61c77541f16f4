"""The shim and the model of a disk do what they say, so that a sweep without complaints means something."""

import errno
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import fault_judge
import pytest
from fault_client import HERE
from fault_power import POLICIES, Disk, cuts
from fault_shim import MODES, PASS, Change, built, changes, why_not

needs_shim = pytest.mark.skipif(why_not() is not None, reason=str(why_not()))

# One change after another, by many ways to make one.
WORK = """
import os, sys, shutil
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from fault_shim import MODES, PASS, Shim
root, mode, n = Path(sys.argv[2]), sys.argv[3], int(sys.argv[4])
shim = Shim()
shim.arm(root, n, MODES.get(mode, PASS), Path(sys.argv[5]), data=True)
try:
    os.mkdir(root / "d")
    handle = os.open(root / "d", os.O_RDONLY)
    with open(root / "d" / "a", "wb") as file:
        file.write(b"12345678")
        file.flush()
        os.fsync(file.fileno())
    os.rename("a", "b", src_dir_fd=handle, dst_dir_fd=handle)
    shutil.copyfile(root / "d" / "b", root / "c")
    os.chdir(root)
    os.truncate("c", 3)
    os.link("c", "e")
    Path("/tmp").exists()
    shutil.rmtree(root / "d")
finally:
    print(shim.count)
"""
ALL = ["mkdir d", "create d/a", "write d/a", "fsync d/a", "rename d/a -> d/b", "create c", "write c", "truncate c"]
ALL += ["link c -> e", "unlink d/b", "rmdir d"]
NUMBERS = {text: n + (n > 7) for n, text in enumerate(ALL, 1)}  # the copy asks once more, and nothing comes of it


def work(folder: Path, mode: str = "pass", n: int = 0) -> tuple[subprocess.CompletedProcess, list[Change]]:
    (folder / "in").mkdir()
    log = folder / "log"
    done = subprocess.run(
        [sys.executable, "-c", WORK, HERE, folder / "in", mode, str(n), log],
        env=os.environ | {"LD_PRELOAD": str(built())},
        capture_output=True,
        text=True,
    )
    return done, list(changes(log))


def text(folder: Path, change: Change) -> str:
    return str(change).replace(f"{folder / 'in'}/", "")


@needs_shim
def test_every_change_is_counted_and_written_down(tmp_path):
    done, seen = work(tmp_path)
    assert done.returncode == 0, done.stderr
    assert [text(tmp_path, change) for change in seen if change.kind != "?"] == ALL
    assert int(done.stdout) == len(seen)
    assert [c.data for c in seen if c.kind == "w"] == [b"12345678", b"12345678"]
    assert [c.offset for c in seen if c.kind == "t"] == [3]


@needs_shim
@pytest.mark.parametrize("change", ALL)
def test_it_kills_before_and_after(change, tmp_path):
    n, at = NUMBERS[change], ALL.index(change)
    for mode, count in (("kill-before", at), ("kill-after", at + 1)):
        folder = tmp_path / mode
        folder.mkdir()
        done, seen = work(folder, mode, n)
        assert done.returncode == -signal.SIGKILL
        assert [text(folder, c) for c in seen if c.kind not in "!?"] == ALL[:count]
        assert len([c for c in seen if c.kind == "!"]) == 1


@needs_shim
def test_it_writes_half_before_it_kills(tmp_path):
    _, seen = work(tmp_path, "kill-after", NUMBERS["write d/a"])
    assert (tmp_path / "in" / "d" / "a").read_bytes() == b"1234"
    assert seen[-1].data == b"1234"


@needs_shim
def test_it_refuses_once_or_from_then_on(tmp_path):
    for mode, code, at in (("eio-once", errno.EIO, "fsync d/a"), ("enospc-ever", errno.ENOSPC, "create c")):
        folder = tmp_path / mode
        folder.mkdir()
        done, seen = work(folder, mode, NUMBERS[at])
        assert os.strerror(code) in done.stderr
        assert [text(folder, c) for c in seen if c.kind not in "!?"] == ALL[: ALL.index(at)]


@needs_shim
def test_a_full_disk_lets_go(tmp_path):
    done, seen = work(tmp_path, "enospc-ever", NUMBERS["unlink d/b"])
    assert done.returncode == 0, done.stderr
    assert not [c for c in seen if c.kind == "!"]


@needs_shim
def test_a_short_write_is_none_to_who_writes_on(tmp_path):
    done, _ = work(tmp_path, "short-once", 3)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "in" / "c").read_bytes() == b"123"


def test_only_what_was_synchronised_is_certain(tmp_path):
    root = tmp_path / "disk"
    (root / "d").mkdir(parents=True)
    (root / "d" / "old").write_bytes(b"old")

    def change(kind: str, path: str, other: str = "", offset: int = 0, data: bytes = b"") -> Change:
        return Change(kind, str(root / path), str(root / other) if other else "", offset, data)

    done = [
        change("c", "d/new"),
        change("w", "d/new", data=b"sure"),
        change("f", "d/new"),
        change("w", "d/new", offset=4, data=b"perhaps"),
        change("r", "d/new", "d/old"),
        change("m", "e"),
        change("f", "."),
        change("w", "d/old", offset=0, data=b"S"),
    ]
    assert [change.kind for change in done[:7]] == ["c", "w", "f", "w", "r", "m", "f"]
    disk, held = Disk(root), {}
    for policy in POLICIES:
        disk.materialise(done, policy, tmp_path / policy)
        found = tmp_path / policy
        held[policy] = {str(p.relative_to(found)): p.read_bytes() for p in found.rglob("*") if p.is_file()}
        assert (found / "e").is_dir()  # its folder was synchronised
    assert held["all"] == {"d/old": b"old"}  # d never was: the rename is undone
    assert held["data"] == {"d/old": b"sure"}
    assert held["names"] == {"d/old": b"old"}
    assert held["zeros"] == {"d/old": bytes(11)}
    disk.materialise([*done, change("f", "d"), change("f", "d/old")], "all", tmp_path / "last")
    assert (tmp_path / "last" / "d" / "old").read_bytes() == b"Sureperhaps"


def test_the_end_is_cut_in_every_way():
    done = [Change("f", f"/d/{i}", "", 0, b"") for i in range(9)]
    chosen = list(cuts(done, 12))
    assert len(chosen) == 12
    assert chosen[:4] == [(9, policy) for policy in POLICIES]
    assert len({at for at, _ in chosen[4:]}) > 4


def test_the_judge_finds_what_is_wrong():
    def state(*rows: object, files: dict | None = None) -> fault_judge.State:
        exact = {json.dumps(row, sort_keys=True) for row in rows}
        likes = set()
        for place, table, values in rows:
            values = {n: fault_judge._likeness(table, n, v) for n, v in values.items()}
            likes.add(json.dumps([place, table, values], sort_keys=True))
        return fault_judge.State(frozenset(exact), frozenset(likes), files or {}, True)

    one, two, three = (["a", "scenes", {"id": i, "removed_at": None}] for i in "123")
    before, after = state(one, two), state(one, two, three)
    assert fault_judge.judge_rows(before, after, before) == []
    assert fault_judge.judge_rows(before, after, after) == []
    assert "lost" in fault_judge.judge_rows(before, after, state(one))[0]
    assert "invented" in fault_judge.judge_rows(before, after, state(one, two, ["a", "scenes", {"id": "4"}]))[0]
    gone = ["a", "scenes", {"id": "2", "removed_at": "2026"}]
    assert fault_judge.judge_rows(before, state(one, gone), state(one, gone)) == []
    files = state(one, two, files={"out/a": "1"})
    assert "cut off" in fault_judge.judge_rows(files, files, state(one, two, files={"out/a": "2"}))[0]

    words = fault_judge.judge_words
    assert words(1, "gsmap: the disk is full; nothing was changed\n", before, after, before, whole=True) == []
    assert words(1, "gsmap: the disk is full; nothing was changed\n", before, after, after, whole=True)
    assert words(1, "gsmap: the catalog is damaged\n", before, after, before, whole=True)
    assert words(1, "gsmap: the catalog is damaged\n", before, after, before, whole=False) == []
    assert words(0, "", before, after, before, whole=True)
    assert words(0, "", before, after, after, whole=True) == []
    assert words(1, "", before, after, before, whole=True)
    assert fault_judge.tracebacks('x\nTraceback (most recent call last):\n  File "a"\nOSError: b')
    assert PASS.name not in MODES
