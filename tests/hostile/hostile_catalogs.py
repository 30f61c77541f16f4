"""Catalogs whose rows, tables and URLs say what gsmap would never have written."""

from __future__ import annotations

import json
import os
import shutil
import struct

from hostile_world import ALL, Plant, World, case

ROWS = r"the catalog holds .* gsmap did not write"
TABLES = r"its catalog has .*gsmap does not write"


@case(verbs=ALL, works=ALL)
def nothing_at_all(w: World) -> None:
    """What the others are measured by: on the good map every verb works."""


# --- paths -----------------------------------------------------------------------------------------------------------


@case(ROWS)
def a_group_that_is_an_absolute_path(w: World) -> None:
    w.set("INSERT INTO groups VALUES (?, 'scenes', '2026')", str(w.home / "photos"))


@case(ROWS)
def a_group_that_leads_upwards(w: World) -> None:
    w.set("INSERT INTO groups VALUES ('../../../home/photos', 'scenes', '2026')")


@case(ROWS)
def a_kind_that_leads_upwards(w: World) -> None:
    w.set("INSERT INTO groups VALUES (?, '../../home', '2026')", "0" * 32)


@case(ROWS)
def a_kind_that_is_an_absolute_path(w: World) -> None:
    w.set("INSERT INTO groups VALUES ('photos', ?, '2026')", str(w.home))


@case(ROWS)
def a_kind_that_is_the_staging(w: World) -> None:
    w.set("INSERT INTO groups VALUES (?, 'staging', '2026')", "0" * 32)


@case(ROWS)
def a_scene_whose_arrays_lie_elsewhere(w: World) -> None:
    w.set("UPDATE scenes SET group_id = ? WHERE name = 'a'", str(w.home / "mine.gsmap"))


@case(ROWS)
def a_scene_with_a_path_for_an_id(w: World) -> None:
    w.set("UPDATE scenes SET id = '../../home' WHERE name = 'a'")


@case(ROWS, verbs=("check MAP", "prune MAP", "changes MAP"))
def a_comparison_whose_arrays_lie_elsewhere(w: World) -> None:
    w.set("UPDATE comparisons SET group_id = '../../../home/photos'")


@case(ROWS, verbs=("changes MAP", "show MAP c1", "status MAP"))
def a_change_of_a_kind_that_there_is_not(w: World) -> None:
    w.set("UPDATE changes SET kind = '../../home'")


@case(ROWS, verbs=("changes MAP", "show MAP c1", "status MAP"))
def a_change_without_a_box(w: World) -> None:
    w.set("UPDATE changes SET box = '[1, 2]'")


@case(ROWS)
def a_graph_whose_arrays_lie_elsewhere(w: World) -> None:
    w.set("UPDATE results SET group_id = '../../../home/photos'")


@case(ROWS)
def a_file_of_a_group_with_an_absolute_path(w: World) -> None:
    w.set("UPDATE files SET path = ? WHERE path = 'arrays.zip'", str(w.home / "thesis.txt"))


@case(ROWS)
def a_file_of_a_group_that_leads_upwards(w: World) -> None:
    w.set("UPDATE files SET path = '../../../../home/thesis.txt' WHERE path = 'arrays.zip'")


@case(r"models.path.*gsmap did not write", works=("list MAP scenes",))
def a_model_that_leads_upwards(w: World) -> None:
    w.set("UPDATE models SET path = 'models/../../home/thesis.txt'")


@case(r"models.path.*gsmap did not write")
def a_copied_model_with_an_absolute_path(w: World) -> None:
    w.set("UPDATE models SET path = ?, removed_at = NULL", str(w.home / "thesis.txt"))


@case(r"differs from the file that was added", works=("list MAP scenes", "models list MAP"))
def a_model_elsewhere_that_is_no_model(w: World) -> None:
    w.set("UPDATE models SET path = ?, copied = 0", str(w.home / "thesis.txt"))


@case(r"is not a regular file", works=("list MAP scenes",))
def a_model_elsewhere_that_is_a_device(w: World) -> None:
    w.set("UPDATE models SET path = '/dev/zero', copied = 0")


@case(r"is not a regular file", works=("list MAP scenes",))
def a_model_elsewhere_that_is_a_pipe(w: World) -> None:
    os.mkfifo(w.root / "pipe.onnx")
    w.set("UPDATE models SET path = ?, copied = 0", str(w.root / "pipe.onnx"))


@case(ROWS, verbs=("list MAP tiles", "status MAP", "export MAP TILES"))
def a_tile_of_the_catalog_that_leads_upwards(w: World) -> None:
    w.set("UPDATE tiles SET path = '../../home/thesis.txt'")


@case(verbs=ALL, works=("list MAP scenes", "status MAP", "check MAP"))
def exports_to_other_folders(w: World) -> None:
    w.set("UPDATE exports SET target = ?", str(w.home / "photos"))


# --- words -----------------------------------------------------------------------------------------------------------

_WORDS = "\x1b]0;owned\x07\x1b[2J\nfake row\r\u202e\x9b31m"


@case(
    verbs=(*ALL, "show MAP IDA"), works=("list MAP scenes", "list MAP edges", "show MAP IDA", "status MAP", "check MAP")
)
def names_and_notes_that_steer_the_terminal(w: World) -> None:
    w.set("UPDATE scenes SET name = ? WHERE name = 'a'", f"a{_WORDS}")
    w.set("UPDATE scenes SET notes = ?, source = ?", json.dumps([_WORDS]), _WORDS)
    w.set("UPDATE scene_facts SET value = ?, author = ?", _WORDS, _WORDS)
    w.set("UPDATE reviews SET note = ?", _WORDS)
    w.set("UPDATE revisions SET note = ?, notes = ?", _WORDS, json.dumps([_WORDS]))
    w.set("UPDATE registrations SET reason = ?, proposer = ?, evidence = ?", _WORDS, _WORDS, json.dumps({_WORDS: 1}))
    w.set("UPDATE poses SET status = ?", _WORDS)
    w.set("UPDATE comparisons SET notes = ?", json.dumps([_WORDS]))
    w.set("UPDATE changes SET evidence = ?", json.dumps({_WORDS: 1}))
    w.set("UPDATE change_reviews SET note = ?", _WORDS)


@case(works=("list MAP scenes", "models list MAP"))
def a_model_whose_name_steers_the_terminal(w: World) -> None:
    w.set("UPDATE models SET name = ?, kind = ?", _WORDS, _WORDS)


@case(r"\\x1b")
def a_group_whose_name_steers_the_terminal(w: World) -> None:
    w.set("INSERT INTO groups VALUES (?, 'scenes', '2026')", _WORDS)


@case(r"\\x1b")
def files_whose_names_steer_the_terminal(w: World) -> None:
    (w.map / "arrays" / "a\x1b[31m\nb").mkdir()
    (w.group() / "c\x1b[31m").write_bytes(b"x")
    (w.map / "models" / "d\x1b[31m").mkdir()


# --- values ----------------------------------------------------------------------------------------------------------


@case(ROWS)
def json_that_is_none(w: World) -> None:
    w.set("UPDATE results SET about = '{'")


@case(ROWS)
def json_that_is_too_deep(w: World) -> None:
    w.set("UPDATE scenes SET notes = ?", "[" * 200_000)


@case(ROWS)
def json_of_another_shape(w: World) -> None:
    w.set("UPDATE results SET about = '[1, 2]'")
    w.set("UPDATE scenes SET bounds = '\"wide\"'")


@case(ROWS, verbs=ALL)
def poses_of_another_shape(w: World) -> None:
    w.set("UPDATE poses SET S_map_scene = ?", b"\0" * 96)


@case(ROWS)
def poses_of_nan(w: World) -> None:
    w.set("UPDATE poses SET S_map_scene = ?", struct.pack("<13d", *[float("nan")] * 9, 0, 0, 0, 1))


@case(ROWS)
def poses_that_are_no_rotation(w: World) -> None:
    w.set("UPDATE poses SET S_map_scene = ?", struct.pack("<13d", *[2.0] * 9, 0, 0, 0, 1))


@case(ROWS)
def covariances_of_infinity(w: World) -> None:
    w.set("UPDATE poses SET covariance = ?", struct.pack("<28d", *[float("inf")] * 28))


@case(ROWS, verbs=("list MAP edges",))
def information_that_is_not_symmetric(w: World) -> None:
    w.set("UPDATE registrations SET information = ?", struct.pack("<49d", *range(49)))


@case(r"lacks a row or has a duplicate row", verbs=("export MAP TILES --tile-size 0",))
def a_map_without_an_id(w: World) -> None:
    w.set("DELETE FROM about")


@case(verbs=ALL, works=("list MAP scenes",))
def edges_and_poses_of_scenes_that_are_not_there(w: World) -> None:
    w.set("UPDATE registrations SET source = ?, pair = ?", "f" * 32, f"{w.id_of('a')}:{'f' * 32}")
    w.set("UPDATE poses SET scene = ? WHERE scene = ?", "e" * 32, w.id_of("b"))
    w.set("UPDATE results SET scene = ?", "d" * 32)


# --- tables ----------------------------------------------------------------------------------------------------------


@case(TABLES)
def a_trigger(w: World) -> None:
    w.set(
        "CREATE TRIGGER t AFTER UPDATE ON scenes BEGIN INSERT INTO groups VALUES ('/home', 'scenes', '2026'); "
        "DELETE FROM revisions; END"
    )


@case(TABLES)
def a_view_in_the_place_of_a_table(w: World) -> None:
    w.set("ALTER TABLE groups RENAME TO real_groups")
    w.set("CREATE VIEW groups AS SELECT '/home' AS id, 'scenes' AS kind, '2026' AS created_at")


@case(TABLES)
def a_table_whose_types_are_not_kept_to(w: World) -> None:
    w.loosen("scenes")
    w.set("UPDATE scenes SET num_gaussians = 'many'")


@case(TABLES)
def a_table_with_other_types(w: World) -> None:
    w.loosen("models", "copied INTEGER", "copied TEXT")


# --- SQLite's own files ----------------------------------------------------------------------------------------------


@case(r"names another file for SQLite to delete")
def a_journal_that_has_sqlite_delete_a_file(w: World) -> None:
    """A rollback journal of one page whose super-journal is a file of the person's: SQLite deletes it after rolling
    back, since nothing in it names another database."""
    name = str(w.home / "thesis.txt").encode()
    page = (w.map / "map.sqlite").stat().st_size // 4096
    header = bytes.fromhex("d9d505f920a163d7") + b"".join(n.to_bytes(4, "big") for n in (0, 0, page, 512, 4096))
    check = sum(name) & 0xFFFFFFFF
    tail = (1 + 0x40000000 // 4096).to_bytes(4, "big") + name + len(name).to_bytes(4, "big") + check.to_bytes(4, "big")
    (w.map / "map.sqlite-journal").write_bytes(header.ljust(512, b"\0") + tail + bytes.fromhex("d9d505f920a163d7"))


def _linked(name: str, target: str) -> Plant:
    def plant(w: World) -> None:
        w.replaced(w.map / name, w.home / target)

    plant.__name__ = f"{name}_that_is_a_link".replace(".", "_")
    return plant


for _name, _target in {
    "map.sqlite": "mine.gsmap/map.sqlite",
    "map.sqlite-wal": "thesis.txt",
    "map.sqlite-shm": "thesis.txt",
    "map.sqlite-journal": "thesis.txt",
    "map.sqlite.sha256": "thesis.txt",
    "lock": "thesis.txt",
    "settings.toml": "settings.toml",
    "models": "photos/2019",
    "arrays": "mine.gsmap/arrays",
}.items():
    case(r"is a link", verbs=("list MAP scenes", "prune MAP", "settings MAP --set merge.method=union"))(
        _linked(_name, _target)
    )


@case(r"is a pipe or a device")
def settings_that_are_a_pipe(w: World) -> None:
    os.mkfifo(w.map / "settings.toml")


@case(r"is a pipe or a device")
def a_lock_that_is_a_pipe(w: World) -> None:
    (w.map / "lock").unlink(missing_ok=True)
    os.mkfifo(w.map / "lock")


# --- catalogs on servers ---------------------------------------------------------------------------------------------


def _remote(w: World, *lines: str) -> None:
    (w.map / "map.sqlite").unlink()
    (w.map / "catalog.url").write_text("".join(f"{line}\n" for line in lines))


@case(r"does not name a PostgreSQL database")
def a_catalog_that_is_another_map(w: World) -> None:
    _remote(w, f"sqlite:///{w.home}/mine.gsmap/map.sqlite")


@case(r"not trusted yet: run gsmap trust", verbs=("list MAP scenes", "remove MAP a", "prune MAP", "trust MAP"))
def a_catalog_on_a_server_that_collects_passwords(w: World) -> None:
    _remote(w, f"postgresql+psycopg://bob@127.0.0.1:{w.environment['PORT']}/x", "0" * 32)


@case(r"not trusted yet: run gsmap trust", verbs=("list MAP scenes", "trust MAP"))
def a_catalog_on_such_a_server_as_older_maps_name_it(w: World) -> None:
    _remote(w, f"postgresql://bob@127.0.0.1:{w.environment['PORT']}/x")


@case(r"does not name a PostgreSQL database")
def a_catalog_of_another_kind_of_server(w: World) -> None:
    _remote(w, f"mysql+pymysql://bob@127.0.0.1:{w.environment['PORT']}/x", "0" * 32)


@case(r"does not name a PostgreSQL database")
def a_catalog_url_full_of_escapes(w: World) -> None:
    _remote(w, "postgresql://\x1b[31mbob@127.0.0.1/x", "0" * 32)


@case(r"does not name a PostgreSQL database")
def a_catalog_url_without_an_end(w: World) -> None:
    _remote(w, "postgresql://" + "x" * 10_000)


@case(r"is a link")
def a_catalog_url_that_is_a_link(w: World) -> None:
    (w.map / "map.sqlite").unlink()
    (w.map / "catalog.url").symlink_to(w.home / "thesis.txt")


@case(r"holds nothing|not a gsmap map|is a link|damaged|gsmap (did|does) not")
def a_map_that_is_only_links(w: World) -> None:
    shutil.rmtree(w.map)
    w.map.mkdir()
    (w.map / "map.sqlite").symlink_to(w.home / "mine.gsmap" / "map.sqlite")
    (w.map / "arrays").symlink_to(w.home / "mine.gsmap" / "arrays")
