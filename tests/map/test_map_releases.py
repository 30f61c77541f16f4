"""Maps that releases wrote (`tools/make/release_map.py`): each opens, migrates, checks, lists, exports and goes on."""

from __future__ import annotations

import tarfile
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from sqlite3 import connect

import pytest

import gsmap.map
from gsmap.map import Map
from gsmap.store import schema, sqlite
from tools.make.release_map import LIMIT_KB

RELEASES = sorted((Path(__file__).parents[1] / "store" / "releases").glob("*.tar.xz"))


@pytest.fixture(params=RELEASES, ids=lambda path: path.name.removesuffix(".tar.xz"))
def archive(request: pytest.FixtureRequest) -> Path:
    return request.param


@pytest.fixture
def site(archive: Path, tmp_path: Path) -> Path:
    with tarfile.open(archive) as packed:
        packed.extractall(tmp_path, filter="data")
    (path,) = tmp_path.glob("*.gsmap")
    return path


@pytest.fixture(autouse=True)
def one_worker(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GSMAP_WORKERS", "1")


def said_by(path: Path) -> dict[str, int]:
    """Rows by table, as the file has them."""
    with closing(connect(f"file:{path / sqlite.FILE}?mode=ro&immutable=1", uri=True)) as database:
        tables = ("scenes", "results", "registrations", "revisions", "priors", "models", "exports", "tiles")
        return {table: database.execute(f"SELECT count(*) FROM {table}").fetchone()[0] for table in tables}


def version(path: Path) -> str:
    with closing(connect(f"file:{path / sqlite.FILE}?mode=ro&immutable=1", uri=True)) as database:
        return str(database.execute("SELECT version_num FROM alembic_version").fetchone()[0])


@pytest.fixture
def opened(site: Path) -> Iterator[Map]:
    if version(site) < schema.HEAD:
        gsmap.map.migrate(site)
    with gsmap.map.open(site) as m:
        yield m


def test_there_is_a_map_of_every_schema(tmp_path: Path) -> None:
    versions = set()
    for archive in RELEASES:
        with tarfile.open(archive) as packed:
            packed.extractall(tmp_path / archive.name, filter="data")
        versions.add(version(next((tmp_path / archive.name).glob("*.gsmap"))))
        assert archive.stat().st_size < 1000 * LIMIT_KB
    assert versions == {f"{number:04}" for number in range(int(schema.FIRST), int(schema.HEAD) + 1)}


def test_it_opens_once_migrated_and_keeps_every_row(site: Path) -> None:
    before, rows = version(site), said_by(site)
    if before < schema.HEAD:
        with gsmap.map.open(site) as m:
            assert m.scene_rows()
        assert gsmap.map.migrate(site) == (before, schema.HEAD)
        assert (site / f"{sqlite.FILE}.{before}.bak").is_file()
    with gsmap.map.open(site) as m:
        assert m.check().problems == ()
    assert said_by(site) == rows
    assert gsmap.map.migrate(site) == (schema.HEAD, schema.HEAD)


def test_everything_in_it_is_listed_and_shown(opened: Map) -> None:
    rows = said_by(opened.store.folder)
    scenes, revisions = opened.scene_rows(), opened.revision_rows()
    removed = opened.store.scenes.list(removed=True)
    assert len(scenes) + len(removed) == rows["scenes"]
    assert len(revisions) == rows["revisions"]
    assert len(opened.tile_rows()) == rows["tiles"]
    assert len(opened.model_rows()) == rows["models"]
    assert len(opened.pose_rows()) == len(scenes)
    for scene in scenes:
        shown = opened.show_scene(scene.name)
        assert shown.num_nodes is not None
        gaussians, cameras = opened.read(scene.name)
        assert len(gaussians) == scene.num_gaussians > 0
        assert len(cameras) > 0
    edges = opened.edge_rows()
    assert edges
    for edge in edges:
        assert opened.show_pair(f"{edge.target_name}:{edge.source_name}").history
    whole = [row for row in revisions if row.dropped_at is None]
    assert len(whole) > 1
    for before, after in pairwise(whole):
        opened.diff(before.number, after.number)
    assert opened.status().scenes == len(scenes)
    for one in opened.store.changes.current():
        assert len(opened.store.changes.load(one.number).changes) == len(one.changes)
        for change in one.changes:
            shown = opened.show_change(f"c{change.number}")
            assert (shown.status == "confirmed") == bool(shown.history)


def test_its_branches_and_tags_open(site: Path) -> None:
    names = sorted(path.name for path in (site / "branches").glob("*"))
    for path in (str(site), *(f"{site}@{name}" for name in names)):
        if version(site / "branches" / path.rpartition("@")[2] if "@" in path else site) < schema.HEAD:
            gsmap.map.migrate(path)
        with gsmap.map.open(path) as m:
            assert m.scene_rows()
            assert m.check().problems == ()


def test_it_is_exported_edited_and_updated(opened: Map, tmp_path: Path) -> None:
    first = opened.export(tmp_path / "tiles", format="ply", tile_size_m=0, merge="voxel")
    assert sum(tile.num_gaussians for tile in first.tiles) > 0
    names = [row.name for row in opened.scene_rows()]
    opened.edit(names[0], note="seen again", tags=["later"])
    gaussians, cameras = opened.read(names[0])
    opened.ingest(replace(gaussians, means=gaussians.means + 0.125), cameras=cameras, name="newcomer")
    report = opened.update()
    assert report.revision is not None
    assert set(opened.pose_graph().poses) == {row.id for row in opened.scene_rows()}
    assert len(opened.scene_rows()) == len(names) + 1
    todo = {row.what for row in opened.status().todo}
    assert not todo & {"undescribed", "stale_graphs", "stale_edges", "unsolved", "stale_poses"}
    opened.export(tmp_path / "tiles", format="ply", tile_size_m=0, merge="voxel")
    opened.remove("newcomer")
    opened.prune(keep_revisions=1)
    assert opened.check().problems == ()
