"""Starts servers of `fault_server` and asks them."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from fault_shim import built

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]


def memory_folder() -> str | None:
    """A folder in memory, where copies and fsync cost little; None where there is none."""
    place = "/dev/shm"
    return place if os.path.isdir(place) and os.access(place, os.W_OK) else None


class Client:
    """One server with a folder of its own; both go at `close`."""

    def __init__(self) -> None:
        self.root = Path(tempfile.mkdtemp(prefix="gsmap-faults-", dir=memory_folder())).resolve()
        there = os.pathsep.join([str(ROOT), str(ROOT / "synthetic"), str(HERE), str(HERE.parent)])
        environment = os.environ | {"LD_PRELOAD": str(built()), "PYTHONPATH": there, "GSMAP_WORKERS": "1"}
        # A fork must not meet threads that other libraries keep.
        environment |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
        self._said = open(self.root / "server.log", "w+")  # noqa: SIM115
        self._process = subprocess.Popen(
            [sys.executable, str(HERE / "fault_server.py"), str(self.root)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._said,
            text=True,
            env=environment,
        )

    def ask(self, what: str, **options: Any) -> Any:
        """What the server answers.

        Raises:
            RuntimeError: it could not do that.
        """
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        print(json.dumps({"what": what, **options}), file=self._process.stdin, flush=True)
        line = self._process.stdout.readline()
        if not line:
            self._said.seek(0)
            raise RuntimeError(f"the server is gone: {self._said.read()[-2000:]}")
        answer = json.loads(line)
        if "error" in answer:
            raise RuntimeError(answer["error"])
        return answer["answer"]

    def close(self) -> None:
        self._process.kill()
        self._process.wait()
        self._said.close()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                pipe.close()
        shutil.rmtree(self.root, ignore_errors=True)

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


def faulty(point: dict[str, Any]) -> dict[str, list[str]]:
    """What was wrong at a point; empty where nothing was."""
    return {name: point[name] for name in ("lost", "tracebacks", "untrue", "repeat", "left") if point[name]}


def described(point: dict[str, Any]) -> str:
    """A point and what was wrong there, to read."""
    lines = [f"{point['verb']} {point['mode']} {point['n']} (at {point['at']}); said {point['said']}"]
    lines += [f"  {name}: {item}" for name, items in faulty(point).items() for item in items]
    return "\n".join(lines)
