"""Branches, merges and purges of maps that lead elsewhere."""

from __future__ import annotations

import json
import shutil
import sqlite3
from pathlib import Path

from hostile_world import World, case

import gsmap.map
from gsmap.store import page_digests

OVER_ALL = (
    "list MAP scenes",
    "check MAP",
    "branch MAP",
    "prune MAP --keep-revisions 0",
    "list MAP@b scenes",
    "clone MAP HOME/../cloned.gsmap",
    "backup MAP HOME/../backup",
    "remove MAP a --purge --branches",
    "migrate MAP",
)
TAKEN_IN = ("merge INTO MAP", "clone MAP HOME/../cloned.gsmap", "split MAP HOME/../half.gsmap --scenes a")


def _branch(w: World) -> Path:
    with gsmap.map.open(w.map) as m:
        m.branch("b")
    return w.map / "branches" / "b"


def _set(file: Path, statement: str, *values: object) -> None:
    connection = sqlite3.connect(file, isolation_level=None)
    connection.execute("PRAGMA foreign_keys = OFF")
    connection.execute(statement, values)
    connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    connection.close()
    page_digests.write_digests(file)


@case(r"is a link", verbs=OVER_ALL)
def branches_that_lie_elsewhere(w: World) -> None:
    _branch(w)
    shutil.move(w.map / "branches", w.home / "branches")
    (w.map / "branches").symlink_to(w.home / "branches")


@case(verbs=OVER_ALL, works=("list MAP scenes",))
def a_branch_that_lies_elsewhere(w: World) -> None:
    shutil.move(_branch(w), w.home / "b")
    (w.map / "branches" / "b").symlink_to(w.home / "b")


@case(verbs=OVER_ALL, works=("list MAP scenes",))
def a_branch_whose_catalog_is_a_link(w: World) -> None:
    w.replaced(_branch(w) / "map.sqlite", w.home / "mine.gsmap" / "map.sqlite")


@case(r"is a link", verbs=OVER_ALL, works=("list MAP scenes",))
def a_branch_whose_log_is_a_link(w: World) -> None:
    w.replaced(_branch(w) / "map.sqlite-wal", w.home / "thesis.txt")


@case(r"the catalog holds|gsmap did not", verbs=OVER_ALL, works=("list MAP scenes",))
def a_branch_with_a_group_that_leads_upwards(w: World) -> None:
    file = _branch(w) / "map.sqlite"
    _set(file, "INSERT INTO groups VALUES ('../../../home/photos', 'scenes', '2026')")


@case(verbs=OVER_ALL)
def a_branch_that_says_nonsense_of_itself(w: World) -> None:
    (_branch(w) / "branch.json").write_text("[" * 100_000)


@case(r"models.path.*gsmap did not write", verbs=TAKEN_IN)
def a_map_to_take_in_whose_model_leads_upwards(w: World) -> None:
    w.set("UPDATE models SET path = 'models/../../home/thesis.txt'")


@case(r"models.path.*gsmap did not write", verbs=TAKEN_IN)
def a_map_to_take_in_whose_model_is_an_absolute_path(w: World) -> None:
    w.set("UPDATE models SET path = ?", str(w.home / "photos" / "new.onnx"))


@case(r"the catalog holds|gsmap did not", verbs=TAKEN_IN)
def a_map_to_take_in_whose_files_lead_upwards(w: World) -> None:
    w.set("UPDATE files SET path = '../../../../home/thesis.txt' WHERE path = 'arrays.zip'")


@case(r"the catalog holds|gsmap did not", verbs=TAKEN_IN)
def a_map_to_take_in_whose_groups_lead_upwards(w: World) -> None:
    w.set("UPDATE groups SET id = '../../../home/photos' || rowid WHERE kind = 'scenes'")
    w.set("UPDATE scenes SET group_id = '../../../home/photos1' WHERE name = 'a'")


@case(r"not a regular file|is a link|missing", verbs=TAKEN_IN)
def a_map_to_take_in_whose_chunks_are_links(w: World) -> None:
    for group in (w.map / "arrays" / "scenes").iterdir():
        chunk = group / "arrays.zip"
        shutil.move(chunk, w.home / f"chunk_{group.name}")
        chunk.symlink_to(w.home / f"chunk_{group.name}")


@case(verbs=("remove MAP a --purge", "remove MAP b --purge"), works=("remove MAP a --purge",))
def a_purge_of_folders_of_others(w: World) -> None:
    w.set("UPDATE exports SET target = ?", str(w.home / "photos"))
    receipt = {"rows": {}, "pending": {"targets": [str(w.home), str(w.home / "photos")]}, "backups": []}
    w.set("INSERT INTO purges (scene, receipt, created_at) VALUES (?, ?, '2026')", w.id_of("b"), json.dumps(receipt))


@case(verbs=("remove MAP a --purge", "check MAP"), works=("remove MAP a --purge", "check MAP"))
def a_purge_that_takes_the_catalog_for_a_copy(w: World) -> None:
    pending = {"targets": [], "copies": ["map.sqlite", "settings.toml"], "groups": {}, "tiles": {}}
    receipt = {"rows": {}, "pending": pending, "backups": []}
    w.set("INSERT INTO purges (scene, receipt, created_at) VALUES (?, ?, '2026')", w.id_of("b"), json.dumps(receipt))
