"""ONNX models that describe scenes: checked once, named by their digest."""

from __future__ import annotations

import hashlib
import os
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from gsmap.describe.onnx_file import refuse_external_data
from gsmap.errors import ConfigError, InputError, NotFoundError

KINDS = ("sam-encoder", "sam-decoder", "clip")
PRESETS = {  # mean and standard deviation of rgb in [0, 1]
    "clip": ((0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711)),
    "imagenet": ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225)),
    "unit": ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)),
}
SAM_SIDE_PX = 1024
# What the published SAM decoder export takes (segment-anything, scripts/export_onnx_model.py).
SAM_DECODER_INPUTS = (
    "image_embeddings",
    "point_coords",
    "point_labels",
    "mask_input",
    "has_mask_input",
    "orig_im_size",
)


@dataclass(frozen=True)
class Tensor:
    """An input or output of a model: its name, shape (None where it is free) and ONNX type such as ``float``."""

    name: str
    shape: tuple[int | None, ...]
    dtype: str


@dataclass(frozen=True)
class ModelSpec:
    """A checked ONNX model.

    Args:
        kind: ``sam-encoder``, ``sam-decoder`` or ``clip`` (any image encoder).
        path: where the file is.
        sha256: of its bytes.
        preset: how its pixels are scaled: a name, or ``mean=r,g,b;std=r,g,b``.
        mean, std: of rgb in [0, 1].
        inputs, outputs: as the file declares them.
    """

    kind: str
    path: str
    sha256: str
    preset: str
    mean: tuple[float, float, float]
    std: tuple[float, float, float]
    inputs: tuple[Tensor, ...]
    outputs: tuple[Tensor, ...]

    def to_json(self) -> dict[str, Any]:
        """Plain values, for a catalog."""
        return asdict(self)

    @property
    def digest(self) -> str:
        """What it contributes to a layer's method: the same file scaled otherwise gives other features."""
        return f"{self.kind}:{self.sha256}:{self.mean}:{self.std}"


def parse_preset(preset: str) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Mean and standard deviation of a preset's name or of ``mean=r,g,b;std=r,g,b``.

    Raises:
        ConfigError: neither, or a standard deviation that is not positive.
    """
    if preset in PRESETS:
        return PRESETS[preset]
    try:
        parts = dict(p.split("=", 1) for p in preset.replace(" ", "").split(";"))
        mean, std = (tuple(float(v) for v in parts.pop(key).split(",")) for key in ("mean", "std"))
        if len(mean) == len(std) == 3 and min(std) > 0 and max(map(abs, mean + std)) < 1e6 and not parts:
            return mean, std
    except (KeyError, ValueError):
        pass
    raise ConfigError(
        f"pixel scaling must be {', '.join(PRESETS)} or mean=r,g,b;std=r,g,b with rgb in [0, 1], got {preset!r}"
    )


def check_model(kind: str, path: str | os.PathLike[str], preset: str = "clip") -> ModelSpec:
    """Check that a file is an ONNX model of a kind, complete in itself, and say what it takes and gives.

    Raises:
        ConfigError: an unknown kind or preset.
        NotFoundError: no such file.
        InputError: not an ONNX model, weights in other files, or inputs and outputs that do not fit the kind.
    """
    if kind not in KINDS:
        raise ConfigError(f"model kind must be one of {', '.join(KINDS)}, got {kind!r}")
    mean, std = parse_preset(preset)
    path = Path(path)
    if not path.is_file():
        raise NotFoundError(f"no model file at {path}")
    refuse_external_data(path)
    sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
    session = _session(str(path), sha256)
    inputs = tuple(_tensor(t) for t in session.get_inputs())
    outputs = tuple(_tensor(t) for t in session.get_outputs())
    problem = {"sam-encoder": _sam_encoder, "sam-decoder": _sam_decoder, "clip": _image_encoder}[kind](inputs, outputs)
    if problem:
        have = ", ".join(f"{t.name} {list(t.shape)}" for t in inputs)
        raise InputError(f"{path} is not a {kind} model: {problem}; its inputs are {have or 'none'}")
    spec = ModelSpec(kind, str(path), sha256, preset, mean, std, inputs, outputs)
    if kind == "clip":
        from gsmap.describe.embedders import clip

        clip.ClipEmbedder(clip.Params(), spec)  # runs it once: declared shapes do not tell all that can go wrong
    return spec


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
        return session.run(outputs, feed)
    except Exception as error:  # onnxruntime raises many types
        given = ", ".join(f"{name} {list(value.shape)}" for name, value in feed.items())
        reason = str(error).splitlines()[0][:200]
        raise InputError(
            f"model {spec.kind} ({spec.path}) does not run on {given}: {reason}; add another with `gsmap models add`"
        ) from error


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


def is_image(tensor: Tensor) -> bool:
    """Whether a tensor holds pictures: (N, 3, H, W) or (N, H, W, 3), or (H, W, 3) as some SAM encoders take."""
    s = tensor.shape
    channels_first = len(s) == 4 and s[1] in (3, None)
    return channels_first or (len(s) in (3, 4) and s[-1] == 3)


def _image_encoder(inputs: tuple[Tensor, ...], outputs: tuple[Tensor, ...]) -> str:
    if len(inputs) != 1 or not is_image(inputs[0]) or len(inputs[0].shape) != 4:
        return "an image encoder takes one input of shape (N, 3, H, W) or (N, H, W, 3)"
    return "" if outputs else "it gives nothing"


def _sam_encoder(inputs: tuple[Tensor, ...], outputs: tuple[Tensor, ...]) -> str:
    if len(inputs) != 1 or not is_image(inputs[0]):
        return "a SAM encoder takes one image, (1, 3, 1024, 1024) or (H, W, 3)"
    if any(side not in (1, 3, SAM_SIDE_PX, None) for side in inputs[0].shape):
        return f"a SAM encoder takes images of {SAM_SIDE_PX} x {SAM_SIDE_PX} pixels"
    return "" if any(len(t.shape) == 4 for t in outputs) else "a SAM encoder gives embeddings (1, C, h, w)"


def _sam_decoder(inputs: tuple[Tensor, ...], outputs: tuple[Tensor, ...]) -> str:
    missing = [name for name in SAM_DECODER_INPUTS if name not in {t.name for t in inputs}]
    if missing:
        return f"the published SAM decoder export also takes {', '.join(missing)}"
    absent = [name for name in ("masks", "iou_predictions") if name not in {t.name for t in outputs}]
    return f"it does not give {', '.join(absent)}" if absent else ""
