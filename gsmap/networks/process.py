"""ONNX models in separate processes, which end at a time limit, when unused, and with this process."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import time
import weakref
from collections.abc import Mapping
from typing import Any

import numpy as np

from gsmap import platform
from gsmap.errors import InputError
from gsmap.networks import child
from gsmap.types.model import ModelLimits, Tensor

_MIB = 1 << 20
_MAX_S, _MAX_BYTES = 1e6, 1 << 50  # largest timeout and memory limit that the system accepts
_PER_ARRAY_BYTES = 64  # additional shared memory per array, for alignment


class ModelProcess:
    """An ONNX model that is loaded in a separate process.

    Args:
        path: path of the file.
        limits: time in seconds for loading and for each run, and memory in addition to the libraries.

    Attributes:
        inputs, outputs: inputs and outputs that the file declares.

    Raises:
        InputError: onnxruntime cannot run the model within the limits.
    """

    inputs: tuple[Tensor, ...]
    outputs: tuple[Tensor, ...]

    def __init__(self, path: str, limits: ModelLimits) -> None:
        self.path, self.limits = path, limits
        self._memory_bytes = min(limits.memory_mb * _MIB, _MAX_BYTES)
        self._time_s = min(limits.time_s, _MAX_S)
        self._lock = threading.Lock()
        self._result_bytes = 0
        link, child_link = socket.socketpair()
        shared = platform.shared_memory("gsmap-model")
        command = [sys.executable, "-P", child.__file__, str(child_link.fileno()), str(shared)]
        self._process = subprocess.Popen(
            [*command, path, str(self._memory_bytes)],
            stdin=subprocess.PIPE,  # unused, but it closes when this process ends, which ends the child
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            pass_fds=(child_link.fileno(), shared),
            start_new_session=True,  # Ctrl-C must reach only this process, which then ends the child
            env={**os.environ, "MALLOC_ARENA_MAX": "4"},  # the arenas of many threads would count as memory
        )
        child_link.close()
        self._channel = child.Channel(link, shared)
        self.close = weakref.finalize(self, _end, self._process, link, shared)
        answer, _ = self._exchange("loading it", None, {})
        if "error" in answer:
            self.close()
            raise InputError(f"{path} is not a runnable ONNX model: {answer['error']}", code="not_a_model")
        self.inputs, self.outputs = (_tensors(answer[end]) for end in ("inputs", "outputs"))

    @property
    def pid(self) -> int:
        return self._process.pid

    @property
    def is_alive(self) -> bool:
        return self.close.alive and self._process.poll() is None

    def run(self, outputs: list[str] | None, feed: Mapping[str, np.ndarray]) -> list[np.ndarray]:
        """Run the model on the given inputs.

        Args:
            outputs: names of the outputs to return; None for all.

        Raises:
            InputError: the run exceeded a limit, and its process was ended.
            RuntimeError: onnxruntime raised an error.
        """
        given = ", ".join(f"{name} {list(value.shape)}" for name, value in feed.items())
        with self._lock:
            answer, arrays = self._exchange(f"a run on {given}", outputs, feed)
            arrays = [array.copy() for array in arrays]
        if "error" in answer:
            raise RuntimeError(answer["error"])
        self._result_bytes = sum(array.nbytes + _PER_ARRAY_BYTES for array in arrays)
        return arrays

    def _exchange(
        self, what: str, outputs: list[str] | None, feed: Mapping[str, np.ndarray]
    ) -> tuple[dict[str, Any], list[np.ndarray]]:
        """Send inputs and receive outputs (or the declaration after loading); end the process at the time limit."""
        deadline = time.monotonic() + self._time_s
        try:
            if feed:
                taken = sum(array.nbytes + _PER_ARRAY_BYTES for array in feed.values())
                self._channel.reserve(max(taken, self._result_bytes))
                self._channel.link.settimeout(self._time_s)
                self._channel.send({"outputs": outputs, "names": list(feed)}, list(feed.values()))
            answer, arrays = self._channel.receive(self._memory_bytes, deadline)
        except TimeoutError as error:
            self.close()
            raise InputError(
                f"model {self.path}: {what} took more than {self.limits.time_s:g} s and was ended: allow more with "
                "--set describe.object.model_time_s=SECONDS, or use another model",
                code="model_timeout",
            ) from error
        except (EOFError, OSError, ValueError, LookupError, TypeError) as error:
            self.close()
            code = self._process.returncode
            raise self._too_large(what, signal.Signals(-code).name if code < 0 else f"code {code}") from error
        except BaseException:  # Ctrl-C: otherwise the answer of this run would be taken for that of the next
            self.close()
            raise
        if answer.get("lacks_memory"):
            self.close()
            raise self._too_large(what, "no memory left")
        return answer, arrays

    def _too_large(self, what: str, ended: str) -> InputError:
        return InputError(
            f"model {self.path}: {what} ended its process ({ended}), most likely for lack of memory: allow more than "
            f"{self.limits.memory_mb} MB with --set describe.object.model_memory_mb=MB, or use another model",
            code="model_out_of_memory",
        )


def _tensors(listed: list[Any]) -> tuple[Tensor, ...]:
    return tuple(
        Tensor(
            str(name),
            tuple(d if isinstance(d, int) and d > 0 else None for d in shape),
            str(kind).removeprefix("tensor(").removesuffix(")"),
        )
        for name, shape, kind in listed
    )


def _end(process: subprocess.Popen[bytes], link: socket.socket, shared: int) -> None:
    process.kill()
    link.close()
    os.close(shared)
    process.wait()
    if process.stdin is not None:
        process.stdin.close()
