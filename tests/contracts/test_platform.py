"""The one module of calls that differ between systems: no other makes them, and gsmap runs without those of Linux."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
MODULES = {"fcntl", "resource", "msvcrt", "winreg", "pwd", "grp"}
CALLS = {"sched_getaffinity", "sched_setaffinity", "memfd_create", "prctl", "pidfd_open", "posix_fadvise", "splice"}
SOURCES = [*(ROOT / "gsmap").rglob("*.py"), *(ROOT / "synthetic" / "gsmap_synthetic").rglob("*.py")]


def calls_of_one_system(path: Path) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names} & MODULES
        elif isinstance(node, ast.ImportFrom):
            found |= {str(node.module)} & MODULES
        elif isinstance(node, ast.Attribute) and node.attr in CALLS:
            found.add(node.attr)
        elif isinstance(node, ast.Attribute) and node.attr == "platform" and ast.unparse(node) == "sys.platform":
            found.add("sys.platform")
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            found |= {node.value} if node.value.startswith(("/proc", "/sys/", "/dev/shm")) else set()
    return found


def test_no_other_module_calls_one_system() -> None:
    own = ROOT / "gsmap" / "platform.py"
    assert len(calls_of_one_system(own)) > 8
    assert {path: found for path in SOURCES if path != own and (found := calls_of_one_system(path))} == {}


def run(code: str, tmp_path: Path) -> str:
    """Run code with the portable implementation, where calls of Linux fail."""
    path = os.pathsep.join([str(ROOT), str(ROOT / "synthetic"), *filter(None, [os.environ.get("PYTHONPATH")])])
    environment = os.environ | {"GSMAP_PLATFORM": "portable", "PYTHONPATH": path}
    barrier = (
        "import os\nfor name in ('sched_getaffinity', 'sched_setaffinity', 'memfd_create'): vars(os).pop(name, None)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", barrier + code], capture_output=True, text=True, env=environment, cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


def test_portable_functions(tmp_path: Path) -> None:
    code = """
import os, socket
from gsmap import platform
assert not platform.IS_LINUX
assert platform.num_processors() == os.cpu_count()
assert platform.machine_id() == socket.gethostname()
assert platform.process_start() is None and platform.user_of_connection(("127.0.0.1", 1), ("127.0.0.1", 2)) is None
memory = platform.shared_memory("x")
os.ftruncate(memory, 10)
one = os.open("lock", os.O_RDWR | os.O_CREAT)
two = os.open("lock", os.O_RDWR)
platform.lock(one)
try:
    platform.lock(two, wait=False)
except BlockingIOError:
    os.close(one)
    platform.lock(two, wait=False)
    print("locked")
with platform.pinned_thread():
    platform.end_with_thread_of_parent()
"""
    assert run(code, tmp_path) == "locked\n"


JOBS = """
def square(number):
    return number * number
"""


def test_map_workers_and_models_with_portable_functions(tmp_path: Path) -> None:
    """A map is written and read, jobs run in worker processes, and locks are owned by living processes."""
    (tmp_path / "portable_jobs.py").write_text(JOBS)
    code = """
import sys, numpy as np, gsmap
sys.path.insert(0, ".")
import portable_jobs
from gsmap.engine.executors.local import Params, start
from gsmap.types.lock_owner import this_process
points = np.random.default_rng(0).uniform(size=(50, 3)).astype(np.float32)
one, zero = np.tile(np.array([1, 0, 0, 0], np.float32), (50, 1)), np.zeros(50, np.float32)
captured = gsmap.Gaussians(points, one, np.full((50, 3), -4, np.float32), zero, np.zeros((50, 1, 3), np.float32))
with gsmap.map.create("site.gsmap") as m:
    m.ingest(captured, name="hall", scale="known")
    m.optimize()
with gsmap.open("site.gsmap") as m:
    assert [scene.name for scene in m] == ["hall"]
assert not this_process("test").is_gone
if __name__ == "__main__":
    workers = start(Params(workers=2))
    print(sorted(value for _, value in workers.run(portable_jobs.square, [(i,) for i in range(4)])))
"""
    assert run(code, tmp_path) == "[0, 1, 4, 9]\n"


def test_a_scan_is_read_with_portable_functions(tmp_path: Path) -> None:
    pytest.importorskip("laspy")
    pytest.importorskip("lazrs")
    code = """
import laspy, numpy as np
from gsmap.formats import scans
las = laspy.create(point_format=2, file_version="1.2")
las.header.scales = [0.001] * 3
las.x, las.y, las.z = np.arange(30.0).reshape(3, 10)
las.write("a.las")
print(len(scans.read("a.las")))
"""
    assert run(code, tmp_path) == "10\n"
