"""Running ONNX models; the one place that knows onnxruntime."""

from __future__ import annotations

import hashlib
from functools import lru_cache
from pathlib import Path
from typing import Any

from gsmap.errors import InputError, NotFoundError
from gsmap.types.model import ModelSpec, Tensor


def open_session(spec: ModelSpec) -> Any:
    """An onnxruntime session of a checked model.

    Raises:
        NotFoundError: the file is gone.
        InputError: its bytes are not those that were checked.
    """
    path = Path(spec.path)
    if not path.is_file():
        raise NotFoundError(f"model {spec.kind} is missing: {path}; add it again with `gsmap models add`")
    if hashlib.sha256(path.read_bytes()).hexdigest() != spec.sha256:
        raise InputError(f"model {spec.kind} has changed since it was added: {path}; add it again")
    return _session(spec.path, spec.sha256)


def run(spec: ModelSpec, session: Any, outputs: list[str] | None, feed: dict[str, Any]) -> list[Any]:
    """The session's outputs; what onnxruntime raises becomes an InputError that names the model."""
    try:
        return list(session.run(outputs, feed))
    except Exception as error:  # onnxruntime raises many types
        given = ", ".join(f"{name} {list(value.shape)}" for name, value in feed.items())
        reason = str(error).splitlines()[0][:200]
        raise InputError(
            f"model {spec.kind} ({spec.path}) does not run on {given}: {reason}; add another with `gsmap models add`"
        ) from error


def declared(path: Path, sha256: str) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
    """Inputs and outputs of the model in a file whose bytes have this digest.

    Raises:
        InputError: not a model that onnxruntime runs.
    """
    session = _session(str(path), sha256)
    return tuple(map(_tensor, session.get_inputs())), tuple(map(_tensor, session.get_outputs()))


def misfit(spec: ModelSpec, problem: str) -> InputError:
    """The error for a model whose inputs and outputs are not those of its kind."""
    have = ", ".join(f"{t.name} {list(t.shape)}" for t in spec.inputs)
    return InputError(f"{spec.path} is not a {spec.kind} model: {problem}; its inputs are {have or 'none'}")


@lru_cache(maxsize=4)
def _session(path: str, sha256: str) -> Any:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4  # errors are raised as well
    try:
        return onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime raises many types, all meaning that this file cannot be run
        reason = str(error).splitlines()[0][:200]
        raise InputError(f"{path} is not an ONNX model that can be run: {reason}") from error


def _tensor(value: Any) -> Tensor:
    shape = tuple(d if isinstance(d, int) and d > 0 else None for d in value.shape)
    return Tensor(value.name, shape, value.type.removeprefix("tensor(").removesuffix(")"))
