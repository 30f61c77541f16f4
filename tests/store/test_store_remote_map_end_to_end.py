"""The whole job on a map without a folder (PostgreSQL and an object store) beside the embedded one: from
captures to tiles, every pose and every byte is the same."""

import contextlib
import itertools
import json
import os
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


def captures(folder):
    """Three that overlap, in files."""
    made = make_captures(0, 3, shut_doors=False, steps=0, num_frames=24, num_gaussians=25_000, size_px=(160, 120))
    write_captures(folder / "captures", made)
    return sorted((folder / "captures").glob("*.ply"))


def assert_same(ours, theirs):
    """Two maps of the same captures have the same poses and graphs, to the bit."""
    with gsmap.map.open(ours) as here, gsmap.map.open(theirs) as there:
        first, second = here.pose_graph(), there.pose_graph()
        assert set(first.poses) == set(second.poses)
        assert {pose.status for pose in first.poses.values()} == {"placed"}
        for scene, pose in first.poses.items():
            assert np.array_equal(pose.S_map_scene.matrix(), second.poses[scene].S_map_scene.matrix())
            a, b = (to_arrays(m.store.graphs.load(scene))[0] for m in (here, there))
            assert a.keys() == b.keys()
            assert all(np.array_equal(a[name], b[name]) for name in a)


@pytest.mark.slow
def test_a_map_in_a_bucket_is_the_embedded_one_to_the_bit(remote, tmp_path):
    url, database = remote
    files = captures(tmp_path)
    cli("init", tmp_path / "site.gsmap")
    cli("init", url, "--catalog", database)
    for place, out in ((tmp_path / "site.gsmap", "here"), (url, "there")):
        cli("ingest", place, *files)
        for verb in ("describe", "register", "optimize"):
            cli(verb, place)
        cli("export", place, tmp_path / out, "--tile-size", "4", "--merge", "voxel")
    assert len(tiles_of(tmp_path / "here")) > 1
    assert tiles_of(tmp_path / "here") == tiles_of(tmp_path / "there")
    assert_same(tmp_path / "site.gsmap", url)
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


_HIDE = ("unshare", "-m", "sh", "-c", 'mount -t tmpfs none "$0" && exec "$@"')
"""Runs a command (after a folder) that sees an empty disk of its own in the folder's place."""


def hidden(folder, *command):
    return [*_HIDE, str(folder), *map(str, command)]


@contextlib.contextmanager
def workers_elsewhere(scheduler, count, folder, environment):
    """So many Dask workers that see nothing of what lies in a folder here; what they keep there is their own."""
    started = []
    try:
        for _ in range(count):
            words = ["-m", "distributed.cli.dask_worker", scheduler, "--nthreads", "1", "--no-nanny", "--no-dashboard"]
            command = hidden(folder, sys.executable, *words, "--local-directory", folder / "scratch")
            with open(folder / f"worker {len(started)}.log", "wb") as log:
                started.append(subprocess.Popen(command, stdout=log, stderr=log, env=environment))
        yield
    finally:
        for process in started:
            process.kill()
            process.wait()


@pytest.mark.slow
def test_a_cluster_that_shares_no_folder_makes_the_embedded_map_to_the_bit(remote, tmp_path, monkeypatch):
    """PostgreSQL, an object store and two Dask workers that have nothing but those two addresses."""
    distributed = pytest.importorskip("distributed", reason="the extra `cluster` is not installed")
    if subprocess.run(hidden(tmp_path, "true"), capture_output=True).returncode:
        pytest.skip("needs the right to mount, so that workers see none of our folders")
    url, database = remote
    files = captures(tmp_path)
    root = Path(__file__).parents[2]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(root), *sys.path]))
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    monkeypatch.setenv("GSMAP_WORKERS", "1")
    cli("init", tmp_path / "site.gsmap")
    cli("init", url, "--catalog", database)
    theirs = os.environ | {"GSMAP_CATALOG": database, "XDG_CONFIG_HOME": str(tmp_path / "config of workers")}
    with (
        distributed.LocalCluster(n_workers=0, dashboard_address=None) as cluster,
        workers_elsewhere(cluster.scheduler_address, 2, tmp_path, theirs),
    ):
        with distributed.Client(cluster, set_as_default=False) as client:
            client.wait_for_workers(2, timeout=120)
            seen = client.run(os.path.exists, str(files[0]))
            assert list(seen.values()) == [False, False], "workers see our folders"
        on_cluster = ("--executor", "dask", "--scheduler", cluster.scheduler_address)
        for place, out, how in ((tmp_path / "site.gsmap", "here", ()), (url, "there", on_cluster)):
            cli("update", place, *files, *how)
            cli("export", place, tmp_path / out, "--tile-size", "4", "--steps", "10", *how)
        with distributed.Client(cluster, set_as_default=False) as client:
            fetched = client.run(os.listdir, os.environ["GSMAP_CACHE"])
        assert len(fetched) == 2
        assert all(fetched.values()), "each worker has read captures from the bucket"
    assert len(tiles_of(tmp_path / "here")) > 1
    assert tiles_of(tmp_path / "here") == tiles_of(tmp_path / "there")
    assert_same(tmp_path / "site.gsmap", url)
    assert json.loads(cli("check", url, "--json"))["problems"] == []
