"""Open sessions of ONNX models, each in a separate process (`gsmap.networks`)."""

from __future__ import annotations

import hashlib
import threading
from pathlib import Path
from typing import Any

from gsmap.errors import InputError, NotFoundError
from gsmap.networks.process import ModelProcess
from gsmap.types.model import ModelLimits, ModelSpec, Tensor

_KEPT = 4  # number of processes: an encoder, a decoder, an extractor, and one to spare
_processes: dict[tuple[str, str, ModelLimits], ModelProcess] = {}
_lock = threading.Lock()


def open_session(spec: ModelSpec) -> ModelProcess:
    """Open a checked model, which is then ready to `run` within its limits.

    Raises:
        NotFoundError: the file does not exist any more.
        InputError: the file has changed since it was checked, or does not load within its limits.
    """
    path = Path(spec.path)
    if not path.is_file():
        raise NotFoundError(
            f"the file of model {spec.kind} is missing: {path}; add it again with `gsmap models add`",
            code="model_missing",
        )
    if hashlib.sha256(path.read_bytes()).hexdigest() != spec.sha256:
        raise InputError(
            f"model {spec.kind} has changed since it was added: {path}; add it again", code="model_changed"
        )
    return _process(spec.path, spec.sha256, spec.limits)


def run(spec: ModelSpec, session: ModelProcess, outputs: list[str] | None, feed: dict[str, Any]) -> list[Any]:
    """Compute the outputs of a session.

    Raises:
        InputError: onnxruntime rejects the inputs, or the run exceeds a limit.
    """
    try:
        return list(session.run(outputs, feed))
    except RuntimeError as error:
        given = ", ".join(f"{name} {list(value.shape)}" for name, value in feed.items())
        raise InputError(
            f"model {spec.kind} ({spec.path}) does not run on {given}: {error}; add another with `gsmap models add`",
            code="model_failed",
        ) from error


def declared(path: Path, sha256: str, limits: ModelLimits) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
    """Return the inputs and outputs that a model declares; ``sha256`` is the digest of its file.

    Raises:
        InputError: not a model that onnxruntime runs within the limits.
    """
    session = _process(str(path), sha256, limits)
    return session.inputs, session.outputs


def misfit(spec: ModelSpec, problem: str) -> InputError:
    """Return the error for a model whose inputs and outputs do not fit its kind."""
    have = ", ".join(f"{t.name} {list(t.shape)}" for t in spec.inputs)
    return InputError(
        f"{spec.path} is not a {spec.kind} model: {problem}; its inputs are {have or 'none'}", code="model_misfit"
    )


def _process(path: str, sha256: str, limits: ModelLimits) -> ModelProcess:
    """Return the process of a model; the least recently used process is dropped, and ends once it is unused."""
    key = path, sha256, limits
    with _lock:
        found = _processes.pop(key, None)
        if found is None or not found.is_alive:
            found = ModelProcess(path, limits)
        _processes[key] = found
        while len(_processes) > _KEPT:
            del _processes[next(iter(_processes))]
    return found
