"""A purge takes what exports show of a scene, what killed exports left, and names what it could not reach."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from complete_map import BENCH, BOX, room
from raising import raises

import gsmap.map
from gsmap.durable import remove_staged, staged_folder, write_owned, write_text_output
from gsmap.errors import GsmapError
from gsmap.map import Map
from gsmap.map.outputs import note_target
from gsmap.map.small_map.export import SmallLocalizer
from gsmap.store import purging
from gsmap.types import Cameras, PoseGraph, ScenePose, Sim3
from gsmap.view.tree_cache import TreeCache

# A process that is killed while it stages an export.
KILLED = """
import os, sys
from pathlib import Path
from gsmap.durable import staged_folder
with staged_folder(Path(sys.argv[1]), sys.argv[2]) as folder:
    (folder / "content").write_text("attic")
    os._exit(9)
"""


def kill_export(target: Path, owner: str) -> None:
    done = subprocess.run([sys.executable, "-c", KILLED, target, owner])
    assert done.returncode == 9


def hidden(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.rglob(".*"))


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Map]:
    """Two scenes of one place."""
    monkeypatch.setenv("GSMAP_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("GSMAP_WORKERS", "1")
    pose = np.tile(np.eye(4), (2, 1, 1))
    pose[:, :3, :3] = [[[0, 0, 1], [-1, 0, 0], [0, -1, 0]], [[0, 0, -1], [1, 0, 0], [0, -1, 0]]]
    pose[:, :3, 3] = [[0.5, 1.5, 1.2], [3.5, 1.5, 1.2]]
    cameras = Cameras(pose, np.tile([30.0, 30, 32, 24], (2, 1)), np.tile([64, 48], (2, 1)))
    with gsmap.map.create(tmp_path / "site.gsmap") as m:
        for name, boxes in (("hall", [BENCH]), ("attic", [BENCH, BOX])):
            m.ingest(room(boxes), cameras=cameras, name=name, scale="known")
        m.store.revisions.save(PoseGraph({s.id: ScenePose(s.id, Sim3.identity(), 0, "placed") for s in m.scenes()}))
        yield m


def test_what_killed_processes_stage_goes_with_the_next_and_what_lives_stays(tmp_path: Path) -> None:
    target, mine, other = tmp_path / "www", "a" * 32, "b" * 32
    kill_export(target, mine)
    kill_export(target, other)
    assert len(hidden(tmp_path)) == 2
    with staged_folder(target, mine) as living:
        assert len(hidden(tmp_path)) == 2
        assert remove_staged(tmp_path, mine) == (0, [living])
        with staged_folder(target, mine) as second:
            assert second != living
    assert [name.split(".")[2] for name in hidden(tmp_path)] == [other[:12]]
    assert remove_staged(tmp_path, other) == (1, [])
    write_owned(target, mine, lambda staged: staged.write_text("whole"))
    assert (target.read_text(), hidden(tmp_path)) == ("whole", [])


def test_a_purged_scene_leaves_a_small_map_that_localizes_in_the_rest(site: Map, tmp_path: Path) -> None:
    gone = site.store.scenes.get("attic").id
    site.export_small(tmp_path / "small", 5_000_000)
    assert {scene.name for scene in SmallLocalizer(tmp_path / "small").small.values()} == {"hall", "attic"}
    kill_export(tmp_path / "small", site.store.id)
    receipt = site.purge("attic")
    assert (receipt.unreachable, receipt.num_tiles) == ((), 3)
    assert {scene.name for scene in SmallLocalizer(tmp_path / "small").small.values()} == {"hall"}
    assert hidden(tmp_path / "small") == hidden(tmp_path) == []
    left = [path for path in (tmp_path / "small").iterdir() if gone in path.name or b"attic" in path.read_bytes()]
    assert left == []
    site.purge("hall")
    assert not (tmp_path / "small").exists()


def test_a_purge_names_what_it_cannot_reach(site: Map, tmp_path: Path) -> None:
    for name in ("www", "page.html", "foreign"):
        note_target(site.store, tmp_path / name, {})
    (tmp_path / "foreign").mkdir()
    (tmp_path / "foreign" / "localize.json").write_text(
        json.dumps({"format": "gsmap small map", "version": 2, "map_id": "c" * 32, "scenes": [{"id": "x"}]})
    )
    kill_export(tmp_path / "www", site.store.id)
    with staged_folder(tmp_path / "page.html", site.store.id) as living:
        unreachable = site.purge("attic").unreachable
    found = {Path(text.split(":")[0]) for text in unreachable}
    assert {tmp_path / "foreign", living} <= found
    assert hidden(tmp_path) == []


def test_what_a_killed_process_left_of_a_file_goes_with_the_next_one(tmp_path: Path) -> None:
    kill_export(tmp_path / "poses.txt", "gsmap")
    assert len(hidden(tmp_path)) == 1
    write_text_output(tmp_path / "poses.txt", "whole")
    assert ((tmp_path / "poses.txt").read_text(), hidden(tmp_path)) == ("whole", [])


def test_a_target_that_an_interrupted_purge_cleaned_is_not_unreachable(site: Map, tmp_path: Path) -> None:
    for name in ("cleaned", "elsewhere"):
        note_target(site.store, tmp_path / name, {})
    begun = purging.begin(site.store, site.store.scenes.get("attic").id)
    purging.record_files(site.store, begun, str(tmp_path / "cleaned"), 2)
    receipt = site.purge("attic")
    assert [text.split(":")[0] for text in receipt.unreachable] == [str(tmp_path / "elsewhere")]
    assert str(tmp_path / "cleaned") in receipt.exports


def test_a_cache_forgets_what_it_holds_half_made_of_a_scene(tmp_path: Path) -> None:
    cache, scene = TreeCache(tmp_path, 1 << 20), "d" * 32
    kill_export(tmp_path / f"{scene}-1.tree", "cache")
    (tmp_path / ("." + "e" * 32)).mkdir()  # of an older gsmap
    kill_export(tmp_path / f"{'f' * 32}-1.tree", "cache")
    assert cache.num_files(scene) == 1
    cache.forget(scene)
    assert [name[1:33] for name in hidden(tmp_path)] == ["f" * 32]


def test_a_list_that_says_it_is_of_this_map_and_is_not_one_is_no_small_map(site: Map, tmp_path: Path) -> None:
    note_target(site.store, tmp_path / "small", {})
    (tmp_path / "small").mkdir()
    (tmp_path / "small" / "localize.json").write_text(
        json.dumps({"format": "gsmap small map", "version": 2, "map_id": site.store.id, "scenes": ["x"]})
    )
    (unreachable,) = site.purge("attic").unreachable
    assert str(tmp_path / "small") in unreachable
    with raises(GsmapError, code="small_map_damaged"):
        SmallLocalizer(tmp_path / "small")
