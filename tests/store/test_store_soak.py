"""What tools/check/soak.py does for ten minutes: that it notices what is lost, and twenty seconds of it."""

import importlib.util
import json
import random
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import gsmap.map

SOAK = Path(__file__).resolve().parents[2] / "tools" / "check" / "soak.py"


@pytest.fixture
def soak(monkeypatch):
    monkeypatch.setattr(sys, "path", list(sys.path))
    spec = importlib.util.spec_from_file_location("soak", SOAK)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_it_notices_what_is_lost_or_out_of_order(soak, tmp_path):
    rng, choose, log, mine = np.random.default_rng(0), random.Random(1), soak.Log(tmp_path / "log"), []
    with gsmap.map.create(tmp_path / "m") as m:
        for step in range(25):
            soak.act(m, mine, f"w0-{step}", float(step), rng, choose, log)
    actions = [json.loads(line) for line in (tmp_path / "log").read_text().splitlines()]
    assert not [a for a in actions if "error" in a]
    first, last = actions[0], actions[-1]
    now = (last["ended"] + 1, last["ended"] + 2)
    assert {a["do"] for a in actions} > {"ingest", "note", "edge", "review"}
    assert soak.wrong_with(tmp_path / "m", actions, now) == []
    lost = {"do": "note", "mark": "never", "began": first["began"], "ended": first["ended"]}
    assert "lacks note never" in soak.wrong_with(tmp_path / "m", [*actions, lost], now)[0]
    # read before it was over, but newer things are there
    early = (first["began"] - 2, last["ended"] + 1)
    assert "older than what it has" in soak.wrong_with(tmp_path / "m", [*actions, lost], early)[0]
    assert "nobody committed" in soak.wrong_with(tmp_path / "m", actions[1:], now)[0]
    assert "begun later" in soak.wrong_with(tmp_path / "m", actions, (0.0, first["began"] - 1))[0]


@pytest.mark.slow
@pytest.mark.parametrize("options", [[], ["--postgres", "temporary", "--only-postgres"]], ids=["sqlite", "postgres"])
def test_writers_readers_and_a_backup_share_a_map(options):
    if options:
        pytest.importorskip("psycopg")
    command = [sys.executable, SOAK, "--minutes", "0.33", "--writers", "4", "--readers", "3", "--backup", *options]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "0 lost or wrong, 0 locked, 0 other errors, 0 died" in done.stdout
