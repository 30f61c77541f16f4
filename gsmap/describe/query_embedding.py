"""Embed a picture or text that a user queries, comparably with the features of nodes."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from gsmap.describe.objects.layer import Params, choose_methods
from gsmap.errors import ConfigError, InputError
from gsmap.formats.pictures import open_picture
from gsmap.methods import family
from gsmap.types.model import ModelSpec
from gsmap.types.views import PointCloud, SceneContext

_MIN_PX, _MAX_PX = 8, 512  # side of a picture: smaller ones show too little, larger ones are downscaled


def embed_query_picture(
    path: str | os.PathLike[str], params: Params, models: Mapping[str, ModelSpec]
) -> tuple[np.ndarray, np.ndarray]:
    """Embed a picture of one object with the embedder of the nodes: return features (F,), and an (F,) mask of the valid
    features.

    Raises:
        NotFoundError: the file does not exist.
        InputError, MissingDependencyError: gsmap cannot read the picture, or it is too small.
        ConfigError: the embedder cannot embed a separate picture, or its model is missing.
    """
    rgb = _picture(Path(path))
    chosen = choose_methods(params, models)
    name = chosen.params.embedder
    method = family("embedder").get(name)
    lacking = [kind for kind in method.MODELS if kind not in models]
    if lacking:
        raise ConfigError(
            f"embedder {name} needs a model: gsmap models add MAP {lacking[0]} FILE.onnx", code="model_required"
        )
    limited = {kind: replace(model, limits=params.limits) for kind, model in models.items()}
    nothing = PointCloud(np.zeros((0, 3)), np.zeros((0, 3), np.float32), np.zeros(0), np.zeros(0, np.int64))
    embedder = method.make(SceneContext(nothing, 0, None, 1.0, limited), chosen.params.embedders[name])
    if not hasattr(embedder, "embed_picture"):
        raise ConfigError(
            f"embedder {name} cannot embed a picture file: query with --like SCENE:NODE",
            code="option_not_applicable",
        )
    vector, valid = embedder.embed_picture(rgb)
    return np.asarray(vector, np.float32), np.asarray(valid, bool)


def embed_query_text(text: str, params: Params, models: Mapping[str, ModelSpec]) -> np.ndarray:
    """Embed a text with the text tower of the nodes' embedder; return a unit vector (F,).

    Raises:
        ConfigError: the embedder has no text tower, or the map lacks its model.
        InputError, MissingDependencyError: see `gsmap.describe.onnx.text`.
    """
    name = choose_methods(params, models).params.embedder
    method = family("embedder").get(name)
    if not hasattr(method, "embed_text"):
        raise ConfigError(
            f"the embedder {name} reads no text: search by --like o12, --at X,Y,Z or --picture FILE, or add a CLIP "
            "model, which docs/how-to/find.md says how to get: gsmap models add MAP clip IMAGE.onnx, then clip-text "
            "TEXT.onnx and clip-tokenizer tokenizer.json",
            code="model_required",
        )
    limited = {kind: replace(model, limits=params.limits) for kind, model in models.items()}
    found: np.ndarray = method.embed_text(text, limited)
    return found


def _picture(path: Path) -> np.ndarray:
    """Read a picture (H, W, 3) uint8, downscaled to at most `_MAX_PX` on each side."""
    with open_picture(path) as image:
        picture = image.convert("RGB")
        picture.thumbnail((_MAX_PX, _MAX_PX))
        rgb = np.asarray(picture)
    if min(rgb.shape[:2]) < _MIN_PX:
        raise InputError(
            f"{path} has {rgb.shape[1]} x {rgb.shape[0]} pixels: pass a picture of at least {_MIN_PX} x {_MIN_PX}",
            code="picture_too_small",
        )
    return rgb
