"""The whole job on a map without a folder (PostgreSQL and an object store) beside the embedded one: from
captures to tiles, every pose and every byte is the same."""

import itertools
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from store_swift import BUCKET, ENVIRONMENT

import gsmap.map
from gsmap.store.graph_content import to_arrays
from gsmap_synthetic import make_captures, write_captures

_numbers = itertools.count()


@pytest.fixture
def remote(server, postgres_database, monkeypatch, tmp_path):
    """A bucket's place and a database, both empty, in the environment that every verb is run in."""
    for name, value in {**ENVIRONMENT, "AWS_ENDPOINT_URL": server.url}.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setenv("GSMAP_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    return f"s3://{BUCKET}/whole/site {next(_numbers)}", postgres_database


def cli(*arguments):
    words = [sys.executable, "-P", "-m", "gsmap", *map(str, arguments)]
    done = subprocess.run(words, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr
    return done.stdout


def tiles_of(folder):
    """What an export wrote, without where its map lies."""
    listed = json.loads((folder / "tiles.json").read_text())
    return [(t["name"], t["sha256"], t["key"], t["num_gaussians"]) for t in listed["tiles"]]


@pytest.mark.slow
def test_a_map_in_a_bucket_is_the_embedded_one_to_the_bit(remote, tmp_path):
    url, database = remote
    made = make_captures(0, 3, shut_doors=False, steps=0, num_frames=24, num_gaussians=25_000, size_px=(160, 120))
    write_captures(tmp_path / "captures", made)
    files = sorted(Path(tmp_path / "captures").glob("*.ply"))
    cli("init", tmp_path / "site.gsmap")
    cli("init", url, "--catalog", database)
    for place, out in ((tmp_path / "site.gsmap", "here"), (url, "there")):
        cli("ingest", place, *files)
        for verb in ("describe", "register", "optimize"):
            cli(verb, place)
        cli("export", place, tmp_path / out, "--tile-size", "4", "--merge", "voxel")
    assert tiles_of(tmp_path / "here") == tiles_of(tmp_path / "there")
    with gsmap.map.open(tmp_path / "site.gsmap") as here, gsmap.map.open(url) as there:
        assert len(tiles_of(tmp_path / "here")) > 1
        ours, theirs = here.pose_graph(), there.pose_graph()
        assert set(ours.poses) == set(theirs.poses)
        assert {pose.status for pose in ours.poses.values()} == {"placed"}
        for scene, pose in ours.poses.items():
            assert np.array_equal(pose.S_map_scene.matrix, theirs.poses[scene].S_map_scene.matrix)
            a, b = (to_arrays(m.store.graphs.load(scene))[0] for m in (here, there))
            assert a.keys() == b.keys()
            assert all(np.array_equal(a[name], b[name]) for name in a)
    assert json.loads(cli("check", url, "--json"))["problems"] == []
    # Every other verb takes the bucket, too.
    for verb in ("status", "prune"):
        cli(verb, url)
    name = json.loads(cli("list", url, "scenes", "--json"))["scenes"][0]["name"]
    cli("show", url, name)
    cli("poses", url, tmp_path / "poses.json", "--format", "json")
    cli("settings", url, "--set", "register.verdict.max_log_nfa=-7")
    assert "-7" in cli("settings", url)
    cli("backup", url, tmp_path / "backup")
    cli("clone", url, tmp_path / "clone.gsmap")
    cli("remove", url, name, "--purge")
    cli("update", url, *files)
    assert json.loads(cli("check", tmp_path / "clone.gsmap", "--json"))["problems"] == []
