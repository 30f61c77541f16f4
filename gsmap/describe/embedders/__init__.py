"""Embedders: one file each; from the masks of a view to feature vectors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np

from gsmap.describe.models import ModelSpec
from gsmap.describe.segmenters import Mask
from gsmap.describe.views import View
from gsmap.errors import ConfigError


class Embedder(Protocol):
    """Describes masks by vectors whose cosine says how alike two things look.

    ``codebook`` (K, F) holds unit vectors that context histograms are counted over: it depends on the embedder alone,
    never on data, so that histograms of all scenes of all maps compare.
    """

    codebook: np.ndarray

    def embed(self, view: View, masks: Sequence[Mask], points: Sequence[np.ndarray]) -> np.ndarray:
        """(R, F) float32 unit vectors of the masks; ``points`` are the surface points (n, 3) that each shows."""
        ...


EMBEDDERS = ("builtin", "clip")


def params_of(name: str) -> object:
    """The default parameters of an embedder.

    Raises:
        ConfigError: no embedder of that name.
    """
    if name == "builtin":
        from gsmap.describe.embedders import builtin as module
    elif name == "clip":
        from gsmap.describe.embedders import clip as module
    else:
        raise ConfigError(f"there is no embedder {name!r}; choose {' or '.join(EMBEDDERS)}")
    return module.Params()


def make_embedder(
    name: str, params: object, up: np.ndarray | None, unit_m: float, models: Mapping[str, ModelSpec]
) -> Embedder:
    """An embedder ready for the views of one scene.

    Raises:
        ConfigError: no embedder of that name, or its model was not given.
    """
    if name == "builtin":
        from gsmap.describe.embedders.builtin import BuiltinEmbedder

        return BuiltinEmbedder(params, up, unit_m)
    params_of(name)
    from gsmap.describe.embedders.clip import ClipEmbedder

    if "clip" not in models:
        raise ConfigError("embedder clip needs an image encoder: add one with `gsmap models add MAP clip FILE.onnx`")
    return ClipEmbedder(params, models["clip"])
