"""The parts that keep gsmap inside a folder, each by itself."""

from __future__ import annotations

import fcntl
import json
import os
import stat
import time
from pathlib import Path

import numpy as np
import pytest
from hostile_world import everything_in, make_cameras, make_gaussians
from raising import raises

from gsmap import durable
from gsmap.errors import ConfigError, CorruptError, StoreError
from gsmap.store import Store, layout, sqlite, trust
from gsmap.store.arrays import Arrays
from gsmap.texts import control_characters, escaped


@pytest.fixture
def home(tmp_path: Path) -> Path:
    (tmp_path / "home" / "photos").mkdir(parents=True)
    (tmp_path / "home" / "photos" / "1.jpg").write_bytes(b"1")
    return tmp_path / "home"


@pytest.fixture
def root(tmp_path: Path) -> Path:
    (tmp_path / "root" / "a" / "b").mkdir(parents=True)
    (tmp_path / "root" / "a" / "b" / "c").write_bytes(b"c")
    return tmp_path / "root"


@pytest.mark.guards("security")
def test_deleting_follows_no_link(home, root):
    before = everything_in(home)
    (root / "a" / "inner").symlink_to(home / "photos")
    (root / "out").symlink_to(home)
    for function in (durable.remove_tree, durable.remove_file):
        with raises(CorruptError, code="link_refused"):
            function(root, "out", "photos", "1.jpg")
        with raises(CorruptError, code="link_refused"):
            function(root, "a", "inner", "1.jpg")
    durable.remove_empty_folder(root, "a", "b")
    assert (root / "a" / "b" / "c").exists()
    durable.remove_tree(root, "out")  # the link itself
    durable.remove_tree(root, "a")
    assert list(root.iterdir()) == []
    assert everything_in(home) == before


def test_a_root_that_is_a_link_is_the_persons_own_doing(root, tmp_path):
    (tmp_path / "short").symlink_to(root)
    durable.remove_file(tmp_path / "short", "a", "b", "c")
    assert list((root / "a" / "b").iterdir()) == []


@pytest.mark.parametrize("name", ["..", ".", "", "a/b", "/etc", "a\0b"])
@pytest.mark.guards("security")
def test_a_name_is_one_part_of_a_path(root, name):
    for function in (durable.remove_tree, durable.remove_file, durable.refuse_links):
        with raises(CorruptError, code="invalid_stored_name"):
            function(root, "a", name)
    assert (root / "a" / "b" / "c").exists()


def test_what_is_missing_is_no_error(root):
    durable.remove_tree(root, "none", "x")
    durable.remove_file(root, "none", "x")
    durable.remove_file(root, "a", "none")
    durable.refuse_links(root, "none", "x")
    assert durable.files_below(root / "none") == {}
    assert list(durable.files_below(root)) == ["a/b/c"]


@pytest.mark.guards("security")
def test_only_plain_files_are_opened(home, root):
    (root / "link").symlink_to(home / "photos" / "1.jpg")
    os.mkfifo(root / "pipe")
    for name in ("link", "pipe", "a"):
        with raises(CorruptError, code="not_a_plain_file"):
            durable.open_file(root / name)
    with pytest.raises(FileNotFoundError):
        durable.open_file(root / "none")


@pytest.mark.parametrize(("kind", "name"), [("..", "0" * 32), ("scenes", ".."), ("staging", "0" * 32), ("scenes", "x")])
@pytest.mark.guards("security")
def test_a_group_has_a_kind_and_a_digest(tmp_path, kind, name):
    arrays = Arrays(tmp_path / "arrays")
    for call in (
        arrays.drop,
        arrays.size_bytes,
        lambda *at: arrays.read(*at, ()),
        lambda *at: arrays.problems(*at, ()),
    ):
        with raises(CorruptError, code="invalid_stored_name"):
            call(kind, name)


def test_a_group_is_laid_out_as_it_is_checked(tmp_path, monkeypatch):
    """Every size around a chunk, so that what gsmap writes is never refused."""
    monkeypatch.setattr("gsmap.store.arrays.CHUNK_ROWS", 16)
    arrays = Arrays(tmp_path / "arrays")
    rng = np.random.default_rng(0)
    for n in (0, 1, 15, 16, 17, 48, 130):
        made = {"x": rng.normal(size=(n, 3)).astype(np.float32), "zeros": np.zeros((n, 2, 3)), "none": np.zeros((n, 0))}
        made["flags"] = np.zeros(n, bool)
        name = f"{n:032x}"
        with arrays.stage(made, "scenes", name) as staged:
            arrays.publish(staged, "scenes", name)
        assert arrays.problems("scenes", name, staged.files) == []
        read = arrays.read("scenes", name, staged.files, shapes={"x": (n, 3), "none": (None, 0)})
        assert all((read[key] == made[key]).all() for key in made)
        if n:
            with raises(CorruptError, code="arrays_corrupt"):
                arrays.read("scenes", name, staged.files, shapes={"x": (n + 1, 3)})


def test_what_a_chunk_unpacks_to():
    from numcodecs.zstd import Zstd

    for size in (0, 1, 255, 256, 65_791, 65_792, 1_000_000):
        assert layout._unpacked_bytes(Zstd().encode(bytes(size))[:18]) == size
    assert layout._unpacked_bytes(b"") == -1
    assert layout._unpacked_bytes(b"\x28\xb5\x2f\xfd\xe4") == -1


def test_what_a_killed_init_left_goes_with_the_next(tmp_path):
    ours, held, other = (tmp_path / f".site.gsmap.{digits}" for digits in ("0badcafe", "1badcafe", "2badcafe"))
    for folder in (ours, held, other):
        (folder / "arrays").mkdir(parents=True)
    (ours / "map.sqlite").touch()
    (other / "letters").touch()  # nobody's map
    (tmp_path / ".other.gsmap.0badcafe").mkdir()
    handle = os.open(held, os.O_RDONLY)
    fcntl.flock(handle, fcntl.LOCK_EX)  # another process is at it
    Store.create(tmp_path / "site.gsmap").close()
    os.close(handle)
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {"site.gsmap", held.name, other.name, ".other.gsmap.0badcafe"}


def test_a_reader_waits_for_no_lock_that_a_link_leads_to(tmp_path):
    with Store.create(tmp_path / "m") as store, open(tmp_path / "theirs", "w") as theirs:
        store.catalog.patience_s = 0.1
        (store.folder / "lock").unlink()
        (store.folder / "lock").symlink_to(tmp_path / "theirs")
        fcntl.flock(theirs, fcntl.LOCK_EX)
        with store.catalog.pause_writers():
            pass
        (store.folder / "lock").unlink()


def test_prune_takes_what_a_killed_replacement_left(tmp_path):
    with Store.create(tmp_path / "m") as store:
        old, young, mine = ".settings.toml.0badcafe", ".settings.toml.1badcafe", ".notes.0badcafe"
        for name in (old, ".map.sqlite.sha256", young, mine):
            (store.folder / name).write_bytes(b"12345")
            os.utime(store.folder / name, (time.time() - 3600,) * 2)
        os.utime(store.folder / young)
        assert store.prune(dry_run=True).num_bytes == 10
        assert store.prune().num_bytes == 10
        assert {young, mine} == {p.name for p in store.folder.iterdir() if p.name.startswith(".")}


def test_whom_the_user_trusts_is_the_users_own_file(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    trust.trust("0" * 32, "postgresql://me@here/a")
    trust.trust("1" * 32, "postgresql://me@here/b")
    trust.trust("1" * 32, "postgresql://me@here/b")
    assert trust.trusted_urls() == {"0" * 32: ("postgresql://me@here/a",), "1" * 32: ("postgresql://me@here/b",)}
    assert stat.S_IMODE(trust.config_file().stat().st_mode) == 0o600
    for text in ("[]", '{"catalogs": {"0": 5}}', '{"catalogs": {"0": [5]}}', "[" * 100_000):
        trust.config_file().write_text(text)
        with raises(StoreError, code="trust_file_unreadable"):
            trust.trusted_urls()


@pytest.mark.guards("security")
def test_a_map_that_was_restored_to_another_database_leaves_the_first_one_trusted(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    trust.config_file().parent.mkdir()
    trust.config_file().write_text(json.dumps({"catalogs": {"0" * 32: "postgresql://me@here/a"}}))  # of an older gsmap
    trust.trust("0" * 32, "postgresql://me@here/b")
    for database, known in (("a", True), ("b", True), ("c", False)):
        assert trust.is_trusted(trust.CatalogAddress(f"postgresql://me@here/{database}", "0" * 32)) == known
    assert not trust.is_trusted(trust.CatalogAddress("postgresql://me@here/a", "1" * 32))
    assert not trust.is_trusted(trust.CatalogAddress("postgresql://me@here/a", None))


def test_where_a_remembered_catalog_lies(tmp_path):
    url = "postgresql+psycopg://me@/site?host=/run/pg&port=5433"
    trust.write(tmp_path, url, "0" * 32)
    found = trust.read_address(tmp_path)
    assert (found.server, found.database, found.user) == ("/run/pg, port 5433", "site", "me")
    (tmp_path / "catalog.url").write_text("postgresql://a@good,evil/x?hostaddr=10.0.0.1\n")
    assert trust.read_address(tmp_path).server == "good,evil, 10.0.0.1"


def test_only_postgresql_holds_a_catalog(tmp_path):
    with raises(ConfigError, code="invalid_catalog_url"):
        Store.create(tmp_path / "m", catalog_url=f"sqlite:///{tmp_path}/other.sqlite")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("ending", ["", "-wal", "-shm", "-journal"])
def test_sqlite_opens_no_link(tmp_path, home, ending):
    """Branches and others are opened without opening a store."""
    sqlite.create_file(tmp_path / "map.sqlite")
    file = tmp_path / f"map.sqlite{ending}"
    file.unlink(missing_ok=True)
    file.symlink_to(home / "photos" / "1.jpg")
    with raises(CorruptError, code="link_refused"):
        sqlite.engine(tmp_path / "map.sqlite", writable=False)


def test_texts():
    assert escaped("plain, ä, 日本, 👩‍🚀") == "plain, ä, 日本, 👩‍🚀"
    assert escaped("a\x1b[2J\r\n\x7f\x9b\u202e\u2028\udcff") == r"a\x1b[2J\r\n\x7f\x9b\u202e\u2028\udcff"
    assert escaped("a\nb\x07", lines=True) == "a\nb\\x07"
    assert control_characters("tab\there") == ["\t"]


def test_a_link_is_refused_in_a_map_and_not_as_a_map(tmp_path):
    with Store.create(tmp_path / "m") as store:
        store.scenes.add(make_gaussians(1), make_cameras(), name="a")
    (tmp_path / "short").symlink_to(tmp_path / "m")
    with Store.open(tmp_path / "short") as store:
        assert len(store.scenes.gaussians("a")) == 300
        assert store.check().ok
    (tmp_path / "m" / "notes").symlink_to(tmp_path)
    with raises(CorruptError, code="not_a_plain_file"):
        Store.open(tmp_path / "m")
