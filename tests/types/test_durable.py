"""Files appear whole or not at all, and what was there stays where a write fails."""

import os

import pytest

from gsmap import durable


def test_a_file_is_replaced_whole(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    durable.write_whole(path, lambda staged: staged.write_text("new"))
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")

    def half(staged):
        staged.write_text("ne")
        raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match="No space left"):
        durable.write_whole(path, half)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_bytes_are_synchronised_before_the_name_and_the_name_after(tmp_path, monkeypatch):
    path, calls = tmp_path / "a.txt", []
    real = os.replace
    monkeypatch.setattr(durable, "sync_file", lambda p: calls.append(("file", p.read_text())))
    monkeypatch.setattr(os, "replace", lambda a, b: (calls.append(("rename", b.name)), real(a, b)))
    monkeypatch.setattr(durable, "sync_folder", lambda p: calls.append(("folder", (p / "a.txt").read_text())))
    durable.write_whole(path, lambda staged: staged.write_text("new"))
    assert calls == [("file", "new"), ("rename", "a.txt"), ("folder", "new")]


def test_synchronising_reaches_the_system(tmp_path, monkeypatch):
    reached = []
    monkeypatch.setattr(os, "fsync", lambda handle: reached.append(os.fstat(handle).st_ino))
    path = tmp_path / "a.txt"
    path.write_text("x")
    durable.sync_file(path)
    durable.sync_folder(tmp_path)
    assert reached == [path.stat().st_ino, tmp_path.stat().st_ino]
