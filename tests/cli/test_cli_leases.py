"""What verbs say of others that are at work."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from gsmap.export.lock import LOCK_FILE, folder_lock
from gsmap.store import Store


def test_a_second_export_to_a_folder_says_who_is_at_it(cli: Callable[..., Any], site: Path, tmp_path: Path) -> None:
    out = tmp_path / "tiles"
    with folder_lock(out):
        (out / ".partial").mkdir()
        done = cli("export", site, out, "--merge", "union")
        assert done.code == 1
        assert f"gsmap export (process {os.getpid()} on " in done.stderr
        assert "--wait" in done.stderr
        assert sorted(path.name for path in out.iterdir()) == [LOCK_FILE, ".partial"]
    done = cli("export", site, out, "--merge", "union", "--wait")
    assert done.code == 0
    assert LOCK_FILE not in os.listdir(out)


def test_status_says_who_is_at_work(cli: Callable[..., Any], site: Path) -> None:
    assert cli("status", site, "--json").json["at_work"] == []
    with Store.open(site) as store, store.leases.announce("update"):
        (row,) = cli("status", site, "--json").json["at_work"]
        assert (row["what"], row["task"], row["process"]) == ("map", "update", os.getpid())
        assert str(os.getpid()) in cli("status", site).stdout
        assert f"gsmap update (process {os.getpid()} on " in cli("describe", site).stderr
