"""Arrays, models and folders of a map that lead elsewhere, or that zarr would come to harm by."""

from __future__ import annotations

import json
import os
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from hostile_world import World, case
from zarr.storage import ZipStore

from gsmap.store import array_archive
from gsmap.store.layout import CHUNK_ROWS

READ = ("check MAP", "show MAP a", "export MAP TILES --tile-size 0 --merge voxel", "look MAP")
LAYOUT = r"gsmap did not write"

# --- links and pipes -------------------------------------------------------------------------------------------------


@case(r"is a link")
def scenes_that_lie_elsewhere(w: World) -> None:
    shutil.copytree(w.map / "arrays" / "scenes", w.home / "scenes")
    w.replaced(w.map / "arrays" / "scenes", w.home / "scenes")


@case(r"is a link")
def a_staging_that_lies_elsewhere(w: World) -> None:
    w.replaced(w.map / "arrays" / "staging", w.home / "photos")


@case(r"extra is not a file of the map", works=("list MAP scenes", "prune MAP --keep-revisions 0"))
def a_link_among_the_kinds(w: World) -> None:
    (w.map / "arrays" / "extra").symlink_to(w.home / "photos")


@case(r"is not a file of the map", works=("list MAP scenes", "prune MAP --keep-revisions 0"))
def a_link_among_the_groups(w: World) -> None:
    (w.map / "arrays" / "scenes" / ("0" * 32)).symlink_to(w.home / "photos")


@case(r"is not a file of the map", works=("list MAP scenes", "prune MAP --keep-revisions 0"))
def a_group_with_another_name(w: World) -> None:
    (w.map / "arrays" / "scenes" / "notes").mkdir()
    (w.map / "arrays" / "scenes" / "notes" / "x").write_bytes(b"x")


@case(works=("list MAP scenes", "prune MAP --keep-revisions 0"))
def an_orphan_full_of_links(w: World) -> None:
    orphan = w.map / "arrays" / "scenes" / ("0" * 32)
    (orphan / "deep").mkdir(parents=True)
    (orphan / "deep" / "link").symlink_to(w.home / "photos")
    (orphan / "file").symlink_to(w.home / "thesis.txt")
    (w.map / "arrays" / "staging" / "left").symlink_to(w.home / "photos")


@case(r"is a link")
def a_group_that_lies_elsewhere(w: World) -> None:
    group = w.group()
    shutil.move(group, w.home / "group")
    group.symlink_to(w.home / "group")


@case(r"not a regular file", works=("list MAP scenes",))
def a_chunk_that_is_a_link(w: World) -> None:
    for group in w.older_form():
        chunk = group / "means" / "c" / "0" / "0"
        shutil.move(chunk, w.home / f"chunk_{group.name}")
        chunk.symlink_to(w.home / f"chunk_{group.name}")


@case(r"missing or truncated|is missing", works=("list MAP scenes",))
def a_folder_of_chunks_that_is_a_link(w: World) -> None:
    for group in w.older_form():
        shutil.move(group / "means", w.home / f"means_{group.name}")
        (group / "means").symlink_to(w.home / f"means_{group.name}")


@case(r"not a regular file", works=("list MAP scenes",))
def a_chunk_that_is_a_pipe(w: World) -> None:
    for group in w.older_form():
        chunk = group / "sh" / "c" / "0" / "0" / "0"
        chunk.unlink()
        os.mkfifo(chunk)
        w.set("UPDATE files SET size_bytes = 0 WHERE path = 'sh/c/0/0/0'")


@case(r"is a link", works=("list MAP scenes", "remove MAP b"))
def a_model_that_is_a_link(w: World) -> None:
    for model in (w.map / "models").iterdir():
        w.replaced(model, w.home / "thesis.txt")


@case(r"is not a file of the map", works=("list MAP scenes", "prune MAP --keep-revisions 0"))
def a_folder_among_the_models(w: World) -> None:
    (w.map / "models" / "mine").mkdir()
    (w.map / "models" / "mine" / "net.onnx").write_bytes(b"x")


@case(works=("list MAP scenes", "prune MAP --keep-revisions 0"))
def a_forgotten_model_that_is_a_link(w: World) -> None:
    (w.map / "models" / "old.onnx").symlink_to(w.home / "thesis.txt")
    (w.map / "models" / "photos").symlink_to(w.home / "photos")


# --- zarr ------------------------------------------------------------------------------------------------------------


def _changed(w: World, change: Callable[[dict[str, Any]], None], array: str = "means") -> None:
    """Change the metadata of an array of every scene, and have the catalog agree."""
    for group in w.older_form():
        path = group / array / "zarr.json"
        about = json.loads(path.read_text())
        change(about)
        path.write_text(json.dumps(about))
        w.restated(path)


def _written(w: World, path: Path, data: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    w.restated(path)


@case(LAYOUT, verbs=READ)
def a_codec_of_somebody_else(w: World) -> None:
    _changed(w, lambda about: about["codecs"].append({"name": "numcodecs.pickle", "configuration": {}}))


@case(LAYOUT, verbs=READ)
def a_codec_that_zarr_has_and_gsmap_never_writes(w: World) -> None:
    _changed(w, lambda about: about.update(codecs=[{"name": "bytes"}, {"name": "gzip", "configuration": {"level": 1}}]))


@case(LAYOUT, verbs=READ)
def a_shape_that_the_catalog_contradicts(w: World) -> None:
    _changed(w, lambda about: about.update(shape=[10**11, 3]))


@case(LAYOUT, verbs=READ)
def a_shape_of_a_petabyte(w: World) -> None:
    _changed(w, lambda about: about.update(shape=[10**14, 3]))
    w.set("UPDATE scenes SET num_gaussians = ?", 10**14)


@case(LAYOUT, verbs=READ)
def a_chunk_of_a_petabyte(w: World) -> None:
    def change(about: dict[str, Any]) -> None:
        about["chunk_grid"]["configuration"]["chunk_shape"] = [10**14, 3]

    _changed(w, change)


@case(LAYOUT, verbs=READ)
def chunks_within_chunks_of_a_petabyte(w: World) -> None:
    def change(about: dict[str, Any]) -> None:
        inner = {"name": "sharding_indexed", "configuration": {"chunk_shape": [1, 3], "codecs": about["codecs"]}}
        inner["configuration"]["index_codecs"] = [{"name": "bytes"}, {"name": "crc32c"}]
        about["codecs"] = [inner]
        about["chunk_grid"]["configuration"]["chunk_shape"] = [2**40, 3]

    _changed(w, change)


@case(LAYOUT, verbs=READ)
def a_chunk_that_unpacks_to_gigabytes(w: World) -> None:
    """A zstd frame that says 64 GB."""
    for group in w.older_form():
        frame = b"\x28\xb5\x2f\xfd" + bytes([0xE4]) + (64 << 30).to_bytes(8, "little") + b"\x01\x00\x00"
        _written(w, group / "means" / "c" / "0" / "0", frame)


@case(LAYOUT, verbs=READ)
def a_hundred_dimensions(w: World) -> None:
    _changed(w, lambda about: about.update(shape=[300] + [1] * 100))


@case(LAYOUT, verbs=READ)
def metadata_that_is_too_deep(w: World) -> None:
    for group in w.older_form():
        _written(w, group / "means" / "zarr.json", b"[" * 60_000)


@case(LAYOUT, verbs=READ)
def metadata_that_is_none(w: World) -> None:
    _changed(w, lambda about: about.update(shape="everything", codecs=7))


@case(LAYOUT, verbs=READ)
def arrays_described_a_second_time(w: World) -> None:
    """Consolidated metadata would count instead of that of the arrays."""
    for group in w.older_form():
        path = group / "zarr.json"
        about = json.loads(path.read_text())
        inner = json.loads((group / "means" / "zarr.json").read_text()) | {"shape": [10**11, 3]}
        about["consolidated_metadata"] = {"kind": "inline", "must_understand": False, "metadata": {"means": inner}}
        _written(w, path, json.dumps(about).encode())


@case(LAYOUT, verbs=READ)
def values_that_are_no_numbers(w: World) -> None:
    _changed(
        w, lambda about: about.update(data_type={"name": "fixed_length_utf32", "configuration": {"length": 2**40}})
    )


@case(LAYOUT, verbs=READ)
def chunks_that_zarr_would_look_for_elsewhere(w: World) -> None:
    _changed(w, lambda about: about.update(chunk_key_encoding={"name": "default", "configuration": {"separator": "."}}))


# --- archives --------------------------------------------------------------------------------------------------------


def _arrays_of(group: Path) -> dict[str, np.ndarray]:
    with ZipStore(group / array_archive.FILE, mode="r") as store:
        return {name: np.asarray(array[...]) for name, array in zarr.open_group(store, mode="r").arrays()}


def _archived(
    w: World, change: Callable[[dict[str, bytes]], object], compression: int = zipfile.ZIP_STORED, kind: str = "scenes"
) -> None:
    """Change the members of every scene's archive, and have the catalog agree."""
    for group in (w.map / "arrays" / kind).iterdir():
        path = group / array_archive.FILE
        with zipfile.ZipFile(path) as archive:
            members = {name: archive.read(name) for name in archive.namelist()}
        change(members)
        with zipfile.ZipFile(path, "w", compression) as archive:
            for name, content in members.items():
                archive.writestr(zipfile.ZipInfo(name), content, compression)
        w.restated(path)


def _edited(w: World, change: Callable[[bytearray, int], object]) -> None:
    """Change the bytes of every scene's archive, whose table of contents begins there, and have the catalog agree."""
    for group in (w.map / "arrays" / "scenes").iterdir():
        path = group / array_archive.FILE
        data = bytearray(path.read_bytes())
        change(data, int.from_bytes(data[-6:-2], "little"))
        path.write_bytes(data)
        w.restated(path)


@case(LAYOUT, verbs=READ)
def an_archive_whose_members_are_packed(w: World) -> None:
    _archived(w, lambda members: None, zipfile.ZIP_DEFLATED)


@case(LAYOUT, verbs=READ)
def an_archive_without_a_chunk(w: World) -> None:
    _archived(w, lambda members: members.pop("sh/c/0/0/0"))


@case(LAYOUT, verbs=READ)
def an_archive_of_a_shape_of_a_petabyte(w: World) -> None:
    def change(members: dict[str, bytes]) -> None:
        about = json.loads(members["means/zarr.json"]) | {"shape": [10**14, 3]}
        members["means/zarr.json"] = json.dumps(about).encode()

    _archived(w, change)
    w.set("UPDATE scenes SET num_gaussians = ?", 10**14)


@case(LAYOUT, verbs=READ)
def an_archive_with_a_chunk_that_unpacks_to_gigabytes(w: World) -> None:
    frame = b"\x28\xb5\x2f\xfd" + bytes([0xE4]) + (64 << 30).to_bytes(8, "little") + b"\x01\x00\x00"
    _archived(w, lambda members: members.update({"means/c/0/0": frame}))


@case(LAYOUT, verbs=READ)
def an_archive_that_is_none(w: World) -> None:
    _edited(w, lambda data, table: data.__setitem__(slice(None), b"x" * len(data)))


@case(LAYOUT, verbs=READ)
def an_archive_whose_members_lie_elsewhere(w: World) -> None:
    """The second member is said to begin far beyond the file."""

    def change(data: bytearray, table: int) -> None:
        at = data.index(b"PK\1\2", table + 4)
        data[at + 42 : at + 46] = (0x7FFFFFFF).to_bytes(4, "little")

    _edited(w, change)


@case(LAYOUT, verbs=READ)
def an_archive_whose_members_overlap(w: World) -> None:
    def change(data: bytearray, table: int) -> None:
        at = data.index(b"PK\1\2", table + 4)
        data[at + 42 : at + 46] = (0).to_bytes(4, "little")

    _edited(w, change)


@case(LAYOUT, verbs=READ)
def an_archive_of_more_members_than_it_lists(w: World) -> None:
    _edited(w, lambda data, table: data.__setitem__(slice(-14, -10), b"\xfe\xff\xfe\xff"))


@case(LAYOUT, verbs=READ)
def an_archive_with_a_table_of_gigabytes(w: World) -> None:
    _edited(w, lambda data, table: data.__setitem__(slice(-10, -6), (0x7FFFFFFF).to_bytes(4, "little")))


@case(LAYOUT, verbs=READ)
def an_archive_whose_metadata_differs_from_its_digest(w: World) -> None:
    _edited(w, lambda data, table: data.__setitem__(data.index(b"float32"), ord("x")))


@case(r"gsmap did not write|does not match its row", verbs=("check MAP", "look MAP"))
def a_graph_whose_row_says_otherwise(w: World) -> None:
    """Arrays of a terabyte by the row, of other types, of layers of other widths."""
    with w.sql() as connection:
        (text,) = connection.execute("SELECT about FROM results WHERE kind = 'graphs'").fetchone()
        about = json.loads(text)
        for how in about["arrays"].values():
            how["shape"] = [10**12 if n == 4 else n for n in how["shape"]]
        connection.execute("UPDATE results SET about = ? WHERE kind = 'graphs'", (json.dumps(about),))


@case(r"gsmap does not write", verbs=("look MAP",))
def a_graph_of_types_that_there_are_none_of(w: World) -> None:
    w.set('UPDATE results SET about = replace(about, \'"is": "f8"\', \'"is": "O"\')')
    w.set('UPDATE results SET about = replace(about, \'"is":"f8"\', \'"is":"O"\')')


@case(r"not valid text", verbs=("look MAP", "export MAP TILES --tile-size 0 --merge union"))
def camera_names_that_are_no_text(w: World) -> None:
    """In the place of the good ones, packed as gsmap packs them."""
    for group in (w.map / "arrays" / "scenes").iterdir():
        arrays = _arrays_of(group)
        (group / array_archive.FILE).unlink()
        arrays["cameras.names"] = np.frombuffer(b"\xff\xfe\xfd", np.uint8)
        array_archive.write(group / array_archive.FILE, arrays, chunk_rows=CHUNK_ROWS)
        w.restated(group / array_archive.FILE)
    w.set("UPDATE tiles SET removed_at = '2026'")
    shutil.rmtree(w.tiles)
