"""Validate a model before a map accepts it."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path
from typing import Any

from gsmap.describe.onnx import text
from gsmap.errors import ConfigError, NotFoundError
from gsmap.methods import family
from gsmap.networks import refuse_external_data
from gsmap.networks.session import declared
from gsmap.types.model import ModelLimits, ModelSpec

PRESETS = {  # mean and standard deviation of rgb in [0, 1]
    "clip": ((0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711)),
    "imagenet": ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225)),
    "unit": ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)),
}


def kinds() -> dict[str, list[Any]]:
    """List all kinds of models that segmenters, embedders and extractors name, each with these methods; and the kinds
    for text.

    Raises:
        ConfigError: a method names models but has no ``probe`` for them.
    """
    found: dict[str, list[Any]] = {}
    for methods in (family("segmenter"), family("embedder"), family("extractor")):
        for name in methods.usable():
            method = methods.get(name)
            if method.MODELS and not hasattr(method, "probe"):
                raise ConfigError(
                    f"{methods.name} {name!r} has no function probe: see the contract in gsmap.methods.{methods.name}",
                    code="invalid_method",
                )
            for kind in method.MODELS:
                found.setdefault(kind, []).append(method)
    return found | {kind: [] for kind in text.KINDS}


def parse_preset(preset: str) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Parse mean and standard deviation from a preset's name or ``mean=r,g,b;std=r,g,b``.

    Raises:
        ConfigError: the text is neither, or a standard deviation is not positive.
    """
    if preset in PRESETS:
        return PRESETS[preset]
    try:
        parts = dict(p.split("=", 1) for p in preset.replace(" ", "").split(";"))
        mean, std = (tuple(float(v) for v in parts.pop(key).split(",")) for key in ("mean", "std"))
        if len(mean) == len(std) == 3 and min(std) > 0 and max(map(abs, mean + std)) < 1e6 and not parts:
            return (mean[0], mean[1], mean[2]), (std[0], std[1], std[2])
    except (KeyError, ValueError):
        pass
    raise ConfigError(
        f"pixel scaling must be {', '.join(PRESETS)} or mean=r,g,b;std=r,g,b with rgb in [0, 1], got {preset!r}",
        code="invalid_choice",
    )


def check_model(
    kind: str, path: str | os.PathLike[str], preset: str = "clip", limits: ModelLimits | None = None
) -> ModelSpec:
    """Validate an ONNX file as a model of a kind: it must be complete, and usable by the methods that need it.

    Args:
        kind: one of `kinds`.
        preset: see `parse_preset`.
        limits: time and memory limits of the model, now and wherever this spec is used.

    Raises:
        ConfigError: the kind or preset is unknown.
        NotFoundError: the file does not exist.
        InputError: the file is not an ONNX model, has weights in other files, takes too long or too much memory, or is
            rejected by a method's ``probe``.
    """
    known = kinds()
    if kind not in known:
        raise ConfigError(f"model kind must be one of {', '.join(sorted(known))}, got {kind!r}", code="invalid_choice")
    mean, std = parse_preset(preset)
    path = Path(path)
    if not path.is_file():
        raise NotFoundError(f"there is no model file {path}", code="file_not_found")
    if kind == text.TOKENIZER:
        return text.check_tokenizer(path)
    refuse_external_data(path)
    sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
    limits = limits or ModelLimits()
    spec = ModelSpec(kind, str(path), sha256, preset, mean, std, *declared(path, sha256, limits), limits)
    for method in known[kind]:
        method.probe(spec)
    if kind == text.TEXT:
        text.probe_text(spec)
    return spec
