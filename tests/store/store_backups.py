"""What the tests of backups share: a map with some of everything, what a map holds, and snapshots made by hand."""

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
from sqlalchemy import MetaData, select
from store_samples import key, made_change, make_cameras, make_gaussians, save_comparison
from test_store_nouns import graph_of, layer, registration, tile

from gsmap.store import Store, schema
from gsmap.store.arrays import StoredFile
from gsmap.store.backup.repository import SNAPSHOTS, Backup, Snapshot, format_file_list, object_name
from gsmap.store.catalog_copy import snapshot_read, tables
from gsmap.store.storage import Storage
from gsmap.types import Prior, SceneGraph, Sim3

PASSING = {"leases", "backups"}  # who is at work, and where it went: no part of what a map holds


def fill(store: Store, folder: Path) -> None:
    """Two scenes and what is known of them, a model, a setting."""
    a, _ = store.scenes.add(make_gaussians(400), make_cameras(), name="a")
    b, _ = store.scenes.add(make_gaussians(300, seed=2), make_cameras(), name="b")
    store.graphs.save(SceneGraph(a.id, {"objects": layer()}), key("describe", a.id))
    store.registrations.save(registration(a.id, b.id), key("register"))
    store.registrations.review("a", "b", "confirm", "ok")
    save_comparison(store, a.id, b.id, made_change([[0, 0, 0], [1, 1, 1]]))
    store.revisions.save(graph_of([a, b]))
    store.priors.set(Prior("a", Sim3.identity(), np.full(7, np.inf)))
    store.exports.add_tile(store.exports.begin("/tmp/out", revision=1), tile("a.ply", [a, b]))
    (folder / "net.onnx").write_bytes(b"not really")
    store.models.add("net", folder / "net.onnx", kind="clip")
    (store.catalog.folder / "settings.toml").write_text("[register]\n")


def holdings(path: Path) -> dict[str, Any]:
    """Everything that a map holds: the rows of its tables, and the digests of its files."""
    with Store.open(path, "r") as store, snapshot_read(store.catalog) as connection:
        rows = {
            table.name: [tuple(row) for row in connection.execute(select(table).order_by(*table.primary_key))]
            for table in tables()
            if table.name not in PASSING
        }
    # 64 bits in PostgreSQL, 32 in SQLite's tree, which rounds outwards
    rows["chunk_boxes"] = [tuple(round(float(value), 3) for value in row) for row in rows["chunk_boxes"]]
    files = {}
    for place in ("arrays", "models", "settings.toml"):
        for file in [path / place, *(path / place).rglob("*")]:
            if file.is_file():
                files[str(file.relative_to(path))] = hashlib.sha256(file.read_bytes()).hexdigest()
    return {**rows, "files": files}


def put(place: Storage, content: bytes) -> str:
    """Store bytes as an object; their digest."""
    sha256 = hashlib.sha256(content).hexdigest()
    place.put(object_name(sha256), [content], len(content))
    return sha256


def make_snapshot(
    place: Storage, map_id: str, content: dict[str, bytes], lines: bytes | None = None, /, **changed: Any
) -> Snapshot:
    """A snapshot with these files, whatever they are; and with another list of files, or other fields, than is true."""
    Backup.at_or_new(place, map_id)
    stored = [StoredFile(path, len(data), put(place, data)) for path, data in content.items()]
    text = format_file_list(stored) if lines is None else lines
    fields: dict[str, Any] = {
        "name": "",
        "map_id": map_id,
        "created_at": "2026-01-02T03:04:05.000000+00:00",
        "schema": schema.HEAD,
        "gsmap_version": "0.0",
        "files": put(place, text),
        "files_bytes": len(text),
        "num_files": len(content),
        "num_bytes": sum(len(data) for data in content.values()),
        "num_bytes_new": 0,
        "revision": None,
        "counts": {},
    }
    made = Snapshot(**fields | changed)
    name, packed = made.packed()
    place.put(f"{SNAPSHOTS}{name}.json", [packed], len(packed))
    return Snapshot(**fields | changed | {"name": name})


def files_of(path: Path) -> dict[str, bytes]:
    """The files of a map that nobody has open, as a snapshot lists them."""
    kept = [path / "map.sqlite", path / "settings.toml", *(path / "arrays").rglob("*"), *(path / "models").rglob("*")]
    return {str(file.relative_to(path)): file.read_bytes() for file in kept if file.is_file()}


def tables_of(engine: Any) -> list[str]:
    """The tables of a database."""
    found = MetaData()
    found.reflect(engine)
    return sorted(found.tables)
