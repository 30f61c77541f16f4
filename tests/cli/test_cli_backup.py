"""Backups from the command line: what is said, and how it exits."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

Run = Callable[..., Any]


def _object_of(backup: Path, map: Path, name: str) -> Path:
    import hashlib

    array = next((map / "arrays" / "scenes").glob(name))
    sha256 = hashlib.sha256(array.read_bytes()).hexdigest()
    return backup / "objects" / sha256[:2] / sha256


def test_a_map_comes_back_as_it_was(site: Path, tmp_path: Path, cli: Run) -> None:
    dest = f"file://{tmp_path}/my%20backup"
    before = cli("list", site, "scenes", "--json").json
    first = cli("backup", site, dest, "--json")
    assert first.code == 0, first.stderr
    assert first.json["dest"] == str(tmp_path / "my backup")
    assert first.json["snapshot"]["counts"]["scenes"] == 3
    cli("remove", site, "left")
    second = cli("backup", site, dest)
    assert (second.code, second.stdout) == (0, "")
    assert "of which" in second.stderr
    listed = cli("backup", tmp_path / "gone.gsmap", dest, "--list", "--json").json["snapshots"]
    assert [row["counts"]["scenes"] for row in listed] == [3, 2]
    assert first.json["snapshot"] == listed[0]
    assert "bytes" in cli("backup", site, dest, "--list").stdout

    done = cli("restore", dest, tmp_path / "r.gsmap", "--at", listed[0]["snapshot"])
    assert (done.code, done.stdout) == (0, "")
    assert f"as of {listed[0]['created_at']}" in done.stderr
    assert cli("list", tmp_path / "r.gsmap", "scenes", "--json").json == before
    assert cli("check", tmp_path / "r.gsmap").code == 0
    local = listed[0]["created_at"].replace("+00:00", "Z")
    assert cli("restore", dest, tmp_path / "r2.gsmap", "--at", local, "--json").json["needs_migration"] is False
    assert len(cli("list", tmp_path / "r2.gsmap", "scenes", "--json").json["scenes"]) == 3
    assert cli("restore", dest, tmp_path / "r3.gsmap").code == 0
    assert len(cli("list", tmp_path / "r3.gsmap", "scenes", "--json").json["scenes"]) == 2

    newest = max((tmp_path / "my backup" / "snapshots").iterdir())
    newest.write_bytes(newest.read_bytes()[:-9])
    damaged = cli("backup", site, dest, "--list", "--json")
    assert (damaged.code, damaged.json["snapshots"]) == (1, listed[:1])
    assert newest.name in damaged.stderr


def test_what_goes_wrong_is_one_line(site: Path, tmp_path: Path, cli: Run) -> None:
    assert cli("backup", site, tmp_path / "b").code == 0
    for code, line in (
        (1, ("restore", tmp_path / "b", site)),
        (1, ("restore", tmp_path / "b", tmp_path / "r", "--at", "2001-01-01")),
        (1, ("restore", tmp_path / "b", tmp_path / "r", "--at", "yesterday")),
        (1, ("restore", tmp_path / "nowhere", tmp_path / "r")),
        (2, ("backup", site, "ftp://host/folder")),
        (2, ("backup", site, "s3://key:secret@bucket/folder")),
        (2, ("backup", site, tmp_path / "b", "--keep", "0")),
        (1, ("backup", site, tmp_path)),
        (1, ("clone", site, tmp_path / "b")),
    ):
        said = cli(*line)
        assert (said.code, said.stdout) == (code, ""), said.stderr
        assert said.stderr.startswith("gsmap: ")
        assert said.stderr.count("\n") == 1
        assert "secret" not in said.stderr
    assert cli("backup", site, tmp_path / "b", "--list", "--keep", "1").code == 2
    assert not (tmp_path / "r").exists()


def test_damage_that_cannot_be_mended_is_exit_code_1(site: Path, tmp_path: Path, cli: Run) -> None:
    cli("backup", site, tmp_path / "b")
    broken = _object_of(tmp_path / "b", site, "*/arrays.zip")
    broken.write_bytes(b"x" * broken.stat().st_size)
    mended = cli("backup", site, tmp_path / "b", "--verify", "--json")
    assert (mended.code, mended.json["problems"]) == (0, [])
    for name in ("left", "right", "odd:one"):
        cli("remove", site, name)
    cli("prune", site, "--keep-revisions", 0)
    broken.write_bytes(b"x" * broken.stat().st_size)
    lost = cli("backup", site, tmp_path / "b", "--verify")
    assert lost.code == 1
    assert broken.name in lost.stdout
    assert "snapshot" in lost.stderr


def test_a_clone_goes_its_own_way(site: Path, tmp_path: Path, cli: Run) -> None:
    made = cli("clone", site, tmp_path / "c.gsmap", "--json").json
    assert made["map_id"] != made["source_map_id"]
    before = cli("list", site, "scenes", "--json").json
    assert cli("list", tmp_path / "c.gsmap", "scenes", "--json").json == before
    cli("remove", tmp_path / "c.gsmap", "left")
    assert cli("list", site, "scenes", "--json").json == before
    assert cli("status", tmp_path / "c.gsmap", "--json").code == 0
    assert cli("list", tmp_path / "c.gsmap", "tiles", "--json").json["tiles"] == []
