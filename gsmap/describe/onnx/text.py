"""Text embedding with the model pack of the image encoder ``clip``: its text tower (``clip-text``, ONNX) and its
tokenizer (``clip-tokenizer``, ``tokenizer.json``)."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gsmap.errors import ConfigError, InputError, MissingDependencyError, NotFoundError
from gsmap.networks.session import misfit, open_session, run
from gsmap.types.model import ModelSpec, Tensor

TEXT, TOKENIZER = "clip-text", "clip-tokenizer"
KINDS = (TEXT, TOKENIZER)

_MAX_CHARACTERS = 1000
_MAX_BYTES = 64 << 20  # of a tokenizer; published tokenizers have 2 to 20 MB
_CONTEXT = 77  # number of tokens with which CLIP was trained, for towers that accept any number
_OUTPUTS = ("text_embeds", "text_embedding", "embedding", "embeddings", "sentence_embedding", "pooler_output")
_IMAGE_DIMS = 4


def embed(text: str, models: Mapping[str, ModelSpec]) -> np.ndarray:
    """Compute the unit vector (F,) float32 of a text.

    Raises:
        ConfigError: the map lacks the text tower or its tokenizer.
        InputError: the text is too long, or the tower does not run on it.
        MissingDependencyError: the package tokenizers is not installed.
    """
    missing = [kind for kind in KINDS if kind not in models]
    if missing:
        files = {TEXT: "TEXT.onnx", TOKENIZER: "tokenizer.json"}
        verbs = " and ".join(f"gsmap models add MAP {kind} {files[kind]}" for kind in missing)
        raise ConfigError(
            f"a text query needs the text tower of the map's image encoder. Add it: {verbs}; or query by "
            "--picture FILE, --like SCENE:NODE or --at X,Y,Z",
            code="model_required",
        )
    if len(text) > _MAX_CHARACTERS:
        raise InputError(
            f"the query has {len(text)} characters, more than {_MAX_CHARACTERS}: use a few words", code="invalid_query"
        )
    spec = models[TEXT]
    fixed = _ids_of(spec).shape[1]
    ids, mask = _tokens(text, models[TOKENIZER], fixed or _CONTEXT, pad=fixed is not None)
    found = _run(spec, ids, mask)
    norm = float(np.linalg.norm(found))
    if not np.isfinite(norm) or norm <= 0:
        raise InputError(
            f"model {TEXT} ({spec.path}) returns a zero or infinite vector for {text!r}: use other words",
            code="invalid_query",
        )
    return (found / norm).astype(np.float32)


def probe_text(spec: ModelSpec) -> None:
    """Reject a model that is not a text tower, by running it once.

    Raises:
        InputError: the model's inputs and outputs do not fit, or it does not run.
    """
    if any(len(tensor.shape) == _IMAGE_DIMS for tensor in spec.inputs):
        raise misfit(spec, "the model also takes images: export the text tower alone")
    if not spec.outputs:
        raise misfit(spec, "the model has no outputs")
    length = _ids_of(spec).shape[1] or _CONTEXT
    ids = np.zeros((1, length), np.int64)
    _run(spec, ids, np.ones_like(ids))


def check_tokenizer(path: Path) -> ModelSpec:
    """Validate a ``tokenizer.json``, which is stored beside the models.

    Raises:
        InputError: the file is not a tokenizer.
        MissingDependencyError: the package tokenizers is not installed.
    """
    if path.stat().st_size > _MAX_BYTES:
        raise InputError(
            f"{path} is too large for a tokenizer: pass the tokenizer.json of the model pack", code="invalid_tokenizer"
        )
    _tokenizer(path)
    sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
    return ModelSpec(TOKENIZER, str(path), sha256, "unit", (0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (), ())


def _tokens(text: str, spec: ModelSpec, length: int, *, pad: bool) -> tuple[np.ndarray, np.ndarray]:
    """Tokenize a text: return (1, L) ids, and a (1, L) mask.

    Args:
        length: largest number of tokens.
        pad: pad to ``length`` with the tokenizer's padding token or, as CLIP does, with the end token.
    """
    path = Path(spec.path)
    if not path.is_file():
        raise NotFoundError(
            f"the tokenizer file {path} is missing; add it again with gsmap models add", code="model_missing"
        )
    if hashlib.sha256(path.read_bytes()).hexdigest() != spec.sha256:
        raise InputError(
            f"the tokenizer file {path} has changed since it was added; add it again",
            code="model_changed",
        )
    tokenizer = _tokenizer(path)
    own = tokenizer.padding
    tokenizer.no_padding()
    tokenizer.enable_truncation(max_length=length)
    ids = list(tokenizer.encode(text).ids)
    if not ids:
        raise InputError(f"the tokenizer {path} returns no tokens for {text!r}: use other words", code="invalid_query")
    empty = int(own["pad_id"]) if own else ids[-1]
    rest = length - len(ids) if pad else 0
    found = np.array([ids + [empty] * rest], np.int64)
    return found, np.array([[1] * len(ids) + [0] * rest], np.int64)


def _tokenizer(path: Path) -> Any:
    try:
        from tokenizers import Tokenizer
    except ImportError as error:
        raise MissingDependencyError("text queries need the package tokenizers", extra="text") from error
    try:
        return Tokenizer.from_file(str(path))
    except Exception as error:  # the package raises plain exceptions for all problems
        raise InputError(f"{path} is not a readable tokenizer.json: {error}", code="invalid_tokenizer") from error


def _ids_of(spec: ModelSpec) -> Tensor:
    """Return the input that takes the tokens."""
    takes = [t for t in spec.inputs if len(t.shape) == 2 and not any(w in t.name for w in ("mask", "type", "position"))]
    if len(takes) != 1:
        raise misfit(spec, "a text tower takes tokens of shape (N, L), and optionally a mask of the same shape")
    return takes[0]


def _run(spec: ModelSpec, ids: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Run the tower on the tokens of one text; return a vector (F,)."""
    feed = {}
    for tensor in spec.inputs:
        value = ids
        if "mask" in tensor.name:
            value = mask
        elif "type" in tensor.name:
            value = np.zeros_like(ids)
        elif "position" in tensor.name:
            value = np.arange(ids.shape[1])[None]
        rows = tensor.shape[0] or 1
        feed[tensor.name] = np.repeat(value, rows, axis=0).astype(np.int32 if tensor.dtype == "int32" else np.int64)
    named = [tensor.name for tensor in spec.outputs if tensor.name in _OUTPUTS]
    flat = [tensor.name for tensor in spec.outputs if len(tensor.shape) == 2]
    output = (named or flat or [spec.outputs[0].name])[0]
    found = np.asarray(run(spec, open_session(spec), [output], feed)[0], np.float32)
    if found.ndim != 2 or not found.shape[1]:
        raise misfit(spec, f"the output {output} has shape {list(found.shape)}, but one vector per text is needed")
    return found[0]
