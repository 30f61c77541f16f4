import json
import signal
import subprocess
import sys
import urllib.request

import numpy as np
import pytest

import gsmap
from gsmap import formats
from gsmap.map import create
from gsmap.types import Gaussians


@pytest.fixture
def folder(tmp_path):
    rng = np.random.default_rng(0)
    n = 3000
    g = Gaussians(
        rng.uniform(-3, 3, (n, 3)) * [1, 1, 0.4],
        rng.normal(size=(n, 4)),
        rng.uniform(-4, -3, (n, 3)),
        rng.normal(2, 1, n),
        rng.normal(0, 0.5, (n, 1, 3)),
    )
    formats.write(tmp_path / "hall.ply", g)
    with create(tmp_path / "site.gsmap") as m:
        m.ingest(tmp_path / "hall.ply")
    return tmp_path / "site.gsmap"


def test_python_serves_what_the_store_holds(folder):
    with gsmap.open(folder) as m, m.view().start() as server:

        def get(path: str):
            return urllib.request.urlopen(f"http://127.0.0.1:{server.port}/{path}?token={server.token}", timeout=30)

        said = json.load(get("map.json"))
        assert [s["name"] for s in said["scenes"]] == ["hall"]
        assert said["title"] == "site.gsmap"
        assert json.load(get(said["scenes"][0]["extras"]))["layers"] == {}


def test_the_command_serves_until_it_is_interrupted(folder):
    command = [sys.executable, "-P", "-m", "gsmap", "view", str(folder), "--no-browser"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            line = process.stderr.readline()
            assert line.startswith("http://127.0.0.1:")
            browser = urllib.request.build_opener(urllib.request.HTTPCookieProcessor())
            assert b"<!doctype html" in browser.open(line.split()[0], timeout=10).read()
            process.send_signal(signal.SIGINT)
            assert process.wait(20) == 0
        finally:
            process.kill()
