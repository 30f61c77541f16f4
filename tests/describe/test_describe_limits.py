"""Models that never end, or take all memory: they run in a process of their own, and it is that which ends."""

from __future__ import annotations

import gc
import hashlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from raising import raises

from gsmap.describe.objects.layer import Params, object_layer
from gsmap.describe.onnx.check import check_model
from gsmap.errors import ConfigError, InputError
from gsmap.map import create
from gsmap.networks import ModelProcess, session
from gsmap.networks.session import open_session, run
from gsmap.types import Cameras, Gaussians
from gsmap.types.model import ModelLimits, ModelSpec, Tensor
from gsmap.types.views import PointCloud, SceneContext

networks = pytest.importorskip("describe_networks", reason="needs the onnx package")
linux = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="looks into /proc")

PICTURE = {"pixels": np.ones((2, 3, 8, 8), np.float32)}


def children() -> set[int]:
    """The processes that this one started and that have not ended."""
    out = set()
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            state, parent = (folder / "stat").read_text().rsplit(")", 1)[1].split()[:2]
        except OSError:
            continue
        if int(parent) == os.getpid() and state != "Z":
            out.add(int(folder.name))
    return out


def is_running(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


def spec_of(path: Path, limits: ModelLimits) -> ModelSpec:
    """A spec that nobody checked."""
    ends = (Tensor("pixels", (None, 3, 8, 8), "float"),), (Tensor("features", (None, 3), "float"),)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    return ModelSpec("clip", str(path), digest, "unit", (0, 0, 0), (1, 1, 1), *ends, limits)


@linux
def test_a_model_without_end_is_ended(tmp_path):
    before = children()
    start = time.monotonic()
    with raises(InputError, code="model_timeout"):
        check_model("clip", networks.endless(tmp_path / "m.onnx"), "unit", ModelLimits(time_s=1))
    assert time.monotonic() - start < 20
    assert children() <= before


@linux
@pytest.mark.parametrize("network", [lambda p: networks.endless(p, grows=True), networks.enormous])
def test_a_model_that_takes_all_memory_is_ended(tmp_path, network):
    before = children()
    with raises(InputError, code="model_out_of_memory"):
        check_model("clip", network(tmp_path / "m.onnx"), "unit", ModelLimits(time_s=60, memory_mb=300))
    assert children() <= before


@linux
def test_memory_is_held_to_the_limit_and_what_fits_runs(tmp_path):
    path = networks.image_encoder(tmp_path / "m.onnx", side="side")
    small, large = ModelProcess(str(path), ModelLimits(60, 100)), ModelProcess(str(path), ModelLimits(60, 2000))
    endless = ModelProcess(str(path), ModelLimits(float("inf"), 2**60))
    np.testing.assert_allclose(endless.run(None, PICTURE)[0], 1)
    pictures = np.ones((60, 3, 512, 512), np.float32)  # 189 MB
    assert large.run(None, {"pixels": pictures})[0].shape == (60, 3)
    with raises(InputError, code="model_out_of_memory"):
        small.run(None, {"pixels": pictures})
    inside = str(networks.enormous(tmp_path / "e.onnx", 100_000_000))  # 400 MB that nobody sends
    np.testing.assert_allclose(ModelProcess(inside, ModelLimits(60, 2000)).run(None, PICTURE)[0], 1)
    with raises(InputError, code="model_out_of_memory"):
        ModelProcess(inside, ModelLimits(60, 100)).run(None, PICTURE)


def test_numbers_are_those_of_the_model_whatever_their_size_and_kind(tmp_path):
    """Through shared memory, which grows, and beside it."""
    encoder = check_model("clip", networks.image_encoder(tmp_path / "m.onnx", side="side"), "unit")
    model = open_session(encoder)
    rng = np.random.default_rng(0)
    kept = []
    for side, count in ((8, 1), (64, 2), (8, 3), (300, 7), (1, 1)):
        pictures = rng.normal(size=(count, 3, side, side)).astype(np.float32)
        kept.append((run(encoder, model, None, {"pixels": pictures})[0], pictures.mean((2, 3))))
        strided = np.asfortranarray(pictures)
        kept.append((run(encoder, model, ["features"], {"pixels": strided})[0], pictures.mean((2, 3))))
    for found, true in kept:  # none is overwritten by a later run
        np.testing.assert_allclose(found, true, atol=1e-5)
    assert run(encoder, model, None, {"pixels": np.zeros((0, 3, 8, 8), np.float32)})[0].shape == (0, 3)
    with raises(InputError, code="model_failed"):
        run(encoder, model, None, {"pixels": np.zeros((1, 3, 8), np.float32)})
    np.testing.assert_allclose(run(encoder, model, None, PICTURE)[0], 1)  # that did it no harm


def test_after_a_process_has_ended_the_model_is_loaded_again(tmp_path):
    encoder = check_model("clip", networks.image_encoder(tmp_path / "m.onnx"), "unit")
    model = open_session(encoder)
    assert open_session(encoder) is model
    model._process.kill()
    with raises(InputError, code="model_out_of_memory"):
        run(encoder, model, None, PICTURE)
    again = open_session(encoder)
    np.testing.assert_allclose(run(encoder, again, None, PICTURE)[0], 1)


@linux
def test_processes_end_when_nobody_needs_them(tmp_path):
    before = children()
    path = networks.image_encoder(tmp_path / "m.onnx")
    model = ModelProcess(str(path), ModelLimits())
    assert len(children() - before) == 1
    assert model.is_alive
    del model
    gc.collect()
    assert children() <= before
    for i in range(session._KEPT + 2):
        check_model("clip", networks.image_encoder(tmp_path / f"{i}.onnx", side=8 + i), "unit")
    assert len(children() - before) <= session._KEPT


@linux
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_a_signal_ends_both_at_once(tmp_path, how):
    """While the model is in a loop without end, and with nothing left behind."""
    path = networks.endless(tmp_path / "m.onnx")
    code = (
        "import sys, threading, time\n"
        "from gsmap.networks import ModelProcess\n"
        "from gsmap.types.model import ModelLimits\n"
        "import numpy as np\n"
        "model = ModelProcess(sys.argv[1], ModelLimits(600))\n"
        "print(model.pid, flush=True)\n"
        "model.run(None, {'pixels': np.ones((1, 3, 8, 8), np.float32)})\n"
    )
    parent = subprocess.Popen([sys.executable, "-c", code, str(path)], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    try:
        model = int(parent.stdout.readline())
        time.sleep(0.5)
        assert is_running(model)
        parent.send_signal(how)
        assert parent.wait(5) != 0
        end = time.monotonic() + 2
        while is_running(model) and time.monotonic() < end:
            time.sleep(0.05)
        assert not is_running(model)
    finally:
        parent.kill()
        parent.communicate()


@linux
def test_it_writes_no_files(tmp_path):
    model = ModelProcess(str(networks.image_encoder(tmp_path / "m.onnx")), ModelLimits())
    limits = Path(f"/proc/{model.pid}/limits").read_text()
    assert [line.split()[3:5] for line in limits.splitlines() if line.startswith("Max file size")] == [["0", "0"]]


def test_the_settings_of_a_map_hold_when_a_model_is_added(tmp_path):
    path = networks.endless(tmp_path / "m.onnx")
    with create(tmp_path / "a.gsmap") as m:
        m.with_settings({"describe.object.model_time_s": 1.0})
        with raises(InputError, code="model_timeout"):
            m.add_model("clip", path)
        assert m.model_rows() == []
    for name in ("model_time_s", "model_memory_mb"):
        with raises(ConfigError, code="out_of_range", match=name):
            Params(**{name: 0})


def test_the_settings_hold_when_a_scene_is_described(tmp_path):
    spec = spec_of(networks.endless(tmp_path / "m.onnx"), ModelLimits(time_s=15))
    one = Gaussians(np.zeros((1, 3)), [[1.0, 0, 0, 0]], np.full((1, 3), -3.0), [3.0], np.ones((1, 1, 3)))
    cloud = PointCloud(np.zeros((1, 3)), np.zeros((1, 3), np.float32), np.ones(1), np.zeros(1, np.int64))
    context = SceneContext(cloud, 1, None, 1.0, {"clip": spec})
    cameras = Cameras(np.eye(4)[None], [[100.0, 100, 50, 50]], [[100, 100]])
    with raises(InputError, code="model_timeout"):
        object_layer(one, cameras, context, Params(model_time_s=1.0))
    assert "limits" not in spec.to_json()
