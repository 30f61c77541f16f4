"""``gsmap check`` and ``prune``: what they say of a catalog that differs, that a person accepts, that shrinks."""

import sqlite3

import pytest

import gsmap.map
from gsmap.cli.app import run
from gsmap.types import PoseGraph


@pytest.fixture
def path(tmp_path):
    gsmap.map.create(tmp_path / "site.gsmap").close()
    return tmp_path / "site.gsmap"


def said(capfd, *arguments: str) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as caught:
        run(list(arguments))
    out, err = capfd.readouterr()
    return caught.value.code or 0, out, err


def test_a_catalog_that_another_program_changed(path, capfd):
    with sqlite3.connect(path / "map.sqlite") as connection:
        connection.execute("UPDATE about SET gsmap_version = '0.0'")
    connection.close()
    for words in (["list", "scenes"], ["check"], ["prune"]):
        code, _, err = said(capfd, words[0], str(path), *words[1:])
        assert code == 1
        assert "page " in err
        assert "differs from what gsmap wrote" in err
        assert "--accept-catalog" in err
    code, _, err = said(capfd, "check", str(path), "--accept-catalog")
    assert code == 0
    assert "ACCEPTED: page " in err
    assert "values may be wrong" in err
    code, _, err = said(capfd, "check", str(path), "--accept-catalog")
    assert code == 0
    assert "nothing to accept" in err
    assert f"{path} is intact" in said(capfd, "check", str(path))[2]


def test_a_catalog_that_cannot_be_verified_is_not_called_whole(path, capfd):
    (path / "map.sqlite.digests").unlink()
    code, out, err = said(capfd, "check", str(path))
    assert code == 0
    assert out.startswith("cannot verify the catalog: ")
    assert "is intact" not in err


def test_revisions_that_follow_one_another_are_dropped_in_one_line(path, capfd):
    with gsmap.map.open(path) as m:
        for _ in range(5):
            m.store.revisions.save(PoseGraph({}))
    _, _, err = said(capfd, "prune", str(path), "--keep-revisions", "3")
    assert err.splitlines() == ["dropped revisions 1 to 2"]
    _, _, err = said(capfd, "prune", str(path), "--keep-revisions", "2")
    assert err.splitlines() == ["dropped revision 3"]
